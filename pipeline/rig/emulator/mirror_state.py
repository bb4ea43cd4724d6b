"""The emulated mirror controller: its motion in closed form, vector units, targets, status and log. No protocol.

Nothing runs by itself: everything is worked out up to the clock's moment when it is asked for, so time may run at any
speed. Assumptions on the vector unit, which no document describes: the run command takes the first cell, with an
external trigger too. Each edge of the trigger then takes one cell. A unit that is done keeps its last cell and reports
that it no longer runs.
"""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import groupby

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.geometry.scan import Ends
from pipeline.rig.mirror.pro_mode import CHANNELS, FEEDBACK_X, LOG_SLOTS, ChannelRegisters, Status, Trigger, Unit
from pipeline.rig.transports import Clock
from pipeline.simulator.effects.pointing import responses

Floats = NDArray[np.float64]
KEPT_STEPS = 20_000  # commands that an axis remembers; older times are given as the oldest state that is known
MOST_STEPS = 20_000  # steps that are played one by one; of a longer silence only the last ones are


@dataclass(frozen=True)
class Stiffness:
    """Dynamics of an axis. The defaults are those of the simulated mirror: data sheet and assumed."""

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
        """Return the position that the axis goes to."""
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

    def rest(self, time_s: float) -> None:
        """Reset to rest at 0 at once, as after a loss of power; the past is forgotten."""
        self._time, self._place, self._rate, self._command = [time_s], [0.0], [0.0], [0.0]

    def places(self, times_s: ArrayLike) -> Floats:
        """Return the positions of the axis at times (...), in the unit of its commands.

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
        """Return the positions that the axis was sent to at times (...).

        Times before the oldest that is remembered get the oldest.
        """
        at = np.searchsorted(np.asarray(self._time), np.asarray(times_s, np.float64), side="right") - 1
        return np.asarray(self._command)[np.clip(at, 0, None)]

    def place(self, time_s: float) -> float:
        """Return where the axis was at one time, which is faster for the time after the last command."""
        if time_s < self._time[-1]:
            return float(self.places(time_s))
        return self._moved(time_s - self._time[-1])[0]

    def unsettled(self, time_s: float) -> float:
        """Return a bound on how far the axis may still be off its command from a time on, oscillation included."""
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
    """Return the responses to a unit impulse and a unit step at one time.

    They are cached: a vector is played with few different times.
    """
    impulse, rise = responses(np.array([angle]), damping)
    return float(impulse[0]), float(rise[0])


@dataclass
class VectorPlayer:
    """Registers and clockwork of one channel's vector unit."""

    ends: Ends = "exclusive"
    unit: Unit = Unit.FEEDBACK
    start: int = 0
    end: int = 0
    frequency_hz: float = 10_000.0
    cycles: int = -1  # without end
    external: Trigger = Trigger.OFF
    running: bool = False
    _began_s: float = 0.0
    _played: int = 0
    _edges: deque[float] = field(default_factory=deque)

    @property
    def length(self) -> int:
        """Cells of one cycle."""
        return self.end - self.start + (self.ends == "inclusive")

    @property
    def index(self) -> int:
        """The cell that is played, or was last."""
        return self.start + max(self._played - 1, 0) % self.length if self.length > 0 else self.start

    def run(self, time_s: float) -> None:
        """Start with the first cell."""
        self.running, self._began_s, self._played = True, time_s, 0
        self._edges.clear()

    def stop(self) -> None:
        """Hold the cell that is played."""
        self.running = False
        self._edges.clear()

    def trigger(self, rises_s: NDArray[np.float64], falls_s: NDArray[np.float64]) -> None:
        """Take pulses at the trigger input, in order; those while the unit does not wait for any are lost."""
        if self.running and self.external is not Trigger.OFF:
            both = np.stack([rises_s, falls_s], axis=-1).ravel()
            self._edges.extend((rises_s if self.external is Trigger.RISING_EDGE else both).tolist())

    def due(self, now_s: float) -> Iterator[tuple[float, int]]:
        """Yield the steps (time, cell) since the last call up to now, and stop where the run is over."""
        if not self.running or self.length < 1:
            return
        total = math.inf if self.cycles < 0 else self.cycles * self.length
        for time_s in self._by_edges(now_s) if self.external is not Trigger.OFF else self._by_clock(now_s, total):
            if self._played >= total:
                self.stop()
                return
            cell = self.start + self._played % self.length
            self._played += 1
            yield time_s, cell

    def _by_clock(self, now_s: float, total: float) -> Iterator[float]:
        if self.frequency_hz <= 0:
            return
        due = np.floor((now_s - self._began_s) * self.frequency_hz + 1e-9)  # steps 0 .. due
        last = int(min(due, total))
        self._played += max(last - self._played - MOST_STEPS, 0)
        for number in range(self._played, last + 1):
            yield self._began_s + number / self.frequency_hz

    def _by_edges(self, now_s: float) -> Iterator[float]:
        if self._played == 0:
            yield self._began_s
        while self._edges and self._edges[0] <= now_s:
            yield self._edges.popleft()


RIM_SLACK = 1e-6  # of float32 cells
STABLE_WITHIN = 1e-4  # of the disk's radius; about 1 px of the view


