"""What devices are waited for with, and what they fail with: clocks, and errors of their own."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Protocol, Self

from pipeline.errors import RigError


class Clock(Protocol):
    """A clock that never goes back. Deadlines are moments of it."""

    def now(self) -> float:
        """Give the moment, counted from anywhere. [s]"""

    def sleep(self, seconds: float) -> None:
        """Let time pass; nothing for a time that is not above 0. [s]"""


@dataclass(frozen=True)
class SystemClock:
    """The monotonic clock of the machine."""

    def now(self) -> float:
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        if seconds > 0:
            time.sleep(seconds)


SYSTEM_CLOCK = SystemClock()


class Closing(ABC):
    """A context that ends with :meth:`close`; one that does not say how it closes cannot be made."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    @abstractmethod
    def close(self) -> None:
        """Let go of what is held."""


class DeviceGone(RigError):  # noqa: N818 - the name says what is the case
    """A device is not there, or went away."""


class DeadlinePassed(RigError):  # noqa: N818 - the name says what is the case
    """A device did not answer in time, and nothing can have moved; ``silent`` says that not a byte came."""

    def __init__(self, message: str, *, silent: bool = False) -> None:
        super().__init__(message)
        self.silent = silent


class DeviceRefused(RigError):  # noqa: N818 - the name says what is the case
    """A device answered that it did not do what was asked; ``code`` is the number it gave.

    ``garbled`` says that it did not get the request whole: what only reads may be asked again.
    """

    def __init__(self, message: str, code: int | None = None, *, garbled: bool = False) -> None:
        super().__init__(message)
        self.code = code
        self.garbled = garbled


class StateUnknown(RigError):  # noqa: N818 - the name says what is the case
    """A device may or may not have moved; motions are frozen until somebody connects anew."""


class NotKept(RigError):  # noqa: N818 - the name says what is the case
    """What a device sent could not be kept here: the disk refuses. The device still has it."""
