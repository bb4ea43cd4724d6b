"""Faults of the controller itself: what it answers, what it is in, and what it does without saying so."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.rig.emulator.exchange import Chunk, Mode, Request
from pipeline.rig.emulator.fault import Fault
from pipeline.rig.mirror.pro_mode import Command, Frame, encode
from pipeline.rig.mirror.pro_payloads import CELL, int_cell, read_vector, refuse
from pipeline.rig.mirror.registers import VECTOR_MEMORY, Status
from pipeline.rig.mirror.simple_mode import END, ID, VERSION

if TYPE_CHECKING:
    from pipeline.rig.emulator.mirror_device import MirrorDevice

_OTHER_ID, _OTHER_VERSION, _OTHER_FIRMWARE = "LENS-DRIVER-4", "0.0.1", 0xDEAD0001
_WRITES_VECTOR = frozenset({Command.SET_VECTOR})


@dataclass
class ProAtConnect(Fault):
    """An earlier session left the controller in pro mode."""

    def begin(self, device: MirrorDevice) -> None:
        """Be in one of the two pro modes."""
        self.chance.struck += 1
        device.set_mode(self.chance.random.choice((Mode.PRO, Mode.PRO_CRC)))


@dataclass
class SilentReset(Fault):
    """The controller restarts by itself as a request comes, says nothing and is in simple mode afterwards."""

    boot_s: float
    commands: Collection[int] | None = None  # frames that can be struck; None is any request

    def verdict(self, device: MirrorDevice, request: Request) -> bytes | None:
        """Restart instead of an answer."""
        if (self.commands is not None and request.command not in self.commands) or not self.chance.comes():
            return None
        device.restart(boot_s=self.boot_s)
        return b""


@dataclass
class AnswersLine(Fault):
    """One line of simple mode gets a refusal and is not carried out."""

    answer: str

    def verdict(self, device: MirrorDevice, request: Request) -> bytes | None:
        """Refuse the line whose turn it is."""
        if request.mode is not Mode.SIMPLE or not self.chance.comes():
            return None
        return self.answer.encode("ascii") + END


@dataclass
class AnswersError(Fault):
    """One frame gets an error code and is not carried out."""

    code: int
    commands: Collection[int] | None = None  # that can be struck; None is any

    def verdict(self, device: MirrorDevice, request: Request) -> bytes | None:
        """Refuse the frame whose turn it is."""
        command = request.command
        if command is None or (self.commands is not None and command not in self.commands):
            return None
        return encode(refuse(command, self.code)) if self.chance.comes() else None


@dataclass
class CellLost(Fault):
    """One cell of the vector memory keeps what it held, though its writing is acknowledged."""

    def verdict(self, device: MirrorDevice, request: Request) -> bytes | None:
        """Carry the request out and put one of the cells that it changes back."""
        if request.frame is None or request.command not in _WRITES_VECTOR or len(request.frame.payload) < 5 + CELL:
            return None
        register, offset, length, _ = read_vector(request.frame.payload)
        memory, cells = device.state.memory, slice(offset // CELL, (offset + length) // CELL)
        if register != VECTOR_MEMORY or not self.chance.comes():
            return None
        before = memory[cells].copy()
        reply = device.carry_out(request)
        changed = np.flatnonzero(memory[cells] != before)
        if changed.size:
            place = self.chance.random.choice(changed.tolist())
            memory[cells.start + place] = before[place]
        return reply


@dataclass
class StatusBit(Fault):
    """From one request on a bit of the status is on, and stays."""

    bit: Status
    on: bool = False

    def verdict(self, device: MirrorDevice, request: Request) -> bytes | None:
        """Take the request for an opportunity, no more."""
        self.on = self.chance.lasts()
        if self.on:
            device.state.flags |= self.bit
        return None


@dataclass
class OtherFirmware(Fault):
    """The controller is another model of its maker."""

    def verdict(self, device: MirrorDevice, request: Request) -> bytes | None:
        """Say who it is."""
        texts = {ID: _OTHER_ID, VERSION: _OTHER_VERSION}
        if request.line in texts:
            self.chance.struck += 1
            return texts[request.line].encode("ascii") + END
        if request.command == Command.FIRMWARE_ID:
            self.chance.struck += 1
            return encode(Frame(Command.FIRMWARE_ID, int_cell(_OTHER_FIRMWARE)))
        return None


@dataclass
class OldReplyAgain(Fault):
    """The reply before is sent once more, in front of one reply."""

    last: bytes = b""

    def outgoing(self, device: MirrorDevice, request: Request, chunks: list[Chunk]) -> list[Chunk]:
        """Send the old reply first, when the turn has come."""
        whole = b"".join(data for _, data in chunks)
        if not whole:
            return chunks
        again = [Chunk(chunks[0].delay_s, self.last)] if self.chance.comes() and self.last else []
        self.last = whole
        return again + chunks
