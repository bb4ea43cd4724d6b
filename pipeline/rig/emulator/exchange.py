"""What passes between the emulated controller and whoever speaks to it, and what a fault may do with a controller."""

from __future__ import annotations

import errno
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple, Protocol

from pipeline.rig.clock import Clock
from pipeline.rig.emulator.mirror_state import MirrorState, MirrorUnit
from pipeline.rig.mirror.pro_mode import Command, Damaged, Frame


class Mode(Enum):
    """How the controller is spoken to."""

    SIMPLE = "simple"
    PRO = "pro"
    PRO_CRC = "pro, requests checked"


class Chunk(NamedTuple):
    """Bytes that a device sends, so long after it took the request. [s]"""

    delay_s: float
    data: bytes


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


class VanishedError(OSError):
    """The device went away: no port knows it any more."""

    def __init__(self, why: str) -> None:
        super().__init__(errno.EIO, why)


class StruckMirror(Protocol):
    """The emulated controller as a fault sees it. ``gone``: no port knows it; ``hung``: its port takes no bytes."""

    clock: Clock
    unit: MirrorUnit
    state: MirrorState
    gone: bool
    hung: bool

    def set_mode(self, mode: Mode) -> None:
        """Speak another mode from the next byte on."""

    def restart(self, *, boot_s: float | None = None) -> None:
        """Lose everything and be in simple mode, deaf for a while."""

    def carry_out(self, request: Request) -> bytes:
        """Do what a request asks for and give the bytes of the reply."""
