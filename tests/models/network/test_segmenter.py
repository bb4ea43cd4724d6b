"""The two-scale segmenter: sizes, places, windows, composites and what its parts may depend on."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from torch import Tensor

from models.network.segmenter import Segmenter, SegmenterConfig
from models.weights.files import Weights
from pipeline.errors import ShapeError

Maker = Callable[..., Weights]


def _drawn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def _scene(model: Segmenter, rows: int = 2, columns: int = 3, batch: int = 1) -> tuple[Tensor, Tensor]:
    """Coarse image and every fine patch of a scene of ``rows`` x ``columns`` coarse patches."""
    p, j, s = model.config.patch, model.config.columns, model.config.factor
    coarse = _drawn(batch, j, rows * p, columns * p)
    return coarse, _drawn(batch, rows * columns * s * s, j, p, p, seed=1)


@pytest.mark.parametrize(
    ("sizes", "words"),
    [
        ({"classes": 1}, "2 to 255 classes, got 1"),
        ({"classes": 256}, "2 to 255 classes, got 256"),
        ({"patch": 24}, "power of two, got 24"),
        ({"patch": 8, "factor": 16}, "patch 8 must divide by the factor 16"),
        ({"factor": 0}, "factor of a segmenter must be at least 1 and at most 1024, got 0"),
        ({"dim": 18, "heads": 2}, "width 18 must divide by 4"),
        ({"dim": 16, "heads": 3}, "by its 3 heads"),
        ({"layers": 257}, "layers of a segmenter must be at least 1 and at most 256, got 257"),
        ({"heads": 2.0}, "heads of a segmenter must be a whole number, got 2.0"),
        ({"layers": -1}, "layers of a segmenter must be at least 1 and at most 256, got -1"),
    ],
)
def test_sizes_that_do_not_fit_are_refused(sizes: dict[str, Any], words: str):
    """A configuration says what is wrong before anything is built from it."""
    with pytest.raises(ShapeError, match=words):
        SegmenterConfig(**{"classes": 3, **sizes})


def test_a_configuration_is_kept_as_plain_values():
    """What a checkpoint keeps builds the same configuration again."""
    config = SegmenterConfig(classes=7, patch=32, positions="paper")
    assert SegmenterConfig(**config.as_dict()) == config


@torch.inference_mode()
@pytest.mark.parametrize(("patch", "factor"), [(8, 2), (16, 4), (4, 4)])
def test_windows_are_those_of_the_whole_canvas(tiny: Maker, patch: int, factor: int):
    """The features under a seat equal the window of the whole canvas brought up bilinearly, borders included."""
    model = tiny(patch=patch, factor=factor).segmenter
    rows, columns = 2 * factor, 3 * factor
    canvas = _drawn(2, model.config.coarse_width, 2 * patch, 3 * patch)
    whole = F.interpolate(model.under(canvas), scale_factor=factor, mode="bilinear", align_corners=False)
    seats = torch.randperm(rows * columns, generator=torch.Generator().manual_seed(3)).expand(2, -1)
    windows = model.canvas_windows(canvas, seats).view(2, -1, model.config.width, patch, patch)
    for place, seat in enumerate(seats[0].tolist()):
        y, x = seat // columns * patch, seat % columns * patch
        assert (windows[:, place] - whole[:, :, y : y + patch, x : x + patch]).abs().max() <= 1e-6


@torch.inference_mode()
def test_a_composite_holds_patches_where_seats_say(tiny: Maker):
    """Captured seats show their patch, all else the coarse logits brought up, each scene its own."""
    model = tiny().segmenter
    coarse, fine = _drawn(2, 3, 8, 16), _drawn(2, 3, 3, 8, 8, seed=1)
    seats = torch.tensor([[0, 5, 7], [6, 1, 2]])
    expected = F.interpolate(coarse, scale_factor=2, mode="bilinear", align_corners=False)
    for scene in range(2):
        for place, seat in enumerate(seats[scene].tolist()):
            y, x = seat // 4 * 8, seat % 4 * 8
            expected[scene, :, y : y + 8, x : x + 8] = fine[scene, place]
    assert (model.composite(coarse, fine, seats) == expected).all()


@torch.inference_mode()
@pytest.mark.parametrize(("positions", "seats", "tokens"), [("2d", 100, 356), ("paper", 200, 456), ("paper", 0, 256)])
def test_tokens_are_counted_as_in_the_paper(tiny: Maker, positions: str, seats: int, tokens: int):
    """A scene of 256 px with patches of 8 px and factor 2 has 256 coarse tokens, and one more a seat."""
    model = tiny(positions=positions, width=4, dim=8).segmenter
    read: list[int] = []
    model.encoder.register_forward_hook(lambda module, args, out: read.append(out[0].shape[1]))
    coarse, fine = torch.zeros(1, 4, 128, 128), torch.zeros(1, seats, 4, 8, 8)
    logits, patches = model(coarse, fine, torch.arange(seats)[None])
    assert sum(read) == tokens
    assert logits.shape == (1, 3, 128, 128)
    assert patches.shape == (1, seats, 3, 8, 8)


@torch.inference_mode()
@pytest.mark.parametrize(("positions", "patch"), [("2d", 8), ("paper", 8), ("2d", 32)])
def test_every_place_has_a_token_of_its_own(tiny: Maker, positions: str, patch: int):
    """Equal pixels become tokens that differ by place: between patches, between seats, between scales."""
    model = tiny(positions=positions, patch=patch, factor=2).segmenter
    count = model.config.token_side**2
    cells = torch.cartesian_prod(torch.arange(2), torch.arange(2))[None]
    places = torch.cartesian_prod(torch.arange(4), torch.arange(4))[None]
    coarse = model._coded(torch.zeros(1, 4, count, 16), cells, 2, None, fine=False)
    fine = model._coded(torch.zeros(1, 16, count, 16), places, 2, None, fine=True)
    assert len(torch.cat([fine, coarse], dim=1)[0].unique(dim=0)) == 20 * count


@torch.inference_mode()
def test_crops_move_in_the_plane_and_not_in_the_papers_row(tiny: Maker):
    """An offset of the places changes what two-dimensional codes give, and nothing for the paper's numbers."""
    coarse, fine = _scene(tiny().segmenter, 1, 2)
    seats, origin = torch.arange(8)[None], torch.tensor([[37, 11]])
    for positions, moves in (("2d", True), ("paper", False)):
        model = tiny(positions=positions).segmenter
        still, moved = model(coarse, fine, seats), model(coarse, fine, seats, origin)
        assert all(bool((a != b).any()) == moves for a, b in zip(still, moved, strict=True))


