"""The emulated logger: six registers taken down at up to 10 kHz, worked out when they are read."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.rig.emulator.mirror_state import MirrorState
from pipeline.rig.mirror.registers import (
    CHANNELS,
    FEEDBACK_A,
    FEEDBACK_X,
    LOG_SLOTS,
    ChannelRegisters,
    Unit,
    VectorRegister,
)

# what the slots take down after power came: two outputs of the drive, then both forms of the optical feedback
FIRST_SLOTS = (0xE802, 0xE902, 0x2300, 0x2301, 0x2302, 0x2303)


class PositionLogger:
    """Slots, rate and rows of the logger. It stops by itself when its rows are full."""

    def __init__(self, state: MirrorState) -> None:
        self._state = state
        self.slots = list(FIRST_SLOTS)
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
        if not 0 <= slot < LOG_SLOTS:
            raise IndexError(slot)
        times = (self._began_s or 0.0) + np.arange(start, stop) / self.rate_hz
        return self._column(self.slots[slot], times)

    def _column(self, register: int, times: NDArray[np.float64]) -> bytes:
        state = self._state
        for channel in range(CHANNELS):
            registers, player = ChannelRegisters(channel), state.players[channel]
            if register in (FEEDBACK_X + channel, FEEDBACK_A + channel):
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
