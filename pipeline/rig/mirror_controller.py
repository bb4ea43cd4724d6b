"""The mirror controller's driver: sends a mirror to a position, or along a path.

It follows the documented protocol and was tested against scripted bytes; it never ran on hardware. Positions are those
of a mirror mounted straight. The wire carries the device's own positions, by the mounting in the settings.

A controller begins in simple mode: lines of ASCII with CR LF, at most 64 bytes, in either case. The driver reads its
identity there, and changes to pro mode: frames, see `pro_mode`.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import chain

from numpy.typing import ArrayLike

from spectralzoom.pipeline.errors import RigError, SettingsError, ShapeError
from spectralzoom.pipeline.geometry.mirror import wire_positions
from spectralzoom.pipeline.geometry.scan import device_range
from spectralzoom.pipeline.rig import pro_mode as pro
from spectralzoom.pipeline.rig.device_settings import SurveyRig
from spectralzoom.pipeline.rig.transports import (
    SYSTEM_CLOCK,
    Answer,
    Clock,
    DeadlinePassed,
    DeviceRefused,
    Kind,
    Receiver,
    SerialTransport,
    Transport,
    Wire,
)

LOG = logging.getLogger(__name__)
SAMPLED_EVERY = 10  # frames
KNOWN_MODEL = "MR"  # begins the ids of documented controllers
_POLL_S = 0.01

END = b"\r\n"
START = "START"
ID, VERSION, SERIAL = "GETID", "GETVERSION", "GETSN"
GO_PRO, GO_PRO_CRC = "GOPRO", "GOPROCRC"
OK = "OK"
REFUSALS = ("NO", "OL", "OU", "ERROR")  # unknown or not now; below or above the range; an error on the device


def read_done(line: bytes, request: str, port: str) -> bool:
    """Accept the reply OK; DeviceRefused at another reply of the protocol, RigError at anything else."""
    text = line.decode("ascii", "backslashreplace").strip()
    if text.upper() in REFUSALS:
        raise DeviceRefused(f"the mirror controller on {port} answered {text.upper()} to {request}")
    if text.upper() != OK:
        raise RigError(f"expected OK to {request} from {port}, got {text!r}; is this the mirror controller?")
    return True


def read_text(line: bytes, request: str, port: str) -> str:
    """Read a reply that is a text of the device, such as its id; empty where it does not know the request."""
    text = line.decode("ascii", "backslashreplace").strip()
    if not re.fullmatch(r"[ -~]+", text) or "\\x" in text:
        raise RigError(f"expected text to {request} from {port}, got {line!r}; is the port's speed right?")
    return "" if text.upper() in REFUSALS else text


def ask_line(wire: Wire, request: str, parse: Callable[[bytes, str, str], Answer], kind: Kind = "read") -> Answer:
    """Send a line of simple mode and return the parsed line that answers it; raises as `Wire.exchange`."""

    def receiver() -> Receiver[Answer]:
        """Return a receiver that collects a line."""
        held = b""

        def receive(data: bytes) -> Answer | None:
            nonlocal held
            *lines, held = (held + data).split(b"\n")
            line = next((line for line in (line.rstrip(b"\r") for line in lines) if line), None)
            return None if line is None else parse(line, request, wire.port)

        return receive

    return wire.exchange(request.encode("ascii") + END, request, kind, receiver)


@dataclass(frozen=True)
class ProLink:
    """Frames of pro mode over a wire. ``with_crc`` sends CRCs, and refuses replies whose CRC does not fit.

    Requests raise DeviceRefused, DeadlinePassed or DeviceGone, and one that moves the mirror StateUnknown.
    """

    wire: Wire
    with_crc: bool = False

    def ask(self, frame: pro.Frame, name: str, parse: Callable[[bytes], Answer], kind: Kind = "read") -> Answer:
        """Send a request that only reads and return the parsed payload; it is sent again where no answer comes."""

        def receiver() -> Receiver[Answer]:
            reader = pro.FrameReader()

            def receive(data: bytes) -> Answer | None:
                answers = (self._answer(found, frame, name, parse) for found in reader.feed(data))
                return next((answer for answer in answers if answer is not None), None)

            return receive

        return self.wire.exchange(pro.encode(frame, with_crc=self.with_crc), name, kind, receiver)

    def set(self, frame: pro.Frame, name: str) -> None:
        """Send a request once that writes and moves nothing."""
        self.ask(frame, name, bytes, "write")

    def _answer(self, found: pro.Frame, sent: pro.Frame, name: str, parse: Callable[[bytes], Answer]) -> Answer | None:
        """Return the answer in a frame; None, and a line in the log, where it does not answer the request."""
        port = self.wire.port
        if self.with_crc and not found.crc_good:
            LOG.warning("%s: the CRC of an answer to %s does not fit; it is refused", port, name)
            return None
        try:
            if found.command == sent.command | pro.ERROR_FLAG:
                code = pro.cell_int(found.payload)
                raise DeviceRefused(f"the mirror controller on {port} refused {name}: {pro.format_error(code)}", code)
            if found.command == sent.command:
                return parse(found.payload)
        except ShapeError as error:
            LOG.info("%s, while waiting for %s: an answer that does not fit: %s", port, name, error)
            return None
        LOG.info("%s, while waiting for %s: an answer to command %02X", port, name, found.command)
        return None


def upload(link: ProLink, cells: bytes) -> None:
    """Write cells, X of all positions and then Y of all, to the vector memory.

    Every tenth frame and the ends of both channels are read back. Raises RigError: a cell holds another value.
    """
    size = pro.VECTOR_CELLS * pro.CELL
    frames = [(at // pro.CELL, cells[at : at + size]) for at in range(0, len(cells), size)]
    for start, sent in frames:
        stop = start + len(sent) // pro.CELL
        link.set(pro.set_vector(pro.VECTOR_MEMORY, start, sent), f"writing cells {start} to {stop}")
    for number in frames_to_check(len(frames)):
        start, sent = frames[number]
        place = f"cells {start} to {start + len(sent) // pro.CELL}"
        asked = pro.get_vector(pro.VECTOR_MEMORY, start, len(sent) // pro.CELL)
        if link.ask(asked, f"reading {place}", partial(pro.checked, size=len(sent))) != sent:
            raise RigError(
                f"{place} of the vector memory on {link.wire.port} hold other values than were sent; nothing was "
                "moved: run again"
            )


def frames_to_check(frames: int) -> list[int]:
    """Return the numbers of the frames that are read back."""
    half = frames // 2  # X ends and Y begins here
    ends = (0, half - 1, half, frames - 1)
    return sorted({number for number in chain(range(0, frames, SAMPLED_EVERY), ends) if 0 <= number < frames})


_STOPPED: dict[int, pro.Value] = {pro.X.run: 0, pro.Y.run: 0}  # halts the vector units of both channels


class MirrorController:
    """A mirror controller on a port, a `pipeline.rig.drivers.MirrorDriver`. Call :meth:`connect` first.

    Motions (goto, run) are sent once; one that is not acknowledged raises StateUnknown. Positions beyond the disk raise
    PoseError, before a byte is sent.
    """

    def __init__(
        self, transport: Transport, rig: SurveyRig, clock: Clock = SYSTEM_CLOCK, *, vector_pairs: int = 1500
    ) -> None:
        self.rig = rig
        self.vector_pairs = vector_pairs
        self.wire = Wire(transport, clock)
        self._link = ProLink(self.wire, rig.with_crc)
        self._pairs = 0  # positions in the vector memory
        self.identity = ""

    def connect(self) -> None:
        """Find the controller in either mode, and change it to pro mode. Nothing moves.

        Raises DeadlinePassed or DeviceGone where nothing answers, RigError where another device answers.
        """
        try:
            self._greet()
        except DeadlinePassed:
            LOG.info("%s does not answer in simple mode; it may be in pro mode", self.wire.port)
            with suppress(DeadlinePassed):  # it may have changed; the greeting shows
                # with a CRC: an earlier session may have had them checked
                ProLink(self.wire, with_crc=True).set(pro.GO_SIMPLE, "changing to simple mode")
            self._greet()
        # empty where it does not know the request
        device, version, number = (ask_line(self.wire, request, read_text) for request in (ID, VERSION, SERIAL))
        self.identity = f"{device or 'no id'}, version {version or 'unknown'}, serial {number or 'unknown'}"
        if not device.upper().startswith(KNOWN_MODEL):
            raise RigError(
                f"expected a controller whose id begins with {KNOWN_MODEL} on {self.wire.port}, got "
                f"{self.identity}; is another device at this port?"
            )
        try:
            with suppress(DeadlinePassed):  # it may have changed; the status shows
                ask_line(self.wire, GO_PRO_CRC if self.rig.with_crc else GO_PRO, read_done, "write")
            self.status()
        except (DeadlinePassed, DeviceRefused) as error:
            own, other = ("with", "without")[:: 1 if self.rig.with_crc else -1]
            raise RigError(
                f"frames {own} a CRC: {error}; if this firmware wants them {other} one, set with_crc = "
                f"{str(not self.rig.with_crc).lower()} in [rig]"
            ) from error

    def _greet(self) -> None:
        try:
            ask_line(self.wire, START, read_done)
        except DeviceRefused:  # the greeting ended a line that was begun before
            ask_line(self.wire, START, read_done)

    def status(self) -> pro.Status:
        """Return the present status bits."""
        return pro.Status(self._link.ask(pro.ASK_STATUS, "the status", pro.cell_int))

    def goto(self, x: float, y: float) -> None:
        """Send the mirror to a position; return once that is acknowledged. RigError: the status forbids motion."""
        to_x, to_y = map(float, wire_positions([(x, y)], self.rig.mounting)[0])
        # all registers fill one frame: both channels go there, hold it, and end any path
        values = {pro.X.static_xy: to_x, pro.Y.static_xy: to_y, **pro.X.hold, **pro.Y.hold, **_STOPPED}
        self._move(values, f"going to {to_x:.6g}; {to_y:.6g}")

    def settle(self, within_s: float) -> None:
        """Wait until the mirror is at rest; RigError where it is not, or the device trimmed the target to the rim."""
        until = self.wire.clock.now() + within_s
        while pro.Status.NOT_STABLE in (status := self.status()):
            if self.wire.clock.now() >= until:
                raise RigError(f"the mirror on {self.wire.port} is not at rest after {within_s:g} s; {status.sentence}")
            self.wire.clock.sleep(_POLL_S)
        if pro.Status.TRIMMED in status:
            raise RigError(f"the mirror on {self.wire.port} is not where it was sent; {status.sentence}")

    def load_path(self, positions: ArrayLike) -> None:
        """Put positions (position, 2) into the vector memory: X of all, then Y of all, from cell 0 on. Halts a path.

        Raises SettingsError: there are too many. Raises RigError: a cell that was read back holds another value.
        """
        cells = wire_positions(positions, self.rig.mounting)
        if len(cells) > self.vector_pairs:
            raise SettingsError(
                f"the vector memory holds {self.vector_pairs} positions, got {len(cells)}; load in parts"
            )
        self.halt()
        self._pairs = 0
        upload(self._link, cells.T.astype(">f4").tobytes())
        self._pairs = len(cells)

    def run(self, rate_hz: float) -> None:
        """Play the loaded positions once; X from cell 0 on, Y from behind the X of all positions.

        Raises SettingsError: no path is loaded. Raises also as :meth:`goto`.
        """
        if not self._pairs:
            raise SettingsError(f"no path is loaded on {self.wire.port}; load one first")
        self.halt()
        for name, begin, channel in (("X", 0, pro.X), ("Y", self._pairs, pro.Y)):
            start, end = device_range((begin, begin + self._pairs), self.rig.ends)
            values: dict[int, pro.Value] = {
                channel.unit: pro.UNIT_XY,
                channel.start: start,
                channel.end: end,
                channel.frequency: float(rate_hz),
                channel.cycles: 1,
                channel.trigger: pro.TRIGGER_OFF,
            }
            self._link.set(pro.set_values(values), f"setting up the path's {name}")
        # one frame: both begin together
        self._move({**pro.X.play, **pro.Y.play, pro.X.run: 1, pro.Y.run: 1}, "running the path")

    def halt(self) -> None:
        """Stop playing; the mirror stays where it is."""
        self._link.set(pro.set_values(_STOPPED), "halting the path")

    def close(self) -> None:
        """Close the port; the mirror stays where it is."""
        self.wire.transport.close()

    def _move(self, values: dict[int, pro.Value], name: str) -> None:
        if (status := self.status()).stops_motion:
            raise RigError(f"{name} is refused on {self.wire.port}; {status.sentence}; mend that first")
        self._link.ask(pro.set_values(values), name, bytes, "motion")


def open_mirror(rig: SurveyRig, vector_pairs: int = 1500, clock: Clock = SYSTEM_CLOCK) -> MirrorController:
    """Open the port of the settings and connect to the controller there. Nothing moves.

    Raises as `MirrorController.connect`, and DeviceGone: there is no such port, it is in use, or not permitted.
    """
    mirror = MirrorController(SerialTransport(rig.port, rig.baud, clock), rig, clock, vector_pairs=vector_pairs)
    try:
        mirror.connect()
    except BaseException:
        mirror.close()
        raise
    return mirror
