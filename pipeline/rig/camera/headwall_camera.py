"""The camera's driver: its control socket, one command at a time, and its files, as a line camera for surveys."""

from __future__ import annotations

import logging
import re
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Self, TypeVar

from pipeline.errors import RigError, SettingsError
from pipeline.rig.camera.camera_cubes import CapturedLines, MeanFrame, Read, mean_frame, read_capture, read_references
from pipeline.rig.camera.camera_files import Kept, Progress, RemoteFile, fetch_files
from pipeline.rig.camera.headwall_replies import (
    MisfitError,
    ReplyReader,
    as_folder,
    as_listing,
    as_truth,
    check_repeated,
    check_times_set,
    response_of,
    to_request,
)
from pipeline.rig.device_settings import (
    CameraAddress,
    CameraLimits,
    ControlPatience,
    FileServer,
    check_capture,
    check_times,
)
from pipeline.rig.drivers import Capture, FrameClaim
from pipeline.rig.transports import (
    SYSTEM_CLOCK,
    Clock,
    DeadlinePassed,
    DeviceRefused,
    SocketTransport,
    StateUnknown,
    Transport,
)

LOG = logging.getLogger(__name__)
LONGEST_GREETING = 1 << 16  # bytes
CAPTURE_ROOT = "/captured"  # where new folders appear; assumed, the reply to a capture shows it
MOST_PASSED_OVER = 32  # replies to other commands, while one is waited for
Answer = TypeVar("Answer")
MOST_TEXT = 1 << 26  # bytes of a header, a frame index or another text: an index of two million frames
MOST_OFFSET = 1 << 16  # bytes before the first frame of a cube; cameras write none
MOST_REFERENCE_FRAMES = 2048
MOST_FILES = 4096
_RAW = re.compile(r"raw_\d+", re.IGNORECASE)
_REFERENCE = re.compile(r"(dark|white)[a-z_]*", re.IGNORECASE)


class CaptureUnknown(StateUnknown):
    """A capture was sent and not acknowledged; what was found on asking stands in the message."""


