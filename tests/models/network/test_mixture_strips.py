"""Features of a mixture's surroundings: in strips, regions and whole images they are the same."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from spectralzoom.models.network.mixture import STRIP_ROWS, Mixture
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


@pytest.mark.parametrize("rows", [1, STRIP_ROWS, 2 * STRIP_ROWS + 9])
def test_strips_are_parts_of_the_whole_image(mixture: Mixture, rows: int) -> None:
    image = scene(rows)
    with torch.inference_mode():
        strips = list(mixture.strips(image, {VALUES, RELATIVE, AROUND}))
        for kind, whole in mixture.features(image, {VALUES, RELATIVE, AROUND}).items():
            torch.testing.assert_close(torch.cat([one[kind] for one in strips], dim=1), whole, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("context", [False, True])
def test_a_region_with_a_halo_is_a_part_of_the_map(mixture: Mixture, context: bool) -> None:
    own = Mixture(replace(mixture.config, context=context)).eval()
    own.load_state_dict(mixture.state_dict(), strict=False)
    halo, image = own.config.halo_px, scene(200, 180)
    with torch.inference_mode():
        region = own(image[..., 70 - halo : 110 + halo, 80 - halo : 100 + halo])
        part = region[..., halo:-halo, halo:-halo]
        torch.testing.assert_close(part, own(image)[..., 70:110, 80:100], rtol=1e-4, atol=1e-4)


def test_features_of_pixels_are_those_of_the_image(mixture: Mixture) -> None:
    image = scene(2 * STRIP_ROWS + 9)
    places = torch.tensor([0, 69, 70 * STRIP_ROWS - 1, 70 * STRIP_ROWS, 70 * (2 * STRIP_ROWS + 8)])
    with torch.inference_mode():
        for kind, own in mixture.of_pixels(image, {VALUES, AROUND}, places).items():
            every = mixture.features(image, {kind})[kind].flatten(0, 2)
            torch.testing.assert_close(own, every[places], rtol=1e-5, atol=1e-5)
