"""Kernels fitted to other bands and patch sizes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F  # noqa: N812 - its usual name

from models.network.spectral import SpectralBasis
from models.training.pretrained import map_rgb_kernel, resize_patch_kernel, rgb_response


def drawn(seed: int, *shape: int) -> torch.Tensor:
    """Seeded normal numbers."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def test_colours_look_at_their_wavelengths():
    """Each colour weighs most the column nearest to it, and the weights of a colour sum to 1."""
    response = rgb_response(SpectralBasis(400.0, 1000.0, 25))  # a column every 25 nm
    assert response.argmax(axis=1).tolist() == [10, 6, 2]
    assert response.sum(axis=1) == pytest.approx([1, 1, 1])


@pytest.mark.parametrize(("low", "high", "columns"), [(660.0, 800.0, 2), (900.0, 2500.0, 24), (700.0, 700.0, 1)])
def test_colours_outside_the_data_take_the_nearest_end(low: float, high: float, columns: int):
    """Every colour is seen in something, whatever the wavelengths."""
    response = rgb_response(SpectralBasis(low, high, columns))
    assert np.isfinite(response).all()
    assert response.argmax(axis=1).tolist() == [0, 0, 0]
    assert response.sum(axis=1) == pytest.approx([1, 1, 1])


def test_a_mapped_kernel_sees_what_the_old_one_saw_of_the_mixed_colours():
    """Mixing columns to colours first and mapping the kernel are the same; grey stays grey."""
    response = rgb_response(SpectralBasis(400.0, 1000.0, 12))
    kernel, columns = drawn(0, 5, 3, 3, 3), drawn(1, 1, 12, 9, 9)
    mapped = map_rgb_kernel(kernel, response)
    colours = torch.einsum("bjyx,cj->bcyx", columns, torch.from_numpy(response))
    torch.testing.assert_close(F.conv2d(columns, mapped), F.conv2d(colours, kernel), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(mapped.sum(dim=1), kernel.sum(dim=1), rtol=1e-4, atol=1e-5)


def test_a_larger_patch_kernel_answers_enlarged_patches_alike():
    """The pseudo-inverse of bilinear enlarging: the answer to the enlarged patch is the old one."""
    kernel, patch = drawn(2, 6, 3, 8, 8), drawn(3, 1, 3, 8, 8)
    larger = F.interpolate(patch, size=(16, 16), mode="bilinear", align_corners=False)
    answer = F.conv2d(larger, resize_patch_kernel(kernel, (16, 16)))
    torch.testing.assert_close(answer, F.conv2d(patch, kernel), rtol=1e-3, atol=1e-3)
    assert resize_patch_kernel(kernel, (4, 4)).shape == (6, 3, 4, 4)
