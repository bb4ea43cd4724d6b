"""The camera's driver: commands and replies of its control socket, and its files, as a line camera for surveys.

A command is ``name`` or ``name(JSON)`` and a carriage return. The camera repeats that line (some versions do not), and
sends ``{"success": ..., "response": ..., "errorMessage": ...}`` and the prompt ``hpi> ``.
"""

from __future__ import annotations

import json
import logging
import re
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self, TypeVar

from pipeline.errors import RigError, SettingsError
from pipeline.rig.camera.camera_cubes import CapturedLines, MeanFrame, Read, mean_frame, read_capture, read_references
from pipeline.rig.camera.camera_files import (
    Capture,
    FrameClaim,
    Kept,
    Progress,
    RemoteFile,
    check_remote_name,
    fetch_files,
)
from pipeline.rig.device_settings import (
    CameraAddress,
    CameraLimits,
    ControlPatience,
    FileServer,
    check_prefix,
    check_times,
)
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
COMMANDS = ("configure", "capture", "isCapturing", "stopCapture", "listFiles")
LONGEST_REPLY = 1 << 24  # bytes: a listing of a hundred thousand files
Answer = TypeVar("Answer")
TIMES_ALIKE = 0.01  # of a time: cameras round them
MOST_TEXT = 1 << 26  # bytes of a header, a frame index or another text: an index of two million frames
MOST_OFFSET = 1 << 16  # bytes before the first frame of a cube; cameras write none
MOST_REFERENCE_FRAMES = 2048
_RAW = re.compile(r"raw_\d+", re.IGNORECASE)
_REFERENCE = re.compile(r"(dark|white)[a-z_]*", re.IGNORECASE)
_PROMPT = re.compile(rb"(?:\A|(?<=[\r\n}]))hpi> ")  # a reply may hold the word, but not there
_NEGOTIATION = re.compile(rb"\xff[\xfb-\xfe].", re.DOTALL)  # of telnet; UTF-8 never holds the byte FF
_UNFIT = re.compile(r"[\x00-\x1f\x7f-\x9f\ud800-\udfff]")
# words of a refusal -> what to do about it
_REMEDIES = (
    (("full", "space", "storage"), "copy the folders on the camera's disk to another and delete them there"),
    (("busy", "already", "progress", "in use"), "wait until it is done, or stop it with its own program; run again"),
    (("exposure", "period"), "give an exposure that is not longer than the frame period, both in ms"),
    (("folder", "directory", "file", "path"), "list the folder above it and take a name from there"),
)


@dataclass(frozen=True)
class CameraReply:
    """A reply: the command that it repeats, if any, its JSON, if it is such, and the text for messages."""

    command: str
    content: dict[str, Any] | None
    text: str


def to_request(name: str, argument: Any = None) -> bytes:
    """Return the bytes of a command."""
    text = name if argument is None else f"{name}({json.dumps(argument)})"
    return text.encode("ascii") + b"\r"


class ReplyReader:
    """Takes bytes as they come and gives the replies whose prompt is there."""

    def __init__(self) -> None:
        self.held = b""  # bytes that no prompt has followed yet

    def feed(self, data: bytes) -> list[CameraReply]:
        """Take bytes; return the replies that they complete. RigError where more came than any reply has."""
        *texts, self.held = _PROMPT.split(_NEGOTIATION.sub(b"", self.held + data))
        if len(self.held) > LONGEST_REPLY:
            raise RigError(f"{len(self.held)} bytes came without a prompt 'hpi> '; is this the camera's control port?")
        return [_parse(text) for text in texts]


def _parse(data: bytes) -> CameraReply:
    """Return the reply before a prompt; its command and text are empty where only a line end came."""
    text = data.decode("utf-8", errors="replace").strip("\0 \t\r\n")
    echo, body = "", text
    if not text.startswith("{"):
        echo, _, body = text.replace("\n", "\r").partition("\r")
    try:
        content = json.loads(body)
    except ValueError:
        content = None
    command = echo.split("(")[0].strip()
    return CameraReply(command if command in COMMANDS else "", content if isinstance(content, dict) else None, text)


def response_of(reply: CameraReply, name: str, port: str) -> Any:
    """Return the response of a reply that reports success.

    Raises DeviceRefused, with the remedy: it reports a failure. Raises RigError: it is no such reply.
    """
    success = None if reply.content is None else reply.content.get("success")
    if reply.content is None or not isinstance(success, bool):
        raise RigError(
            f"{port} answered {name} with {reply.text[:200]!r}, expected JSON with success true or false; is this the "
            "camera's control port?"
        )
    if not success:
        reason = _UNFIT.sub("?", str(reply.content.get("errorMessage") or "no reason given"))[:300]
        fitting = (what for words, what in _REMEDIES if any(word in reason.lower() for word in words))
        raise DeviceRefused(
            f"the camera at {port} refused {name}: {reason}; {next(fitting, 'see the manual of the camera')}"
        )
    return reply.content.get("response")


