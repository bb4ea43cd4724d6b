"""Named faults of the emulated mirror controller, wrapped around it; a seed draws when and how each strikes."""

from __future__ import annotations

import errno
import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import partial
from random import Random
from typing import Any

import numpy as np

from pipeline.rig.emulator import Chunk
from pipeline.rig.emulator.mirror_device import TURNAROUND_S, MirrorDevice, Mode, Request
from pipeline.rig.mirror_controller import END, ID, VERSION
from pipeline.rig.pro_mode import CELL, VECTOR_MEMORY, Command, ErrorCode, Status, encode, read_vector, refuse

LATE_S = 20.0  # beyond any deadline
SLOW_S = 0.02  # from byte to byte
# left behind by another program: the end of a text reply, the end of a status, and a whole frame
_LEFT_BEHIND = (b"R-E-2\r\n", b"00000010\r\n", bytes.fromhex("7e 00 11 04 00 00 00 00 f2 81 7e"))
_OTHER_TEXTS = {ID: "LENS-DRIVER-4", VERSION: "0.0.1"}

Change = Callable[[bytes, int, Random], bytes]  # some bytes, and the place of the changed one
Spoil = Callable[[MirrorDevice, list[Chunk], Random], list[Chunk]]


class VanishedError(OSError):
    """The device disappeared, so that no port has it."""

    def __init__(self) -> None:
        super().__init__(errno.EIO, "the device is gone")


@dataclass
class Chance:
    """Draws the opportunity at which a fault strikes, with equal probability per octave of opportunities."""

    random: Random
    at: int
    seen: int = 0
    struck: int = 0

    @classmethod
    def drawn(cls, name: str, seed: int, span: int, at: int | None = None) -> Chance:
        """Draw the opportunity from 0 to ``span``, exclusive, unless ``at`` is given."""
        random = Random(f"{name} {seed}")
        drawn = int(2 ** random.uniform(0, math.log2(span + 1))) - 1
        return cls(random, min(drawn, span - 1) if at is None else at)

    def comes(self) -> bool:
        """Count an opportunity and return whether the fault strikes at it."""
        self.seen += 1
        now = self.seen == self.at + 1
        self.struck += now
        return now

    def lasts(self) -> bool:
        """Count an opportunity and return whether the fault strikes at it or struck before."""
        return self.comes() or self.seen > self.at


@dataclass
class Fault:
    """A fault that never strikes. Its hooks are called in this order."""

    chance: Chance

    def begin(self, device: FaultyMirror) -> None:
        """Act when the controller is switched on."""

    def opened(self, device: FaultyMirror) -> list[Chunk]:
        """Return the bytes in the port when it is opened."""
        return []

    def instead(self, device: FaultyMirror, data: bytes) -> list[Chunk] | None:
        """Answer bytes instead of the controller; None leaves them to it."""
        return None

    def incoming(self, device: FaultyMirror, data: bytes) -> bytes:
        """Return the bytes that reach the controller."""
        return data

    def verdict(self, device: FaultyMirror, request: Request) -> bytes | None:
        """Reply to a request that is then not executed; None lets the controller execute it."""
        return None

    def outgoing(self, device: FaultyMirror, request: Request, chunks: list[Chunk]) -> list[Chunk]:
        """Return the bytes that leave the controller, with their delays."""
        return chunks


