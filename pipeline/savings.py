"""What a run captured against what a full scan would have: lines, samples, bytes, seconds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.camera import LineCamera
from pipeline.coverage import ROUNDING_PX, field_px
from pipeline.grid import SceneGrid
from pipeline.scan import CostModel, Sweep, sweep_to_scene

FullIs = Literal["measured", "predicted"]

BYTES_PER_SAMPLE = 2  # raw samples are uint16


@dataclass(frozen=True)
class Entry:
    """One line of the receipt's savings: what was done, what full resolution takes, and how that figure is known."""

    done: float
    full: float
    full_is: FullIs

    @property
    def ratio(self) -> float | None:
        """Done over full; None where full is 0."""
        return self.done / self.full if self.full else None

    def as_dict(self) -> dict[str, float | str | None]:
        """Give the entry as the receipt stores it."""
        return {"done": self.done, "full": self.full, "ratio": self.ratio, "full_is": self.full_is}


def count_lines(sweeps: Sequence[Sweep]) -> int:
    """Count the lines of sweeps; a coarse line counts as one."""
    return sum(sweep.lines for sweep in sweeps)


def count_samples(sweeps: Sequence[Sweep], camera: LineCamera, grid: SceneGrid) -> int:
    """Count the (binned) samples whose ray at mid exposure meets the scene; those beside it cost time and are left out.

    Rays are exact: line rotation and stretch included.
    """
    return sum(_on_scene(sweep, camera, grid) for sweep in sweeps)


def _on_scene(sweep: Sweep, camera: LineCamera, grid: SceneGrid) -> int:
    across, scan = field_px(grid, sweep.along)
    along_px, scan_px = sweep_to_scene(sweep, camera)
    inside = np.ones(along_px.shape, bool)
    for place, size in ((along_px, across), (scan_px, scan)):
        # Half open: a sample on the border between two pixels falls into the second, and rounding has no say in it.
        pixel = np.floor(place + size / 2 + ROUNDING_PX)
        inside &= (pixel >= 0) & (pixel < size)
    return int(np.count_nonzero(inside))


def raw_bytes(sweeps: Sequence[Sweep], camera: LineCamera, bands: int) -> int:
    """Count the bytes of the captured lines: a line takes all its samples, whatever was asked of it."""
    samples = sum(sweep.lines * (camera.samples // sweep.binning) for sweep in sweeps)
    return samples * bands * BYTES_PER_SAMPLE


def capture_savings(
    done: Sequence[Sweep],
    full: Sequence[Sweep],
    camera: LineCamera,
    grid: SceneGrid,
    *,
    cost: CostModel,
    bands: int,
    full_is: FullIs = "predicted",
) -> dict[str, Entry]:
    """Compare sweeps with those of a full scan.

    Returns
    -------
    ``lines``, ``samples`` (on the scene), ``bytes_raw`` and ``capture_s`` (by the cost model, in seconds).
    """

    def entry(of_done: float, of_full: float) -> Entry:
        return Entry(of_done, of_full, full_is)

    return {
        "lines": entry(count_lines(done), count_lines(full)),
        "samples": entry(count_samples(done, camera, grid), count_samples(full, camera, grid)),
        "bytes_raw": entry(raw_bytes(done, camera, bands), raw_bytes(full, camera, bands)),
        "capture_s": entry(cost.seconds(list(done), camera), cost.seconds(list(full), camera)),
    }
