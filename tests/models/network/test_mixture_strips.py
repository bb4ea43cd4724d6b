"""Features of a mixture's surroundings: in strips, regions and whole images they are the same."""

import numpy as np
import pytest
import scipy.ndimage
import torch

from spectralzoom.models.network.mixture import REACH, STRIP_ROWS, Mixture, window_means
from spectralzoom.models.network.sizes import AROUND, RELATIVE, VALUES, SegmenterConfig


@pytest.fixture(scope="module")
def mixture() -> Mixture:
    parts = ((VALUES, 0, 0.25), (RELATIVE, 0, 0.25), (AROUND, 4, 0.5))
    made = Mixture(SegmenterConfig(3, columns=2, parts=parts, components=(2, 3)))
    with torch.no_grad(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)
        for one in (made.own_axes, made.relative_axes):
            one.normal_()
    return made.eval()


def scene(rows: int, columns: int = 70) -> torch.Tensor:
    drawn = np.random.default_rng(2).normal(size=(1, 2, rows, columns)).cumsum(axis=2)
    return torch.from_numpy(drawn.astype(np.float32))


@pytest.mark.parametrize("side", [1, 5, 61])
def test_window_means_repeat_the_borders(side: int) -> None:
    image = scene(40)
    expected = scipy.ndimage.uniform_filter(image.numpy().astype(np.float64), (1, 1, side, side), mode="nearest")
    np.testing.assert_allclose(window_means(image, side).numpy(), expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("rows", [1, STRIP_ROWS, 2 * STRIP_ROWS + 9])
def test_strips_are_parts_of_the_whole_image(mixture: Mixture, rows: int) -> None:
    image = scene(rows)
    with torch.inference_mode():
        strips = list(mixture.strips(image, {VALUES, RELATIVE, AROUND}))
        for kind, whole in mixture.features(image, {VALUES, RELATIVE, AROUND}).items():
            torch.testing.assert_close(torch.cat([one[kind] for one in strips], dim=1), whole, rtol=1e-5, atol=1e-5)


def test_a_region_with_a_halo_is_a_part_of_the_map(mixture: Mixture) -> None:
    image, inside = scene(150, 130), np.s_[..., 40:80, 50:90]
    with torch.inference_mode():
        region = mixture(image[..., 40 - REACH : 80 + REACH, 50 - REACH : 90 + REACH])
        part = region[..., REACH:-REACH, REACH:-REACH]
        torch.testing.assert_close(part, mixture(image)[inside], rtol=1e-5, atol=1e-5)
