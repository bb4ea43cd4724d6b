"""How much of each class a map has: as a whole, and how surely; in cells of a prescription, and the dose of each cell.

Shares are judged from a confusion matrix, or from the map's own probabilities. Cells lie along a heading, or along
north for task data.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from affine import Affine
from numpy.typing import ArrayLike, NDArray

from pipeline.errors import SettingsError, ShapeError
from pipeline.geometry.grid import UNLABELLED
from pipeline.lazy import deferred

if TYPE_CHECKING:
    import shapely
else:
    shapely = deferred("shapely")

Floats = NDArray[np.float64]

BLOCK_PX = 16  # a side: errors within such a block are taken to come together, those of different blocks alone
Classes = NDArray[np.uint8]
ToAxes = Callable[[Floats, Floats], Floats]  # x and y of a map to (..., 2) along and across the cells

ROWS_AT_ONCE = 256
MOST_CELLS = 4_000_000


@dataclass(frozen=True)
class FractionEstimate:
    """Shares of the classes in what is mapped, and their standard errors."""

    fractions: Floats  # (class,)
    errors: Floats  # (class,)


def stratified_fractions(mapped: ArrayLike, confusion: ArrayLike) -> FractionEstimate:
    """Estimate shares from a map's and what pixels of each mapped class turned out to be.

    ``mapped`` is (class,) fractions of the map, ``confusion`` (label, mapped class) counts, as
    `models.evaluation.metrics.confusion` gives them. The judged pixels are taken for a random sample of each mapped
    class. NaN where a class that is mapped was judged at fewer than two pixels. Raises ShapeError: the sizes differ.

    References
    ----------
    .. [1] Olofsson et al., "Good practices for estimating area and assessing accuracy of land change", Remote Sensing
       of Environment 148, 2014. doi:10.1016/j.rse.2014.02.015
    """
    weight, counts = np.asarray(mapped, np.float64), np.asarray(confusion, np.float64)
    if counts.shape != (len(weight), len(weight)):
        raise ShapeError(f"{len(weight)} classes and a confusion matrix of {counts.shape} do not fit")
    judged = counts.sum(axis=0)
    with np.errstate(all="ignore"):  # a class that was not judged says nothing
        of_map = np.where(weight > 0, counts / judged, 0.0)
        spread = np.where(weight > 0, of_map * (1 - of_map) / (judged - 1), 0.0)
    fractions = (weight * of_map).sum(axis=1)  # [1] Eq. 9
    errors = np.sqrt((weight**2 * spread).sum(axis=1))  # [1] Eq. 10
    return FractionEstimate(fractions, np.where(np.isfinite(fractions), errors, np.nan))


def probable_fractions(swaths: Iterable[NDArray[np.floating]], classes: int) -> FractionEstimate:
    """Estimate shares from probabilities (y, x, class), given as strips of a map from the top down.

    NaN where a pixel has no class. Strips are as high as a multiple of ``BLOCK_PX``, but for the last. Each pixel is
    one draw by its probabilities; within a block of 16 x 16 px all draws go the same way, between blocks they are
    independent, so that a map in large patches is not taken for surer than it is. NaN without any pixel.
    """
    total, expected, variance = 0, np.zeros(classes), np.zeros(classes)
    for swath in swaths:
        known = np.isfinite(swath).all(axis=-1)
        fraction = np.where(known[..., None], swath, 0.0).astype(np.float64)
        total += int(known.sum())
        expected += fraction.sum(axis=(0, 1))
        spread = np.sqrt(fraction * (1 - fraction))
        for axis in (0, 1):
            spread = np.add.reduceat(spread, np.arange(0, spread.shape[axis], BLOCK_PX), axis=axis)
        variance += (spread**2).sum(axis=(0, 1))
    if not total:
        return FractionEstimate(np.full(classes, np.nan), np.full(classes, np.nan))
    return FractionEstimate(expected / total, np.sqrt(variance) / total)


@dataclass(frozen=True)
class Heading:
    """Axes of cells in the plane of a map: along a heading, clockwise from north, and across to the right of it."""

    degrees: float = 0.0

    @property
    def _turn(self) -> tuple[float, float]:
        return float(np.sin(np.deg2rad(self.degrees))), float(np.cos(np.deg2rad(self.degrees)))

    def to_axes(self, x: Floats, y: Floats) -> Floats:
        """Give (..., 2) along and across of places x east, y north, in the map's unit."""
        sine, cosine = self._turn
        return np.stack([x * sine + y * cosine, x * cosine - y * sine], axis=-1)

    def from_axes(self, along: Floats, across: Floats) -> Floats:
        """Give (..., 2) x and y; the inverse of ``to_axes``."""
        sine, cosine = self._turn
        return np.stack([along * sine + across * cosine, along * cosine - across * sine], axis=-1)


