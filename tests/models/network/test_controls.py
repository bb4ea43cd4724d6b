"""The networks that the segmenter is compared with: what they read, count and may depend on."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from models.network.controls import build_network
from models.network.layers import code_1d
from models.network.sizes import PRESETS, Preset, SegmenterConfig
from tests.models.conftest import noise, scene_tensors

SMALL = {"classes": 3, "columns": 4, "patch": 8, "factor": 2, "width": 8, "dim": 16, "layers": 1, "heads": 2}


def _config(preset: Preset, **sizes: Any) -> SegmenterConfig:
    return SegmenterConfig(**{**SMALL, **sizes}, **PRESETS[preset])


def _network(preset: Preset, **sizes: Any) -> Any:
    return build_network(_config(preset, **sizes)).eval()


@pytest.mark.parametrize(("factor", "coarse"), [(4, 64), (2, 256)])
@pytest.mark.parametrize("seats", [100, 200, 300, 400, 500])
def test_tokens_are_counted_as_in_the_paper(factor: int, coarse: int, seats: int):
    """A scene of 1024 fine patches has 64 coarse tokens at a factor of 4, 256 at 2, and K more."""
    network = _network("paper", factor=factor, columns=1, patch=4)
    side = 32 // factor * 4
    with torch.inference_mode():
        tokens = network.tokens(noise(0, 1, 1, side, side), noise(0, 1, seats, 1, 4, 4), torch.arange(seats)[None])
    assert tokens.shape == (1, coarse + seats, 16)


def test_places_are_the_papers_numbers():
    """At a factor of 2 coarse patch 4 is number 21, and its last seat 25; the next patch is 26."""
    network = _network("paper", columns=1, dim=32)
    with torch.inference_mode():
        seats = torch.tensor([[5, 4, 1]])  # of a row of 6 coarse patches, 12 seats wide
        blank = torch.zeros(1, 1, 8, 48), torch.zeros(1, 3, 1, 8, 8)
        codes = network.tokens(*blank, seats)[0] - network.project.bias
    numbers = torch.tensor([1, 6, 11, 16, 21, 26, 13, 12, 3]).double()
    assert codes == pytest.approx(code_1d(numbers, 32), abs=1e-5)


def test_in_the_paper_everything_reads_everything():
    """A fine patch changes the map of every coarse patch, and a coarse patch what fine tokens say of the others."""
    network = _network("paper", layers=2)
    coarse, fine, seats = scene_tensors(network.config)
    few, chosen = fine[:, :1], seats[:, :1]
    with torch.inference_mode():
        before = network.token_logits(coarse, few, chosen)
        after = network.token_logits(coarse, few + 1, chosen)
        assert ((after - before).abs().amax(dim=1) > 1e-6).all()
        read = [network.encoder(network.tokens(image, few, chosen))[0][0, -1] for image in (coarse, coarse + 1)]
    assert (read[0] - read[1]).abs().max() > 1e-4


@pytest.mark.parametrize("preset", ["dense", "coarser"])
def test_a_dense_network_sees_nothing_of_the_coarse_image(preset: Preset):
    """The twin and the coarser grid have the fine image alone."""
    network = _network(preset)
    coarse, fine, seats = scene_tensors(network.config)
    with torch.inference_mode():
        drawn = network.draw(coarse, fine, seats)
        assert torch.equal(drawn, network.draw(coarse + 1, fine, seats))
        assert not torch.equal(drawn, network.draw(coarse, fine + 1, seats))
    assert drawn.shape == (1, 3, 32, 48)


def test_the_upsampled_network_sees_nothing_of_the_fine_image():
    """Its map follows from the coarse image, whatever the seats hold, and has as many tokens as the twin's."""
    network = _network("upsampled")
    coarse, fine, seats = scene_tensors(network.config)
    with torch.inference_mode():
        drawn = network.draw(coarse, fine, seats)
        assert torch.equal(drawn, network.draw(coarse, fine * float("nan"), seats[:, :0]))
        assert not torch.equal(drawn, network.draw(coarse + 1, fine, seats))


def test_the_coarser_network_sees_means():
    """Changes that leave the mean of each 2 x 2 px change nothing."""
    network = _network("coarser")
    coarse, fine, seats = scene_tensors(network.config)
    swapped = fine.unflatten(-1, (-1, 2)).flip(-1).flatten(-2)
    with torch.inference_mode():
        drawn, other = network.draw(coarse, fine, seats), network.draw(coarse, swapped, seats)
        assert (drawn - other).abs().max() < 1e-5
