"""The emulated controller's registers: which there are, what may be written to them, and the error where it may not."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from pipeline.rig.emulator.mirror_state import MirrorState
from pipeline.rig.emulator.position_logger import PositionLogger
from pipeline.rig.mirror.pro_mode import MOST_PAYLOAD, ErrorCode
from pipeline.rig.mirror.pro_payloads import CELL, cell_float, cell_int, float_cell, int_cell
from pipeline.rig.mirror.registers import (
    FEEDBACK_A,
    FEEDBACK_X,
    LOG_RATE,
    LOG_RUN,
    LOG_SLOTS,
    VECTOR_MEMORY,
    ChannelRegisters,
    Trigger,
    Unit,
    VectorRegister,
    log_slot,
)  # fmt: skip

LOWEST_HZ, HIGHEST_HZ = 0.0, 10_000.0
_TEMPERATURES = 0x2200  # mirror, electronics, and the limits of both, in whole degrees
_ANALOG, _GENERATOR = 0x58, 0x60
_CURRENT_A = 0.7


class RefusedError(Exception):
    """The controller answers with an error code."""

    def __init__(self, code: ErrorCode) -> None:
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

    def to_cell(self) -> bytes:
        """Give the cell of what is in it."""
        value = self.read()
        return int_cell(int(value)) if self.whole else float_cell(float(value))

    def check(self, cell: bytes) -> float | int:
        """Read a cell that is to be written.

        Raises
        ------
        RefusedError : the register is read only, or the value is out of its range.
        """
        if self.write is None:
            raise RefusedError(ErrorCode.READ_ONLY)
        value: float | int = cell_int(cell) if self.whole else cell_float(cell)
        if self.signed and value >= 2**31:
            value -= 2**32
        if not self.least <= value <= self.most:  # NaN is in no range
            raise RefusedError(ErrorCode.OUT_OF_RANGE)
        return value


class RegisterFile:
    """All registers of a controller, by id."""

    def __init__(self, state: MirrorState) -> None:
        self._state = state
        self.logger = PositionLogger(state)
        self._registers = {
            **_board(state), **_logger(self.logger), **_channel(state, 0), **_channel(state, 1)
        }  # fmt: skip

    @property
    def firmware_id(self) -> int:
        """Id of the firmware, which is no register."""
        return self._state.unit.firmware_id

    def get(self, number: int) -> bytes:
        """Give a register's cell.

        Raises
        ------
        RefusedError : there is no such register.
        """
        self._state.advance()
        return self._find(number).to_cell()

    def put(self, cells: Mapping[int, bytes]) -> None:
        """Write registers at one moment; held positions go out together.

        Raises
        ------
        RefusedError : a register is missing, read only or out of range, and then none is written; or one does not take
            its value as things stand, and then those before it are.
        """
        values = {number: self._find(number).check(cell) for number, cell in cells.items()}
        self._state.advance()
        for number, value in values.items():
            write = self._find(number).write
            assert write is not None
            write(value)
        self._state.aim()

    def get_cells(self, number: int, offset: int, length: int) -> bytes:
        """Give cells of the vector memory or of a slot of the logger; offset and length in bytes.

        Raises
        ------
        RefusedError : no such vector, not whole cells, beyond the vector's end, or more than a frame carries.
        """
        start, stop = _cells(offset, length)
        if number == VECTOR_MEMORY:
            _within(stop, self._state.memory.size)
            return self._state.memory[start:stop].astype(">f4").tobytes()
        if number not in range(log_slot(0), log_slot(LOG_SLOTS)):
            raise RefusedError(ErrorCode.NO_REGISTER)
        _within(stop, self.logger.rows)
        return self.logger.cells(number - log_slot(0), start, stop)

    def put_cells(self, number: int, offset: int, data: bytes) -> None:
        """Write cells of the vector memory.

        Raises
        ------
        RefusedError : no such vector, one that is read only, not whole cells, or beyond the vector's end.
        """
        start, stop = _cells(offset, len(data))
        if number != VECTOR_MEMORY:
            logged = number in range(log_slot(0), log_slot(LOG_SLOTS))
            raise RefusedError(ErrorCode.READ_ONLY if logged else ErrorCode.NO_REGISTER)
        _within(stop, self._state.memory.size)
        self._state.advance()
        self._state.memory[start:stop] = np.frombuffer(data, ">f4")

    def _find(self, number: int) -> Register:
        found = self._registers.get(number)
        if found is None:
            raise RefusedError(ErrorCode.NO_REGISTER)
        return found


def _cells(offset: int, length: int) -> tuple[int, int]:
    if offset % CELL or length % CELL:
        raise RefusedError(ErrorCode.VECTOR_ALIGNMENT)
    if not 0 < length <= MOST_PAYLOAD:
        raise RefusedError(ErrorCode.LENGTH_MISMATCH)
    return offset // CELL, (offset + length) // CELL


def _within(stop: int, size: int) -> None:
    if stop > size:
        raise RefusedError(ErrorCode.VECTOR_INDEX)


def _board(state: MirrorState) -> dict[int, Register]:
    """Temperatures and optical feedback."""

    def place(channel: int) -> float:
        return state.axes[channel].place(state.moment)

    table = {
        first + channel: Register(partial(place, channel)) for first in (FEEDBACK_A, FEEDBACK_X) for channel in (0, 1)
    }
    degrees = (state.unit.temperature_c, state.unit.temperature_c, 65.0, 65.0)
    for number, value in enumerate(degrees, _TEMPERATURES):
        table[number] = Register(partial(round, value), whole=True)
    table[VECTOR_MEMORY] = Register(lambda: 0, whole=True)  # whether the head's own copy is valid
    return table


def _logger(logger: PositionLogger) -> dict[int, Register]:
    def choose(slot: int, register: int) -> None:
        logger.slots[slot] = register

    def set_rate(rate_hz: float) -> None:
        logger.rate_hz = rate_hz

    table = {
        log_slot(slot): Register(partial(logger.slots.__getitem__, slot), partial(choose, slot), 0, 0xFFFF, whole=True)
        for slot in range(LOG_SLOTS)
    }
    table[LOG_RUN] = Register(lambda: logger.running, lambda on: logger.run(bool(on)), 0, 1, whole=True)
    table[LOG_RATE] = Register(lambda: logger.rate_hz, set_rate, 1.0, HIGHEST_HZ)
    return table


def _channel(state: MirrorState, channel: int) -> dict[int, Register]:
    """Inputs of a channel and which of them it follows; analog input and generator only keep what they are given."""
    registers = ChannelRegisters(channel)
    inputs = {registers.static_system, registers.vector_system, _ANALOG + channel, _GENERATOR + channel}

    def choose(system: int) -> None:
        if system not in inputs:
            raise RefusedError(ErrorCode.SYSTEM_NOT_SELECTABLE)
        state.inputs[channel] = system

    def control(system: int) -> None:
        state.controls[channel] = system

    def hold(unit: Unit, value: float) -> None:
        state.static[channel][unit] = value

    table = {
        registers.input: Register(lambda: state.inputs[channel], choose, 0, 0xFF, whole=True),
        registers.control: Register(lambda: state.controls[channel], control, 0, 0xFF, whole=True),
    }
    for unit in Unit:
        most = _CURRENT_A if unit is Unit.CURRENT else 1.0
        table[registers.static_system << 8 | unit] = Register(
            partial(state.static[channel].__getitem__, unit), partial(hold, unit), -most, most
        )
    kept: dict[int, float] = {}
    for number in (
        *range((_ANALOG + channel) << 8 | 1, ((_ANALOG + channel) << 8) + 6),
        *range((_GENERATOR + channel) << 8, ((_GENERATOR + channel) << 8) + 9),
        *range(registers.xy_system << 8, (registers.xy_system << 8) + 3),
    ):
        kept[number] = 0.0
        table[number] = Register(partial(kept.__getitem__, number), partial(kept.__setitem__, number))
    return {**table, **_vector_unit(state, channel)}


def _vector_unit(state: MirrorState, channel: int) -> dict[int, Register]:
    player = state.players[channel]
    most = state.memory.size

    def setter(name: str, kind: type = int) -> Callable[[float], None]:
        return lambda value: setattr(player, name, kind(value))

    def run(on: int) -> None:
        if not on:
            player.stop()
        elif player.length < 1 or player.start + player.length > most:
            raise RefusedError(ErrorCode.VECTOR_INDEX)
        else:
            player.run(state.moment)

    def reader(name: str) -> Callable[[], float]:
        return lambda: getattr(player, name)

    rows = {
        VectorRegister.UNIT: Register(reader("unit"), setter("unit", Unit), 0, 2, whole=True),
        VectorRegister.RUN: Register(reader("running"), run, 0, 1, whole=True),
        VectorRegister.START: Register(reader("start"), setter("start"), 0, most, whole=True),
        VectorRegister.END: Register(reader("end"), setter("end"), 0, most, whole=True),
        VectorRegister.FREQUENCY: Register(reader("frequency_hz"), setter("frequency_hz", float), 1e-3, HIGHEST_HZ),
        VectorRegister.LOWEST: Register(lambda: LOWEST_HZ),
        VectorRegister.HIGHEST: Register(lambda: HIGHEST_HZ),
        VectorRegister.CYCLES: Register(reader("cycles"), setter("cycles"), -1, 2**31 - 1, whole=True, signed=True),
        VectorRegister.TRIGGER: Register(reader("external"), setter("external", Trigger), 0, 2, whole=True),
        VectorRegister.OUTPUT: Register(lambda: state.played[channel]),
        VectorRegister.INDEX: Register(reader("index"), whole=True),
    }
    return {ChannelRegisters(channel).vector(name): register for name, register in rows.items()}
