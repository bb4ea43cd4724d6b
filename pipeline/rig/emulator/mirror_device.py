"""The emulated mirror controller: bytes in, bytes out, registers, vector memory, trigger input and log.

It answers what the driver asks in both modes of the documented protocol. The mirror is where it was last sent; the
status bit NOT_STABLE stays on for `SETTLE_S` after each move. Nothing runs by itself: each call plays the vector memory
up to the clock's present time, so time may run at any speed.

Assumptions where the documents say nothing: an empty line has no answer. NO answers an unknown line, ERROR one that is
too long. Bytes in pro mode that form no frame are answered by error 0001 at the next boundary. Only GOPROCRC makes the
controller check the CRC of requests; replies always carry one. Ranges of cells exclude their end. The run command plays
the first cell, with an external trigger too. Each rising edge then plays one more cell. A unit that has finished holds
its last cell.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.errors import ShapeError
from pipeline.rig import pro_mode as pro
from pipeline.rig.emulator import Chunk
from pipeline.rig.mirror_controller import END, GO_PRO, GO_PRO_CRC, ID, MOST_LINE, OK, SERIAL, START, VERSION
from pipeline.rig.pro_mode import ErrorCode, Status, VectorRegister
from pipeline.rig.transports import Clock

Floats = NDArray[np.float64]
Pulses = Callable[[float, float], Floats]  # start and end of a time span -> times of the rising edges in it

# properties of the emulated controller; none of them was read from a real one
TEXTS = {ID: "MR-E-2", VERSION: "EMULATOR 1.0", SERIAL: "EMUL0001"}
CELLS = 3000  # of the vector memory, X and Y
LOG_ROWS = 16_000
TURNAROUND_S = 2e-4  # from a request's last byte to the reply
SETTLE_S = 0.1
HIGHEST_HZ = 10_000.0
KEPT_MOVES = 20_000  # per axis; an older time gets the oldest position that is kept


class RefusedError(Exception):
    """The controller answers with an error code."""

    def __init__(self, code: ErrorCode) -> None:
        super().__init__(code.name)
        self.code = code


@dataclass(frozen=True)
class Register:
    """The range of a register's values, its value after power-on, and its type."""

    least: float = 0
    most: float = 0xFFFF
    start: float = 0
    whole: bool = True

    def read(self, cell: bytes) -> float:
        """Return the value of a cell that is to be written; RefusedError where it is out of range."""
        value: float = pro.cell_int(cell) if self.whole else pro.cell_float(cell)
        if not self.least <= value <= self.most:  # NaN is in no range
            raise RefusedError(ErrorCode.OUT_OF_RANGE)
        return value


# the registers of a controller that take a value, by id
REGISTERS = {pro.log_slot(slot): Register() for slot in range(pro.LOG_SLOTS)} | {
    pro.LOG_RUN: Register(most=1),
    pro.LOG_RATE: Register(1.0, HIGHEST_HZ, HIGHEST_HZ, whole=False),
}
for _channel in (pro.X, pro.Y):
    REGISTERS |= {
        _channel.vector(VectorRegister.UNIT): Register(most=2),
        _channel.vector(VectorRegister.RUN): Register(most=1),
        _channel.vector(VectorRegister.START): Register(most=CELLS),
        _channel.vector(VectorRegister.END): Register(most=CELLS),
        _channel.vector(VectorRegister.FREQUENCY): Register(1e-3, HIGHEST_HZ, HIGHEST_HZ, whole=False),
        _channel.vector(VectorRegister.CYCLES): Register(1, 2**31 - 1, 1),
        _channel.vector(VectorRegister.TRIGGER): Register(most=2),
        _channel.input: Register(most=0xFF, start=_channel.static_system),
        _channel.control: Register(most=0xFF, start=_channel.xy_system),
        _channel.static_xy: Register(-1.0, 1.0, whole=False),
    }


class Axis:
    """The positions that an axis was sent to, with their times."""

    def __init__(self, now_s: float) -> None:
        self.time_s, self.place = [now_s], [0.0]

    def send(self, times_s: Floats, places: NDArray[np.floating]) -> None:
        """Send the axis to places (step,) at ascending times; steps that change nothing are left out."""
        moved = np.diff(places, prepend=self.place[-1]) != 0
        self.time_s += np.maximum(times_s[moved], self.time_s[-1]).tolist()
        self.place += places[moved].astype(float).tolist()
        del self.time_s[: -2 * KEPT_MOVES], self.place[: -2 * KEPT_MOVES]

    def at(self, times_s: ArrayLike) -> Floats:
        """Return where the axis was sent at times (...)."""
        last = np.searchsorted(np.asarray(self.time_s), np.asarray(times_s, np.float64), side="right") - 1
        return np.asarray(self.place)[np.clip(last, 0, None)]