@dataclass(frozen=True)
class CellGrid:
    """Equal cells side by side; rows count along the axis of work, columns across it, both from the lower end."""

    corner: tuple[float, float]  # along and across
    step: tuple[float, float]  # sides of a cell, along and across
    shape: tuple[int, int]  # rows, columns

    @classmethod
    def around(cls, points: ArrayLike, step: tuple[float, float]) -> CellGrid:
        """Lay cells around (..., 2) points along and across; they begin at multiples of their sides.

        Raises SettingsError: there would be more than four million cells.
        """
        places = np.asarray(points, np.float64).reshape(-1, 2)
        first = np.floor(places.min(axis=0) / step)
        count = np.floor(places.max(axis=0) / step) - first + 1
        if np.prod(count) > MOST_CELLS:
            raise SettingsError(
                f"cells of this size would be {count[0]:.0f} x {count[1]:.0f}, more than {MOST_CELLS}; use larger ones"
            )
        corner = (first * step).tolist()
        return cls((corner[0], corner[1]), step, (int(count[0]), int(count[1])))

    def cell_of(self, points: Floats) -> NDArray[np.intp]:
        """Number of the cell that each of (..., 2) points lies in, row by row; -1 outside."""
        place = np.floor((points - self.corner) / self.step).astype(np.intp)
        inside = ((place >= 0) & (place < self.shape)).all(axis=-1)
        return np.where(inside, place[..., 0] * self.shape[1] + place[..., 1], -1)

    def outlines(self) -> Floats:
        """(row, column, corner, 2) along and across of the cells' corners, closed: five of each."""
        row, column = np.meshgrid(*(np.arange(size) for size in self.shape), indexing="ij")
        down, right = np.array([0, 1, 1, 0, 0]), np.array([0, 0, 1, 1, 0])
        along = self.corner[0] + self.step[0] * (row[..., None] + down)
        across = self.corner[1] + self.step[1] * (column[..., None] + right)
        return np.stack([along, across], axis=-1)


def pixel_axes(transform: Affine, rows: slice, width: int, to_axes: ToAxes) -> Floats:
    """Give where the centres of some rows of a map's pixels lie, (row, x, 2) along and across."""
    column, row = np.meshgrid(np.arange(width) + 0.5, np.arange(rows.start, rows.stop) + 0.5)
    a, b, c, d, e, f = transform[:6]
    return to_axes(a * column + b * row + c, d * column + e * row + f)


def count_classes(
    grid: CellGrid, classes: Classes, transform: Affine, to_axes: ToAxes, count: int
) -> NDArray[np.int64]:
    """Count the pixels of ``count`` classes whose centres lie in each cell, (row, column, class).

    ``classes`` is a map (y, x), ``transform`` leads from its pixel corners to its x and y.
    """
    found = np.zeros(grid.shape[0] * grid.shape[1] * count, np.int64)
    for first in range(0, classes.shape[0], ROWS_AT_ONCE):
        rows = slice(first, min(first + ROWS_AT_ONCE, classes.shape[0]))
        part = classes[rows]
        cell = grid.cell_of(pixel_axes(transform, rows, classes.shape[1], to_axes))
        known = (part != UNLABELLED) & (cell >= 0)
        found += np.bincount(cell[known] * count + part[known], minlength=len(found))
    return found.reshape(*grid.shape, count)


def dose_cells(counts: NDArray[np.int64], doses: Mapping[int, float], least_fraction: float) -> Floats:
    """Give the dose of each cell, (row, column): of the classes with a fraction above ``least_fraction`` the greatest.

    ``counts`` are pixels (row, column, class), ``doses`` by the class's number. 0 where no treated class has such a
    share, NaN where the map shows nothing of the cell. Raises ShapeError: a class has no count.
    """
    if doses and max(doses) >= counts.shape[2]:
        raise ShapeError(f"class {max(doses)} has a dose, and cells count {counts.shape[2]} classes")
    total = counts.sum(axis=2)
    result = np.zeros(total.shape)
    for number, dose in doses.items():
        result = np.maximum(result, np.where(counts[..., number] > least_fraction * total, dose, 0.0))
    return np.where(total > 0, result, np.nan)


def cell_polygons(grid: CellGrid, heading: Heading) -> NDArray[Any]:
    """(row, column) outlines of the cells as shapely's polygons, in x and y of the map."""
    corners = grid.outlines()
    polygons: NDArray[Any] = shapely.polygons(heading.from_axes(corners[..., 0], corners[..., 1]))
    return polygons
