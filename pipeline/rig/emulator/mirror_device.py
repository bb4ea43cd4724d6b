"""The emulated mirror controller: bytes in, bytes out. No transport, and time only by the clock that it is given.

Both modes of the documented protocol. Assumed, as the documents leave it open: an empty line has no answer; NO answers
a line that is not known, ERROR one that is known and cannot be read; a position beyond the rim is pulled in to it, and
the answer says to which side it lay; a reset is answered by OK, and what comes while the controller boots is lost; in
pro mode bytes that are no frame are answered by error 0001 at the next boundary, requests are checked by their CRC
after GOPROCRC alone, and replies always carry it. Two other firmwares are emulated, too: one that checks the CRC of
requests after GOPRO as well (``crc="required"``), and one that knows no GOPROCRC and sends 00 00 in the CRC's place
(``crc="absent"``).
"""

from __future__ import annotations

import math
import re
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.rig.devices import Clock
from pipeline.rig.emulator import Chunk
from pipeline.rig.emulator.mirror_registers import RegisterFile
from pipeline.rig.emulator.mirror_state import MirrorState, MirrorUnit
from pipeline.rig.mirror import mirror_requests as simple
from pipeline.rig.mirror.mirror_requests import END, MOST_LINE, Reply
from pipeline.rig.mirror.pro_mode import (
    BOUNDARY,
    ERROR_FLAG,
    ChannelRegisters,
    Command,
    Damaged,
    ErrorCode,
    Frame,
    FrameReader,
    Unit,
    encode,
    refuse,
)

KEPT_ACTS = 5_000
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:E[-+]?\d+)?"
_PLACE = re.compile(rf"(X|Y|XY)=({_NUMBER})(?:;({_NUMBER}))?")

Floats = NDArray[np.float64]
Pulses = Callable[[float, float], Floats]  # (pulse, 2) rises and falls of pulses that rise within a span of time


class Mode(Enum):
    """How the controller is spoken to."""

    SIMPLE = "simple"
    PRO = "pro"
    PRO_CRC = "pro, requests checked"


@dataclass(frozen=True)
class Request:
    """What came: a line of simple mode without its end, a frame, or bytes between boundaries that are none."""

    mode: Mode
    line: str = ""
    frame: Frame | None = None
    damaged: Damaged | None = None

    @property
    def command(self) -> int | None:
        """Command of the frame."""
        return None if self.frame is None else self.frame.command

    @property
    def words(self) -> str:
        """What was asked, for people: the line, or the command's name."""
        if self.frame is None:
            return self.line or "bytes that are no frame"
        known = {command.value: command.name for command in Command}
        return known.get(self.frame.command, f"command {self.frame.command:02X}").lower().replace("_", " ")


@dataclass(frozen=True)
class Act:
    """A request that was carried out, for whoever checks what happened, and when. [s]"""

    time_s: float
    request: Request


