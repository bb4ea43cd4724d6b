"""An emulated mirror controller whose trigger input is wired to a camera: it looks there before it does anything."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.rig.clock import Clock
from pipeline.rig.emulator.exchange import Chunk
from pipeline.rig.emulator.fault import Fault
from pipeline.rig.emulator.mirror_device import MirrorDevice
from pipeline.rig.emulator.mirror_state import MirrorUnit

Floats = NDArray[np.float64]
Pulses = Callable[[float, float], Floats]  # (pulse, 2) rises and falls of pulses that rise within a span of time


def no_pulses(from_s: float, to_s: float) -> Floats:
    """A trigger input that nothing is wired to."""
    return np.zeros((0, 2))


class TriggeredMirror(MirrorDevice):
    """A :class:`MirrorDevice` that takes the pulses of ``pulses`` as time passes; set it once the camera is there."""

    def __init__(self, clock: Clock, faults: Sequence[Fault] = (), *, unit: MirrorUnit | None = None) -> None:
        super().__init__(clock, faults, unit=unit)
        self.pulses: Pulses = no_pulses
        self._taken_s = clock.now()
        self._wire = threading.Lock()

    def receive(self, data: bytes) -> list[Chunk]:
        """Take what came at the trigger input, then bytes; see :meth:`MirrorDevice.receive`."""
        self.take_pulses()
        return super().receive(data)

    def positions(self, times_s: ArrayLike) -> Floats:
        """Give where the mirror truly was, (..., 2), at times of the clock up to now (...)."""
        self.take_pulses()
        return super().positions(times_s)

    def sent(self, times_s: ArrayLike) -> Floats:
        """Give where the mirror was sent, (..., 2), at times of the clock up to now (...)."""
        self.take_pulses()
        with self._lock:
            self.state.advance()
            return np.stack([axis.commands(times_s) for axis in self.state.axes], axis=-1)

    def take_pulses(self) -> None:
        """Step through the vector memory as the pulses since the last call say."""
        with self._wire:
            now_s = self.clock.now()
            pulses = self.pulses(self._taken_s, now_s)
            self._taken_s = max(now_s, self._taken_s)
            if not len(pulses):
                return
            with self._lock:
                for player in self.state.players:
                    player.trigger(pulses[:, 0], pulses[:, 1])
                self.state.advance()
