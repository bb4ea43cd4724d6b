"""An emulated camera in this process with a manual clock, and the lines that it sees."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.rig.camera.headwall_camera import HeadwallCamera


def wait_for(camera: HeadwallCamera, at_most_s: float) -> None:
    """Advance the clock until the capture ends."""
    until = camera.clock.now() + at_most_s
    while camera.is_capturing():
        assert camera.clock.now() < until, f"the capture still runs after {at_most_s:g} s"
        camera.clock.sleep(0.2)


class LinesOf:
    """Lines that depend on their time only, recorded as they were returned."""

    def __init__(self) -> None:
        self.given: list[NDArray[np.uint16]] = []

    def __call__(self, times: NDArray[np.float64]) -> NDArray[np.uint16]:
        """Return lines (line, sample, band) uint16 for their times."""
        seed = np.rint(times * 1e4).astype(np.int64) * 7919
        lines = ((seed[:, None, None] + 31 * np.arange(24).reshape(6, 4)) % 4096).astype(np.uint16)
        self.given.append(lines)
        return lines