class FaultyMirror(MirrorDevice):
    """A controller with faults; ``gone``: no port has it; ``hung``: it takes no bytes."""

    def __init__(self, clock: Any, faults: Sequence[Fault] = ()) -> None:
        self.faults: tuple[Fault, ...] = ()
        self.requests: list[Request] = []  # executed ones
        self.gone = self.hung = False
        self.deaf_until_s = -math.inf
        super().__init__(clock)
        self.have(faults)

    def have(self, faults: Sequence[Fault]) -> None:
        """Replace the faults."""
        self.faults = tuple(faults)
        for fault in self.faults:
            fault.begin(self)

    def opened(self) -> list[Chunk]:
        """Return the bytes that a user finds in the port when it is opened."""
        return [chunk for fault in self.faults for chunk in fault.opened(self)]

    def receive(self, data: bytes) -> list[Chunk]:
        """Receive bytes and return the reply; raise VanishedError if a fault removed the device."""
        self.take_pulses()
        with self._lock:
            if self.gone:
                raise VanishedError
            for fault in self.faults:
                instead = fault.instead(self, data)
                if instead is not None:
                    return instead
                data = fault.incoming(self, data)
            return super().receive(data) if self.clock.now() >= self.deaf_until_s else []

    def carry_out(self, request: Request) -> bytes:
        """Record a request, and execute it."""
        self.requests.append(request)
        return super().carry_out(request)

    def _answer(self, request: Request, out: list[Chunk]) -> None:
        if self.gone:
            return
        reply: bytes | None = None
        for fault in self.faults:
            reply = fault.verdict(self, request) if reply is None else reply
        if reply is None:
            reply = self.carry_out(request)
        chunks = [Chunk(TURNAROUND_S, reply)] if reply else []
        for fault in self.faults:
            chunks = fault.outgoing(self, request, chunks)
        out += chunks


# changes of bytes


def lose(data: bytes, at: int, random: Random) -> bytes:
    """Drop a byte."""
    return data[:at] + data[at + 1 :]


def flip(data: bytes, at: int, random: Random) -> bytes:
    """Flip one bit of a byte."""
    return data[:at] + bytes((data[at] ^ 1 << random.randrange(8),)) + data[at + 1 :]


# changes of a reply


def changed(change: Change) -> Spoil:
    """Return a function that changes one byte."""

    def spoil(device: MirrorDevice, chunks: list[Chunk], random: Random) -> list[Chunk]:
        delay_s, data = chunks[0]
        return [Chunk(delay_s, change(data, random.randrange(len(data)), random)), *chunks[1:]]

    return spoil


def split(device: MirrorDevice, chunks: list[Chunk], random: Random) -> list[Chunk]:
    """Split it into pieces of a few bytes, a millisecond apart."""
    pieces = []
    for delay_s, data in chunks:
        while data:
            size = random.randint(1, 3)
            pieces.append(Chunk(delay_s, data[:size]))
            data = data[size:]
            delay_s += 1e-3
    return pieces


def late(device: MirrorDevice, chunks: list[Chunk], random: Random) -> list[Chunk]:
    """Delay it beyond any deadline."""
    return [Chunk(delay_s + LATE_S, data) for delay_s, data in chunks]


def just_late(device: MirrorDevice, chunks: list[Chunk], random: Random) -> list[Chunk]:
    """Delay it to about its deadline of a second, so that it may collide with the next request."""
    return [Chunk(delay_s + random.uniform(0.3, 1.5), data) for delay_s, data in chunks]


def lost(device: MirrorDevice, chunks: list[Chunk], random: Random) -> list[Chunk]:
    """Drop it."""
    return []


def slow(device: MirrorDevice, chunks: list[Chunk], random: Random) -> list[Chunk]:
    """Send its bytes one at a time, with long gaps."""
    whole = b"".join(data for _, data in chunks)
    return [Chunk(chunks[0].delay_s + place * SLOW_S, whole[place : place + 1]) for place in range(len(whole))]


@dataclass
class SpoiltReply(Fault):
    """One reply, or all from one on, are changed; requests without a reply do not count."""

    spoil: Spoil
    lasting: bool = False

    def outgoing(self, device: FaultyMirror, request: Request, chunks: list[Chunk]) -> list[Chunk]:
        if not chunks or not (self.chance.lasts() if self.lasting else self.chance.comes()):
            return chunks
        return self.spoil(device, chunks, self.chance.random)


