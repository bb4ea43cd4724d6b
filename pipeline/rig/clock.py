"""The clock that devices are waited for with: the system's, or one that tests and emulators turn by hand."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Protocol

from pipeline.errors import SettingsError


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


class ManualClock:
    """A clock that moves only when it is told to: sleeping takes no time and moves it."""

    def __init__(self, start: float = 0.0) -> None:
        self._now = start

    def now(self) -> float:
        return self._now

    def sleep(self, seconds: float) -> None:
        if seconds > 0:
            self._now += seconds

    def advance(self, seconds: float) -> None:
        """Move the clock on by so much; SettingsError where that is below 0. [s]"""
        if not seconds >= 0:
            raise SettingsError(f"a clock only goes forward, got {seconds} s; give 0 or more")
        self._now += seconds
