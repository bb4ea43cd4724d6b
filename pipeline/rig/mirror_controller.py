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
from functools import partial

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
    Transport,
    Wire,
)

LOG = logging.getLogger(__name__)
SAMPLED_EVERY = 10  # frames
KNOWN_MODEL = "MR"  # begins the ids of documented controllers
POLL_S = 0.01
REFUSALS = ("NO", "OL", "OU", "ERROR")  # unknown or not now; below or above the range; an error on the device


def read_done(line: bytes, request: str, port: str) -> bool:
    """Accept the reply OK; DeviceRefused at another reply of the protocol, RigError at anything else."""
    text = line.decode("ascii", "backslashreplace").strip()
    if text.upper() in REFUSALS:
        raise DeviceRefused(f"the mirror controller on {port} answered {text.upper()} to {request}")
    if text.upper() != "OK":
        raise RigError(f"expected OK to {request} from {port}, got {text!r}; is this the mirror controller?")
    return True


def read_text(line: bytes, request: str, port: str) -> str:
    """Read a reply that is a text of the device, such as its id; empty where it does not know the request."""
    if not re.fullmatch(rb"[ -~]+", line):
        raise RigError(f"expected text to {request} from {port}, got {line!r}; is this the mirror controller?")
    text = line.decode("ascii").strip()
    return "" if text.upper() in REFUSALS else text


def ask_line(wire: Wire, request: str, parse: Callable[[bytes, str, str], Answer], kind: Kind = "read") -> Answer:
    """Send a line of simple mode and return the parsed line that answers it; raises as `Wire.exchange`."""

    def receiver() -> Receiver[Answer]:
        held = b""

        def receive(data: bytes) -> Answer | None:
            nonlocal held
            *lines, held = (held + data).split(b"\n")
            whole = next((line for line in (line.rstrip(b"\r") for line in lines) if line), None)
            return None if whole is None else parse(whole, request, wire.port)

        return receive

    return wire.exchange(request.encode("ascii") + b"\r\n", request, kind, receiver)


def ask_frame(
    wire: Wire,
    frame: pro.Frame,
    name: str,
    parse: Callable[[bytes], Answer],
    kind: Kind = "read",
    *,
    with_crc: bool = False,
) -> Answer:
    """Send a frame and return the parsed payload of its answer; raises as `Wire.exchange`.

    ``with_crc`` sends a CRC, and refuses an answer whose CRC does not fit.
    """

    def answer(found: pro.Frame) -> Answer | None:
        """Return the answer in a frame; None, and a line in the log, where it does not answer the request."""
        if with_crc and not found.crc_good:
            LOG.warning("%s: the CRC of an answer to %s does not fit; it is refused", wire.port, name)
            return None
        try:
            if found.command == frame.command | pro.ERROR_FLAG:
                code = pro.cell_int(found.payload)
                reason = pro.format_error(code)
                raise DeviceRefused(f"the mirror controller on {wire.port} refused {name}: {reason}", code)
            if found.command == frame.command:
                return parse(found.payload)
        except ShapeError as error:
            LOG.info("%s, while waiting for %s: an answer that does not fit: %s", wire.port, name, error)
            return None
        LOG.info("%s, while waiting for %s: an answer to command %02X", wire.port, name, found.command)
        return None

    def receiver() -> Receiver[Answer]:
        reader = pro.FrameReader()
        return lambda data: next((one for found in reader.feed(data) if (one := answer(found)) is not None), None)

    return wire.exchange(pro.encode(frame, with_crc=with_crc), name, kind, receiver)


_STOPPED: dict[int, pro.Value] = {pro.X.run: 0, pro.Y.run: 0}  # halts the vector units of both channels


