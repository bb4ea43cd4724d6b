"""Cells of a prescription: every pixel in one cell, axes that turn back, doses by share."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from affine import Affine
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import SettingsError
from pipeline.geometry.grid import UNLABELLED
from pipeline.products.prescriptions import CellGrid, Heading, cell_polygons, count_classes, dose_cells, pixel_axes

TRANSFORM = Affine(0.5, 0.0, 400_000.0, 0.0, -0.5, 5_000_000.0)


@given(st.floats(0, 360), st.integers(0, 9), st.floats(0.4, 7))
def test_every_pixel_lies_in_the_cell_that_contains_it(degrees: float, seed: int, side: float) -> None:
    """Counts are those of pixel centres within the cells' polygons, whatever the heading, and none is lost."""
    classes = np.random.default_rng(seed).choice([0, 1, 255], (7, 9)).astype(np.uint8)
    heading = Heading(degrees)
    points = pixel_axes(TRANSFORM, slice(0, 7), 9, heading.to_axes)
    grid = CellGrid.around(points, (side, 2 * side))
    counts = count_classes(grid, classes, TRANSFORM, heading.to_axes, 2)
    assert counts.sum() == (classes != UNLABELLED).sum()
    x, y = TRANSFORM * np.meshgrid(np.arange(9) + 0.5, np.arange(7) + 0.5)
    cells = cell_polygons(grid, heading)
    for number in range(2):
        centres = shapely.points(x[classes == number], y[classes == number])
        near = [int(shapely.dwithin(cell, centres, 1e-6).sum()) for cell in cells.ravel()]
        deep = [int(shapely.contains(shapely.buffer(cell, -1e-6), centres).sum()) for cell in cells.ravel()]
        own = counts[..., number].ravel()
        assert (deep <= own).all()  # a centre on a border lies in one of its cells
        assert (own <= near).all()


@given(st.floats(-720, 720))
def test_axes_turn_back(degrees: float) -> None:
    """Along a heading of 90 is east, of 0 north; from axes undoes to axes."""
    heading = Heading(degrees)
    x, y = np.array([3.0, -2.0]), np.array([1.0, 8.0])
    axes = heading.to_axes(x, y)
    np.testing.assert_allclose(heading.from_axes(axes[:, 0], axes[:, 1]), np.stack([x, y], axis=-1), atol=1e-9)
    np.testing.assert_allclose(Heading(90).to_axes(x, y), np.stack([x, -y], axis=-1), atol=1e-9)


def test_doses_go_by_share() -> None:
    """The greatest dose of the classes above the share, 0 where none is, NaN where nothing is known."""
    counts = np.array([[[8, 2, 0], [9, 0, 1], [4, 3, 3], [0, 0, 0]]])
    found = dose_cells(counts, {1: 2.0, 2: 5.0}, 0.15)
    np.testing.assert_array_equal(found, [[2.0, 0.0, 5.0, np.nan]])
    np.testing.assert_array_equal(dose_cells(counts, {2: 5.0}, 0.0), [[0.0, 5.0, 5.0, np.nan]])


def test_too_many_cells_are_refused() -> None:
    """With how many there would be."""
    with pytest.raises(SettingsError, match=r"10001 x 10001, more than 4000000; use larger ones"):
        CellGrid.around([[0, 0], [1000, 1000]], (0.1, 0.1))
