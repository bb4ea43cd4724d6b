"""Faults of the line between driver and controller: bytes lost, changed, cut, late or made up, and ports that go."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random
from typing import TYPE_CHECKING

from pipeline.rig.emulator.exchange import Chunk, Request, VanishedError
from pipeline.rig.emulator.fault import Fault

if TYPE_CHECKING:
    from pipeline.rig.emulator.mirror_device import MirrorDevice

LATE_S = 20.0  # beyond any deadline
SLOW_S = 0.02  # from byte to byte
TICK_S = 0.005  # at which replies that wait for each other leave
# the end of a reply with a text, one of a status, and a whole frame: what another program left behind
_LEFT_BEHIND = (b"R-E-2\r\n", b"00000010\r\n", bytes.fromhex("7e 00 11 04 00 00 00 00 f2 81 7e"))

Change = Callable[[bytes, int, Random], bytes]


def lose(data: bytes, at: int, random: Random) -> bytes:
    """Leave a byte out."""
    return data[:at] + data[at + 1 :]


def flip(data: bytes, at: int, random: Random) -> bytes:
    """Turn one bit of a byte."""
    return data[:at] + bytes((data[at] ^ 1 << random.randrange(8),)) + data[at + 1 :]


def double(data: bytes, at: int, random: Random) -> bytes:
    """Have a byte twice."""
    return data[: at + 1] + data[at:]


@dataclass
class RequestByte(Fault):
    """One byte of all that go to the controller is changed."""

    change: Change

    def incoming(self, device: MirrorDevice, data: bytes) -> bytes:
        """Change the byte whose turn it is."""
        out = b""
        for byte in data:
            one = bytes((byte,))
            out += self.change(one, 0, self.chance.random) if self.chance.comes() else one
        return out


@dataclass
class ReplyByte(Fault):
    """One byte of one reply is changed."""

    change: Change

    def outgoing(self, device: MirrorDevice, request: Request, chunks: list[Chunk]) -> list[Chunk]:
        """Change a byte of the reply whose turn it is."""
        if not chunks or not self.chance.comes():
            return chunks
        delay_s, data = chunks[0]
        return [
            Chunk(delay_s, self.change(data, self.chance.random.randrange(len(data)), self.chance.random)),
            *chunks[1:],
        ]


@dataclass
class SplitReplies(Fault):
    """From one reply on all come in pieces of a few bytes, a millisecond apart."""

    def outgoing(self, device: MirrorDevice, request: Request, chunks: list[Chunk]) -> list[Chunk]:
        """Cut the replies."""
        if not chunks or not self.chance.lasts():
            return chunks
        pieces = []
        for delay_s, data in chunks:
            while data:
                size = self.chance.random.randint(1, 3)
                pieces.append(Chunk(delay_s, data[:size]))
                data, delay_s = data[size:], delay_s + 1e-3
        return pieces


@dataclass
class MergedReplies(Fault):
    """From one reply on all leave at the ticks of a slow clock, together where there are several."""

    def outgoing(self, device: MirrorDevice, request: Request, chunks: list[Chunk]) -> list[Chunk]:
        """Let the replies wait for the next tick."""
        if not chunks or not self.chance.lasts():
            return chunks
        now = device.clock.now()
        return [Chunk(math.ceil((now + delay_s) / TICK_S) * TICK_S - now, data) for delay_s, data in chunks]


@dataclass
class StaleBytes(Fault):
    """What another program asked for lies in the port when it is opened, and some more follows."""

    def opened(self, device: MirrorDevice) -> list[Chunk]:
        """Give what was left behind, in two parts."""
        self.chance.struck += 1
        left = self.chance.random.choice(_LEFT_BEHIND)
        cut = self.chance.random.randrange(1, len(left))
        return [Chunk(0.0, left[:cut]), Chunk(0.01, left[cut:])]


@dataclass
class Noise(Fault):
    """Bytes that mean nothing come before one reply."""

    def outgoing(self, device: MirrorDevice, request: Request, chunks: list[Chunk]) -> list[Chunk]:
        """Put the noise before the reply whose turn it is."""
        if not chunks or not self.chance.comes():
            return chunks
        noise = self.chance.random.randbytes(self.chance.random.randint(1, 12))
        return [Chunk(chunks[0].delay_s, noise), *chunks]


@dataclass
class LateReply(Fault):
    """One reply comes after any deadline."""

    def outgoing(self, device: MirrorDevice, request: Request, chunks: list[Chunk]) -> list[Chunk]:
        """Hold the reply whose turn it is back."""
        if not chunks or not self.chance.comes():
            return chunks
        return [Chunk(delay_s + LATE_S, data) for delay_s, data in chunks]


@dataclass
class JustLateReply(Fault):
    """One reply comes soon after its deadline of a second, so that it meets the next request."""

    def outgoing(self, device: MirrorDevice, request: Request, chunks: list[Chunk]) -> list[Chunk]:
        """Hold the reply whose turn it is back."""
        if not chunks or not self.chance.comes():
            return chunks
        return [Chunk(delay_s + self.chance.random.uniform(0.3, 1.5), data) for delay_s, data in chunks]


@dataclass
class LostReply(Fault):
    """One request is carried out and never answered."""

    def outgoing(self, device: MirrorDevice, request: Request, chunks: list[Chunk]) -> list[Chunk]:
        """Keep the reply whose turn it is."""
        return [] if chunks and self.chance.comes() else chunks


@dataclass
class Mute(Fault):
    """From one request on all are carried out, and none is answered."""

    def outgoing(self, device: MirrorDevice, request: Request, chunks: list[Chunk]) -> list[Chunk]:
        """Keep the replies."""
        return [] if chunks and self.chance.lasts() else chunks


@dataclass
class SlowBytes(Fault):
    """From one reply on bytes come one at a time, with long gaps."""

    def outgoing(self, device: MirrorDevice, request: Request, chunks: list[Chunk]) -> list[Chunk]:
        """Space the bytes."""
        if not chunks or not self.chance.lasts():
            return chunks
        whole = b"".join(data for _, data in chunks)
        return [Chunk(chunks[0].delay_s + place * SLOW_S, whole[place : place + 1]) for place in range(len(whole))]


@dataclass
class GoneBefore(Fault):
    """The device goes away before a request reaches it."""

    def incoming(self, device: MirrorDevice, data: bytes) -> bytes:
        """Go, when the turn has come."""
        if self.chance.comes():
            device.gone = True
            raise VanishedError("the device went away")
        return data


@dataclass
class GoneWithin(Fault):
    """The device goes away in the middle of a request, of which it took a part."""

    def incoming(self, device: MirrorDevice, data: bytes) -> bytes:
        """Take the bytes before the one whose turn it is, and go."""
        for place in range(len(data)):
            if self.chance.comes():
                device.gone = True
                return data[:place]
        return data


@dataclass
class GoneAfter(Fault):
    """The device carries a request out and goes away before it answers."""

    def outgoing(self, device: MirrorDevice, request: Request, chunks: list[Chunk]) -> list[Chunk]:
        """Go, when the turn has come."""
        if self.chance.comes():
            device.gone = True
            return []
        return chunks


@dataclass
class PortHangs(Fault):
    """From one request on the port takes no more bytes, and writing to it blocks."""

    def incoming(self, device: MirrorDevice, data: bytes) -> bytes:
        """Take none, once the turn has come."""
        if self.chance.lasts():
            device.hung = True
            return b""
        return data


@dataclass
class Echo(Fault):
    """A loop of wire instead of a controller: all that is sent comes back."""

    def instead(self, device: MirrorDevice, data: bytes) -> list[Chunk]:
        """Send the bytes back."""
        self.chance.struck += 1
        return [Chunk(device.unit.turnaround_s, data)]


@dataclass
class Modem(Fault):
    """A modem instead of a controller: it shows what is typed, and answers lines as modems do."""

    typed: bytes = field(default=b"", init=False)

    def instead(self, device: MirrorDevice, data: bytes) -> list[Chunk]:
        """Show the bytes, and answer the lines that they end."""
        self.chance.struck += 1
        answers = []
        for byte in data:
            if byte == 0x0D:
                good = self.typed.strip().upper().startswith(b"AT")
                answers.append(b"\r\nOK\r\n" if good else b"\r\nERROR\r\n" if self.typed.strip() else b"")
                self.typed = b""
            else:
                self.typed = (self.typed + bytes((byte,)))[-64:]
        return [Chunk(device.unit.turnaround_s, data + b"".join(answers))]
