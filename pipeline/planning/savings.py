"""What a run captured against what a full scan would have: lines, samples, bytes, seconds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import CostModel, Sweep
from pipeline.planning.coverage import on_scene

FullIs = Literal["measured", "predicted"]

BYTES_PER_SAMPLE = 2  # raw samples are uint16


@dataclass(frozen=True)
class SavingEntry:
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
    """Count the (binned) samples that look at the scene; those beside it cost time and are left out."""
    shape = (grid.height, grid.width)
    return sum(int(np.count_nonzero(on_scene(shape, camera, sweep))) for sweep in sweeps)


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
) -> dict[str, SavingEntry]:
    """Compare sweeps with those of a full scan.

    Returns
    -------
    ``lines``, ``samples`` (on the scene), ``bytes_raw`` and ``capture_s`` (by the cost model, in seconds).
    """

    def entry(of_done: float, of_full: float) -> SavingEntry:
        return SavingEntry(of_done, of_full, full_is)

    return {
        "lines": entry(count_lines(done), count_lines(full)),
        "samples": entry(count_samples(done, camera, grid), count_samples(full, camera, grid)),
        "bytes_raw": entry(raw_bytes(done, camera, bands), raw_bytes(full, camera, bands)),
        "capture_s": entry(cost.seconds(list(done), camera), cost.seconds(list(full), camera)),
    }