def as_folder(response: Any) -> str:
    """Return the folder of a capture; RigError where the response has none."""
    folder = response.get("folder") if isinstance(response, dict) else None
    if not isinstance(folder, str) or not folder:
        raise RigError(f"expected the folder of the capture from the camera, got {response!r:.100}")
    check_remote_name(folder)
    return folder


def as_truth(response: Any) -> bool:
    """Return whether a capture runs; RigError where the response does not say."""
    value = response.get("capturing") if isinstance(response, dict) else response
    if not isinstance(value, bool):
        raise RigError(f"expected true or false from the camera, got {value!r:.100}")
    return value


def as_listing(response: Any) -> list[RemoteFile]:
    """Return the entries of a folder, by name; RigError where the response is no list of files."""
    found = []
    for entry in response if isinstance(response, list) else [response]:
        name = entry.get("name") if isinstance(entry, dict) else None
        if not isinstance(name, str):
            raise RigError(f"expected a list of files from the camera, got {entry!r:.100}")
        check_remote_name(name)
        try:
            size = max(int(entry.get("size")), 0)
        except (TypeError, ValueError, OverflowError):
            size = None
        found.append(RemoteFile(re.sub("/{2,}", "/", name), size, bool(entry.get("isDirectory"))))
    return sorted(found, key=lambda entry: entry.name)


def check_times_set(response: Any, asked_ms: Mapping[str, float]) -> None:
    """Raise RigError where the response states other times than were asked for. [ms]"""
    stated = response if isinstance(response, dict) else {}
    for name, wanted in asked_ms.items():
        found = stated.get(name, wanted)
        if not isinstance(found, int | float) or not abs(found - wanted) <= TIMES_ALIKE * wanted:
            raise RigError(
                f"the camera set {name} to {found!r:.40} ms, asked was {wanted:g} ms; give a time that it supports"
            )


