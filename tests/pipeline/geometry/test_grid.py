"""The scene grid: padding, patches, valid shares and reflection."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import ShapeError
from pipeline.geometry.grid import SceneGrid, pad_by_reflection

sizes = st.integers(1, 200)


@given(sizes, sizes, st.integers(1, 40), st.integers(1, 8))
def test_padded_grid_is_the_least_whole_number_of_coarse_patches(height: int, width: int, patch: int, factor: int):
    """The padded size divides by patch * factor and is less than one such cell larger than the scene."""
    padded = SceneGrid(height, width, patch, factor).padded_shape
    for size, scene in zip(padded, (height, width), strict=True):
        assert size % (patch * factor) == 0
        assert 0 <= size - scene < patch * factor


@given(sizes, sizes, st.integers(1, 40), st.integers(1, 8))
def test_valid_fractions_add_up_to_the_scene(height: int, width: int, patch: int, factor: int):
    """Shares times a patch's area sum to the scene's area, and valid patches are those with a fraction."""
    grid = SceneGrid(height, width, patch, factor)
    fraction = grid.valid_fraction()
    assert fraction.sum() * patch**2 == pytest.approx(height * width)
    assert len(grid.valid_patches()) == -(-height // patch) * -(-width // patch) == np.count_nonzero(fraction)


def test_patches_are_numbered_row_by_row():
    """Patch 5 of a grid 4 patches wide starts in the second row and column."""
    grid = SceneGrid(64, 64, 16, 2)
    assert grid.patch_shape == (4, 4)
    assert grid.patch_origin(np.array([0, 5, 15])).tolist() == [[0, 0], [16, 16], [48, 48]]


@pytest.mark.parametrize("field", ["height", "width", "patch", "factor"])
def test_sizes_below_one_are_refused(field: str):
    """The message names the size and what came."""
    sizes = {"height": 4, "width": 4, "patch": 2, "factor": 2, field: 0}
    with pytest.raises(ShapeError, match=f"{field} .* at least 1, got 0"):
        SceneGrid(**sizes)


@given(st.integers(2, 9), st.integers(0, 40))
def test_reflection_repeats_with_its_period(size: int, more: int):
    """Pixel i of the grown image is the one that a mirror at either edge shows, however far it grows."""
    grown = pad_by_reflection(np.arange(size)[:, None], (size + more, 1))[:, 0]
    place = np.arange(size + more) % (2 * size - 2)
    assert grown.tolist() == np.where(place < size, place, 2 * size - 2 - place).tolist()