@dataclass
class Playback:
    """A run of a channel's vector unit: cells ``start`` to ``start + length``, ``total`` steps in all."""

    start: int = 0
    length: int = 1
    total: int = 0
    rate_hz: float = 1.0
    triggered: bool = False
    began_s: float = 0.0
    steps: int = 0  # played so far
    running: bool = False

    @property
    def index(self) -> int:
        """The cell that plays, or played last."""
        return self.start + max(self.steps - 1, 0) % self.length

    def due(self, now_s: float) -> Floats:
        """Return the times of the steps up to now that the unit's own clock has not played yet."""
        last = int(min((now_s - self.began_s) * self.rate_hz + 1e-9, self.total))
        return self.began_s + np.arange(self.steps, last + 1) / self.rate_hz

    def play(self, steps: int) -> NDArray[np.intp]:
        """Return the next cells; the run is over where fewer than ``steps`` are left."""
        taken = min(steps, self.total - self.steps)
        cells = self.start + (self.steps + np.arange(taken)) % self.length
        self.steps += taken
        self.running = taken == steps
        return cells


class MirrorState:
    """Registers, memory and motion of one controller, played up to the clock's time when they are used."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.flags = Status(0)  # further status bits
        self.memory = np.zeros(CELLS, np.float32)
        self.values = {number: register.start for number, register in REGISTERS.items()}
        self.axes = [Axis(-math.inf), Axis(-math.inf)]
        self.playbacks = [Playback(), Playback()]
        self._log_s: tuple[float, float] | None = None  # start and stop of the log

    def advance(self) -> float:
        """Play what is due by the units' own clocks, and return the present time. [s]"""
        now = self.clock.now()
        for number, playback in enumerate(self.playbacks):
            if playback.running and not playback.triggered:
                self._step(number, playback.due(now))
        return now

    def trigger(self, rises_s: Floats) -> None:
        """Step the units that wait for rising edges at the trigger input; all others ignore them."""
        for number, playback in enumerate(self.playbacks):
            if playback.running and playback.triggered:
                self._step(number, rises_s)

    def positions(self, times_s: ArrayLike) -> Floats:
        """Return the mirror's positions (..., 2) at times (...) up to now."""
        self.advance()
        return np.stack([axis.at(times_s) for axis in self.axes], axis=-1)

    def status(self) -> Status:
        """Return the present status bits."""
        now = self.advance()
        moving = any(now < axis.time_s[-1] + SETTLE_S for axis in self.axes)
        return self.flags | Status.NOT_STABLE if moving else self.flags

    def get(self, number: int) -> bytes:
        """Return a register's cell; RefusedError where there is no such register."""
        self.advance()
        for channel, playback in zip((pro.X, pro.Y), self.playbacks, strict=True):
            if number == channel.vector(VectorRegister.INDEX):
                return pro.int_cell(playback.index)
        whole = self._register(number).whole
        return pro.int_cell(int(self.values[number])) if whole else pro.float_cell(self.values[number])

    def put(self, cells: Mapping[int, bytes]) -> None:
        """Write registers at one moment; held positions take effect together.

        RefusedError where a register is missing or out of range; none is written then. A range that is not in the
        memory is refused after the other registers were written.
        """
        values = {number: self._register(number).read(cell) for number, cell in cells.items()}
        for channel in (pro.X, pro.Y):
            if values.get(channel.input) not in (None, channel.static_system, channel.vector_system):
                raise RefusedError(ErrorCode.SYSTEM_NOT_SELECTABLE)
        now = self.advance()
        self.values |= values
        for number, channel in enumerate((pro.X, pro.Y)):
            run = values.get(channel.vector(VectorRegister.RUN))
            if run == 0:
                self.playbacks[number].running = False
            elif run is not None:
                self.playbacks[number] = self._started(channel, now)
                self._step(number, np.array([now]))
            if self.values[channel.input] == channel.static_system:
                self.axes[number].send(np.array([now]), np.array([self.values[channel.static_xy]]))
        if values.get(pro.LOG_RUN) == 1:
            self._log_s = now, math.inf
        elif pro.LOG_RUN in values and self._log_s is not None:
            self._log_s = self._log_s[0], min(self._log_s[1], now)

    def get_cells(self, number: int, start: int, stop: int) -> bytes:
        """Return cells of the vector memory or of a log's slot; else RefusedError."""
        if number == pro.VECTOR_MEMORY:
            _check_within(stop, self.memory.size)
            return self.memory[start:stop].astype(">f4").tobytes()
        if not 0 <= number - pro.log_slot(0) < pro.LOG_SLOTS:
            raise RefusedError(ErrorCode.NO_REGISTER)
        _check_within(stop, self._rows())
        channel = int(self.values[number]) - pro.FEEDBACK_X
        times_s = (self._log_s or (0.0, 0.0))[0] + np.arange(start, stop) / self.values[pro.LOG_RATE]
        logged = self.positions(times_s)[:, channel] if channel in (0, 1) else np.zeros(stop - start)
        return logged.astype(">f4").tobytes()

    def put_cells(self, number: int, start: int, data: bytes) -> None:
        """Write cells of the vector memory (else RefusedError)."""
        cells = np.frombuffer(data, ">f4")
        if number != pro.VECTOR_MEMORY:
            raise RefusedError(ErrorCode.NO_REGISTER)
        _check_within(start + len(cells), self.memory.size)
        self.advance()
        self.memory[start : start + len(cells)] = cells

    def _step(self, number: int, times_s: Floats) -> None:
        """Play one cell at each time; the axis follows where its input is the vector unit."""
        cells = self.playbacks[number].play(len(times_s))
        channel = (pro.X, pro.Y)[number]
        if self.values[channel.input] == channel.vector_system:
            self.axes[number].send(times_s[: len(cells)], self.memory[cells])

    def _started(self, channel: pro.ChannelRegisters, now_s: float) -> Playback:
        start, end, cycles, trigger = (
            int(self.values[channel.vector(name)])
            for name in (VectorRegister.START, VectorRegister.END, VectorRegister.CYCLES, VectorRegister.TRIGGER)
        )
        length = end - start
        if length < 1 or end > self.memory.size:
            raise RefusedError(ErrorCode.VECTOR_INDEX)
        rate_hz = self.values[channel.vector(VectorRegister.FREQUENCY)]
        return Playback(start, length, cycles * length, rate_hz, trigger != pro.Trigger.OFF, now_s, 0, True)

    def _rows(self) -> int:
        """Return the rows of the log; it stops by itself when it is full."""
        if self._log_s is None:
            return 0
        seconds = min(self._log_s[1], self.clock.now()) - self._log_s[0]
        return min(int(seconds * self.values[pro.LOG_RATE] + 1e-9) + 1, LOG_ROWS)

    def _register(self, number: int) -> Register:
        if number not in REGISTERS:
            raise RefusedError(ErrorCode.NO_REGISTER)
        return REGISTERS[number]


