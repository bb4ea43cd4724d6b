"""What the emulated mirror controller is in: targets, vector memory, motion, status, log. No protocol; time by a clock.

Nothing runs by itself: everything is worked out up to the clock's moment when somebody asks.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass, field
from itertools import groupby
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.geometry.scan import Ends
from pipeline.rig.devices import Clock
from pipeline.rig.emulator.mirror_motion import AxisMotion, Stiffness, VectorPlayer
from pipeline.rig.mirror.registers import (
    CHANNELS,
    FEEDBACK_X,
    LOG_SLOTS,
    ChannelRegisters,
    Status,
    Unit,
    VectorRegister,
)

RIM_SLACK = 1e-6  # of float32 cells
STABLE_WITHIN = 1e-4  # of the disk's radius; about 1 px of the view
_LATCHED = {
    Status.DISCONNECTED: Status.WAS_DISCONNECTED,
    Status.ELECTRONICS_WARM: Status.WAS_ELECTRONICS_WARM,
    Status.MIRROR_WARM: Status.WAS_MIRROR_WARM,
    Status.OUTPUT_LIMIT: Status.WAS_OUTPUT_LIMIT,
    Status.AVERAGE_LIMIT: Status.WAS_AVERAGE_LIMIT,
    Status.TRIMMED: Status.WAS_TRIMMED,
}
_COPIES = Status(sum(_LATCHED.values()))


@dataclass(frozen=True)
class MirrorUnit:
    """What one emulated controller is. None of it was read from a real one."""

    model: str = "MR-E-2"
    version: str = "EMULATOR 1.0"
    serial_number: str = "EMUL0001"
    firmware_id: int = 0x00010000
    temperature_c: float = 25.0
    vector_pairs: int = 1500  # of X and Y, in one memory
    ends: Ends = "exclusive"  # what the device takes the end of a range for; not settled (erratum E14)
    crc: Literal["either", "required", "absent"] = "either"  # of requests, see `mirror_device`
    log_rows: int = 16_000  # of the logger; more could not be addressed
    boot_s: float = 1.0  # silence after a reset
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
        """Be as after power came: at rest in the middle, memory and registers empty."""
        self.players = [VectorPlayer(self.unit.ends) for _ in range(CHANNELS)]
        self.memory = np.zeros(2 * self.unit.vector_pairs, np.float32)
        self.static = [dict.fromkeys(Unit, 0.0) for _ in range(CHANNELS)]
        self.inputs = [ChannelRegisters(channel).static_system for channel in range(CHANNELS)]
        self.controls = [ChannelRegisters(channel).xy_system for channel in range(CHANNELS)]
        self.played = [0.0] * CHANNELS
        self.latched, self.trimmed = Status(0), False
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
        self.latched |= self._present(now) & _COPIES
        return now

    def aim(self) -> None:
        """Send the axes where the systems that they follow say, now."""
        self._aim(self.advance())
        self.latched |= self._present(self.moment) & _COPIES

    def trigger(self, rises_s: NDArray[np.float64], falls_s: NDArray[np.float64]) -> None:
        """Take pulses at the trigger input."""
        for player in self.players:
            player.trigger(rises_s, falls_s)
        self.advance()

    def positions(self, times_s: ArrayLike) -> NDArray[np.float64]:
        """Give where the mirror was, (..., 2), at times up to now (...)."""
        self.advance()
        return np.stack([axis.places(times_s) for axis in self.axes], axis=-1)

    def status(self) -> Status:
        """Give the status bits, latched ones included."""
        self.advance()
        return self._present(self.moment) | self.latched

    def acknowledge(self) -> None:
        """Forget what was; what still is, is latched again."""
        self.latched = Status(0)
        self.advance()

    def _aim(self, time_s: float) -> None:
        if Status.DISCONNECTED in self.flags:
            return  # no head that could move
        x, y = (self._wanted(channel) for channel in range(CHANNELS))
        reach = math.hypot(x, y)
        self.trimmed = reach > 1 + RIM_SLACK
        if self.trimmed:
            x, y = x / reach, y / reach
            self.latched |= Status.WAS_TRIMMED
        for axis, place in zip(self.axes, (x, y), strict=True):
            axis.command(time_s, place)

    def _wanted(self, channel: int) -> float:
        """Where a channel's input says; where it says nothing, the axis stays."""
        registers, followed = ChannelRegisters(channel), self.inputs[channel]
        if self.controls[channel] == registers.xy_system:
            if followed == registers.static_system:
                return self.static[channel][Unit.XY]
            if followed == registers.vector_system and self.players[channel].unit is Unit.XY:
                return self.played[channel]
        return self.axes[channel].commanded

    def _present(self, now_s: float) -> Status:
        flags = self.flags
        if self.trimmed:
            flags |= Status.TRIMMED
        if any(axis.unsettled(now_s) > STABLE_WITHIN for axis in self.axes):
            flags |= Status.NOT_STABLE
        was = Status(0)
        for bit, copy in _LATCHED.items():
            was |= copy if bit in flags else Status(0)
        return flags | was


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
        """Whether rows are still taken down."""
        return self._began_s is not None and self._stopped_s is None and self.rows < self._state.unit.log_rows

    @property
    def rows(self) -> int:
        """Rows taken down since the run began."""
        if self._began_s is None:
            return 0
        until = self._state.clock.now() if self._stopped_s is None else self._stopped_s
        return min(int((until - self._began_s) * self.rate_hz + 1e-9) + 1, self._state.unit.log_rows)

    def run(self, on: bool) -> None:
        """Begin anew, or stop; a logger that is stopped keeps its rows."""
        if on:
            self._began_s, self._stopped_s = self._state.clock.now(), None
        elif self.running:
            self._stopped_s = self._state.clock.now()

    def cells(self, slot: int, start: int, stop: int) -> bytes:
        """Give the cells of some rows of a slot; registers that do not change with time have their rest value 0."""
        times = (self._began_s or 0.0) + np.arange(start, stop) / self.rate_hz
        register, state = self.slots[slot], self._state
        for channel in range(CHANNELS):
            registers, player = ChannelRegisters(channel), state.players[channel]
            if register == FEEDBACK_X + channel:
                return state.positions(times)[:, channel].astype(">f4").tobytes()
            if register == registers.vector(VectorRegister.INDEX):
                state.advance()
                return player.indices(times).astype(">u4").tobytes()
            if register == registers.vector(VectorRegister.OUTPUT):
                state.advance()
                return state.memory[player.indices(times)].astype(">f4").tobytes()
            if register == registers.static_xy:
                return np.full(times.size, state.static[channel][Unit.XY], ">f4").tobytes()
        return np.zeros(times.size, ">f4").tobytes()