class HeadwallCamera:
    """A line camera for surveys, a `pipeline.rig.drivers.CameraDriver`. The first command connects.

    After a late or damaged reply the connection is closed and opened again, so that a late reply never answers the next
    command. ``connect`` makes a connection. Commands may also raise DeviceRefused, DeadlinePassed or DeviceGone.
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

        Raises SettingsError as :func:`check_times`, RigError where the camera reports other times, and StateUnknown
        where a capture may be running, see ``capture``.
        """
        check_times(exposure_ms, frame_period_ms, self.limits)
        with self._lock:
            self._check_known("configure")
            times = {"exposure": exposure_ms, "framePeriod": frame_period_ms}
            self._ask("configure", times, lambda response: check_times_set(response, times))

    def capture(self, frames: int, *, prefix: str = "") -> Capture:
        """Begin a capture of ``frames`` lines in one file. The command is sent once.

        Raises StateUnknown where no reply comes. Captures and settings are refused from then on, until a person has
        looked at the camera and connects anew. Raises SettingsError where the prefix cannot be used.
        """
        check_prefix(prefix)
        with self._lock:
            self._check_known("capture")
            self._open()
            sent_s = self.clock.now()
            try:
                folder = self._once("capture", {"prefix": prefix, "maxCubes": 1, "maxFramesPerCube": frames}, as_folder)
            except DeviceRefused:
                raise
            except BaseException as error:
                self.unknown = "a capture was sent and not acknowledged"
                self._hang_up()
                if not isinstance(error, RigError):  # interrupted while it waited
                    raise
                raise StateUnknown(
                    f"capture (prefix {prefix!r}) was sent and its reply is lost: {error}. It is not sent again. Look "
                    "at the camera, stop what runs there, then run again, which connects anew"
                ) from error
            return Capture(folder, sent_s, self.clock.now())

    def is_capturing(self) -> bool:
        """Return whether a capture runs."""
        return self._ask("isCapturing", None, as_truth)

    def stop(self) -> bool:
        """End a capture; return False where none ran. A lost reply is asked for again, since stopping twice is safe."""
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
        """Fetch a finished capture's files, small ones first, and return its lines; a later call continues.

        Raises RigError where the capture still runs, its files do not belong together, or are larger than ``claim``.
        """
        files = self._finished(folder, claim)
        files.sort(key=lambda file: (bool(_RAW.fullmatch(file.base)), file.name))
        fetch_files(self.server, files, kept, progress, clock=self.clock)
        return read_capture([file.name for file in files], _reader(kept))

    def references(self, folder: str, kept: Kept, *, claim: FrameClaim | None = None) -> dict[str, MeanFrame]:
        """Return the mean frames of the reference cubes in a capture's folder, by ``dark`` and ``white``."""
        files = [file for file in self._finished(folder, claim) if file.base.lower().startswith(("dark", "white"))]
        fetch_files(self.server, files, kept, clock=self.clock)
        cubes = read_references([file.name for file in files], _reader(kept))
        return {kind: mean_frame(cube.values) for kind, cube in cubes.items()}

    def close(self) -> None:
        """Send exit and close the connection. A capture continues; nothing is raised."""
        with self._lock:
            if self._line is not None:
                try:
                    self._line.write(to_request("exit"), self.clock.now() + self.patience.deadline_s)
                except RigError as error:
                    LOG.info("the camera was gone before exit: %s", error)
            self._hang_up()

    def _ask(self, name: str, argument: Any, check: Callable[[Any], Answer]) -> Answer:
        """Send a command that may be sent twice: again, on a new connection, after a lost, late or damaged reply."""
        with self._lock:
            left = self.patience.retries
            while True:
                try:
                    self._open()
                    return self._once(name, argument, check)
                except DeviceRefused:
                    raise
                except RigError as error:
                    self._hang_up()
                    if not left:
                        raise
                    left -= 1
                    LOG.info("%s; asking again", error)
                    self.clock.sleep(self.patience.pause_s)

    def _open(self) -> None:
        """Open a connection at its prompt, without earlier input."""
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
            self._wait(self._line, "the greeting", lambda _: True)
        except RigError:
            self._hang_up()
            raise

    def _once(self, name: str, argument: Any, check: Callable[[Any], Answer]) -> Answer:
        """Send one command and wait for its reply; replies to other commands are skipped."""
        line = self._line
        assert line is not None
        line.write(to_request(name, argument), self.clock.now() + self.patience.deadline_s)
        reply = self._wait(line, name, lambda reply: bool(reply.text) and reply.command in ("", name))
        return check(response_of(reply, name, line.port))

    def _wait(self, line: Transport, name: str, fits: Callable[[CameraReply], bool]) -> CameraReply:
        """Wait for a reply that fits."""
        deadline = self.clock.now() + self.patience.deadline_s
        skipped = ""
        while self.clock.now() < deadline:
            for reply in self._reader.feed(line.read(65536, deadline)):
                if fits(reply):
                    return reply
                LOG.warning("%s, while waiting for %s: skipped %.200s", line.port, name, reply.text)
                skipped = reply.text
        came = self._reader.held or skipped.encode()
        found = f"{len(came)} bytes came: {came[:80]!r}" if came else "nothing came"
        raise DeadlinePassed(
            f"no reply 'hpi> ' to {name} from {line.port} within {self.patience.deadline_s:g} s ({found}); is it the "
            "camera's control port (8100), is the camera on, and not busy writing?"
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

    def _finished(self, folder: str, claim: FrameClaim | None) -> list[RemoteFile]:
        """Return the files of a folder; RigError where a capture still runs."""
        if self.is_capturing():
            raise RigError(f"a capture still runs, so files of {folder} may grow; wait for its end, or stop it")
        files = [file for file in self.list_files(folder) if not file.folder]
        return files if claim is None else bounded(files, claim)


def _reader(kept: Kept) -> Read:
    return lambda name: kept.read(name, 0, kept.size(name))


def bounded(files: Sequence[RemoteFile], claim: FrameClaim) -> list[RemoteFile]:
    """Return the files with the most bytes that each can have; RigError where a file, or all cubes, have more."""
    found, cubes_bytes = [], 0
    for file in files:
        size, most = file.size or 0, MOST_TEXT
        if _RAW.fullmatch(file.base):
            most = claim.frames * claim.frame_bytes + MOST_OFFSET
            cubes_bytes += max(size - MOST_OFFSET, 0)
            size = max(size, cubes_bytes + MOST_OFFSET)
        elif _REFERENCE.fullmatch(file.base):
            most = MOST_REFERENCE_FRAMES * claim.frame_bytes + MOST_OFFSET
        if size > most:
            raise RigError(
                f"{file.name}, with the cubes before it, has {size} bytes, expected {most} at most, and nothing of it "
                "is fetched; look at what the camera wrote, and at camera.samples and the wavelengths in the settings"
            )
        found.append(replace(file, most=most))
    return found