class HeadwallCamera:
    """A line camera for surveys: its commands and its files. Nothing is connected before the first command.

    After a late or damaged reply the connection is closed and opened again. So a late answer is never taken for the
    next command's reply. ``connect`` makes a connection. Commands raise DeviceRefused, DeadlinePassed or DeviceGone
    besides what they say themselves.
    """

    def __init__(
        self,
        connect: Callable[[], Transport],
        server: FileServer,
        *,
        clock: Clock = SYSTEM_CLOCK,
        patience: ControlPatience | None = None,
        limits: CameraLimits | None = None,
    ) -> None:
        self.server = server
        self.patience = ControlPatience() if patience is None else patience
        self.limits = CameraLimits() if limits is None else limits
        self.clock = clock
        self.unknown = ""  # why it is unknown whether a capture runs; empty where it is known
        self._connect = connect
        self._line: Transport | None = None
        self._reader = ReplyReader()
        self._lock = threading.RLock()

    @classmethod
    def at(cls, address: CameraAddress, server: FileServer, *, clock: Clock = SYSTEM_CLOCK, **given: Any) -> Self:
        """Return a camera on the network."""

        def connect() -> SocketTransport:
            return SocketTransport(address.host, address.port, clock, connect_s=address.connect_s)

        return cls(connect, server, clock=clock, **given)

    def configure(self, exposure_ms: float, frame_period_ms: float) -> None:
        """Set exposure and frame period. [ms]

        Raises SettingsError as :func:`check_times` does, RigError where the camera says that it set others, and
        StateUnknown where a capture may be running, see ``capture``.
        """
        check_times(exposure_ms, frame_period_ms, self.limits)
        with self._lock:
            self._check_known("configure")
            times = {"exposure": exposure_ms, "framePeriod": frame_period_ms}
            self._ask("configure", times, lambda response: check_times_set(response, times))

    def capture(self, frames: int, *, cubes: int = 1, prefix: str = "") -> Capture:
        """Begin a capture of ``cubes`` files (0: until stopped) of ``frames`` lines (0: the camera's own number).

        Sent once. If no reply comes, the camera is asked whether it captures and which folders are new, and the error
        says so. Captures and settings are refused from then on: a person looks, and connects anew. Raises
        CaptureUnknown then, and SettingsError where a number or the prefix cannot be used.
        """
        check_capture(frames, cubes, prefix)
        with self._lock:
            self._check_known("capture")
            before = self._folders()
            self._open()
            sent_s = self.clock.now()
            try:
                folder = self._once(
                    "capture", {"prefix": prefix, "maxCubes": cubes, "maxFramesPerCube": frames}, as_folder
                )
            except DeviceRefused:
                raise
            except RigError as error:
                self._hang_up()
                raise self._find_out(error, before, prefix) from error
            except BaseException:  # interrupted while it waited
                self.unknown = "a capture was sent and the wait for its reply was interrupted"
                self._hang_up()
                raise
            return Capture(folder, sent_s, self.clock.now())

    def is_capturing(self) -> bool:
        """Ask whether a capture runs."""
        return self._ask("isCapturing", None, as_truth)

    def stop(self) -> bool:
        """End a capture; False where none ran. Stopping twice does no harm, so it is asked again without a reply."""
        try:
            return self._ask("stopCapture", None, lambda response: response is not False)
        except DeviceRefused:
            if self.is_capturing():
                raise
            return False

    def list_files(self, folder: str) -> list[RemoteFile]:
        """List one folder, in the order of names; SettingsError for an empty name."""
        if not folder:
            raise SettingsError("expected a folder of the camera to list, such as /captured, got an empty name")
        return self._ask("listFiles", folder, as_listing)

    def fetch(
        self, folder: str, kept: Kept, progress: Progress | None = None, *, claim: FrameClaim | None = None
    ) -> CapturedLines:
        """Get a finished capture's files, small ones first, and give its lines; a later call continues.

        RigError where the capture still runs, its files do not belong together, or are larger than ``claim`` lets them
        be; DeviceRefused, DeadlinePassed, DeviceGone.
        """
        files = self._finished(folder, claim)
        files.sort(key=lambda file: (bool(_RAW.fullmatch(file.base)), file.name))
        fetch_files(self.server, files, kept, progress, clock=self.clock)
        return read_capture([file.name for file in files], _reader(kept))

    def references(self, folder: str, kept: Kept, *, claim: FrameClaim | None = None) -> dict[str, MeanFrame]:
        """Return the mean frames of the reference cubes in a capture's folder, by ``dark`` and ``white``.

        Empty without any.
        """
        files = [file for file in self._finished(folder, claim) if file.base.lower().startswith(("dark", "white"))]
        fetch_files(self.server, files, kept, clock=self.clock)
        cubes = read_references([file.name for file in files], _reader(kept))
        return {kind: mean_frame(cube.values) for kind, cube in cubes.items()}

    def close(self) -> None:
        """Say exit and hang up. A capture continues; nothing is raised."""
        with self._lock:
            if self._line is not None:
                try:
                    self._line.write(to_request("exit"), self.clock.now() + self.patience.deadline_s)
                except RigError as error:
                    LOG.info("the camera was gone before exit: %s", error)
            self._hang_up()

    def _ask(self, name: str, argument: Any, check: Callable[[Any], Answer]) -> Answer:
        """Ask what may be asked twice: again after a lost, late or damaged reply, on a new connection."""
        with self._lock:
            for left in range(self.patience.retries, -1, -1):
                try:
                    self._open()
                    return self._once(name, argument, check)
                except DeviceRefused:
                    raise
                except RigError as error:
                    self._hang_up()
                    if not left:
                        raise
                    LOG.info("%s; asking again", error)
                    self.clock.sleep(self.patience.pause_s)
            raise AssertionError("unreachable")

    def _open(self) -> None:
        """Open a connection that stands at its prompt, with no earlier input left over."""
        if self._line is not None:
            try:
                if stale := self._reader.held + self._line.drain():
                    LOG.warning("%s: dropped %d stale bytes: %r", self._line.port, len(stale), stale[:64])
                self._reader = ReplyReader()
                return
            except RigError as error:
                LOG.info("%s; connecting again", error)
                self._hang_up()
        self._line, self._reader = self._connect(), ReplyReader()
        try:
            self._greet(self._line)
        except RigError:
            self._hang_up()
            raise

    def _greet(self, line: Transport) -> None:
        """Wait for the first prompt, whatever stands before it, not even a line's end."""
        deadline = self.clock.now() + self.patience.deadline_s
        came = b""
        while self.clock.now() < deadline:
            data = line.read(65536, deadline)
            came += data
            if b"hpi> " in came:
                return
            if len(came) > LONGEST_GREETING:
                raise RigError(f"{line.port} greets without end ({_told(came)}); is this the camera's control port?")
        raise DeadlinePassed(
            f"{line.port} sent no prompt 'hpi> ' within {self.patience.deadline_s:g} s ({_told(came)}); "
            "is this the camera's control port (8100)?"
        )

    def _once(self, name: str, argument: Any, check: Callable[[Any], Answer]) -> Answer:
        """Send one command and wait for its own reply; replies to others are passed over."""
        line = self._line
        assert line is not None
        deadline = self.clock.now() + self.patience.deadline_s
        request = to_request(name, argument)
        line.write(request, deadline)
        passed_over: list[str] = []
        while self.clock.now() < deadline:
            for said in self._reader.feed(line.read(65536, deadline)):
                why = f"a reply to {said.command}" if said.command not in ("", name) else ""
                if not why:
                    check_repeated(said, request.decode().rstrip("\r"), line.port)
                    response = response_of(said, name, line.port)
                    try:
                        return check(response)
                    except MisfitError as misfit:
                        why = str(misfit)
                LOG.warning("%s, while waiting for %s: %s: %.200s", line.port, name, why, said.text)
                passed_over.append(said.text[:80])
                if len(passed_over) > MOST_PASSED_OVER:
                    raise RigError(
                        f"{line.port} answers {name} with {len(passed_over)} replies to others; does another program "
                        "talk to the camera? End that first"
                    )
        came = self._reader.held or " | ".join(passed_over).encode()
        raise DeadlinePassed(
            f"no reply to {name} from {line.port} within {self.patience.deadline_s:g} s ({_told(came)}); "
            "is the camera on, and not busy writing? A longer deadline_s waits longer"
        )

    def _hang_up(self) -> None:
        if self._line is not None:
            self._line.close()
        self._line = None

    def _check_known(self, name: str) -> None:
        if self.unknown:
            raise StateUnknown(
                f"{name} is refused: {self.unknown}, so whether the camera captures is not known. Look at the "
                "camera, stop what runs there, then run again, which connects anew"
            )

    def _folders(self) -> set[str] | None:
        """Return the folders of the capture root; None where the camera does not list it."""
        try:
            return {entry.name for entry in self.list_files(CAPTURE_ROOT)}
        except DeviceRefused as error:
            LOG.warning("%s: a capture whose reply is lost will not be found by its folder", error)
            return None

    def _find_out(self, error: RigError, before: set[str] | None, prefix: str) -> CaptureUnknown:
        """Freeze, ask the camera what it does, and say it."""
        self.unknown = "a capture was sent and not acknowledged"
        try:
            does = "captures" if self.is_capturing() else "does not capture"
            now = None if before is None else self._folders()
            new = sorted(now - before) if before is not None and now is not None else []
            found = f"asked again it {does}, and new are {'the folders ' + ', '.join(new) if new else 'no folders'}"
        except RigError as other:
            found = f"asked again it does not answer: {other}"
        return CaptureUnknown(
            f"capture (prefix {prefix!r}) was sent and its reply is lost: {error}. It is not sent again; {found}. "
            "Look at the camera, stop what runs there, then run again, which connects anew"
        )

    def _finished(self, folder: str, claim: FrameClaim | None) -> list[RemoteFile]:
        """Return the files of a folder once two listings in a row agree.

        A listing that lost an entry on its way looks whole.
        """
        if self.is_capturing():
            raise RigError(f"a capture still runs, so files of {folder} may grow; wait for its end, or stop it")
        listed = self.list_files(folder)
        for _ in range(self.patience.retries + 1):
            before, listed = listed, self.list_files(folder)
            if listed == before:
                files = [file for file in listed if not file.folder]
                return files if claim is None else bounded(files, claim)
        raise RigError(f"{folder} was listed differently each time; look at the camera's network, then run again")


