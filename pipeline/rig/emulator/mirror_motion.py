"""How one axis of the emulated mirror moves: a second-order system that follows commands, known at any past time.

Between two commands the motion is a closed form, so that time may run at any speed and nothing is integrated. The
vector player, which feeds an axis from the vector memory, is :mod:`~pipeline.rig.emulator.vector_player`'s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.simulator.effects.mirror_path import responses

Floats = NDArray[np.float64]
KEPT_STEPS = 20_000  # commands that an axis remembers; older times are given as the oldest state that is known


@dataclass(frozen=True)
class Stiffness:
    """What an axis is like. The defaults are those of the simulated mirror: data sheet and assumed."""

    natural_hz: float = 20.0
    damping: float = 0.7

    @property
    def pace(self) -> float:
        """Natural frequency. [rad/s]"""
        return 2 * math.pi * self.natural_hz


@dataclass
class AxisMotion:
    """One axis: starts at rest at 0 and follows steps of its command.

    The history is three columns, when a command came, the place and the rate then, and the command itself.
    """

    stiffness: Stiffness = field(default_factory=Stiffness)
    _time: list[float] = field(default_factory=lambda: [-math.inf])
    _place: list[float] = field(default_factory=lambda: [0.0])
    _rate: list[float] = field(default_factory=lambda: [0.0])  # over the natural frequency
    _command: list[float] = field(default_factory=lambda: [0.0])

    @property
    def commanded(self) -> float:
        """What the axis goes to."""
        return self._command[-1]

    def command(self, time_s: float, place: float) -> None:
        """Take a new command at a time that is not before the last one's (an earlier one counts as then)."""
        now = max(time_s, self._time[-1])
        if place == self._command[-1]:
            return
        here, rate = self._moved(now - self._time[-1])
        self._time.append(now)
        self._place.append(here)
        self._rate.append(rate)
        self._command.append(place)
        if len(self._time) > 2 * KEPT_STEPS:
            for column in (self._time, self._place, self._rate, self._command):
                del column[:-KEPT_STEPS]

    def rest(self, time_s: float, place: float = 0.0) -> None:
        """Be at rest at a place at once, as after a loss of power; the past is forgotten."""
        self._time, self._place, self._rate, self._command = [time_s], [place], [0.0], [place]

    def places(self, times_s: ArrayLike) -> Floats:
        """Give where the axis was at times (...), in the unit of its commands.

        Times before the oldest command that is remembered are given the place then.
        """
        times = np.asarray(times_s, np.float64)
        known = np.asarray(self._time)
        at = np.clip(np.searchsorted(known, times, side="right") - 1, 0, None)
        gone = np.maximum(times - known[at], 0.0)
        still = ~np.isfinite(gone)
        impulse, rise = responses(np.where(still, 0.0, gone) * self.stiffness.pace, self.stiffness.damping)
        off = np.asarray(self._place)[at] - np.asarray(self._command)[at]
        places: Floats = np.asarray(self._command)[at] + off * (1 - rise) + np.asarray(self._rate)[at] * impulse
        return np.where(still, np.asarray(self._command)[at], places)

    def commands(self, times_s: ArrayLike) -> Floats:
        """Give where the axis was sent to at times (...); times before the oldest that is remembered get the oldest."""
        at = np.searchsorted(np.asarray(self._time), np.asarray(times_s, np.float64), side="right") - 1
        return np.asarray(self._command)[np.clip(at, 0, None)]

    def place(self, time_s: float) -> float:
        """Give where the axis was at one time, which is faster for the time after the last command."""
        if time_s < self._time[-1]:
            return float(self.places(time_s))
        return self._moved(time_s - self._time[-1])[0]

    def unsettled(self, time_s: float) -> float:
        """Give a bound on how far the axis may still be off its command from a time on, oscillation included."""
        place, rate = self._moved(max(time_s - self._time[-1], 0.0))
        return math.hypot(place - self._command[-1], rate)

    def _moved(self, gone: float) -> tuple[float, float]:
        """Place, and rate over the natural frequency, ``gone`` after the last command."""
        target = self._command[-1]
        off, rate = self._place[-1] - target, self._rate[-1]
        if not math.isfinite(gone) or (off == 0 and rate == 0):
            return target, 0.0
        impulse, rise = _response(gone * self.stiffness.pace, self.stiffness.damping)
        turned = 1 - rise - 2 * self.stiffness.damping * impulse
        return target + off * (1 - rise) + rate * impulse, -off * impulse + rate * turned


@lru_cache(maxsize=4096)
def _response(angle: float, damping: float) -> tuple[float, float]:
    """Responses to a unit impulse and a unit step at one time; a vector is played with few different times."""
    impulse, rise = responses(np.array([angle]), damping)
    return float(impulse[0]), float(rise[0])
