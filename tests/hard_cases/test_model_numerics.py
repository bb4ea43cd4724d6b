"""Numerical hard cases of the models; the numbers in the names are the rows of the design's table."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from spectralzoom.models.evaluation.metrics import (
    average_accuracy,
    confusion,
    iou_per_class,
    kappa,
    mean_iou,
    overall_accuracy,
)
from spectralzoom.models.network.segmenter import Encoder, code_2d, cut
from spectralzoom.models.network.sizes import PLANES, SegmenterConfig
from spectralzoom.models.network.spectral import LineSpec, Normalisation, with_planes
from spectralzoom.models.policies.policies import pixel_entropy, score_patches
from spectralzoom.models.reading.inference import (
    CoarsePrediction,
    check_patch_index,
    coarse_prediction_of_columns,
    segment,
)
from spectralzoom.models.training import train as training
from spectralzoom.models.training.examples import Example
from spectralzoom.models.training.objective import map_loss
from spectralzoom.models.training.train import TrainingSettings, train
from spectralzoom.models.weights.files import load_weights, save_weights
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.planning.coverage import frame_patches, select_patches
from tests.models.conftest import SMALL, coarse_prediction, make_network, noise, plain_weights, read_both

NONE = torch.zeros(1, 0, dtype=torch.int64)
PLACE = torch.zeros(1, 2)


def _encoder() -> Encoder:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        return Encoder(16, 2, 2, 2)


def _image(height: int, width: int, batch: int = 1, seed: int = 0) -> Tensor:
    return noise(seed, batch, 4 + PLANES, height, width)


@pytest.fixture
def threads() -> Iterator[None]:
    """Restore torch's number of threads after the test."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@torch.inference_mode()
def test_1_scene_without_live_tokens_is_finite():
    """The overview is finite if all tokens are dead, and so are patches that are read after it."""
    model = make_network(layers=2)
    image = _image(64, 96)
    nothing = model.read_overview(image, None, torch.zeros(6, dtype=torch.bool))
    assert nothing.logits.isfinite().all()
    assert model.read_patches(nothing, cut(image, 8)[:, [0, 95]], torch.tensor([[0, 95]])).isfinite().all()


@torch.inference_mode()
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -1e30])
def test_2_values_of_a_dead_token_do_not_leak(bad: float):
    """NaN, infinity or -1e30 in a dead token changes the transformer's output for all other tokens by at most 1e-6."""
    model = make_network(layers=2)
    image = _image(64, 96)
    said: list[Tensor] = []
    valid = torch.tensor([True, True, False, True, True, True])
    spoiled = image.clone()
    spoiled[..., 15:17, 79:81] = bad  # convolutions spread it to the token's border
    model.from_token.register_forward_hook(lambda module, given, out: said.append(given[0].flatten(2)))
    overviews = [model.read_overview(one, None, valid) for one in (image, spoiled)]
    assert (said[0] - said[1]).abs().max() <= 1e-6
    assert said[0][..., valid].std() > 0.1
    apart = (overviews[0].logits - overviews[1].logits)[..., :57].abs()  # 7 px and more from the dead token
    assert apart.max() <= 1e-6


@torch.inference_mode()
@pytest.mark.parametrize("count", [0, 3])
def test_3_empty_batch_gives_empty_maps(count: int):
    """A batch of no scene passes the whole segmenter, with and without patches, also for sizes of partial tokens."""
    model = make_network(layers=2)
    numbers = torch.zeros(0, count, dtype=torch.int64)
    image = torch.zeros(0, 4 + PLANES, 32, 48)
    logits, patches = read_both(model, image, image, numbers, torch.zeros(0, 2))
    assert logits.shape == (0, 3, 32, 48)
    assert patches.shape == (0, count, 3, 8, 8)
    assert model.composite(logits, patches, numbers).shape == (0, 3, 32, 48)


