"""The emulated mirror controller: bytes in, bytes out, and its registers; time only by the clock that it is given.

It has what drivers ask for in both modes of the documented protocol. Assumed, as the documents leave it open: an empty
line has no answer; NO answers a line that is not known, ERROR one that is too long. Bytes that come while the
controller boots are lost. Bytes in pro mode that are no frame are answered by error 0001 at the next boundary. Requests
are checked by their CRC after GOPROCRC alone, and replies always carry it.
"""

from __future__ import annotations

import math
import operator
import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.errors import ShapeError
from pipeline.rig.emulator import Chunk
from pipeline.rig.emulator.mirror_state import MirrorState, MirrorUnit, PositionLogger
from pipeline.rig.mirror import mirror_requests as simple
from pipeline.rig.mirror import pro_mode as pro
from pipeline.rig.mirror.mirror_requests import END, MOST_LINE, Reply
from pipeline.rig.transports import Clock

LOWEST_HZ, HIGHEST_HZ = 0.0, 10_000.0
_CURRENT_A = 0.7
_LOGGED = range(pro.log_slot(0), pro.log_slot(pro.LOG_SLOTS))  # vectors of the logger


class RefusedError(Exception):
    """The controller answers with an error code."""

    def __init__(self, code: pro.ErrorCode) -> None:
        super().__init__(code.name)
        self.code = code


@dataclass(frozen=True)
class Register:
    """One register: how it is read and written, and the range of what it takes."""

    read: Callable[[], float | int]
    write: Callable[[Any], object] | None = None
    least: float = -math.inf
    most: float = math.inf
    whole: bool = False
    signed: bool = False

    def check(self, cell: bytes) -> float | int:
        """Read a cell that is to be written; RefusedError where it may not be, or is out of range."""
        if self.write is None:
            raise RefusedError(pro.ErrorCode.READ_ONLY)
        value: float | int = pro.cell_int(cell) if self.whole else pro.cell_float(cell)
        if self.signed and value >= 2**31:
            value -= 2**32
        if not self.least <= value <= self.most:  # NaN is in no range
            raise RefusedError(pro.ErrorCode.OUT_OF_RANGE)
        return value


class RegisterFile:
    """All registers of a controller, by id."""

    def __init__(self, state: MirrorState) -> None:
        self._state = state
        self.logger = PositionLogger(state)
        each = [Register(*_item(self.logger.slots, slot), 0, 0xFFFF, whole=True) for slot in range(pro.LOG_SLOTS)]
        self._registers = {pro.log_slot(slot): register for slot, register in enumerate(each)} | {
            pro.FEEDBACK_X: Register(lambda: state.axes[0].place(state.moment)),
            pro.FEEDBACK_Y: Register(lambda: state.axes[1].place(state.moment)),
            pro.VECTOR_MEMORY: Register(lambda: 0, whole=True),  # whether the head's own copy is valid
            pro.LOG_RUN: Register(lambda: self.logger.running, lambda on: self.logger.run(bool(on)), 0, 1, whole=True),
            pro.LOG_RATE: Register(*_attribute(self.logger, "rate_hz", float), 1.0, HIGHEST_HZ),
            **_channel(state, 0),
            **_channel(state, 1),
        }

    def answer(self, frame: pro.Frame) -> pro.Frame:
        """Carry out a frame of pro mode and give the reply, which may say why not."""
        command = frame.command & ~pro.ERROR_FLAG
        try:
            return self._carry_out(frame.command, frame.payload)
        except RefusedError as refused:
            return pro.refuse(command, refused.code)
        except ShapeError:
            return pro.refuse(command, pro.ErrorCode.LENGTH_MISMATCH)

    def _carry_out(self, command: int, payload: bytes) -> pro.Frame:
        match command:
            case pro.Command.FIRMWARE_ID | pro.Command.STATUS:
                _expect(payload in (b"", b"\x00\x00"))
                asked_id = command == pro.Command.FIRMWARE_ID
                return pro.Frame(
                    command, pro.int_cell(self._state.unit.firmware_id if asked_id else int(self._state.status()))
                )
            case pro.Command.SET_MODE:  # which is the device's own affair
                _expect(len(payload) == 2)
                if any(payload):
                    raise RefusedError(pro.ErrorCode.OUT_OF_RANGE)
            case pro.Command.GET_VALUE:
                register, cell = pro.read_register(payload)
                _expect(not cell)
                return pro.Frame(command, self.get(register))
            case pro.Command.SET_VALUE:
                register, cell = pro.read_register(payload)
                _expect(bool(cell))
                self.put({register: cell})
            case pro.Command.GET_VALUES:
                asked = pro.read_registers(payload, with_cells=False)
                _expect(bool(asked))
                return pro.values_reply([self.get(number) for number, _ in asked])
            case pro.Command.SET_VALUES:
                given = pro.read_registers(payload, with_cells=True)
                _expect(bool(given))
                self.put(dict(given))
            case pro.Command.GET_VECTOR:
                register, offset, length, cells = pro.read_vector(payload)
                _expect(not cells)
                return pro.Frame(command, self.get_cells(register, offset, length))
            case pro.Command.SET_VECTOR:
                register, offset, length, cells = pro.read_vector(payload)
                _expect(len(cells) == length)
                self.put_cells(register, offset, cells)
            case _:
                raise RefusedError(pro.ErrorCode.COMMAND_UNKNOWN)
        return pro.Frame(command)

    def get(self, number: int) -> bytes:
        """Return a register's cell; RefusedError where there is no such register."""
        self._state.advance()
        register = self._find(number)
        value = register.read()
        return pro.int_cell(int(value)) if register.whole else pro.float_cell(float(value))

    def put(self, cells: Mapping[int, bytes]) -> None:
        """Write registers at one moment; held positions go out together.

        Raises RefusedError: a register is missing, read only or out of range, and none is written. It is raised, too,
        where one does not take its value in the present state; those before it are written then.
        """
        values = {number: self._find(number).check(cell) for number, cell in cells.items()}
        self._state.advance()
        for number, value in values.items():
            write = self._find(number).write
            assert write is not None
            write(value)
        self._state.aim()

    def get_cells(self, number: int, offset: int, length: int) -> bytes:
        """Return whole cells of the vector memory or of a log's slot; offset and length are in bytes.

        Raises RefusedError: the cells are not whole, or not there.
        """
        start, stop = _cells(offset, length)
        if number == pro.VECTOR_MEMORY:
            _within(stop, self._state.memory.size)
            return self._state.memory[start:stop].astype(">f4").tobytes()
        if number not in _LOGGED:
            raise RefusedError(pro.ErrorCode.NO_REGISTER)
        _within(stop, self.logger.rows)
        return self.logger.cells(number - pro.log_slot(0), start, stop)

    def put_cells(self, number: int, offset: int, data: bytes) -> None:
        """Write whole cells of the vector memory (else RefusedError)."""
        start, stop = _cells(offset, len(data))
        if number != pro.VECTOR_MEMORY:
            raise RefusedError(pro.ErrorCode.READ_ONLY if number in _LOGGED else pro.ErrorCode.NO_REGISTER)
        _within(stop, self._state.memory.size)
        self._state.advance()
        self._state.memory[start:stop] = np.frombuffer(data, ">f4")

    def _find(self, number: int) -> Register:
        found = self._registers.get(number)
        if found is None:
            raise RefusedError(pro.ErrorCode.NO_REGISTER)
        return found


