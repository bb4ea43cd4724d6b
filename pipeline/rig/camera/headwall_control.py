"""The camera's control socket: one command at a time, each with a deadline, captures sent once and never again."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

from pipeline.errors import RigError, SettingsError
from pipeline.rig.camera.camera_files import RemoteFile
from pipeline.rig.camera.headwall_replies import (
    MisfitError,
    ReplyReader,
    as_folder,
    as_listing,
    as_stopped,
    as_truth,
    check_repeated,
    check_times_set,
    response_of,
    to_request,
)
from pipeline.rig.device_settings import CameraLimits, ControlPatience, check_capture, check_times
from pipeline.rig.devices import SYSTEM_CLOCK, Clock, DeadlinePassed, DeviceRefused, StateUnknown
from pipeline.rig.transports import Transport

LOG = logging.getLogger(__name__)
LONGEST_GREETING = 1 << 16  # bytes
CAPTURE_ROOT = "/captured"  # where new folders appear; assumed, the reply to a capture shows it
MOST_PASSED_OVER = 32  # replies to other commands, while one is waited for
Answer = TypeVar("Answer")


@dataclass(frozen=True)
class Capture:
    """A capture that the camera acknowledged."""

    folder: str
    sent_s: float  # when the command was sent, by the clock of the rig's drivers
    acknowledged_s: float  # when its reply was whole: exposures began between the two, or soon after


class CaptureUnknown(StateUnknown):
    """A capture was sent and not acknowledged; what was found on asking stands in the message."""


class HeadwallControl:
    """Commands to the camera.

    After a reply that was late or damaged the connection is given up and made anew, so that what comes late is never
    taken for the next command's reply. ``connect`` makes a connection. Commands raise DeviceRefused, DeadlinePassed or
    DeviceGone besides what they say themselves.
    """

    def __init__(
        self,
        connect: Callable[[], Transport],
        *,
        clock: Clock = SYSTEM_CLOCK,
        patience: ControlPatience | None = None,
        limits: CameraLimits | None = None,
    ) -> None:
        self.patience = ControlPatience() if patience is None else patience
        self.limits = CameraLimits() if limits is None else limits
        self.clock = clock
        self.unknown = ""  # why nobody knows whether a capture runs; empty where it is known
        self._connect = connect
        self._line: Transport | None = None
        self._reader = ReplyReader()
        self._lock = threading.RLock()

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

        Sent once. Where no reply comes the camera is asked whether it captures and which folders are new, and that is
        said in the error; captures and settings are refused from then on: a person looks, and connects anew.
        Raises CaptureUnknown then, and SettingsError where a number or the prefix cannot be used.
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
            return self._ask("stopCapture", None, as_stopped)
        except DeviceRefused:
            if self.is_capturing():
                raise
            return False

    def list_files(self, folder: str) -> list[RemoteFile]:
        """List one folder, in the order of names; SettingsError for an empty name."""
        if not folder:
            raise SettingsError("expected a folder of the camera to list, such as /captured, got an empty name")
        return self._ask("listFiles", folder, as_listing)

    def close(self) -> None:
        """Say exit and hang up. A capture goes on; nothing is raised."""
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
        """Have a connection that stands at its prompt, with nothing left over from before."""
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
        """Folders of the capture root; None where the camera does not list it."""
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


def _told(came: bytes) -> str:
    return f"{len(came)} bytes came: {came[:80]!r}" if came else "nothing came"
