"""The time of day, of the machine or of a test."""

from __future__ import annotations

import time
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Protocol


class WallClock(Protocol):
    """The time of day, which may jump."""

    def now(self) -> datetime:
        """The moment, with its zone."""

    def sleep(self, seconds: float) -> None:
        """Let time pass. [s]"""


@dataclass(frozen=True)
class SystemWallClock:
    """The machine's clock."""

    def now(self) -> datetime:
        """The moment in UTC."""
        return datetime.now(UTC)

    def sleep(self, seconds: float) -> None:
        """Wait; nothing for a time that is not above 0. [s]"""
        if seconds > 0:
            time.sleep(seconds)
