"""Compute the cells of a prescription: a grid along a heading, the covered part of each cell, doses, outlines.

Areas are those of the pixels' outlines, so that cells finer than pixels, and cells across them, are covered in full.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from affine import Affine
from numpy.typing import NDArray

from pipeline.errors import SettingsError

Floats = NDArray[np.float64]
ToAxes = Callable[[Floats, Floats], Floats]  # x and y of a map to (..., 2) along and across the cells

ROWS_AT_ONCE = 64
MOST_CELLS = 4_000_000
LEAST_PART = 1e-6  # of a cell: a smaller part, covered or not, is rounding


@dataclass(frozen=True)
class Heading:
    """Axes of cells in the plane of a map: along a heading, clockwise from north, and across to the right of it."""

    degrees: float = 0.0

    @property
    def _turn(self) -> tuple[float, float]:
        return float(np.sin(np.deg2rad(self.degrees))), float(np.cos(np.deg2rad(self.degrees)))

    def to_axes(self, x: Floats, y: Floats) -> Floats:
        """Return (..., 2) along and across of places x east, y north, in the map's unit."""
        sine, cosine = self._turn
        return np.stack([x * sine + y * cosine, x * cosine - y * sine], axis=-1)

    def from_axes(self, along: Floats, across: Floats) -> Floats:
        """Return (..., 2) x and y; the inverse of ``to_axes``."""
        sine, cosine = self._turn
        return np.stack([along * sine + across * cosine, along * cosine - across * sine], axis=-1)


@dataclass(frozen=True)
class CellGrid:
    """Equal cells side by side; rows count along the axis of work, columns across it, both from the lower end."""

    corner: tuple[float, float]  # along and across
    step: tuple[float, float]  # sides of a cell, along and across
    shape: tuple[int, int]  # rows, columns

    @classmethod
    def around(cls, low: Floats, high: Floats, step: tuple[float, float]) -> CellGrid:
        """Lay cells over the places from ``low`` to ``high``, each (along, across), from multiples of their sides.

        Raises SettingsError: there would be more than four million cells.
        """
        first = np.floor(low / step)
        count = np.maximum(np.ceil(high / step) - first, 1)
        if np.prod(count) > MOST_CELLS:
            raise SettingsError(
                f"cells of this size would be {count[0]:.0f} x {count[1]:.0f}, more than {MOST_CELLS}; use larger ones"
            )
        corner = (first * step).tolist()
        return cls((corner[0], corner[1]), step, (int(count[0]), int(count[1])))

    def outlines(self, row: NDArray[np.intp], column: NDArray[np.intp]) -> Floats:
        """Return (cell, corner, 2) along and across of cells' corners, closed: five of each."""
        down, right = np.array([0, 1, 1, 0, 0]), np.array([0, 0, 1, 1, 0])
        places = np.stack([row[:, None] + down, column[:, None] + right], axis=-1)
        return np.asarray(places * np.array(self.step) + np.array(self.corner), np.float64)


def pixel_sides(mask: NDArray[np.bool_], transform: Affine, to_axes: ToAxes) -> Iterator[Floats]:
    """Yield the outline of a mask's pixels (y, x), some rows at a time: (side, begin and end, along and across).

    ``transform`` converts pixel corners to the map's x and y. Each part is closed, with its pixels to the right.
    """
    a, b, c, d, e, f = transform[:6]
    for top in range(0, mask.shape[0], ROWS_AT_ONCE):
        framed = np.pad(mask[top : top + ROWS_AT_ONCE], 1).astype(np.int8)
        across, down = np.diff(framed[1:-1], axis=1), np.diff(framed[:, 1:-1], axis=0)
        corners = np.concatenate(
            [
                _corners(across == 1, (1, 0), (0, 0)),  # up, with the mask on the right
                _corners(across == -1, (0, 0), (1, 0)),
                _corners(down == 1, (0, 0), (0, 1)),
                _corners(down == -1, (0, 1), (0, 0)),
            ]
        )
        row, column = corners[..., 0] + top, corners[..., 1]
        yield to_axes(a * column + b * row + c, d * column + e * row + f)


def _corners(sides: NDArray[np.bool_], begin: tuple[int, int], end: tuple[int, int]) -> Floats:
    """Return the corners (side, begin and end, row and column) of sides that are marked."""
    return np.asarray((np.argwhere(sides)[:, None, :] + np.array([begin, end])).astype(np.float64))