def _told(came: bytes) -> str:
    return f"{len(came)} bytes came: {came[:80]!r}" if came else "nothing came"


def _reader(kept: Kept) -> Read:
    return lambda name: kept.read(name, 0, kept.size(name))


def bounded(files: Sequence[RemoteFile], claim: FrameClaim) -> list[RemoteFile]:
    """Return the files with the most that each can have: cubes what was asked for, references and texts a fixed number.

    RigError where one claims more, or all cubes together do, or there are too many files.
    """
    if len(files) > MOST_FILES:
        raise RigError(f"the camera lists {len(files)} files in one capture, expected {MOST_FILES} at most; look there")
    found, cubes = [], []
    for file in files:
        most = MOST_TEXT
        if _RAW.fullmatch(file.base):
            most = claim.frames * claim.frame_bytes + MOST_OFFSET
            cubes.append(file)
        elif _REFERENCE.fullmatch(file.base):
            most = MOST_REFERENCE_FRAMES * claim.frame_bytes + MOST_OFFSET
        _check(file.name, file.size or 0, most)
        found.append(replace(file, most=most))
    if cubes:
        most = claim.frames * claim.frame_bytes + len(cubes) * MOST_OFFSET
        _check(f"{cubes[0].name} with the cubes beside it", sum(file.size or 0 for file in cubes), most)
    return found


def _check(name: str, size: int, most: int) -> None:
    if size > most:
        raise RigError(
            f"{name} is said to have {size} bytes, expected {most} at most; nothing of it is fetched: look at what the "
            "camera wrote, and at camera.samples and the wavelengths in the settings"
        )