@pytest.mark.parametrize("images", [0, 2])
@pytest.mark.parametrize("soft_dice", [False, True])
def test_4_batch_without_labels_has_zero_loss(images: int, soft_dice: bool):
    """Without a labelled pixel, or with weights of 0 for all labelled ones, the loss and its gradient are 0."""
    logits = noise(0, images, 3, 4, 4).requires_grad_()
    for value, weight in ((255, torch.ones(3)), (1, torch.zeros(3)), (1, torch.tensor([1.0, 0.0, 1.0]))):
        labels = torch.full((images, 4, 4), value)
        loss = map_loss(logits, labels, weight, soft_dice=soft_dice)
        assert loss.item() == 0
        (gradient,) = torch.autograd.grad(loss, logits)
        assert not gradient.any()


@torch.inference_mode()
def test_5_map_without_patches_is_the_overview():
    """With K = 0 training's forward pass, the overview and the survey's map come from the same logits, bit by bit."""
    weights = plain_weights()
    seen = coarse_prediction_of_columns(weights, noise(0, 48, 64, 4).numpy(), SceneGrid(48, 64, 8))
    image = torch.from_numpy(with_planes(seen.columns, LineSpec()))[None].permute(0, 3, 1, 2)
    model = weights.segmenter
    logits, patches = read_both(model, image, image, NONE, PLACE)
    whole = model.composite(logits, patches, NONE)
    assert torch.equal(whole, logits)
    assert (logits[0].softmax(dim=0).permute(1, 2, 0).numpy() == seen.probability).all()
    drawn = segment(weights, seen, np.empty((0, 8, 8, 4), np.float32), np.empty(0, np.int64))
    confidence, classes = whole[0].softmax(dim=0).max(dim=0)
    assert (drawn.classes == classes.numpy()).all()
    assert np.abs(drawn.confidence - confidence.numpy()).max() <= 1e-6


@torch.inference_mode()
def test_6_map_of_all_patches_ignores_their_order():
    """With K = all, the order changes no logit by more than 1e-5, and no pixel keeps the overview's logits."""
    model = make_network(layers=2)
    image = _image(32, 48)
    maps = []
    for seed in range(3):
        order = torch.randperm(24, generator=torch.Generator().manual_seed(seed))[None]
        logits, patches = read_both(model, image, image, order, PLACE)
        maps.append(model.composite(logits, patches, order))
    assert max((other - maps[0]).abs().max().item() for other in maps[1:]) <= 1e-5
    assert ((maps[0] - logits).abs().amax(dim=1) > 1e-5).all()


@pytest.mark.parametrize("fraction", [-0.01, 1.01, float("nan")])
def test_7_fraction_of_patches_outside_0_to_1_is_refused(fraction: float):
    """The message names the fraction, NaN included, and the number of patches."""
    with pytest.raises(ValueError, match=rf"from 0 to 1, got {fraction} \(of 24 patches\)"):
        frame_patches(np.zeros(24), fraction)


def test_8_equal_scores_select_the_lowest_patch():
    """Equal scores keep the order of the patches, and a larger selection starts with the smaller one."""
    assert select_patches(np.zeros(256), 5).tolist() == [0, 1, 2, 3, 4]
    assert select_patches(np.array([3, 2, 3, 2, 1, 3]), 2).tolist() == [0, 2]
    score = np.random.default_rng(0).integers(0, 4, 60).astype(float)
    choices = [select_patches(score, count) for count in range(61)]
    assert all((more[:-1] == less).all() for less, more in pairwise(choices))


def test_9_nan_scores_are_selected_last():
    """An infinite score comes first; NaN and minus infinity come last, together, by patch number."""
    assert select_patches(np.array([np.nan, 1.0, -np.inf, np.inf, 2.0, np.nan]), 6).tolist() == [3, 4, 1, 0, 2, 5]


def test_10_duplicate_patch_is_refused():
    """A selection lists each patch once; the error names the duplicate, so that no patch is summed or overwritten."""
    with pytest.raises(ValueError, match="patch 4 is given more than once"):
        check_patch_index(np.array([4, 1, 4]), SceneGrid(37, 53, 8))


