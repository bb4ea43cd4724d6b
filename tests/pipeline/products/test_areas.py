"""Areas and their errors: Olofsson's own example, draws by probability; cells of a prescription and their doses."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from affine import Affine
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import SettingsError, ShapeError
from pipeline.geometry.grid import UNLABELLED
from pipeline.products.areas import (
    BLOCK_PX,
    CellGrid,
    Heading,
    cell_polygons,
    count_classes,
    dose_cells,
    pixel_axes,
    probable_fractions,
    stratified_fractions,
)

# Olofsson et al. 2014, table 8: rows are mapped classes there, columns what the reference says
EXAMPLE = np.array([[66, 0, 5, 4], [0, 55, 8, 12], [1, 0, 153, 11], [2, 1, 9, 313]])
MAPPED = np.array([200_000, 150_000, 3_200_000, 6_450_000]) / 1e7
HECTARES_A_PIXEL = 0.09
TRANSFORM = Affine(0.5, 0.0, 400_000.0, 0.0, -0.5, 5_000_000.0)


def test_the_stratified_estimate_is_that_of_its_paper() -> None:
    """Deforestation: 21158 ha with a 95 % interval of 6158 ha, as printed there."""
    found = stratified_fractions(MAPPED, EXAMPLE.T)
    hectares = found.fractions * 1e7 * HECTARES_A_PIXEL
    errors = 1.96 * found.errors * 1e7 * HECTARES_A_PIXEL
    assert hectares[0] == pytest.approx(21_158, abs=1)
    assert errors[0] == pytest.approx(6_158, abs=2)
    assert hectares.sum() == pytest.approx(900_000)


def test_a_mapped_class_that_was_not_judged_says_nothing() -> None:
    """NaN instead of a number; one that is not mapped either takes nothing from the others. Sizes that differ raise."""
    counts = np.array([[5, 0, 0], [1, 0, 0], [0, 0, 0]])
    assert np.isnan(stratified_fractions([0.5, 0.5, 0.0], counts).fractions).all()
    np.testing.assert_allclose(stratified_fractions([1.0, 0.0, 0.0], counts).fractions, [5 / 6, 1 / 6, 0])
    with pytest.raises(ShapeError, match="2 classes and a confusion matrix"):
        stratified_fractions([0.5, 0.5], counts)


def test_errors_by_probability_are_those_of_draws() -> None:
    """The spread of shares over draws in which a block's pixels go the same way is the standard error that is told."""
    rng = np.random.default_rng(3)
    blocks = rng.uniform(0, 1, (4, 5))
    first = np.kron(blocks, np.ones((BLOCK_PX, BLOCK_PX)))
    probability = np.stack([first, 1 - first], axis=-1)
    probability[:3, :3] = np.nan
    found = probable_fractions([probability[:BLOCK_PX], probability[BLOCK_PX:]], 2)
    known = np.isfinite(first) & ~np.isnan(probability[..., 0])
    drawn = []
    for _ in range(4000):
        went = np.kron(rng.uniform(0, 1, blocks.shape) < blocks, np.ones((BLOCK_PX, BLOCK_PX)))
        drawn.append(went[known].mean())
    assert found.fractions[0] == pytest.approx(np.mean(drawn), abs=0.005)
    assert found.errors[0] == pytest.approx(np.std(drawn), rel=0.06)
    assert found.errors[0] == pytest.approx(found.errors[1])
    assert np.isnan(probable_fractions([], 2).fractions).all()


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


def test_doses_go_by_fraction() -> None:
    """The greatest dose of the classes above the fraction, 0 where none is, NaN where nothing is known."""
    counts = np.array([[[8, 2, 0], [9, 0, 1], [4, 3, 3], [0, 0, 0]]])
    found = dose_cells(counts, {1: 2.0, 2: 5.0}, 0.15)
    np.testing.assert_array_equal(found, [[2.0, 0.0, 5.0, np.nan]])
    np.testing.assert_array_equal(dose_cells(counts, {2: 5.0}, 0.0), [[0.0, 5.0, 5.0, np.nan]])


def test_too_many_cells_are_refused() -> None:
    """With how many there would be."""
    with pytest.raises(SettingsError, match=r"10001 x 10001, more than 4000000; use larger ones"):
        CellGrid.around([[0, 0], [1000, 1000]], (0.1, 0.1))
