"""Compute capture times of lines and runs, check budgets, and compare a capture with the full scan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import BudgetError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Sweep
from pipeline.planning.coverage import on_scene

BYTES_PER_SAMPLE = 2  # raw samples are uint16


def select_patches(score: NDArray[np.floating], count: int, valid: NDArray[np.bool_] | None = None) -> NDArray[np.intp]:
    """Return the ``count`` valid patches with the highest ``score`` (patch,), best first.

    Equal scores go to the lowest number, +inf comes first, NaN and -inf last. A smaller count gives the first patches
    of a larger one.
    """
    allowed = np.arange(len(score)) if valid is None else np.flatnonzero(valid)
    given = np.asarray(score, np.float64)[allowed]
    return allowed[np.argsort(np.where(np.isnan(given), np.inf, -given), kind="stable")[:count]]


def frame_patches(
    score: NDArray[np.floating], fraction: float, valid: NDArray[np.bool_] | None = None
) -> NDArray[np.intp]:
    """Return a fraction of the valid patches, chosen by `select_patches`; half a patch is rounded up.

    Raises BudgetError: the fraction is not a number from 0 to 1.
    """
    number = len(score) if valid is None else int(np.count_nonzero(valid))
    if not 0 <= fraction <= 1:  # NaN too
        raise BudgetError(f"the fraction of patches to buy must be from 0 to 1, got {fraction} (of {number} patches)")
    return select_patches(score, min(int(np.floor(fraction * number + 0.5)), number), valid)


@dataclass(frozen=True)
class SavingEntry:
    """One line of the receipt's savings: the capture's value, and the predicted one of full resolution."""

    done: float
    full: float

    @property
    def ratio(self) -> float | None:
        """Return done over full; None where full is 0."""
        return self.done / self.full if self.full else None

    def as_dict(self) -> dict[str, float | str | None]:
        """Return the entry in the receipt's form."""
        return {"done": self.done, "full": self.full, "ratio": self.ratio, "full_is": "predicted"}


def count_samples(sweeps: Sequence[Sweep], camera: LineCamera, grid: SceneGrid) -> int:
    """Count the (binned) samples that show the scene; those beside it are left out."""
    shape = (grid.height, grid.width)
    return sum(int(np.count_nonzero(on_scene(shape, camera, sweep))) for sweep in sweeps)


def raw_bytes(sweeps: Sequence[Sweep], camera: LineCamera, bands: int) -> int:
    """Count the bytes of the captured lines, with all of their samples."""
    return sum(sweep.lines * (camera.samples // sweep.binning) for sweep in sweeps) * bands * BYTES_PER_SAMPLE


def capture_savings(
    done: Sequence[Sweep], full: Sequence[Sweep], camera: LineCamera, grid: SceneGrid
) -> dict[str, SavingEntry]:
    """Compare sweeps with those of a full scan: lines, and samples on the scene."""
    return {
        "lines": SavingEntry(sum(one.lines for one in done), sum(one.lines for one in full)),
        "samples": SavingEntry(count_samples(done, camera, grid), count_samples(full, camera, grid)),
    }