@torch.inference_mode()
@pytest.mark.parametrize("size", [(32, 32), (64, 96), (96, 128)])
def test_11_bfloat16_agrees_with_float32(size: tuple[int, int]):
    """Autocast to bfloat16 adds only its rounding error, and no class changes where one leads by 0.1.

    A layer rounds input, weights and output, each by at most u = 2^-8 of its size, with a standard deviation below
    u / sqrt(3). Independent errors of ``depth`` layers add up to u sqrt(depth). Single errors differ between
    processors, which sum in other orders and fuse other layers.
    """
    model = make_network(layers=2)
    image = _image(*size)
    numbers = torch.arange(0, size[0] * size[1] // 64, 3)[None]
    exact = model.composite(*read_both(model, image, image, numbers, PLACE), numbers)
    with warnings.catch_warnings(), torch.autocast("cpu", dtype=torch.bfloat16):
        warnings.filterwarnings("ignore", "Mismatch dtype between input and weight")  # slower, not less exact
        rough = model.composite(*read_both(model, image, image, numbers, PLACE), numbers)
    depth = sum(isinstance(part, torch.nn.Conv2d | torch.nn.Linear) for part in model.modules())
    assert (exact - rough).square().mean().sqrt() <= 2.0**-8 * math.sqrt(depth) * exact.square().mean().sqrt()
    best = exact.softmax(dim=1).topk(2, dim=1).values
    assert (exact.argmax(dim=1) == rough.argmax(dim=1))[best[:, 0] - best[:, 1] >= 0.1].all()


@torch.inference_mode()
@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16])
def test_11_attention_stays_finite_in_half_precision(kind: torch.dtype):
    """Normalised queries and keys keep attention finite in 16 bits, for inputs of 300."""
    encoder = _encoder().to(kind)
    assert encoder((300 * noise(0, 1, 8, 16)).to(kind)).isfinite().all()


@torch.inference_mode()
def test_12_position_codes_of_a_distant_tile_are_exact():
    """The origin of a tile is added in float64: codes of its tokens are exact to 1e-6 at 1e7 tokens."""
    origin = np.array([9_999_997, 10_000_000.25])
    read: list[Tensor] = []
    model = make_network(layers=2, dim=32)
    model.to_token.weight.zero_()
    model.to_token.bias.zero_()
    model.encoder.register_forward_pre_hook(lambda module, given: read.append(given[0]))
    model.read_overview(_image(64, 96), torch.from_numpy(origin)[None])
    yx = (np.stack(np.divmod(np.arange(6), 3), axis=-1) + 0.5 + origin).astype(np.longdouble)
    angle = 2 * np.longdouble(math.pi) * np.fmod(yx[..., None] / np.geomspace(2, 128, 8).astype(np.longdouble), 1)
    expected = np.concatenate([np.sin(angle), np.cos(angle)], axis=-1).reshape(6, 32).astype(float)
    assert np.abs(read[0][0].numpy() - expected).max() < 1e-6


@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16])
def test_12_positions_in_half_precision_are_refused(kind: torch.dtype):
    """Half precision cannot hold the number of a patch; the message names the type."""
    with pytest.raises(ValueError, match=f"got {kind}"):
        code_2d(torch.zeros(3, 2, dtype=kind), 16)


@pytest.mark.parametrize("value", [0.0, 0.3, 4096.1, 1e-20])
def test_15_constant_band_normalises_to_zero(value: float):
    """A column without variance is exactly 0 alone, and 0 to 1e-5 beside other columns, in any order of them."""
    sample = np.random.default_rng(0).normal(0.5, 0.1, (500, 4)).astype(np.float32)
    sample[:, 1] = value
    normal = Normalisation.measured(sample).apply(sample, np.ones(4, bool))
    assert normal[:, 1] == pytest.approx(0, abs=1e-5)  # whitening mixes in no other column
    assert not Normalisation.measured(sample[:, [1, 1]]).apply(sample[:, [1, 1]], np.ones(2, bool)).any()
    order = [1, 3, 0, 2]
    permuted = Normalisation.measured(sample[:, order]).apply(sample[:, order], np.ones(4, bool))
    assert permuted == pytest.approx(normal[:, order], abs=1e-4)


def test_15_single_pixel_normalises_to_zero():
    """One pixel has no spread, so its normalised values are 0."""
    normalisation = Normalisation.measured(np.array([[0.2, 0.7]]))
    assert not normalisation.apply(np.array([[0.2, 0.7]], np.float32), np.ones(2, bool)).any()