@torch.inference_mode()
def test_fine_patches_change_nothing_of_the_glance(tiny: Maker):
    """What the coarse pass says stands, bit by bit, however many places are looked at again."""
    model = tiny().segmenter
    coarse, fine = _scene(model)
    alone, _ = model(coarse, fine[:, :0], torch.zeros(1, 0, dtype=torch.int64))
    joint, _ = model(coarse, fine[:, :5], torch.arange(5)[None])
    assert (alone == joint).all()


@torch.inference_mode()
def test_fine_patches_read_the_glance_and_each_other(tiny: Maker):
    """A patch is read otherwise beside another patch, and above another coarse pass."""
    model = tiny().segmenter
    coarse, fine = _scene(model)
    _, alone = model(coarse, fine[:, :1], torch.tensor([[0]]))
    _, beside = model(coarse, fine[:, :2], torch.tensor([[0, 1]]))
    _, above = model(coarse.flip(2), fine[:, :1], torch.tensor([[0]]))
    assert (alone - beside[:, :1]).abs().max() > 1e-4
    assert (alone - above).abs().max() > 1e-4


def test_every_parameter_learns(tiny: Maker):
    """The loss of a map with some seats, and of their scores, has a gradient in every parameter."""
    model = tiny(layers=2).segmenter
    coarse, fine = _scene(model)
    seats = torch.tensor([[3, 0, 9]])
    logits, patches = model(coarse, fine[:, seats[0]], seats)
    gain = model.score(model.read_coarse(coarse))
    (model.composite(logits, patches, seats).square().mean() + gain.square().mean()).backward()
    idle = [name for name, value in model.named_parameters() if value.grad is None or not value.grad.any()]
    assert not idle


@torch.inference_mode()
def test_a_factor_of_one_looks_twice_at_one_size(tiny: Maker):
    """With factor 1 coarse and fine patches have the same ground, and the map the size of the coarse image."""
    model = tiny(factor=1).segmenter
    coarse, fine = _scene(model)
    logits, patches = model(coarse, fine, torch.arange(6)[None])
    assert model.composite(logits, patches, torch.arange(6)[None]).shape == (1, 3, 16, 24)


def test_equal_seeds_build_equal_segmenters(tiny: Maker):
    """The weights at the start follow from the seed and the sizes alone."""
    first, second, other = (tiny(seed).segmenter.state_dict() for seed in (4, 4, 5))
    assert all((first[name] == second[name]).all() for name in first)
    assert any((first[name] != other[name]).any() for name in first)
