"""The two-scale segmenter: sizes, places, windows, composites, what parts may depend on, and its scorer of patches."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F  # noqa: N812 - its usual name

from models.network.segmenter import PatchScorer
from models.network.sizes import SegmenterConfig
from models.policies.policies import score_patches
from models.reading.inference import coarse_prediction
from models.training.objective import scoring_loss
from pipeline.geometry.grid import SceneGrid
from tests.models.conftest import Maker, noise, scene_tensors


@torch.inference_mode()
@pytest.mark.parametrize(("patch", "factor"), [(8, 2), (16, 4), (4, 4)])
def test_windows_are_those_of_the_whole_canvas(tiny: Maker, patch: int, factor: int):
    """The features under a patch equal the window of the whole canvas brought up bilinearly, borders included."""
    model = tiny(patch=patch, factor=factor).segmenter
    rows, columns = 2 * factor, 3 * factor
    canvas = noise(0, 2, model.config.coarse_width, 2 * patch, 3 * patch)
    whole = F.interpolate(model.under(canvas), scale_factor=factor, mode="bilinear", align_corners=False)
    patch_index = torch.randperm(rows * columns, generator=torch.Generator().manual_seed(3)).expand(2, -1)
    windows = model.canvas_windows(canvas, patch_index).view(2, -1, model.config.width, patch, patch)
    for place, patch_number in enumerate(patch_index[0].tolist()):
        y, x = patch_number // columns * patch, patch_number % columns * patch
        assert (windows[:, place] - whole[:, :, y : y + patch, x : x + patch]).abs().max() <= 1e-6


@torch.inference_mode()
def test_a_composite_holds_patches_where_patches_say(tiny: Maker):
    """Captured patches show their patch, all else the coarse logits brought up, each scene its own."""
    model = tiny().segmenter
    coarse, fine = noise(0, 2, 3, 8, 16), noise(1, 2, 3, 3, 8, 8)
    patch_index = torch.tensor([[0, 5, 7], [6, 1, 2]])
    expected = F.interpolate(coarse, scale_factor=2, mode="bilinear", align_corners=False)
    for scene in range(2):
        for place, patch_number in enumerate(patch_index[scene].tolist()):
            y, x = patch_number // 4 * 8, patch_number % 4 * 8
            expected[scene, :, y : y + 8, x : x + 8] = fine[scene, place]
    assert (model.composite(coarse, fine, patch_index) == expected).all()


@torch.inference_mode()
@pytest.mark.parametrize(("patch_index", "tokens"), [(100, 356), (200, 456), (0, 256)])
def test_tokens_are_counted_as_in_the_paper(tiny: Maker, patch_index: int, tokens: int):
    """A scene of 256 px with patches of 8 px and factor 2 has 256 coarse tokens, and one more a patch."""
    model = tiny(width=4, dim=8).segmenter
    read: list[int] = []
    model.encoder.register_forward_hook(lambda module, args, out: read.append(out[0].shape[1]))
    coarse, fine = torch.zeros(1, 4, 128, 128), torch.zeros(1, patch_index, 4, 8, 8)
    logits, patches = model(coarse, fine, torch.arange(patch_index)[None])
    assert sum(read) == tokens
    assert logits.shape == (1, 3, 128, 128)
    assert patches.shape == (1, patch_index, 3, 8, 8)


@torch.inference_mode()
def test_fine_patches_read_the_coarse_prediction_and_each_other(tiny: Maker):
    """A patch is read otherwise beside another patch, and above another coarse pass."""
    model = tiny().segmenter
    coarse, fine, _ = scene_tensors(model.config)
    _, alone = model(coarse, fine[:, :1], torch.tensor([[0]]))
    _, beside = model(coarse, fine[:, :2], torch.tensor([[0, 1]]))
    _, above = model(coarse.flip(2), fine[:, :1], torch.tensor([[0]]))
    assert (alone - beside[:, :1]).abs().max() > 1e-4
    assert (alone - above).abs().max() > 1e-4


def test_every_parameter_learns(tiny: Maker):
    """The loss of a map with some patches, and of their scores, has a gradient in every parameter."""
    model = tiny(layers=2).segmenter
    coarse, fine, _ = scene_tensors(model.config)
    patch_index = torch.tensor([[3, 0, 9]])
    logits, patches = model(coarse, fine[:, patch_index[0]], patch_index)
    gain = model.score(model.read_coarse(coarse))
    (model.composite(logits, patches, patch_index).square().mean() + gain.square().mean()).backward()
    idle = [name for name, value in model.named_parameters() if value.grad is None or not value.grad.any()]
    assert not idle


CONFIG = SegmenterConfig(classes=3, columns=2, patch=8, factor=2, width=8, coarse_width=6, dim=16, layers=1, heads=2)


def _seen(rows: int = 16, columns: int = 24) -> tuple[torch.Tensor, torch.Tensor]:
    stream = torch.Generator().manual_seed(2)
    return torch.randn(2, 6, rows, columns, generator=stream), torch.randn(2, 3, rows, columns, generator=stream)


def _scorer() -> PatchScorer:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        scorer = PatchScorer(CONFIG)
        torch.nn.init.normal_(scorer.leave.weight, std=0.3)
    return scorer


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


def test_patches_without_a_label_have_no_say():
    """Scores at patches of which nothing is known change no loss and learn nothing; with none known it is 0."""
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


def test_a_coarse_prediction_tells_gains_and_the_policy_takes_them(tiny: Maker):
    """Scores of the policy are the coarse prediction's gains, by the fraction of each patch that lies on the scene."""
    weights = tiny()
    grid = SceneGrid(27, 40, weights.config.patch, weights.config.factor)
    y, x = grid.coarse_shape
    bands = np.linspace(500, 900, 4)
    seen = coarse_prediction(weights, np.random.default_rng(0).random((y, x, 4)), bands, grid)
    assert seen.gain is not None
    assert seen.gain.shape == grid.patch_shape
    expected = (seen.gain * grid.valid_fraction()).ravel()
    assert score_patches("gain", seen) == pytest.approx(expected)