def test_19_metrics_without_data_are_nan():
    """A class in neither map is NaN and not averaged; without labels every metric is NaN, for 0 pixels."""
    counts = confusion(np.array([0, 0, 1, 255]), np.array([0, 1, 1, 2]), 4)
    assert np.isnan(iou_per_class(counts)).tolist() == [False, False, True, True]
    assert mean_iou(counts) == pytest.approx(0.5)
    none = confusion(np.full(5, 255), np.zeros(5, int), 4)
    assert none.sum() == 0
    assert all(np.isnan(figure(none)) for figure in (mean_iou, overall_accuracy, average_accuracy, kappa))


@pytest.mark.parametrize(("label", "guess"), [(8, 0), (254, 0), (0, 8), (0, 255)])
def test_20_class_numbers_out_of_range_are_refused(label: int, guess: int):
    """A label or prediction outside of the classes is an error, not a wrapped index."""
    with pytest.raises(ValueError, match=r"none of the 8 classes 0\.\.7"):
        confusion(np.array([label], np.uint8), np.array([guess], np.uint8), 8)


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (37, 53), (100, 31)])
def test_21_map_has_the_size_of_the_scene(size: tuple[int, int]):
    """Scenes that patches do not divide evenly are padded and cropped back, from one pixel upwards."""
    weights = plain_weights()
    values = np.random.default_rng(0).uniform(0.1, 0.5, (*size, 5))
    seen = coarse_prediction(weights, values, np.linspace(450, 950, 5), SceneGrid(*size, 8))
    patch_index = frame_patches(score_patches("gain", seen), 0.5)
    drawn = segment(weights, seen, np.zeros((len(patch_index), 8, 8, 4), np.float32), patch_index)
    assert drawn.classes.shape == size
    assert drawn.classes.max() < 3


def test_22_uniform_scene_has_equal_scores():
    """Whole patches score equal to 1e-6, at the border too; partly filled patches rank by their pixels in the scene."""
    grid = SceneGrid(36, 50, 8)
    columns, probability = (np.full((*grid.padded_shape, n), of, np.float32) for n, of in ((4, 0.3), (3, 1 / 3)))
    seen = CoarsePrediction(grid, columns, probability)
    fraction = seen.grid.valid_fraction().ravel()
    scores = score_patches("entropy", seen)
    assert np.ptp(scores[fraction == 1]) <= 1e-6
    assert (np.diff(fraction[select_patches(scores, len(scores))]) <= 0).all()
    assert np.ptp(score_patches("sobel", seen)) <= 1e-6


@torch.inference_mode()
def test_23_map_does_not_depend_on_the_batch():
    """Other scenes, the batch size and the order of patches change logits only by float32's rounding.

    Some processors multiply matrices of another size in another order: a difference of 1.2e-6 was observed.
    """
    model = make_network(layers=2)
    image = _image(32, 64, 8)
    detail = _image(32, 64, 8, 1)
    places = torch.arange(16).view(8, 2)
    numbers = torch.stack([torch.randperm(32, generator=torch.Generator().manual_seed(i))[:5] for i in range(8)])
    together = model.composite(*read_both(model, image, detail, numbers, places), numbers)
    for i in (0, 3, 7):
        one = slice(i, i + 1)
        alone = model.composite(*read_both(model, image[one], detail[one], numbers[one], places[one]), numbers[one])
        assert (alone - together[one]).abs().max() <= 4e-6
    turned = numbers.flip(1)
    assert (model.composite(*read_both(model, image, detail, turned, places), turned) - together).abs().max() <= 4e-6


@torch.inference_mode()
def test_23_transformer_is_equivariant_to_token_order():
    """Only the codes carry positions: permuted tokens give the permuted output."""
    encoder = _encoder()
    tokens = noise(0, 2, 12, 16)
    order = torch.randperm(12, generator=torch.Generator().manual_seed(1))
    assert (encoder(tokens[:, order]) - encoder(tokens)[:, order]).abs().max() <= 2e-6


@pytest.mark.parametrize("nm", [[0.45, 0.65], [450.0, 3001.0], [199.0, 450.0], [np.nan, 450.0]])
def test_24_wavelengths_in_another_unit_are_refused(nm: list[float]):
    """Micrometres, NaN and values outside of 200-3000 nm raise a ValueError that names the range."""
    with pytest.raises(ValueError, match="outside 200-3000 nm"):
        coarse_prediction(plain_weights(), np.zeros((16, 16, 2)), np.array(nm), SceneGrid(16, 16, 8))


