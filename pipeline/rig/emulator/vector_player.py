"""The emulated vector unit of one channel: which cell of the vector memory is played at which time.

Assumed, as no document says it: the first cell is taken at the run command, with an external trigger too, whose edges
then take one cell each; a unit that is done keeps its last cell and reports that it no longer runs.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pipeline.rig.mirror.registers import Trigger, Unit
from pipeline.vector_memory import Ends

MOST_STEPS = 20_000  # steps that are played one by one; of a longer silence only the last ones are
ENDLESS = -1


@dataclass
class VectorPlayer:
    """Registers and clockwork of one channel's vector unit."""

    ends: Ends = "exclusive"
    unit: Unit = Unit.FEEDBACK
    start: int = 0
    end: int = 0
    frequency_hz: float = 10_000.0
    cycles: int = ENDLESS
    external: Trigger = Trigger.OFF
    running: bool = False
    _began_s: float = 0.0
    _played: int = 0
    _edges: deque[float] = field(default_factory=deque)
    _steps: deque[tuple[float, int]] = field(default_factory=lambda: deque(maxlen=MOST_STEPS))

    @property
    def length(self) -> int:
        """Cells of one cycle."""
        return self.end - self.start + (self.ends == "inclusive")

    @property
    def total(self) -> int | None:
        """Cells of all cycles; None for an endless run."""
        return None if self.cycles < 0 else self.cycles * self.length

    @property
    def index(self) -> int:
        """The cell that is played, or was last."""
        return self.start + max(self._played - 1, 0) % self.length if self.length > 0 else self.start

    def run(self, time_s: float) -> None:
        """Begin with the first cell."""
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
        """Give the steps (time, cell) since the last call up to now, and stop where the run is over."""
        if not self.running or self.length < 1:
            return
        for time_s in self._by_edges(now_s) if self.external is not Trigger.OFF else self._by_clock(now_s):
            if self.total is not None and self._played >= self.total:
                self.stop()
                return
            cell = self.start + self._played % self.length
            self._played += 1
            self._steps.append((time_s, cell))
            yield time_s, cell

    def indices(self, times_s: NDArray[np.float64]) -> NDArray[np.int64]:
        """Give the cell that was played at past times; the first cell before the first step that is remembered."""
        if not self._steps:
            return np.full(np.shape(times_s), self.start, np.int64)
        known, cells = (np.array(column) for column in zip(*self._steps, strict=True))
        at = np.clip(np.searchsorted(known, times_s, side="right") - 1, 0, None)
        return np.asarray(cells, np.int64)[at]

    def _by_clock(self, now_s: float) -> Iterator[float]:
        if self.frequency_hz <= 0:
            return
        last = int(np.floor((now_s - self._began_s) * self.frequency_hz + 1e-9))  # steps 0 .. last are due
        last = last if self.total is None else min(last, self.total)
        self._played += max(last - self._played - MOST_STEPS, 0)
        for number in range(self._played, last + 1):
            yield self._began_s + number / self.frequency_hz

    def _by_edges(self, now_s: float) -> Iterator[float]:
        if self._played == 0:
            yield self._began_s
        while self._edges and self._edges[0] <= now_s:
            yield self._edges.popleft()
