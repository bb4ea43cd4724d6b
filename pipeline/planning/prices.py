"""Prices of capture: seconds of lines and runs, what a budget leaves for the fine pass, and what was saved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, isfinite
from typing import Literal

import numpy as np

from pipeline.errors import BudgetError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import CostModel, Sweep
from pipeline.planning.coverage import on_scene

FullIs = Literal["measured", "predicted"]

BYTES_PER_SAMPLE = 2  # raw samples are uint16
LEAST_DIGITS = 4  # of the least budget that a refusal names
ROUNDING = 1e-9


@dataclass(frozen=True)
class ScanPrices:
    """Seconds of a line, of opening a run, and of a reload that is due once every ``lines_per_reload`` lines."""

    line_s: float
    run_s: float
    reload_s: float
    lines_per_reload: int

    @property
    def even_line_s(self) -> float:
        """Price of a line with its fraction of a reload: additive, and below the true price by less than a reload."""
        return self.line_s + self.reload_s / self.lines_per_reload

    def seconds(self, lines: int, runs: int) -> float:
        """True price of so many lines in so many runs [s]."""
        return lines * self.line_s + runs * self.run_s + -(-lines // self.lines_per_reload) * self.reload_s

    def even_seconds(self, lines: int, runs: int) -> float:
        """Additive price [s]."""
        return lines * self.even_line_s + runs * self.run_s

    def most_lines(self, seconds: float, runs: int) -> int:
        """Most lines that so many runs may have for a true price of at most ``seconds``; below 0 where none may."""
        left = seconds - runs * self.run_s
        load = self.lines_per_reload * self.line_s + self.reload_s
        loads = int(left // load)
        rest = max(int((left - loads * load - self.reload_s) / self.line_s), 0)
        lines = loads * self.lines_per_reload + rest
        while lines >= 0 and self.seconds(lines, runs) > seconds:  # rounding
            lines -= 1
        return lines


def prices_of(camera: LineCamera, cost: CostModel) -> ScanPrices:
    """Give the cost model's prices of fine lines (one held position each) and runs."""
    return ScanPrices(camera.frame_ms * 1e-3, cost.setup_seconds(camera), cost.reload_s, cost.vector_pairs)


def least_budget(coarse_seconds: float, full_seconds: float) -> float:
    """Give the least budget that pays for the coarse pass alone, rounded up to four digits; above 1 none does."""
    return ceil(coarse_seconds / full_seconds * 10.0**LEAST_DIGITS - ROUNDING) / 10.0**LEAST_DIGITS


def check_budget(budget: float, coarse_seconds: float, full_seconds: float) -> float:
    """Give the seconds that ``budget`` leaves for the fine pass.

    The budget is the seconds of coarse and fine capture over those of the full scan, above 0 and at most 1.

    Raises BudgetError: the budget is not a number in that range, or less than the coarse pass alone; names the least.
    """
    if not isfinite(budget) or not 0 < budget <= 1:
        raise BudgetError(f"--budget must be a fraction of the full scan's time above 0 and at most 1, got {budget}")
    if coarse_seconds > full_seconds:
        raise BudgetError(
            f"the coarse pass alone ({coarse_seconds:.1f} s) takes longer than the full scan ({full_seconds:.1f} s), "
            f"so no budget can be met, got {budget}; scan in full, or take a larger coarse factor"
        )
    left = budget * full_seconds - coarse_seconds
    if left < -ROUNDING * full_seconds:
        raise BudgetError(
            f"--budget {budget} gives {budget * full_seconds:.1f} s, but the coarse pass alone takes "
            f"{coarse_seconds:.1f} of the full scan's {full_seconds:.1f} s; "
            f"the least possible is {least_budget(coarse_seconds, full_seconds)}, or less with a shorter "
            "--coarse-exposure-ms"
        )
    return max(left, 0.0)


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
    full_is: FullIs = "predicted",
) -> dict[str, SavingEntry]:
    """Compare sweeps with those of a full scan: lines, samples on the scene, seconds by the cost model."""
    both = (done, full)
    counted: dict[str, list[float]] = {
        "lines": [count_lines(sweeps) for sweeps in both],
        "samples": [count_samples(sweeps, camera, grid) for sweeps in both],
        "capture_s": [cost.seconds(list(sweeps), camera) for sweeps in both],
    }
    return {name: SavingEntry(of_done, of_full, full_is) for name, (of_done, of_full) in counted.items()}
