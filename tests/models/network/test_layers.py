"""Parts of the networks: the transformer, images down their levels and back up, and images as patches."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from models.network.segmenter import Head, Stem, cut, joined
from models.network.sizes import level_widths


@torch.inference_mode()
@pytest.mark.parametrize("patch", [4, 8, 32, 64])
def test_an_image_comes_back_at_its_size(patch: int):
    """Features of every level, finest first, down to 4 px, and the width per pixel again."""
    widths = level_widths(8, patch)
    assert widths[:3] == [8, 16, 24][: len(widths)]
    features = Stem(5, widths)(torch.zeros(3, 5, patch, 2 * patch))
    assert [tuple(level.shape) for level in features] == [
        (3, width, patch >> i, 2 * patch >> i) for i, width in enumerate(widths)
    ]
    assert features[-1].shape[2] == 4
    assert Head(widths)(features).shape == (3, 8, patch, 2 * patch)


@given(st.integers(1, 3), st.integers(1, 4), st.sampled_from([1, 4]))
def test_patches_lie_row_by_row_and_make_the_image_again(rows: int, columns: int, patch: int):
    """Cut and joined an image is what it was; the second patch lies right of the first."""
    image = torch.arange(2 * 3 * rows * columns * patch**2).view(2, 3, rows * patch, columns * patch)
    cells = cut(image, patch)
    assert torch.equal(joined(cells, columns), image)
    if columns > 1:
        assert torch.equal(cells[:, 1], image[:, :, :patch, patch : 2 * patch])
