"""The scene grid: padding, patches, valid fractions, reflection and block means."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.pipeline.errors import ShapeError
from spectralzoom.pipeline.geometry.grid import SceneGrid, pad_by_reflection

sizes = st.integers(1, 200)


@given(sizes, sizes, st.integers(1, 40))
def test_padded_grid_is_the_smallest_whole_number_of_patches(height: int, width: int, patch: int):
    """The padded size is a multiple of the patch and less than one patch larger than the scene."""
    for size, scene in zip(SceneGrid(height, width, patch).padded_shape, (height, width), strict=True):
        assert size % patch == 0
        assert 0 <= size - scene < patch


@given(sizes, sizes, st.integers(1, 40))
def test_valid_fractions_add_up_to_the_scene(height: int, width: int, patch: int):
    """Valid fractions times the patch area sum to the scene's area. Valid patches have a fraction above 0."""
    grid = SceneGrid(height, width, patch)
    fraction = grid.valid_fraction()
    assert fraction.sum() * patch**2 == pytest.approx(height * width)
    assert len(grid.every_patch()) == -(-height // patch) * -(-width // patch) == np.count_nonzero(fraction)


def test_patches_are_numbered_by_rows():
    """Patch 5 of a grid 4 patches wide starts in the second row and column."""
    grid = SceneGrid(64, 64, 16)
    assert grid.patch_shape == (4, 4)
    assert grid.patch_origin(np.array([0, 5, 15])).tolist() == [[0, 0], [16, 16], [48, 48]]


@pytest.mark.parametrize("field", ["height", "width", "patch"])
def test_sizes_below_one_are_refused(field: str):
    """The message names the size and its value."""
    with pytest.raises(ShapeError, match=f"{field} .* at least 1, got 0"):
        SceneGrid(**{"height": 4, "width": 4, "patch": 2, field: 0})


@given(st.integers(2, 9), st.integers(0, 40))
def test_reflection_padding_repeats_periodically(size: int, more: int):
    """Pixel i of the padded image is the one that reflection at either edge gives, for any padding."""
    grown = pad_by_reflection(np.arange(size)[:, None], (size + more, 1))[:, 0]
    place = np.arange(size + more) % (2 * size - 2)
    assert grown.tolist() == np.where(place < size, place, 2 * size - 2 - place).tolist()