@dataclass
class StaleBytes(Fault):
    """The port has bytes of another program's session when it is opened, and more follow."""

    def opened(self, device: FaultyMirror) -> list[Chunk]:
        self.chance.struck += 1
        left = self.chance.random.choice(_LEFT_BEHIND)
        cut = self.chance.random.randrange(1, len(left))
        return [Chunk(0.0, left[:cut]), Chunk(0.01, left[cut:])]


@dataclass
class RequestByte(Fault):
    """One of all bytes to the controller is changed."""

    change: Change

    def incoming(self, device: FaultyMirror, data: bytes) -> bytes:
        out = b""
        for byte in data:
            one = bytes((byte,))
            out += self.change(one, 0, self.chance.random) if self.chance.comes() else one
        return out


@dataclass
class ProAtConnect(Fault):
    """An earlier session left the controller in pro mode."""

    def begin(self, device: FaultyMirror) -> None:
        self.chance.struck += 1
        device.set_mode(self.chance.random.choice((Mode.PRO, Mode.PRO_CRC)))


@dataclass
class SilentReset(Fault):
    """The controller restarts at a request, sends nothing and is in simple mode afterwards."""

    boot_s: float
    commands: Collection[int] | None = None  # frames that can be struck; None: any request

    def verdict(self, device: FaultyMirror, request: Request) -> bytes | None:
        """Restart instead of executing the request, without a reply."""
        if (self.commands is not None and request.command not in self.commands) or not self.chance.comes():
            return None
        device.restart()
        device.deaf_until_s = device.clock.now() + self.boot_s
        return b""


@dataclass
class AnswersNo(Fault):
    """One line of simple mode is refused and not executed."""

    def verdict(self, device: FaultyMirror, request: Request) -> bytes | None:
        if request.mode is not Mode.SIMPLE or not self.chance.comes():
            return None
        return b"NO" + END


@dataclass
class AnswersError(Fault):
    """One frame gets an error code and is not executed."""

    code: int
    commands: Collection[int] | None = None  # those that can be struck; None: any

    def verdict(self, device: FaultyMirror, request: Request) -> bytes | None:
        command = request.command
        if command is None or (self.commands is not None and command not in self.commands):
            return None
        return encode(refuse(command, self.code)) if self.chance.comes() else None


