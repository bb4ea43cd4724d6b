"""The networks that the segmenter is compared with: what they read, count and may depend on."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from models.network.controls import DenseNetwork, build_network
from models.network.layers import code_1d, cut, joined
from models.network.segmenter import Segmenter
from models.network.sizes import PRESETS, Preset, SegmenterConfig
from pipeline.errors import ShapeError
from tests.models.conftest import noise, scene_tensors

SMALL = {"classes": 3, "columns": 4, "patch": 8, "factor": 2, "width": 8, "dim": 16, "layers": 1, "heads": 2}


def _config(preset: Preset, **sizes: Any) -> SegmenterConfig:
    return SegmenterConfig(**{**SMALL, **sizes}, **PRESETS[preset])


def _network(preset: Preset, **sizes: Any) -> Any:
    return build_network(_config(preset, **sizes)).eval()


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_comes_back_from_its_config(preset: Preset):
    """A kept configuration builds the same kind of network again and knows its name."""
    config = _config(preset)
    again = SegmenterConfig(**config.as_dict())  # type: ignore[arg-type]
    assert again == config
    assert again.preset == preset
    assert isinstance(build_network(config), Segmenter) == (preset == "two-scale")


def test_configurations_of_old_are_two_scale():
    """A file that names no design holds the two-scale network, and new files of it are written as before."""
    kept = SegmenterConfig(**SMALL).as_dict()
    assert not {"design", "sight"} & set(kept)
    assert SegmenterConfig(**kept).design == "two-scale"  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("sizes", "words"),
    [
        ({"design": "sparse"}, "design of a segmenter is one of two-scale, dense, paper, got 'sparse'"),
        ({"sight": "coarse"}, "only a dense network may read the coarse image, this one is two-scale"),
        ({"design": "paper"}, "a paper network cannot have 2d positions"),
        ({"design": "dense", "positions": "paper"}, "a dense network cannot have paper positions"),
        ({"design": "dense", "sight": "halved", "factor": 1}, "coarser by 2 needs an even factor, got 1"),
    ],
)
def test_designs_that_cannot_be_are_refused(sizes: dict[str, Any], words: str):
    """What does not go together is said before anything is built."""
    with pytest.raises(ShapeError, match=words):
        SegmenterConfig(**{**SMALL, **sizes})


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


def test_the_papers_map_has_no_detail_of_its_own():
    """The logits of a scene are those of the coarse tokens brought up: no seat is seen in it but through them."""
    network = _network("paper")
    coarse, fine, seats = scene_tensors(network.config)
    with torch.inference_mode():
        drawn, tokens = network.draw(coarse, fine, seats), network.token_logits(coarse, fine, seats)
    assert drawn.shape == (1, 3, 32, 48)
    for y, x in ((slice(8), 0), (slice(-8, None), -1)):  # the outer half of a corner's token has one value
        corner, token = drawn[..., y, y], tokens[..., x, x, None, None]
        assert (corner - token).abs().max() < 1e-6


def test_patches_join_to_the_image_they_were_cut_from():
    """Cutting and joining undo each other."""
    image = noise(0, 2, 3, 16, 24)
    assert torch.equal(joined(cut(image, 8), 3), image)


@pytest.mark.parametrize("preset", ["dense", "coarser"])
def test_a_dense_network_asks_for_all_seats(preset: Preset):
    """With a seat missing, or out of order, it is refused and says how many there are."""
    network = _network(preset)
    coarse, fine, seats = scene_tensors(network.config)
    for kept in (seats[:, :-1], seats.flip(1)):
        with pytest.raises(ShapeError, match="reads all 24 seats in order"):
            network.draw(coarse, fine[:, : kept.shape[1]], kept)


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


@pytest.mark.parametrize("preset", ["dense", "coarser", "upsampled"])
def test_dense_networks_know_places(preset: Preset):
    """The same pixels elsewhere in a larger field are read with other codes."""
    network = _network(preset)
    coarse, fine, seats = scene_tensors(network.config)
    with torch.inference_mode():
        here, there = (network.draw(coarse, fine, seats, torch.tensor([at])) for at in ((0, 0), (7, 3)))
    assert (here - there).abs().max() > 1e-4


def test_the_twin_has_the_fine_sides_parts():
    """Stem, encoder, head and last layers have just the weights that they have in the segmenter."""
    two, twin = (build_network(_config(preset, patch=32, layers=2)) for preset in ("two-scale", "dense"))
    assert isinstance(two, Segmenter)
    assert isinstance(twin, DenseNetwork)
    pairs = (
        (two.fine_stem, twin.stem),
        (two.encoder, twin.encoder),
        (two.fine_head, twin.head),
        (two.fine_mix, twin.mix),
        (two.fine_classes, twin.classes),
    )
    sizes = [[{name: value.shape for name, value in part.state_dict().items()} for part in pair] for pair in pairs]
    assert all(ours == theirs for ours, theirs in sizes)


def test_batches_of_scenes_are_read_apart():
    """A scene beside another gives the map it gives alone."""
    for preset in ("dense", "coarser", "upsampled", "paper"):
        network = build_network(_config(preset)).eval()
        assert not isinstance(network, Segmenter)
        coarse, fine, seats = scene_tensors(network.config)
        with torch.inference_mode():
            both = network.draw(
                torch.cat([coarse, coarse + 1]), torch.cat([fine, fine - 1]), seats.expand(2, -1), torch.zeros(2, 2)
            )
            alone = network.draw(coarse + 1, fine - 1, seats, torch.zeros(1, 2))
        assert (both[1:] - alone).abs().max() < 1e-5