def _expect(fits: bool) -> None:
    if not fits:
        raise ShapeError("a payload whose length does not fit the command")


def _cells(offset: int, length: int) -> tuple[int, int]:
    if offset % pro.CELL or length % pro.CELL:
        raise RefusedError(pro.ErrorCode.VECTOR_ALIGNMENT)
    if not 0 < length <= pro.MOST_PAYLOAD:
        raise RefusedError(pro.ErrorCode.LENGTH_MISMATCH)
    return offset // pro.CELL, (offset + length) // pro.CELL


def _within(stop: int, size: int) -> None:
    if stop > size:
        raise RefusedError(pro.ErrorCode.VECTOR_INDEX)


def _channel(state: MirrorState, channel: int) -> dict[int, Register]:
    """Return the inputs of a channel, and which of them it follows."""
    registers = pro.ChannelRegisters(channel)
    inputs = {registers.static_system, registers.vector_system}

    def choose(system: int) -> None:
        if system not in inputs:
            raise RefusedError(pro.ErrorCode.SYSTEM_NOT_SELECTABLE)
        state.inputs[channel] = system

    table = {
        registers.input: Register(lambda: state.inputs[channel], choose, 0, 0xFF, whole=True),
        registers.control: Register(*_item(state.controls, channel), 0, 0xFF, whole=True),
    }
    for unit in pro.Unit:
        most = _CURRENT_A if unit is pro.Unit.CURRENT else 1.0
        table[registers.static_system << 8 | unit] = Register(*_item(state.static[channel], unit), -most, most)
    return {**table, **_vector_unit(state, channel)}