class MirrorDevice:
    """One emulated controller with its mirror.

    ``acts`` are the requests carried out so far, the newest ``KEPT_ACTS``. ``pulses`` is what is wired to the trigger
    input, which is looked at before anything else is done. Methods may be called from several threads: the port's, and
    that of an emulated camera, which gives triggers and asks for positions.
    """

    def __init__(self, clock: Clock, *, unit: MirrorUnit | None = None) -> None:
        self.clock, self.unit = clock, MirrorUnit() if unit is None else unit
        self.acts: deque[Act] = deque(maxlen=KEPT_ACTS)
        self.pulses: Pulses | None = None
        self._pulses_taken_s = clock.now()
        self._lock, self._wire = threading.RLock(), threading.Lock()
        self.state = MirrorState(clock, self.unit)
        self.restart(boot_s=0.0)

    def receive(self, data: bytes) -> list[Chunk]:
        """Take bytes and return what comes back."""
        self.take_pulses()
        with self._lock:
            out: list[Chunk] = []
            while data and self.clock.now() >= self._boots_until:
                data = self._take_line(data, out) if self.mode is Mode.SIMPLE else self._take_frame(data, out)
            return out

    def take_pulses(self) -> None:
        """Step through the vector memory as the pulses at the trigger input since the last call say."""
        if self.pulses is None:
            return
        with self._wire:
            now_s = self.clock.now()
            pulses = self.pulses(self._pulses_taken_s, now_s)
            self._pulses_taken_s = max(now_s, self._pulses_taken_s)
            if len(pulses):
                with self._lock:
                    self.state.trigger(pulses[:, 0], pulses[:, 1])

    def positions(self, times_s: ArrayLike) -> Floats:
        """Give where the mirror truly was, (..., 2) device X and Y, at times of the clock up to now (...)."""
        self.take_pulses()
        with self._lock:
            return self.state.positions(times_s)

    def sent(self, times_s: ArrayLike) -> Floats:
        """Give where the mirror was sent, (..., 2), at times of the clock up to now (...)."""
        self.take_pulses()
        with self._lock:
            self.state.advance()
            return np.stack([axis.commands(times_s) for axis in self.state.axes], axis=-1)

    def restart(self, *, boot_s: float | None = None) -> None:
        """Lose everything and be in simple mode, deaf for a while: a reset, or a loss of power."""
        with self._lock:
            now = self.clock.now()
            self.state.restart(now)
            self.registers = RegisterFile(self.state)
            self.mode = Mode.SIMPLE
            self._line, self._reader = b"", FrameReader()
            boot_s = self.unit.boot_s if boot_s is None else boot_s
            self._boots_until = now + boot_s if boot_s > 0 else -math.inf

    def set_mode(self, mode: Mode) -> None:
        """Speak another mode from the next byte on."""
        self.mode, self._line, self._reader = mode, b"", FrameReader()

    def _take_line(self, data: bytes, out: list[Chunk]) -> bytes:
        """Take bytes up to the end of a line, and give those behind it: a line may change the mode."""
        taken, end, rest = data.partition(b"\n")
        self._line = (self._line + taken)[: 2 * MOST_LINE]  # enough to know, at its end, that it is too long
        if end:
            line, self._line = self._line.rstrip(b"\r"), b""
            if line:
                self._answer(Request(Mode.SIMPLE, line=line.decode("ascii", "replace").strip().upper()), out)
        return rest

    def _take_frame(self, data: bytes, out: list[Chunk]) -> bytes:
        """Take bytes up to a boundary, and give those behind it: a frame may change the mode."""
        taken, end, rest = data.partition(bytes((BOUNDARY,)))
        for found in self._reader.feed(taken + end):
            whole, damaged = (found, None) if isinstance(found, Frame) else (None, found)
            self._answer(Request(self.mode, frame=whole, damaged=damaged), out)
        return rest

    def _answer(self, request: Request, out: list[Chunk]) -> None:
        """Carry a request out and add the reply."""
        if reply := self.carry_out(request):
            out.append(Chunk(self.unit.turnaround_s, reply))

    def carry_out(self, request: Request) -> bytes:
        """Do what a request asks for and give the bytes of the reply."""
        self.acts.append(Act(self.clock.now(), request))
        if request.damaged is not None:  # answered to the command that the bytes seem to hold, if any
            command = request.damaged.data[1] if len(request.damaged.data) > 1 else 0
            return self._framed(refuse(command & ~ERROR_FLAG, ErrorCode.FRAME_INVALID))
        if request.frame is not None:
            if self.mode is Mode.PRO_CRC and not request.frame.crc_good:
                return self._framed(refuse(request.frame.command & ~ERROR_FLAG, ErrorCode.CRC_WRONG))
            reply = self.registers.answer(request.frame)
            if reply.command == Command.SET_MODE:
                self.set_mode(Mode.SIMPLE)
            return self._framed(reply)
        return self._simple(request.line).encode("ascii") + END

    def _framed(self, reply: Frame) -> bytes:
        return encode(reply, with_crc=self.unit.crc != "absent")

    def _simple(self, line: str) -> str:
        """Carry out a line, in capitals and without its end, and give the answer without an end."""
        if len(line) + len(END) > MOST_LINE:
            return Reply.ERROR
        match line:
            case simple.ID:
                return self.unit.model
            case simple.VERSION:
                return self.unit.version
            case simple.SERIAL:
                return self.unit.serial_number
            case simple.TEMPERATURE:
                return f"{self.unit.temperature_c:.2f}"
            case simple.STATUS:
                return f"{int(self.state.status()):08X}"
            case simple.ACKNOWLEDGE:
                self.state.acknowledge()
            case simple.GO_PRO:
                self.set_mode(Mode.PRO_CRC if self.unit.crc == "required" else Mode.PRO)
            case simple.GO_PRO_CRC if self.unit.crc != "absent":
                self.set_mode(Mode.PRO_CRC)
            case simple.RESET:
                self.restart()
            case simple.START:
                pass
            case _:
                return self._go(line)
        return Reply.OK

    def _go(self, line: str) -> Reply:
        name, equals, _ = line.partition("=")
        if not equals or name not in ("X", "Y", "XY"):
            return Reply.NO
        found = _PLACE.fullmatch(line)
        if found is None or (name == "XY") != (found[3] is not None):
            return Reply.ERROR
        state, places = self.state, [float(number) for number in found.groups()[1:] if number is not None]
        x, y = (axis[Unit.XY] for axis in state.static)
        x, y = {"X": (places[0], y), "Y": (x, places[0]), "XY": (places[0], places[-1])}[name]
        for channel, place in enumerate((x, y)):
            registers = ChannelRegisters(channel)
            state.inputs[channel], state.controls[channel] = registers.static_system, registers.xy_system
            state.static[channel][Unit.XY] = place
        state.aim()
        if not state.trimmed:
            return Reply.OK
        return Reply.BELOW if -min(places) > max(places) else Reply.ABOVE
