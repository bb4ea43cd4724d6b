"""How the emulated controller answers frames of pro mode. A change of the mode is the device's own affair."""

from __future__ import annotations

from collections.abc import Callable

from pipeline.errors import ShapeError
from pipeline.rig.emulator.mirror_registers import RefusedError, RegisterFile
from pipeline.rig.mirror.pro_mode import ERROR_FLAG, Command, ErrorCode, Frame
from pipeline.rig.mirror.pro_payloads import (
    acknowledge,
    int_cell,
    read_register,
    read_registers,
    read_vector,
    refuse,
    values_reply,
)  # fmt: skip
from pipeline.rig.mirror.registers import Status

Handler = Callable[[RegisterFile, bytes], Frame]


def answer_frame(registers: RegisterFile, frame: Frame, status: Status) -> Frame:
    """Carry out a frame and give the reply, which may say why not."""
    command = frame.command & ~ERROR_FLAG
    handler = HANDLERS.get(frame.command)
    try:
        if frame.command == Command.FIRMWARE_ID:
            _expect(frame.payload in (b"", b"\x00\x00"))
            return Frame(command, int_cell(registers.firmware_id))
        if frame.command == Command.STATUS:
            _expect(frame.payload in (b"", b"\x00\x00"))
            return Frame(command, int_cell(int(status)))
        if frame.command == Command.SET_MODE:
            _expect(len(frame.payload) == 2)
            return refuse(command, ErrorCode.OUT_OF_RANGE) if any(frame.payload) else acknowledge(command)
        return refuse(command, ErrorCode.COMMAND_UNKNOWN) if handler is None else handler(registers, frame.payload)
    except RefusedError as refused:
        return refuse(command, refused.code)
    except ShapeError:
        return refuse(command, ErrorCode.LENGTH_MISMATCH)


def _get_value(registers: RegisterFile, payload: bytes) -> Frame:
    register, cell = read_register(payload)
    _expect(not cell)
    return Frame(Command.GET_VALUE, registers.get(register))


def _set_value(registers: RegisterFile, payload: bytes) -> Frame:
    register, cell = read_register(payload)
    _expect(bool(cell))
    registers.put({register: cell})
    return acknowledge(Command.SET_VALUE)


def _get_values(registers: RegisterFile, payload: bytes) -> Frame:
    asked = read_registers(payload, with_cells=False)
    _expect(bool(asked))
    return values_reply([registers.get(number) for number, _ in asked])


def _set_values(registers: RegisterFile, payload: bytes) -> Frame:
    given = read_registers(payload, with_cells=True)
    _expect(bool(given))
    registers.put(dict(given))
    return acknowledge(Command.SET_VALUES)


def _get_vector(registers: RegisterFile, payload: bytes) -> Frame:
    register, offset, length, cells = read_vector(payload)
    _expect(not cells)
    return Frame(Command.GET_VECTOR, registers.get_cells(register, offset, length))


def _set_vector(registers: RegisterFile, payload: bytes) -> Frame:
    register, offset, length, cells = read_vector(payload)
    _expect(len(cells) == length)
    registers.put_cells(register, offset, cells)
    return acknowledge(Command.SET_VECTOR)


HANDLERS: dict[int, Handler] = {
    Command.GET_VALUE: _get_value,
    Command.SET_VALUE: _set_value,
    Command.GET_VALUES: _get_values,
    Command.SET_VALUES: _set_values,
    Command.GET_VECTOR: _get_vector,
    Command.SET_VECTOR: _set_vector,
}


def _expect(fits: bool) -> None:
    if not fits:
        raise ShapeError("a payload whose length does not fit the command")