def _vector_unit(state: MirrorState, channel: int) -> dict[int, Register]:
    player, most = state.players[channel], state.memory.size

    def run(on: int) -> None:
        if not on:
            player.stop()
        elif player.length < 1 or player.start + player.length > most:
            raise RefusedError(pro.ErrorCode.VECTOR_INDEX)
        else:
            player.run(state.moment)

    rows = {
        pro.VectorRegister.UNIT: Register(*_attribute(player, "unit", pro.Unit), 0, 2, whole=True),
        pro.VectorRegister.RUN: Register(lambda: player.running, run, 0, 1, whole=True),
        pro.VectorRegister.START: Register(*_attribute(player, "start"), 0, most, whole=True),
        pro.VectorRegister.END: Register(*_attribute(player, "end"), 0, most, whole=True),
        pro.VectorRegister.FREQUENCY: Register(*_attribute(player, "frequency_hz", float), 1e-3, HIGHEST_HZ),
        pro.VectorRegister.LOWEST: Register(lambda: LOWEST_HZ),
        pro.VectorRegister.HIGHEST: Register(lambda: HIGHEST_HZ),
        pro.VectorRegister.CYCLES: Register(*_attribute(player, "cycles"), -1, 2**31 - 1, whole=True, signed=True),
        pro.VectorRegister.TRIGGER: Register(*_attribute(player, "external", pro.Trigger), 0, 2, whole=True),
        pro.VectorRegister.OUTPUT: Register(lambda: state.played[channel]),
        pro.VectorRegister.INDEX: Register(lambda: player.index, whole=True),
    }
    return {pro.ChannelRegisters(channel).vector(name): register for name, register in rows.items()}


def _item(holder: Any, key: int) -> tuple[Callable[[], Any], Callable[[Any], object]]:
    """Return a reader and a writer of an item of a list or of a dictionary."""
    return partial(operator.getitem, holder, key), partial(operator.setitem, holder, key)


def _attribute(holder: object, name: str, kind: type = int) -> tuple[Callable[[], Any], Callable[[Any], object]]:
    """Return a reader and a writer of an attribute."""
    return partial(getattr, holder, name), lambda value: setattr(holder, name, kind(value))


KEPT_ACTS = 5_000
Floats = NDArray[np.float64]
Pulses = Callable[[float, float], Floats]  # (pulse, 2) rises and falls of pulses that rise within a span of time


class Mode(Enum):
    """Modes of the controller's protocol."""

    SIMPLE = "simple"
    PRO = "pro"
    PRO_CRC = "pro, requests checked"


@dataclass(frozen=True)
class Request:
    """A request as it came: a line of simple mode without its end, a frame, or bytes that are neither."""

    mode: Mode
    line: str = ""
    frame: pro.Frame | None = None
    damaged: pro.Damaged | None = None

    @property
    def command(self) -> int | None:
        """Command of the frame."""
        return None if self.frame is None else self.frame.command

    @property
    def words(self) -> str:
        """Return the request for people: the line, or the command's name."""
        if self.frame is None:
            return self.line or "bytes that are no frame"
        known = {command.value: command.name for command in pro.Command}
        return known.get(self.frame.command, f"command {self.frame.command:02X}").lower().replace("_", " ")


@dataclass(frozen=True)
class Act:
    """A request that was carried out, and when, for tests. [s]"""

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
        """Return the true mirror positions, (..., 2) device X and Y, at times of the clock up to now (...)."""
        self.take_pulses()
        with self._lock:
            return self.state.positions(times_s)

    def sent(self, times_s: ArrayLike) -> Floats:
        """Return the commanded mirror positions, (..., 2), at times of the clock up to now (...)."""
        self.take_pulses()
        with self._lock:
            self.state.advance()
            return np.stack([axis.commands(times_s) for axis in self.state.axes], axis=-1)

    def restart(self, *, boot_s: float) -> None:
        """Lose everything and be in simple mode, deaf for ``boot_s``: a reset, or a loss of power."""
        with self._lock:
            now = self.clock.now()
            self.state.restart(now)
            self.registers = RegisterFile(self.state)
            self.mode = Mode.SIMPLE
            self._line, self._reader = b"", pro.FrameReader()
            self._boots_until = now + boot_s if boot_s > 0 else -math.inf

    def set_mode(self, mode: Mode) -> None:
        """Speak another mode from the next byte on."""
        self.mode, self._line, self._reader = mode, b"", pro.FrameReader()

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
        taken, end, rest = data.partition(bytes((pro.BOUNDARY,)))
        for found in self._reader.feed(taken + end):
            whole, damaged = (found, None) if isinstance(found, pro.Frame) else (None, found)
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
            return pro.encode(pro.refuse(command & ~pro.ERROR_FLAG, pro.ErrorCode.FRAME_INVALID))
        if request.frame is not None:
            if self.mode is Mode.PRO_CRC and not request.frame.crc_good:
                return pro.encode(pro.refuse(request.frame.command & ~pro.ERROR_FLAG, pro.ErrorCode.CRC_WRONG))
            reply = self.registers.answer(request.frame)
            if reply.command == pro.Command.SET_MODE:
                self.set_mode(Mode.SIMPLE)
            return pro.encode(reply)
        return self._simple(request.line).encode("ascii") + END

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
            case simple.GO_PRO:
                self.set_mode(Mode.PRO)
            case simple.GO_PRO_CRC:
                self.set_mode(Mode.PRO_CRC)
            case simple.START:
                pass
            case _:
                return Reply.NO
        return Reply.OK