class MirrorController:
    """A mirror controller behind a transport, a `pipeline.rig.drivers.MirrorDriver`. Call :meth:`connect` first.

    Motions (goto, run) are sent once; one that is not acknowledged raises StateUnknown. Positions beyond the disk raise
    PoseError, before a byte is sent.
    """

    def __init__(
        self, transport: Transport, rig: SurveyRig, clock: Clock = SYSTEM_CLOCK, *, vector_pairs: int = 1500
    ) -> None:
        self.rig = rig
        self.vector_pairs = vector_pairs
        self.wire = Wire(transport, clock)
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
                ask_frame(self.wire, pro.GO_SIMPLE, "changing to simple mode", bytes, "write", with_crc=True)
            self._greet()
        # empty where it does not know the request
        device, version, number = (ask_line(self.wire, one, read_text) for one in ("GETID", "GETVERSION", "GETSN"))
        self.identity = f"{device or 'no id'}, version {version or 'unknown'}, serial {number or 'unknown'}"
        if not device.upper().startswith(KNOWN_MODEL):
            raise RigError(
                f"expected a controller whose id begins with {KNOWN_MODEL} on {self.wire.port}, got "
                f"{self.identity}; is another device at this port?"
            )
        try:
            with suppress(DeadlinePassed):  # it may have changed; the status shows
                ask_line(self.wire, "GOPROCRC" if self.rig.with_crc else "GOPRO", read_done, "write")
            self.status()
        except (DeadlinePassed, DeviceRefused) as error:
            own, other = ("with", "without")[:: 1 if self.rig.with_crc else -1]
            raise RigError(
                f"frames {own} a CRC: {error}; if this firmware wants them {other} one, set with_crc = "
                f"{str(not self.rig.with_crc).lower()} in [rig]"
            ) from error

    def _greet(self) -> None:
        try:
            ask_line(self.wire, "START", read_done)
        except DeviceRefused:  # the greeting ended a line that was begun before
            ask_line(self.wire, "START", read_done)

    def status(self) -> pro.Status:
        """Return the present status bits."""
        return pro.Status(self._ask(pro.ASK_STATUS, "the status", pro.cell_int))

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
            self.wire.clock.sleep(POLL_S)
        if pro.Status.TRIMMED in status:
            raise RigError(f"the mirror on {self.wire.port} is not where it was sent; {status.sentence}")

    def load_path(self, positions: ArrayLike) -> None:
        """Put positions (position, 2) into the vector memory: X of all, then Y of all, from cell 0 on. Halts a path.

        Every tenth frame and the ends of both channels are read back. Raises SettingsError: there are too many
        positions. Raises RigError: a cell that was read back holds another value.
        """
        path = wire_positions(positions, self.rig.mounting)
        if len(path) > self.vector_pairs:
            raise SettingsError(
                f"the vector memory holds {self.vector_pairs} positions, got {len(path)}; load in parts"
            )
        self.halt()
        self._pairs = 0
        cells, size = path.T.astype(">f4").tobytes(), pro.VECTOR_CELLS * pro.CELL
        frames = [(at // pro.CELL, cells[at : at + size]) for at in range(0, len(cells), size)]
        for start, sent in frames:
            part = f"cells {start} to {start + len(sent) // pro.CELL}"
            self._set(pro.set_vector(pro.VECTOR_MEMORY, start, sent), f"writing {part}")
        half = len(frames) // 2  # X ends and Y begins here
        for number in sorted({*range(0, len(frames), SAMPLED_EVERY), max(half - 1, 0), half, len(frames) - 1}):
            start, sent = frames[number]
            part = f"cells {start} to {start + len(sent) // pro.CELL}"
            asked = pro.get_vector(pro.VECTOR_MEMORY, start, len(sent) // pro.CELL)
            if self._ask(asked, f"reading {part}", partial(pro.checked, size=len(sent))) != sent:
                raise RigError(
                    f"{part} of the vector memory on {self.wire.port} hold other values than were sent; nothing was "
                    "moved: run again"
                )
        self._pairs = len(path)

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
            self._set(pro.set_values(values), f"setting up the path's {name}")
        # one frame: both begin together
        self._move({**pro.X.play, **pro.Y.play, pro.X.run: 1, pro.Y.run: 1}, "running the path")

    def halt(self) -> None:
        """Stop playing; the mirror stays where it is."""
        self._set(pro.set_values(_STOPPED), "halting the path")

    def close(self) -> None:
        """Close the port; the mirror stays where it is."""
        self.wire.transport.close()

    def _move(self, values: dict[int, pro.Value], name: str) -> None:
        if (status := self.status()).stops_motion:
            raise RigError(f"{name} is refused on {self.wire.port}; {status.sentence}; mend that first")
        self._ask(pro.set_values(values), name, bytes, "motion")

    def _set(self, frame: pro.Frame, name: str) -> None:
        self._ask(frame, name, bytes, "write")

    def _ask(self, frame: pro.Frame, name: str, parse: Callable[[bytes], Answer], kind: Kind = "read") -> Answer:
        return ask_frame(self.wire, frame, name, parse, kind, with_crc=self.rig.with_crc)
