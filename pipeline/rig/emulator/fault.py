"""What a fault of the emulated controller is: when it strikes, and where it may take a hand. Each does nothing here."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from random import Random
from typing import TYPE_CHECKING

from pipeline.rig.emulator.exchange import Chunk, Request
from pipeline.rig.mirror.registers import Status

if TYPE_CHECKING:
    from pipeline.rig.emulator.mirror_device import MirrorDevice


class Where(Enum):
    """What a fault strikes."""

    REQUEST = "bytes to the controller"
    REPLY = "bytes from the controller"
    ANSWER = "what the controller answers"
    STATE = "what the controller is in"
    PORT = "the port"


@dataclass
class Chance:
    """When a fault strikes: at one of the opportunities that come, early ones as likely as later twice as many."""

    random: Random
    at: int
    seen: int = 0
    struck: int = 0

    @classmethod
    def drawn(cls, name: str, seed: int, span: int, at: int | None = None) -> Chance:
        """Draw the opportunity, from 0 to ``span``, exclusive; ``at`` says it instead."""
        random = Random(f"{name} {seed}")
        drawn = int(2 ** random.uniform(0, math.log2(span + 1))) - 1
        return cls(random, min(drawn, span - 1) if at is None else at)

    def comes(self) -> bool:
        """Take note of an opportunity and say whether it is the one."""
        self.seen += 1
        now = self.seen == self.at + 1
        self.struck += now
        return now

    def lasts(self) -> bool:
        """Take note of an opportunity and say whether it is the one, or comes after it."""
        return self.comes() or self.seen > self.at


@dataclass
class Fault:
    """A fault that never strikes. Hooks are called in the order in which they stand here."""

    chance: Chance

    def begin(self, device: MirrorDevice) -> None:
        """Take a hand as the controller is switched on."""

    def opened(self, device: MirrorDevice) -> list[Chunk]:
        """Give what is found in the port as it is opened."""
        return []

    def instead(self, device: MirrorDevice, data: bytes) -> list[Chunk] | None:
        """Answer bytes in the controller's place; None leaves them to it."""
        return None

    def incoming(self, device: MirrorDevice, data: bytes) -> bytes:
        """Give the bytes that reach the controller."""
        return data

    def verdict(self, device: MirrorDevice, request: Request) -> bytes | None:
        """Give a reply to a request that then is not carried out; None lets the controller do it."""
        return None

    def status(self, status: Status) -> Status:
        """Give the status bits that the controller reports."""
        return status

    def outgoing(self, device: MirrorDevice, request: Request, chunks: list[Chunk]) -> list[Chunk]:
        """Give the bytes that leave the controller, and when."""
        return chunks


@dataclass(frozen=True)
class FaultKind:
    """A kind of fault that users can ask for by its name.

    ``span`` is the number of opportunities within which it strikes; ``harmless`` ones change nothing that a driver of
    this protocol may not cope with.
    """

    name: str
    words: str
    where: Where
    build: Callable[[Chance], Fault]
    span: int = 64
    harmless: bool = False

    def make(self, seed: int = 0, at: int | None = None) -> Fault:
        """Build one; the seed says when it strikes and how, ``at`` says when instead."""
        return self.build(Chance.drawn(self.name, seed, self.span, at))