@dataclass
class CellLost(Fault):
    """One cell of the vector memory keeps its old value, although its writing is acknowledged."""

    def verdict(self, device: FaultyMirror, request: Request) -> bytes | None:
        """Write the cells, restore one that changed, and acknowledge all of them."""
        if request.frame is None or request.command != Command.SET_VECTOR or len(request.frame.payload) < 5 + CELL:
            return None
        register, offset, length, _ = read_vector(request.frame.payload)
        memory = device.state.memory
        cells = slice(offset // CELL, (offset + length) // CELL)
        if register != VECTOR_MEMORY or not self.chance.comes():
            return None
        before = memory[cells].copy()
        reply = device.carry_out(request)
        differing = np.flatnonzero(memory[cells] != before)
        if differing.size:
            place = self.chance.random.choice(differing.tolist())
            memory[cells.start + place] = before[place]
        return reply


@dataclass
class StatusBit(Fault):
    """A bit of the status is set from one request on."""

    bit: Status

    def verdict(self, device: FaultyMirror, request: Request) -> bytes | None:
        if self.chance.lasts():
            device.state.flags |= self.bit
        return None


@dataclass
class OtherFirmware(Fault):
    """The controller is another model of its manufacturer."""

    def verdict(self, device: FaultyMirror, request: Request) -> bytes | None:
        """Answer requests for the model, the version or the firmware like the other model."""
        if request.line in _OTHER_TEXTS:
            self.chance.struck += 1
            return _OTHER_TEXTS[request.line].encode("ascii") + END
        return None


@dataclass
class GoneBefore(Fault):
    """The device disappears before a request reaches it."""

    def incoming(self, device: FaultyMirror, data: bytes) -> bytes:
        if self.chance.comes():
            device.gone = True
            raise VanishedError
        return data


@dataclass
class GoneAfter(Fault):
    """The device executes a request and disappears before it answers."""

    def outgoing(self, device: FaultyMirror, request: Request, chunks: list[Chunk]) -> list[Chunk]:
        if self.chance.comes():
            device.gone = True
            return []
        return chunks


@dataclass
class PortHangs(Fault):
    """The port takes no bytes from one request on, and writing to it blocks."""

    def incoming(self, device: FaultyMirror, data: bytes) -> bytes:
        if self.chance.lasts():
            device.hung = True
            return b""
        return data


@dataclass
class Echo(Fault):
    """A loopback wire instead of a controller: all sent bytes come back."""

    def instead(self, device: FaultyMirror, data: bytes) -> list[Chunk]:
        """Return all received bytes."""
        self.chance.struck += 1
        return [Chunk(TURNAROUND_S, data)]


_BYTES = 1024  # bytes to the controller within which it strikes
HARMLESS = ("split-replies", "stale-bytes", "pro-at-connect")  # the driver copes with these


def _reply(spoil: Spoil, *, lasting: bool = False) -> tuple[Callable[[Chance], Fault], int]:
    return partial(SpoiltReply, spoil=spoil, lasting=lasting), 64


def _code(code: int, commands: Collection[int] | None = None, span: int = 64) -> tuple[Callable[[Chance], Fault], int]:
    return partial(AnswersError, code=code, commands=commands), span


def _bit(bit: Status) -> tuple[Callable[[Chance], Fault], int]:
    return partial(StatusBit, bit=bit), 32


# constructor of each fault, and the number of opportunities within which it strikes
KINDS: dict[str, tuple[Callable[[Chance], Fault], int]] = {
    "request-byte-lost": (partial(RequestByte, change=lose), _BYTES),
    "request-bit-flipped": (partial(RequestByte, change=flip), _BYTES),
    "reply-byte-lost": _reply(changed(lose)),
    "reply-bit-flipped": _reply(changed(flip)),
    "split-replies": _reply(split, lasting=True),
    "stale-bytes": (StaleBytes, 64),
    "late-reply": _reply(late),
    "just-late-reply": _reply(just_late),
    "no-reply": _reply(lost),
    "mute": _reply(lost, lasting=True),
    "slow-bytes": _reply(slow, lasting=True),
    "answers-no": (AnswersNo, 6),
    "error-range": _code(ErrorCode.OUT_OF_RANGE, frozenset({Command.SET_VALUES}), 4),
    "error-vector-index": _code(ErrorCode.VECTOR_INDEX, frozenset({Command.SET_VECTOR, Command.GET_VECTOR})),
    "error-unknown": _code(0xBEEF),
    "wrong-firmware": (OtherFirmware, 64),
    "cell-lost": (CellLost, 16),
    "pro-at-connect": (ProAtConnect, 64),
    "silent-reset": (partial(SilentReset, boot_s=0.0), 64),
    "reset-in-upload": (partial(SilentReset, boot_s=1.0, commands=frozenset({Command.SET_VECTOR})), 16),
    "never-stable": _bit(Status.NOT_STABLE),
    "trimmed": _bit(Status.TRIMMED),
    "mirror-warm": _bit(Status.MIRROR_WARM),
    "disconnected": _bit(Status.DISCONNECTED),
    "gone-before": (GoneBefore, 64),
    "gone-after": (GoneAfter, 64),
    "hangs": (PortHangs, 64),
    "echo": (Echo, 64),
}


def make_fault(name: str, seed: int = 0, at: int | None = None) -> Fault:
    """Return a fault; the seed draws when and how it strikes, ``at`` overrides when."""
    build, span = KINDS[name]
    return build(Chance.drawn(name, seed, span, at))