def test_25_entropy_of_certain_pixels_is_0():
    """A probability of 0 adds 0: the entropy is never NaN, and neither below 0 nor above it in float32."""
    tiny = np.array([[1.0, 1e-45, 0, 0]], np.float32)
    entropy = pixel_entropy(np.concatenate([np.eye(4, dtype=np.float32), tiny]))
    assert entropy.min() >= 0
    assert entropy.max() <= 1e-40


@pytest.mark.parametrize("size", [0.0, 1e30])
def test_27_zero_and_huge_corrections_keep_gradients_finite(size: float):
    """A full network with zero output leaves the overview unchanged; logits of 1e30 replace it."""
    model = make_network(layers=2)
    image = _image(32, 32)
    numbers = torch.tensor([[0, 5]])
    with torch.no_grad():
        for parameter in model.full_classes.parameters():
            parameter.zero_()
        model.full_classes.bias[1] = size
    logits, patches = read_both(model, image, image, numbers, PLACE)
    under = cut(logits, 8)[:, numbers[0]]
    assert torch.equal(patches, under) if size == 0 else (patches.argmax(dim=2) == 1).all()
    labels = torch.full((1, 32, 32), 2)
    drawn = model.composite(logits, patches, numbers)
    assert drawn.softmax(dim=1).isfinite().all()
    map_loss(drawn, labels, torch.ones(3), soft_dice=True).backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())
    assert model.full_classes.bias.grad.any()


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_29_steps_with_non_finite_loss_are_skipped_and_end_a_run(value: float, monkeypatch: pytest.MonkeyPatch):
    """Such steps are counted; three in a row stop the training."""
    example = Example("e", np.zeros((16, 16, 4), np.float16), np.zeros((16, 16), np.uint8), (16, 16))
    config = SegmenterConfig(**SMALL)
    settings = TrainingSettings(steps=4, batch=1, crop=16)
    honest = training.batch_loss
    calls = iter(range(100))
    monkeypatch.setattr(training, "batch_loss", lambda *a, **k: honest(*a, **k) * (value if next(calls) % 2 else 1))
    _, summary = train(config, [example], np.zeros(4, np.float32), settings)
    assert summary["skipped_steps"] == 2
    monkeypatch.setattr(training, "batch_loss", lambda *a, **k: honest(*a, **k) * value)
    with pytest.raises(RuntimeError, match="not finite in steps 1 to 3"):
        train(config, [example], np.zeros(4, np.float32), settings)


def test_30_saved_weights_read_any_number_of_bands(tmp_path: Path):
    """Weights from a file give finite probabilities for scenes of 1, 3 and 200 bands."""
    path = tmp_path / "w.safetensors"
    save_weights(plain_weights(), path)
    loaded = load_weights(path)
    grid = SceneGrid(16, 16, 8)
    for bands in (1, 3, 200):
        seen = coarse_prediction(loaded, np.full((16, 16, bands), 0.3), np.linspace(500, 900, bands), grid)
        assert np.isfinite(seen.probability).all()


def test_31_one_and_two_threads_select_the_same_patches(threads: None):
    """All four policies give the same plan on 1 and 2 threads; torch's global random state stays unchanged."""
    weights = plain_weights()
    columns = noise(0, 96, 96, 4).numpy()
    before = torch.random.get_rng_state()
    plans = []
    for count in (1, 2):
        torch.set_num_threads(count)
        seen = coarse_prediction_of_columns(weights, columns, SceneGrid(96, 96, 8))
        policies = ("gain", "entropy", "sobel", "random")
        plans.append([frame_patches(score_patches(policy, seen), 0.3) for policy in policies])
    assert all((one == two).all() for one, two in zip(*plans, strict=True))
    assert torch.equal(torch.random.get_rng_state(), before)


def test_every_row_of_the_table_has_a_test():
    """The 31 rows are the numbers in the names of the tests in this folder."""
    text = "".join(path.read_text(encoding="utf-8") for path in Path(__file__).parent.glob("test_*.py"))
    assert {int(number) for number in re.findall(r"^def test_(\d{1,2})_", text, re.MULTILINE)} == set(range(1, 32))
