"""The scorer of seats: what it sees, what it learns, and that the segmenter learns nothing through it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from models.network.segmenter import SeatScorer
from models.network.sizes import SegmenterConfig
from models.policies.policies import score_seats
from models.reading.inference import Glance, glance
from models.training.objective import scoring_loss
from pipeline.errors import SettingsError
from pipeline.geometry.grid import SceneGrid
from tests.models.conftest import Maker

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


def test_gains_are_asked_of_weights():
    """Without a reading by the weights there is no gain to go by."""
    grid = SceneGrid(16, 16, 8, 2)
    with pytest.raises(SettingsError, match="asks the weights"):
        score_seats("gain", Glance(grid, np.zeros((8, 8, 2), np.float32), np.zeros((8, 8, 3), np.float32)))
