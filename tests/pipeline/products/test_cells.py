"""Cells of a prescription: exact covered parts at any heading and size, their outlines, and doses by fraction."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from affine import Affine
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipeline.errors import SettingsError
from pipeline.products.cells import CellGrid, Heading, cell_polygons, covered_fractions, dose_cells, pixel_sides

TRANSFORM = Affine(0.5, 0.0, 400_000.0, 0.0, -0.5, 5_000_000.0)
PIXEL_M2 = 0.25


def grid_over(mask: NDArray[np.bool_], heading: Heading, step: tuple[float, float]) -> CellGrid:
    """Cells over all of a mask."""
    places = np.concatenate([part.reshape(-1, 2) for part in pixel_sides(mask, TRANSFORM, heading.to_axes)])
    return CellGrid.around(places.min(axis=0), places.max(axis=0), step)


def pixel_boxes(mask: NDArray[np.bool_]) -> NDArray[np.object_]:
    """A mask's pixels as polygons of the map."""
    row, column = np.nonzero(mask)
    x, y = TRANSFORM.c + 0.5 * column, TRANSFORM.f - 0.5 * row
    return np.asarray(shapely.box(x, y - 0.5, x + 0.5, y), object)


@given(st.floats(0, 360), st.integers(0, 9), st.floats(0.1, 7))
def test_cells_are_covered_as_far_as_pixels_reach(degrees: float, seed: int, side: float) -> None:
    """The part of each cell is that of its polygon within the pixels, whatever the heading, finer or coarser."""
    mask = np.random.default_rng(seed).random((5, 6)) < 0.6
    mask[2, 3] = True
    heading = Heading(degrees)
    grid = grid_over(mask, heading, (side, 2 * side))
    covered = covered_fractions(grid, mask, TRANSFORM, heading.to_axes)
    whole = cell_polygons(grid, heading, np.ones(grid.shape), pixel_boxes(mask))
    wanted = shapely.area(shapely.intersection(whole, shapely.union_all(pixel_boxes(mask)))).reshape(grid.shape) / (
        2 * side**2
    )
    np.testing.assert_allclose(covered, wanted, atol=3e-6)
    assert covered.sum() * 2 * side**2 == pytest.approx(mask.sum() * PIXEL_M2, rel=1e-3)


def test_cells_upon_pixels_are_these() -> None:
    """Each is covered in full or not at all; a cell of 2 x 2 pixels has the quarters that the mask has."""
    mask = np.random.default_rng(1).random((8, 6)) < 0.5
    mask[[0, -1]] = True
    same = covered_fractions(grid_over(mask, Heading(), (0.5, 0.5)), mask, TRANSFORM, Heading().to_axes)
    np.testing.assert_array_equal(same[::-1], mask)
    double = covered_fractions(grid_over(mask, Heading(), (1.0, 1.0)), mask, TRANSFORM, Heading().to_axes)
    np.testing.assert_allclose(double[::-1], mask.reshape(4, 2, 3, 2).mean(axis=(1, 3)), atol=1e-9)


@given(st.floats(0, 90), st.floats(0.2, 5))
def test_outlines_are_the_field_once(degrees: float, side: float) -> None:
    """The polygons of the covered cells have its area and no overlap; a cell within it keeps its four corners."""
    mask = np.ones((9, 11), bool)
    mask[:3, :4] = mask[7, 8] = False
    heading, field = Heading(degrees), pixel_boxes(mask)
    grid = grid_over(mask, heading, (side, side))
    covered = covered_fractions(grid, mask, TRANSFORM, heading.to_axes)
    found = cell_polygons(grid, heading, covered, field)
    assert set(shapely.get_type_id(found)) <= {3, 6}
    assert shapely.area(found).sum() == pytest.approx(mask.sum() * PIXEL_M2, rel=1e-3)
    assert shapely.area(shapely.union_all(found)) == pytest.approx(mask.sum() * PIXEL_M2, rel=1e-3)
    np.testing.assert_allclose(shapely.area(found), covered[covered > 0] * side**2, atol=1e-4)
    assert (shapely.get_num_coordinates(found[covered[covered > 0] == 1]) == 5).all()


@given(st.floats(-720, 720))
def test_axes_turn_back(degrees: float) -> None:
    """Along a heading of 90 is east, of 0 north; from axes undoes to axes."""
    heading = Heading(degrees)
    x, y = np.array([3.0, -2.0]), np.array([1.0, 8.0])
    axes = heading.to_axes(x, y)
    np.testing.assert_allclose(heading.from_axes(axes[:, 0], axes[:, 1]), np.stack([x, y], axis=-1), atol=1e-9)
    np.testing.assert_allclose(Heading(90).to_axes(x, y), np.stack([x, -y], axis=-1), atol=1e-9)


def test_doses_go_by_fraction() -> None:
    """The greatest dose of the classes above the fraction of what is covered, 0 where none is, NaN of nothing."""
    covered = np.array([[1.0, 1.0, 0.5, 0.0]])
    one, two = np.array([[0.2, 0.0, 0.15, 0.0]]), np.array([[0.0, 0.1, 0.15, 0.0]])
    found = dose_cells(covered, [(one, 2.0), (two, 5.0)], 0.15)
    np.testing.assert_array_equal(found, [[2.0, 0.0, 5.0, np.nan]])
    np.testing.assert_array_equal(dose_cells(covered, [(two, 5.0)], 0.0), [[0.0, 5.0, 5.0, np.nan]])


def test_too_many_cells_are_refused() -> None:
    """With how many there would be."""
    with pytest.raises(SettingsError, match=r"10000 x 10000, more than 4000000; use larger ones"):
        CellGrid.around(np.zeros(2), np.full(2, 1000.0), (0.1, 0.1))
