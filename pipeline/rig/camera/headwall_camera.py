"""The camera's driver: commands and replies of its control socket, and its files, as a line camera for surveys.

A command is ``name`` or ``name(JSON)`` and a carriage return. The camera repeats that line (some versions do not), and
sends ``{"success": ..., "response": ..., "errorMessage": ...}`` and the prompt ``hpi> ``.
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from pydantic import BaseModel, Field, StrictBool, TypeAdapter, ValidationError

from spectralzoom.pipeline.errors import RigError
from spectralzoom.pipeline.rig.camera.camera_cubes import CapturedLines, MeanFrame, Read, read_capture, read_references
from spectralzoom.pipeline.rig.camera.camera_files import Capture, Kept, Progress, RemoteFile, fetch_files
from spectralzoom.pipeline.rig.device_settings import FileServer
from spectralzoom.pipeline.rig.transports import (
    SYSTEM_CLOCK,
    Answer,
    Clock,
    DeviceRefused,
    Kind,
    Receiver,
    Transport,
    Wire,
)

LOG = logging.getLogger(__name__)
DEADLINE_S = 5.0  # from a command's first byte to the prompt
RETRIES = 2  # of a read
PAUSE_S = 0.5  # before connecting again
ADVICE = "is it the camera's control port (8100), is the camera on, and not busy writing?"
LONGEST_REPLY = 1 << 24  # bytes: a listing of a hundred thousand files
_RAW = re.compile(r"raw_\d+", re.IGNORECASE)
_PROMPT = re.compile(rb"(?:\A|(?<=[\r\n}]))hpi> ")  # a reply may hold the word, but not there
_NEGOTIATION = re.compile(rb"\xff[\xfb-\xfe].", re.DOTALL)  # of telnet; UTF-8 never holds the byte FF


def to_request(name: str, argument: Any = None) -> bytes:
    """Return the bytes of a command."""
    return (name if argument is None else f"{name}({json.dumps(argument)})").encode("ascii") + b"\r"


class ReplyReader:
    """Takes bytes as they come and gives the texts before prompts, where there is one."""

    def __init__(self) -> None:
        self.held = b""  # bytes that no prompt has followed yet

    def feed(self, data: bytes) -> list[str]:
        """Take bytes; return the texts that they complete. RigError where more came than any reply has."""
        *texts, self.held = _PROMPT.split(_NEGOTIATION.sub(b"", self.held + data))
        if len(self.held) > LONGEST_REPLY:
            raise RigError(f"{len(self.held)} bytes came without a prompt 'hpi> '; is this the camera's control port?")
        return [text.decode("utf-8", errors="replace").strip("\0 \t\r\n") for text in texts]


class Reply(BaseModel):
    """A reply to a command. The response of a capture has its folder, that of a listing its entries."""

    success: StrictBool
    response: Any = None
    reason: Any = Field(None, alias="errorMessage")


class Folder(BaseModel):
    """The folder of a capture."""

    folder: str = Field(min_length=1)


class Entry(BaseModel):
    """A file or folder in a listing, by its whole name."""

    name: str
    size: int | None = None  # bytes; None where the camera does not say
    is_folder: bool = Field(False, alias="isDirectory")


def response_of(text: str, name: str, port: str, kind: type[Answer]) -> Answer:
    """Return the response of a reply that reports success.

    Raises DeviceRefused: it reports a failure. Raises RigError: it is no reply, or has no response of this kind.
    """
    # the command is repeated before a reply that does not begin as JSON
    content = text if text.startswith("{") else text.replace("\n", "\r").partition("\r")[2]
    try:
        reply = Reply.model_validate_json(content)
        if reply.success:
            return TypeAdapter(kind).validate_python(reply.response, strict=True)
    except ValidationError as error:
        raise RigError(
            f"{port} answered {name} with {text[:200]!r}: {error.errors()[0]['msg']}; is this the camera's control "
            "port, and does its manual fit?"
        ) from error
    raise DeviceRefused(
        f"the camera at {port} refused {name}: {str(reply.reason or 'no reason given')[:300]!r}; see its manual"
    )


class HeadwallCamera:
    """A line camera for surveys, a `pipeline.rig.drivers.CameraDriver`. The first command connects.

    After a late or damaged reply the connection is closed and opened again, so that a late reply never answers the next
    command. ``connect`` makes a connection.
    """

    def __init__(self, connect: Callable[[], Transport], server: FileServer, *, clock: Clock = SYSTEM_CLOCK) -> None:
        self.server = server
        self.clock = clock
        self._connect = connect
        self._wire: Wire | None = None

    def configure(self, exposure_ms: float, frame_period_ms: float) -> None:
        """Set exposure and frame period. [ms]"""
        self._ask("configure", {"exposure": exposure_ms, "framePeriod": frame_period_ms}, object)

    def capture(self, frames: int, *, prefix: str = "") -> Capture:
        """Begin a capture of ``frames`` lines in one file. The command is sent once; StateUnknown without a reply."""
        wire = self._open()
        sent_s = self.clock.now()
        what = {"prefix": prefix, "maxCubes": 1, "maxFramesPerCube": frames}
        try:
            folder = self._once(wire, "capture", what, Folder, "motion").folder
        except DeviceRefused:
            raise
        except BaseException:  # also one that interrupts the wait
            self._hang_up()
            raise
        return Capture(folder, sent_s, self.clock.now())

    def is_capturing(self) -> bool:
        """Return whether a capture runs."""
        return self._ask("isCapturing", None, bool)

    def stop(self) -> None:
        """End a capture, if one runs. A lost reply is asked for again, since stopping twice is safe."""
        with suppress(DeviceRefused):  # where none runs
            self._ask("stopCapture", None, object)

    def fetch(self, folder: str, kept: Kept, progress: Progress | None = None) -> CapturedLines:
        """Fetch a finished capture's files, small ones first, and return its lines; a later call continues."""
        files = sorted(self._finished(folder), key=lambda file: (bool(_RAW.fullmatch(file.base)), file.name))
        fetch_files(self.server, files, kept, progress, clock=self.clock)
        return read_capture([file.name for file in files], _reader(kept))

    def references(self, folder: str, kept: Kept) -> dict[str, MeanFrame]:
        """Return the mean frames of the reference cubes in a capture's folder, by ``dark`` and ``white``."""
        files = [file for file in self._finished(folder) if file.base.lower().startswith(("dark", "white"))]
        fetch_files(self.server, files, kept, clock=self.clock)
        return read_references([file.name for file in files], _reader(kept))

    def close(self) -> None:
        """Send exit and close the connection. A capture continues; nothing is raised."""
        if self._wire is not None:
            try:
                self._wire.transport.write(to_request("exit"))
            except RigError as error:
                LOG.info("the camera was gone before exit: %s", error)
        self._hang_up()

    def _finished(self, folder: str) -> list[RemoteFile]:
        """Return the files of a folder; RigError where a capture still runs."""
        if self.is_capturing():
            raise RigError(f"a capture still runs, so files of {folder} may grow; wait for its end, or stop it")
        entries = self._ask("listFiles", folder, list[Entry])
        return [RemoteFile(re.sub("/{2,}", "/", one.name), one.size) for one in entries if not one.is_folder]

    def _ask(self, name: str, argument: Any, kind: type[Answer]) -> Answer:
        """Send a command that may be sent twice: again, on a new connection, after a lost, late or damaged reply."""
        left = RETRIES
        while True:
            try:
                return self._once(self._open(), name, argument, kind, "write")
            except DeviceRefused:
                raise
            except RigError as error:
                self._hang_up()
                if not left:
                    raise
                left -= 1
                LOG.info("%s; asking again", error)
                self.clock.sleep(PAUSE_S)

    def _once(self, wire: Wire, name: str, argument: Any, kind: type[Answer], sent: Kind) -> Answer:
        """Send one command and return its response."""

        def receiver() -> Receiver[tuple[Answer]]:
            reader = ReplyReader()
            return lambda data: next(((response_of(one, name, wire.port, kind),) for one in reader.feed(data)), None)

        return wire.exchange(to_request(name, argument), name, sent, receiver)[0]

    def _open(self) -> Wire:
        """Return a connection that has greeted; a new one where the camera ended the last."""
        if self._wire is not None:
            try:
                self._wire.empty_line("before a command")
            except RigError as error:
                LOG.info("%s; connecting again", error)
                self._hang_up()
        if self._wire is None:
            self._wire = Wire(self._connect(), self.clock, deadline_s=DEADLINE_S, advice=ADVICE)
            reader = ReplyReader()
            try:
                self._wire.wait_for("the greeting", lambda data: next(iter(reader.feed(data)), None))
            except RigError:
                self._hang_up()
                raise
        return self._wire

    def _hang_up(self) -> None:
        if self._wire is not None:
            self._wire.transport.close()
        self._wire = None


def _reader(kept: Kept) -> Read:
    return lambda name: kept.read(name, 0, kept.size(name))