def _check_within(stop: int, size: int) -> None:
    if stop > size:
        raise RefusedError(ErrorCode.VECTOR_INDEX)


class Mode(Enum):
    """Modes of the controller's protocol."""

    SIMPLE = "simple"
    PRO = "pro"
    PRO_CRC = "pro, requests checked"


@dataclass(frozen=True)
class Request:
    """A request: a line of simple mode without its end, a frame, or bytes that are neither."""

    mode: Mode
    line: str = ""
    frame: pro.Frame | None = None
    damaged: pro.Damaged | None = None

    @property
    def command(self) -> int | None:
        """The command of the frame."""
        return None if self.frame is None else self.frame.command


class MirrorDevice:
    """One emulated controller with its mirror.

    ``pulses`` gives the rising edges at the trigger input. Methods may be called from several threads: that of the
    port, and that of an emulated camera, which asks for positions.
    """

    _line: bytes  # of simple mode, without its end
    _reader: pro.FrameReader

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.pulses: Pulses | None = None
        self._pulses_taken_s = clock.now()
        self._lock, self._pulses_lock = threading.RLock(), threading.Lock()
        self.restart()

    def receive(self, data: bytes) -> list[Chunk]:
        """Take bytes and return what comes back."""
        self.take_pulses()
        with self._lock:
            out: list[Chunk] = []
            while data:
                simple = self.mode is Mode.SIMPLE  # a line or a frame may change the mode
                taken, end, data = data.partition(b"\n" if simple else b"\x7e")
                if not simple:
                    for found in self._reader.feed(taken + end):
                        whole, damaged = (found, None) if isinstance(found, pro.Frame) else (None, found)
                        self._answer(Request(self.mode, frame=whole, damaged=damaged), out)
                    continue
                self._line = (self._line + taken)[: 2 * MOST_LINE]  # enough to see at its end that it is too long
                if end:
                    line, self._line = self._line.rstrip(b"\r"), b""
                    if line:
                        self._answer(Request(Mode.SIMPLE, line=line.decode("ascii", "replace").strip().upper()), out)
            return out

    def take_pulses(self) -> None:
        """Step through the vector memory by the edges at the trigger input since the last call."""
        if self.pulses is None:
            return
        with self._pulses_lock:
            now_s = self.clock.now()
            rises_s = self.pulses(self._pulses_taken_s, now_s)
            self._pulses_taken_s = max(now_s, self._pulses_taken_s)
            if len(rises_s):
                with self._lock:
                    self.state.trigger(rises_s)

    def positions(self, times_s: ArrayLike) -> Floats:
        """Return the mirror's positions (..., 2), device X and Y, at times of the clock up to now (...)."""
        self.take_pulses()
        with self._lock:
            return self.state.positions(times_s)

    def restart(self) -> None:
        """Lose all state and be in simple mode, as after power-on."""
        with self._lock:
            self.state = MirrorState(self.clock)
            self.set_mode(Mode.SIMPLE)

    def set_mode(self, mode: Mode) -> None:
        """Speak another mode from the next byte on."""
        self.mode = mode
        self._line = b""
        self._reader = pro.FrameReader()

    def _answer(self, request: Request, out: list[Chunk]) -> None:
        """Carry a request out and add the reply."""
        if reply := self.carry_out(request):
            out.append(Chunk(TURNAROUND_S, reply))

    def carry_out(self, request: Request) -> bytes:
        """Do what a request asks for and return the bytes of the reply."""
        if request.damaged is not None:  # answered to the command that the bytes seem to hold, if any
            return _refusal(request.damaged.data[1] if len(request.damaged.data) > 1 else 0, ErrorCode.FRAME_INVALID)
        if request.frame is None:
            return self._simple(request.line).encode("ascii") + END
        frame = request.frame
        if self.mode is Mode.PRO_CRC and not frame.crc_good:
            return _refusal(frame.command, ErrorCode.CRC_WRONG)
        try:
            return pro.encode(pro.Frame(frame.command, self._pro(frame.command, frame.payload)))
        except RefusedError as refused:
            return _refusal(frame.command, refused.code)
        except ShapeError:
            return _refusal(frame.command, ErrorCode.LENGTH_MISMATCH)

    def _simple(self, line: str) -> str:
        """Carry out a line, in capitals and without its end, and return the answer without an end."""
        if len(line) + len(END) > MOST_LINE:
            return "ERROR"
        modes = {START: Mode.SIMPLE, GO_PRO: Mode.PRO, GO_PRO_CRC: Mode.PRO_CRC}
        if line in modes:
            self.set_mode(modes[line])
        return OK if line in modes else TEXTS.get(line, "NO")

    def _pro(self, command: int, payload: bytes) -> bytes:
        """Carry out a frame and return the payload of the reply; RefusedError or ShapeError where it is refused."""
        state = self.state
        match command:
            case pro.Command.STATUS:
                return pro.int_cell(int(state.status()))
            case pro.Command.SET_MODE:
                if any(payload):
                    raise RefusedError(ErrorCode.OUT_OF_RANGE)
                self.set_mode(Mode.SIMPLE)
            case pro.Command.GET_VALUE:
                return state.get(int.from_bytes(pro.checked(payload, 2), "big"))
            case pro.Command.SET_VALUES:
                state.put(pro.read_registers(payload))
            case pro.Command.GET_VECTOR:
                register, offset, length, _ = pro.read_vector(payload)
                return state.get_cells(register, offset // pro.CELL, (offset + length) // pro.CELL)
            case pro.Command.SET_VECTOR:
                register, offset, length, cells = pro.read_vector(payload)
                state.put_cells(register, offset // pro.CELL, pro.checked(cells, length // pro.CELL * pro.CELL))
            case _:
                raise RefusedError(ErrorCode.COMMAND_UNKNOWN)
        return b""


def _refusal(command: int, code: ErrorCode) -> bytes:
    return pro.encode(pro.refuse(command & ~pro.ERROR_FLAG, code))
