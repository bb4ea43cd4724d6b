"""An emulated camera in this process, by a clock turned by hand, and what it sees."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.rig.camera.headwall_camera import HeadwallCamera


def wait_for(camera: HeadwallCamera, at_most_s: float) -> None:
    """Let time pass until no capture runs."""
    until = camera.clock.now() + at_most_s
    while camera.is_capturing():
        assert camera.clock.now() < until, f"the capture still runs after {at_most_s:g} s"
        camera.clock.sleep(0.2)


class LinesOf:
    """Lines that only their own time has, kept as they were given."""

    def __init__(self) -> None:
        self.given: list[NDArray[np.uint16]] = []

    def __call__(self, times: NDArray[np.float64]) -> NDArray[np.uint16]:
        """(line, sample, band) uint16."""
        seed, cell = np.rint(times * 1e4).astype(np.int64) * 7919, np.arange(24).reshape(6, 4) * 31
        lines = ((seed[:, None, None] + cell) % 4096).astype(np.uint16)
        self.given.append(lines)
        return lines