def covered_fractions(grid: CellGrid, mask: NDArray[np.bool_], transform: Affine, to_axes: ToAxes) -> Floats:
    """Return the fraction of each cell, (row, column), that the pixels of a mask (y, x) cover.

    Exact for pixels with straight sides. Each side of the outline, cut at the cells' borders, is a trapezoid to the far
    end of its row of cells. Their signed sum is the covered area (Green's theorem).
    """
    beside, beyond = np.zeros(grid.shape[0] * grid.shape[1]), np.zeros(grid.shape[0] * grid.shape[1])
    for sides in pixel_sides(mask, transform, to_axes):
        cut = _cut(_cut((sides - grid.corner) / grid.step, 0), 1)
        middle, rise = cut.mean(axis=1), cut[:, 1, 0] - cut[:, 0, 0]
        cell = np.clip(np.floor(middle).astype(np.intp), 0, np.array(grid.shape) - 1)
        number = cell[:, 0] * grid.shape[1] + cell[:, 1]
        np.add.at(beside, number, rise * (cell[:, 1] + 1 - middle[:, 1]))
        np.add.at(beyond, number, rise)
    whole = beyond.reshape(grid.shape)
    found = beside.reshape(grid.shape) + whole.cumsum(axis=1) - whole
    found *= np.sign(found.sum())  # axes may turn either way
    return np.where(found < LEAST_PART, 0.0, np.where(found > 1 - LEAST_PART, 1.0, found))


def _cut(sides: Floats, axis: int) -> Floats:
    """Cut sides (side, begin and end, 2) where they cross whole numbers along an axis."""
    low, high = sides[:, :, axis].min(axis=1), sides[:, :, axis].max(axis=1)
    first = np.floor(low)
    pieces = np.maximum(np.ceil(high) - first, 1).astype(np.intp)
    side = np.repeat(np.arange(len(sides)), pieces)
    order = np.arange(len(side)) - np.repeat(pieces.cumsum() - pieces, pieces)
    lines = np.stack([first[side] + order, first[side] + order + 1], axis=1).clip(low[side, None], high[side, None])
    begin, length = sides[side, 0], sides[side, 1] - sides[side, 0]
    along = length[:, axis, None]
    fraction = np.divide(lines - begin[:, axis, None], along, out=np.tile([0.0, 1.0], (len(side), 1)), where=along != 0)
    fraction.sort(axis=1)
    return np.asarray(begin[:, None, :] + fraction[..., None] * length[:, None, :])


def dose_cells(covered: Floats, treated: Sequence[tuple[Floats, float]], least_fraction: float) -> Floats:
    """Return the dose of each cell, (row, column): the greatest of the classes above ``least_fraction`` of it.

    ``covered`` is the fraction of each cell that the map covers, ``treated`` that of each class with its dose. A
    class's fraction is that of the covered part. 0 if no class has such a fraction, NaN where the map shows nothing.
    """
    result = np.zeros(covered.shape)
    for fraction, dose in treated:
        result = np.maximum(result, np.where(fraction > least_fraction * covered, dose, 0.0))
    return np.where(covered > 0, result, np.nan)


def cell_polygons(grid: CellGrid, heading: Heading, covered: Floats, field: NDArray[Any]) -> NDArray[Any]:
    """Return the covered part of each covered cell, row by row, as shapely's polygons in x and y of the map.

    ``field`` are the polygons that ``covered`` was computed from. A fully covered cell keeps its four corners.
    """
    row, column = np.nonzero(covered > 0)
    corners = grid.outlines(row, column)
    polygons: NDArray[Any] = shapely.polygons(heading.from_axes(corners[..., 0], corners[..., 1]))
    whole, partly = shapely.union_all(field), np.flatnonzero(covered[row, column] < 1)
    for cells in np.split(partly, np.flatnonzero(np.diff(row[partly])) + 1):  # of each row
        here = shapely.intersection(whole, shapely.convex_hull(shapely.multipolygons(polygons[cells])))
        cut = shapely.intersection(here, polygons[cells])
        polygons[cells] = shapely.buffer(cut, 0)  # without points and lines where outlines touch
    return polygons
