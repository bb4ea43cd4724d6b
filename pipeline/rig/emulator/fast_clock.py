"""A clock that runs faster than the machine's, for emulated devices whose users do not want to wait."""

from __future__ import annotations

from pipeline.errors import SettingsError
from pipeline.rig.clock import SYSTEM_CLOCK


class FastClock:
    """Monotonic time, ``speed`` times as fast as it is, from 0 on. Sleeping takes as much less."""

    def __init__(self, speed: float = 1.0) -> None:
        if not 0 < speed < float("inf"):
            raise SettingsError(f"a speed of {speed:g}: expected how many times as fast time goes, above 0 (--speed)")
        self.speed = speed
        self._began = SYSTEM_CLOCK.now()

    def now(self) -> float:
        """Give the moment. [s]"""
        return (SYSTEM_CLOCK.now() - self._began) * self.speed

    def sleep(self, seconds: float) -> None:
        """Wait until so much of this clock's time has passed; nothing for a time that is not above 0. [s]"""
        SYSTEM_CLOCK.sleep(seconds / self.speed)