@dataclass(frozen=True)
class MirrorUnit:
    """Properties of one emulated controller. None of them was read from a real one."""

    model: str = "MR-E-2"
    version: str = "EMULATOR 1.0"
    serial_number: str = "EMUL0001"
    firmware_id: int = 0x00010000
    temperature_c: float = 25.0
    vector_pairs: int = 1500  # of X and Y, in one memory
    ends: Ends = "exclusive"  # what the device takes the end of a range for; not settled (erratum E14)
    log_rows: int = 16_000  # of the logger; more could not be addressed
    turnaround_s: float = 2e-4  # from a request's last byte to the reply
    stiffness: Stiffness = field(default_factory=Stiffness)


class MirrorState:
    """State of one controller with its mirror head, lazily up to date."""

    def __init__(self, clock: Clock, unit: MirrorUnit) -> None:
        self.clock, self.unit = clock, unit
        self.axes = [AxisMotion(unit.stiffness) for _ in range(CHANNELS)]
        self.flags = Status(0)  # what is on besides what the motion says: faults set it
        self.moment = clock.now()  # up to which everything is worked out [s]
        self.restart(clock.now())

    def restart(self, now_s: float) -> None:
        """Reset to the state after power came: at rest in the middle, memory and registers empty."""
        self.players = [VectorPlayer(self.unit.ends) for _ in range(CHANNELS)]
        self.memory = np.zeros(2 * self.unit.vector_pairs, np.float32)
        self.static = [dict.fromkeys(Unit, 0.0) for _ in range(CHANNELS)]
        self.inputs = [ChannelRegisters(channel).static_system for channel in range(CHANNELS)]
        self.controls = [ChannelRegisters(channel).xy_system for channel in range(CHANNELS)]
        self.played = [0.0] * CHANNELS
        self.trimmed = False
        self.moment = now_s
        for axis in self.axes:
            axis.rest(now_s)

    def advance(self) -> float:
        """Play what is due of the vector memory, and give the moment up to which it is. [s]"""
        now = self.moment = max(self.clock.now(), self.moment)
        steps = [
            [(time_s, channel, cell) for time_s, cell in player.due(now)] for channel, player in enumerate(self.players)
        ]
        for time_s, together in groupby(heapq.merge(*steps), key=lambda step: step[0]):
            for _, channel, cell in together:
                self.played[channel] = float(self.memory[cell]) if cell < self.memory.size else 0.0
            self._aim(time_s)
        return now

    def aim(self) -> None:
        """Send the axes where the systems that they follow say, now."""
        self._aim(self.advance())

    def trigger(self, rises_s: NDArray[np.float64], falls_s: NDArray[np.float64]) -> None:
        """Take pulses at the trigger input."""
        for player in self.players:
            player.trigger(rises_s, falls_s)
        self.advance()

    def positions(self, times_s: ArrayLike) -> NDArray[np.float64]:
        """Return the mirror's positions, (..., 2), at times up to now (...)."""
        self.advance()
        return np.stack([axis.places(times_s) for axis in self.axes], axis=-1)

    def status(self) -> Status:
        """Return the status bits of now; none of what was."""
        self.advance()
        flags = self.flags
        if self.trimmed:
            flags |= Status.TRIMMED
        if any(axis.unsettled(self.moment) > STABLE_WITHIN for axis in self.axes):
            flags |= Status.NOT_STABLE
        return flags

    def _aim(self, time_s: float) -> None:
        if Status.DISCONNECTED in self.flags:
            return  # no head that could move
        x, y = (self._wanted(channel) for channel in range(CHANNELS))
        reach = math.hypot(x, y)
        self.trimmed = reach > 1 + RIM_SLACK
        if self.trimmed:
            x, y = x / reach, y / reach
        for axis, place in zip(self.axes, (x, y), strict=True):
            axis.command(time_s, place)

    def _wanted(self, channel: int) -> float:
        """Return where a channel's input says; where it says nothing, the axis stays."""
        registers, followed = ChannelRegisters(channel), self.inputs[channel]
        if self.controls[channel] == registers.xy_system:
            if followed == registers.static_system:
                return self.static[channel][Unit.XY]
            if followed == registers.vector_system and self.players[channel].unit is Unit.XY:
                return self.played[channel]
        return self.axes[channel].commanded


class PositionLogger:
    """Slots, rate and rows of the logger. It stops by itself when its rows are full."""

    def __init__(self, state: MirrorState) -> None:
        self._state = state
        self.slots = [0] * LOG_SLOTS
        self.rate_hz = 10_000.0
        self._began_s: float | None = None
        self._stopped_s: float | None = None

    @property
    def running(self) -> bool:
        """Return whether rows are still taken down."""
        return self._began_s is not None and self._stopped_s is None and self.rows < self._state.unit.log_rows

    @property
    def rows(self) -> int:
        """Rows taken down since the run began."""
        if self._began_s is None:
            return 0
        until = self._state.clock.now() if self._stopped_s is None else self._stopped_s
        return min(int((until - self._began_s) * self.rate_hz + 1e-9) + 1, self._state.unit.log_rows)

    def run(self, on: bool) -> None:
        """Start anew, or stop; a logger that is stopped keeps its rows."""
        if on:
            self._began_s, self._stopped_s = self._state.clock.now(), None
        elif self.running:
            self._stopped_s = self._state.clock.now()

    def cells(self, slot: int, start: int, stop: int) -> bytes:
        """Return the cells of some rows of a slot; of registers that are no feedback, 0."""
        times = (self._began_s or 0.0) + np.arange(start, stop) / self.rate_hz
        channel = self.slots[slot] - FEEDBACK_X
        if channel not in range(CHANNELS):
            return np.zeros(times.size, ">f4").tobytes()
        return self._state.positions(times)[:, channel].astype(">f4").tobytes()
