"""Crop rows in the coarse image, and what the other orientation of the line would have shown (mountings are fixed)."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.errors import PoseError, ShapeError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Axis, CostModel, Sweep
from pipeline.planning.coverage import coarse_sweeps, full_sweeps, sweeps_over, with_margin
from pipeline.planning.fine_pass import FinePlan, plan_fine

Floats = NDArray[np.float64]

TILES = 6  # along the shorter side, where the image allows
LEAST_TILE = 12  # pixels a side
LEAST_STRENGTH = 0.12
LEAST_SIGMAS = 4.0  # that the mean over tiles lies from none
STRONG_SHARE = 0.98  # quantile at which gradients are cut, so that a track or a wall does not speak for the field
TURNED: dict[Axis, Axis] = {"x": "y", "y": "x"}
WORDS: dict[Axis, str] = {"x": "across the picture", "y": "down the picture"}  # for people, where lines lie


@dataclass(frozen=True)
class CropRows:
    """Direction of the rows and how clear it is.

    ``angle_deg`` is that of the rows, from x towards y of the array, from 0 to below 180; None where there are none.
    ``strength`` is 0 where gradients point anywhere and 1 where all lie square to the rows, everywhere the same.
    """

    angle_deg: float | None
    strength: float

    @property
    def nearest_axis(self) -> Axis | None:
        """Scene axis that the rows lie closer to; None where there are none."""
        if self.angle_deg is None:
            return None
        return "x" if abs(self.angle_deg - 90) > 45 else "y"


def find_rows(image: ArrayLike) -> CropRows:
    """Find the direction of crop rows in a broad-band image (y, x), such as the mean over bands of the coarse mosaic.

    Gradients are taken between the pixels of 2 x 2 blocks, which is right to four degrees for rows four pixels apart
    or more, and averaged with their angles doubled, tile by tile [1]_. Rows are what many tiles agree on: the direction
    counts where the mean over tiles lies four standard errors from none. NaN pixels count nothing.

    Raises ShapeError: the image has not two axes.

    .. [1] Bigun, Granlund, "Optimal orientation detection of linear symmetry", ICCV 1987.
    """
    pixels = np.asarray(image, np.float64)
    if pixels.ndim != 2:
        raise ShapeError(f"rows are looked for in one (y, x) image, got shape {pixels.shape}; take the mean over bands")
    vectors = _tile_vectors(pixels)
    if len(vectors) < 4:
        return CropRows(None, 0.0)
    mean = complex(vectors.mean())
    strength = abs(mean)
    spread = float(np.sqrt(np.mean(np.abs(vectors - mean) ** 2) / (len(vectors) - 1)))
    if strength < LEAST_STRENGTH or strength < LEAST_SIGMAS * spread:
        return CropRows(None, strength)
    across = np.degrees(np.angle(mean)) / 2  # of the gradient; rows run square to it
    return CropRows(float((across + 90.0) % 180.0), strength)


def _tile_vectors(pixels: Floats) -> NDArray[np.complex128]:
    """Mean gradient of each tile with its angle doubled, over the mean size of its gradients, (tile,)."""
    # Diagonal differences, turned back: both parts of a gradient at the same point, the middle of four pixels.
    down, up = pixels[1:, 1:] - pixels[:-1, :-1], pixels[1:, :-1] - pixels[:-1, 1:]
    along, across = (down - up) / 2, (down + up) / 2
    squared: NDArray[np.complex128] = (along + 1j * across) ** 2
    size = np.abs(squared)
    known = np.isfinite(size)
    if not np.any(size[known] > 0):
        return np.zeros(0, np.complex128)
    cut = float(np.quantile(size[known], STRONG_SHARE)) or float(size[known].max())
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.where(size > cut, cut / size, 1.0)
    pointed: NDArray[np.complex128] = squared * scale
    pointed[~known] = 0
    size = np.where(known, np.minimum(size, cut), 0)
    side = max(min(pixels.shape) // TILES, LEAST_TILE)
    rows, columns = (np.arange(0, max(length - side // 2, 1), side) for length in size.shape)
    total = np.add.reduceat(np.add.reduceat(size, rows, axis=0), columns, axis=1).ravel()
    vector = np.add.reduceat(np.add.reduceat(pointed, rows, axis=0), columns, axis=1).ravel()
    return np.asarray(vector[total > 0] / total[total > 0], np.complex128)


@dataclass(frozen=True)
class OrientationOutcome:
    """Both passes with lines along one axis: seconds of either, fine lines, and the share of the score bought."""

    along: Axis
    coarse_s: float
    fine_s: float
    fine_lines: int
    worth_share: float | None  # None where no seat is worth anything


@dataclass(frozen=True)
class OrientationReport:
    """The plan as it is and as it would be with the line turned by 90 deg, for the same seconds of both passes.

    ``other`` is None where that is not possible: ``why_not`` says why.
    """

    taken: OrientationOutcome
    other: OrientationOutcome | None
    rows: CropRows | None
    why_not: str = ""

    @property
    def sentence(self) -> str:
        """The comparison in words."""
        here, there = WORDS[self.taken.along], WORDS[TURNED[self.taken.along]]
        parts = ["no place is worth a second look"]
        if self.taken.worth_share is not None:
            shown = f"{100 * self.taken.worth_share:.1f} %"
            parts = [f"with camera lines {here} the fine sweeps show {shown} of what is worth a second look"]
        if self.other is None:
            parts.append(f"with lines {there} it could not be done: {self.why_not}")
        elif self.other.worth_share is not None:
            parts.append(
                f"with lines {there} they would show {100 * self.other.worth_share:.1f} % in no more time "
                f"({self.other.coarse_s:.1f} s coarse and {self.other.fine_s:.1f} s fine, here "
                f"{self.taken.coarse_s:.1f} s and {self.taken.fine_s:.1f} s)"
            )
        if self.rows is not None and self.rows.angle_deg is not None and self.rows.nearest_axis is not None:
            off = abs((self.rows.angle_deg + 45) % 90 - 45)
            parts.append(f"crop rows run {WORDS[self.rows.nearest_axis]}, to within {ceil(off)} degrees")
        elif self.rows is not None:
            parts.append("no crop rows are seen")
        return "; ".join(parts)


def compare_orientations(
    grid: SceneGrid,
    camera: LineCamera,
    cost: CostModel,
    along: Axis,
    scores: NDArray[np.floating],
    *,
    budget_s: float,
    plan: FinePlan | None = None,
    rows: CropRows | None = None,
    overlap_px: float = 0,
    margin_px: float = 0,
    threshold: float | None = None,
    coarse_exposure_ms: float | None = None,
    shown: NDArray[np.bool_] | None = None,
) -> OrientationReport:
    """Plan the same scores with lines along the other axis, for the seconds that both passes have here.

    Scores, budget, margin and threshold are those of :func:`pipeline.planning.fine_pass.plan_fine`, ``overlap_px`` and
    ``coarse_exposure_ms`` those of the coarse pass; its sweeps begin earlier and end later by the margin. ``plan`` is
    the plan with lines along ``along`` where it is made already, ``rows`` the crop rows of the coarse image, for the
    sentence. ``shown`` are the seats (seat,) that lines have to show, None for all.

    Raises PoseError: the field is beyond the mirror's range with lines along ``along``; the other axis is only
    reported.
    """

    def cut(sweeps: list[Sweep]) -> list[Sweep]:
        return sweeps if shown is None else sweeps_over(sweeps, grid, camera, shown)

    def coarse_seconds(axis: Axis) -> float:
        sweeps = cut(coarse_sweeps(grid, camera, axis, overlap_px=overlap_px, exposure_ms=coarse_exposure_ms))
        return cost.seconds(with_margin(sweeps, camera, margin_px), camera)

    def fine(axis: Axis, seconds: float) -> FinePlan:
        full = None if shown is None else cut(full_sweeps(grid, camera, axis))
        return plan_fine(
            grid, camera, cost, axis, scores, budget_s=seconds, margin_px=margin_px, full=full, threshold=threshold
        )

    def outcome(axis: Axis, coarse_s: float, plan: FinePlan) -> OrientationOutcome:
        share = plan.worth / plan.wanted_worth if plan.wanted_worth else None
        return OrientationOutcome(axis, coarse_s, plan.seconds, plan.lines, share)

    here = plan or fine(along, budget_s)
    coarse_s = coarse_seconds(along)
    taken, other = outcome(along, coarse_s, here), TURNED[along]
    try:
        other_coarse_s = coarse_seconds(other)
        spent = budget_s if here.spared_s is None else here.seconds  # what a threshold left is not there to be spent
        left = coarse_s + spent - other_coarse_s
        if left < 0:
            reason = f"the coarse pass alone takes {other_coarse_s:.1f} s"
            return OrientationReport(taken, None, rows, reason)
        turned = fine(other, left)
    except PoseError as error:
        return OrientationReport(taken, None, rows, str(error))
    return OrientationReport(taken, outcome(other, other_coarse_s, turned), rows)
