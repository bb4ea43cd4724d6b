"""The two-scale segmenter: sizes, places, windows, composites, what parts may depend on, and its scorer of seats."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F  # noqa: N812 - its usual name

from models.network.layers import code_2d
from models.network.segmenter import SeatScorer
from models.network.sizes import SegmenterConfig
from models.policies.policies import score_seats
from models.reading.inference import glance
from models.training.objective import scoring_loss
from pipeline.errors import ShapeError
from pipeline.geometry.grid import SceneGrid
from tests.models.conftest import Maker, noise, scene_tensors


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


@torch.inference_mode()
@pytest.mark.parametrize(("patch", "factor"), [(8, 2), (16, 4), (4, 4)])
def test_windows_are_those_of_the_whole_canvas(tiny: Maker, patch: int, factor: int):
    """The features under a seat equal the window of the whole canvas brought up bilinearly, borders included."""
    model = tiny(patch=patch, factor=factor).segmenter
    rows, columns = 2 * factor, 3 * factor
    canvas = noise(0, 2, model.config.coarse_width, 2 * patch, 3 * patch)
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
    coarse, fine = noise(0, 2, 3, 8, 16), noise(1, 2, 3, 3, 8, 8)
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
def test_fine_patches_change_nothing_of_the_glance(tiny: Maker):
    """What the coarse pass says stands, bit by bit, however many places are looked at again."""
    model = tiny().segmenter
    coarse, fine, _ = scene_tensors(model.config)
    alone, _ = model(coarse, fine[:, :0], torch.zeros(1, 0, dtype=torch.int64))
    joint, _ = model(coarse, fine[:, :5], torch.arange(5)[None])
    assert (alone == joint).all()


@torch.inference_mode()
def test_fine_patches_read_the_glance_and_each_other(tiny: Maker):
    """A patch is read otherwise beside another patch, and above another coarse pass."""
    model = tiny().segmenter
    coarse, fine, _ = scene_tensors(model.config)
    _, alone = model(coarse, fine[:, :1], torch.tensor([[0]]))
    _, beside = model(coarse, fine[:, :2], torch.tensor([[0, 1]]))
    _, above = model(coarse.flip(2), fine[:, :1], torch.tensor([[0]]))
    assert (alone - beside[:, :1]).abs().max() > 1e-4
    assert (alone - above).abs().max() > 1e-4


def test_every_parameter_learns(tiny: Maker):
    """The loss of a map with some seats, and of their scores, has a gradient in every parameter."""
    model = tiny(layers=2).segmenter
    coarse, fine, _ = scene_tensors(model.config)
    seats = torch.tensor([[3, 0, 9]])
    logits, patches = model(coarse, fine[:, seats[0]], seats)
    gain = model.score(model.read_coarse(coarse))
    (model.composite(logits, patches, seats).square().mean() + gain.square().mean()).backward()
    idle = [name for name, value in model.named_parameters() if value.grad is None or not value.grad.any()]
    assert not idle


CONFIG = SegmenterConfig(classes=3, columns=2, patch=8, factor=2, width=8, coarse_width=6, dim=16, layers=1, heads=2)


def _seen(rows: int = 16, columns: int = 24) -> tuple[torch.Tensor, torch.Tensor]:
    stream = torch.Generator().manual_seed(2)
    return torch.randn(2, 6, rows, columns, generator=stream), torch.randn(2, 3, rows, columns, generator=stream)


def _scorer() -> SeatScorer:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        scorer = SeatScorer(CONFIG)
        torch.nn.init.normal_(scorer.leave.weight, std=0.3)
    return scorer


def test_before_training_scores_are_a_share_of_the_entropy():
    """A scorer begins as the entropy policy: no gain where the glance is sure, the most where it is not at all."""
    canvas, logits = _seen()
    logits[:] = 0.0
    logits[:, 0, :, :4] = 60.0
    score = SeatScorer(CONFIG)(canvas, logits)
    assert score.shape == (2, 4, 6)
    assert torch.allclose(score[:, :, 0], torch.zeros(2, 4), atol=1e-6)
    assert torch.allclose(score[:, :, 1:], torch.full((2, 4, 5), 0.2 * np.log(3)), atol=1e-6)


def test_a_constant_scene_has_one_score():
    """Seats at the border of a scene without any feature score as those within (numerics, row 22)."""
    canvas = torch.randn(1, 6, 1, 1, generator=torch.Generator().manual_seed(1)).expand(1, 6, 16, 24)
    with torch.inference_mode():
        score = _scorer()(canvas, canvas[:, :3])
    assert (score.max() - score.min()) <= 1e-6


def test_the_segmenter_learns_nothing_through_its_scorer():
    """No gradient goes back into features or logits."""
    canvas, logits = (seen.requires_grad_() for seen in _seen())
    _scorer()(canvas, logits).sum().backward()
    assert canvas.grad is None
    assert logits.grad is None


def test_a_scorer_learns_gains():
    """Gains that follow one feature are told after 300 steps, to a tenth of their spread."""
    scorer, stream = _scorer(), torch.Generator().manual_seed(4)
    optimiser = torch.optim.Adam(scorer.parameters(), 1e-2)
    for _ in range(300):
        canvas = torch.randn(4, 6, 16, 16, generator=stream)
        gain = torch.nn.functional.avg_pool2d(canvas[:, :1], 4).flatten(1)
        loss = scoring_loss(scorer(canvas, canvas[:, :3]).flatten(1), gain)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    told = scorer(canvas, canvas[:, :3]).flatten(1).detach()
    assert np.corrcoef(told.flatten(), gain.flatten())[0, 1] > 0.9


def test_scores_in_order_cost_less_than_scores_of_equal_error_out_of_order():
    """Of two sets of scores that are off by as much, the one that ranks the seats rightly has the smaller loss."""
    gain = torch.tensor([[0.1, 0.2, 0.3, 0.4]])
    error = torch.tensor([[-0.2, -0.2, 0.2, 0.2]])
    assert scoring_loss(gain + error, gain) < scoring_loss(gain - error, gain)
    assert scoring_loss(gain, gain) < scoring_loss(gain + error, gain)


@pytest.mark.parametrize("gain", [torch.zeros(2, 4), torch.zeros(2, 1), torch.full((1, 3), 70.0)])
def test_equal_and_extreme_gains_have_a_finite_loss(gain: torch.Tensor):
    """Seats of one gain have no order to learn, and what is beyond the clip counts as the clip."""
    score = torch.zeros_like(gain).requires_grad_()
    loss = scoring_loss(score, gain)
    loss.backward()
    assert loss.item() == pytest.approx(5.0 - 0.05 if gain.max() > 1 else 0.0)
    assert score.grad is not None
    assert score.grad.isfinite().all()


def test_seats_without_a_label_have_no_say():
    """What is scored at seats of which nothing is known changes no loss and learns nothing; with none known it is 0."""
    gain, known = (
        torch.tensor([[0.3, 0.1, 0.0], [0.2, 0.0, 0.0]]),
        torch.tensor([[True, True, False], [True, False, False]]),
    )
    score = torch.tensor([[0.1, 0.2, 3.0], [0.5, -3.0, 1.0]], requires_grad=True)
    loss = scoring_loss(score, gain, known)
    loss.backward()
    assert score.grad is not None
    assert torch.equal(score.grad != 0, known)
    assert loss == scoring_loss(score.detach().where(known, 9.0), gain, known)
    assert scoring_loss(score, gain, torch.zeros_like(known)) == 0


def test_a_glance_tells_gains_and_the_policy_takes_them(tiny: Maker):
    """Scores of the policy are the glance's gains, by the share of each seat that lies on the scene."""
    weights = tiny()
    grid = SceneGrid(27, 40, weights.config.patch, weights.config.factor)
    y, x = grid.coarse_shape
    bands = np.linspace(500, 900, 4)
    seen = glance(weights, np.random.default_rng(0).random((y, x, 4)), bands, grid)
    assert seen.gain is not None
    assert seen.gain.shape == grid.seat_shape
    expected = (seen.gain * grid.valid_share()).ravel()
    assert score_seats("gain", seen) == pytest.approx(expected)


@torch.inference_mode()
@pytest.mark.parametrize("patch", [8, 32])
def test_seats_have_the_codes_of_their_own_centres(tiny: Maker, patch: int):
    """Seats are numbered row by row over a scene of 3 coarse patches across; several tokens lie inside a seat."""
    model = tiny(patch=patch).segmenter
    side = model.config.token_side
    coded = model.code_fine(torch.zeros(1, 2, side**2, 16), torch.tensor([[0, 13]]), 3) - model.scale_code[1]
    within = (torch.arange(side).double() + 0.5) / side
    inside = torch.cartesian_prod(within, within).view(-1, 2)
    centres = torch.cat([inside, inside + torch.tensor([2.0, 1.0])])  # 13 lies in row 2, column 1 of 6 columns
    assert (coded[0] - code_2d(centres, 16)).abs().max() <= 1e-6
