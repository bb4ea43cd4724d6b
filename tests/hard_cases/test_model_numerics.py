"""Numerical hard cases of the models; numbers in the names are the rows of the design's table."""

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

from models.evaluation.metrics import average_accuracy, confusion, iou_per_class, kappa, mean_iou, overall_accuracy
from models.network.segmenter import Encoder, code_2d, cut
from models.network.sizes import PLANES, SegmenterConfig
from models.network.spectral import LineSpec, Normalisation, with_planes
from models.policies.policies import pixel_entropy, score_patches
from models.reading.inference import CoarsePrediction, check_patch_index, coarse_prediction_of_columns, segment
from models.training import train as training
from models.training.examples import Example
from models.training.objective import map_loss, pixel_losses
from models.training.train import TrainingSettings, train
from models.weights.files import load_weights, save_weights
from pipeline.geometry.grid import SceneGrid
from pipeline.planning.coverage import frame_patches, select_patches
from tests.models.conftest import SMALL, coarse_prediction, make_network, noise, plain_weights

NONE = torch.zeros(1, 0, dtype=torch.int64)
PLACE = torch.zeros(1, 2)


def _encoder(layers: int = 2) -> Encoder:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        return Encoder(16, layers, 2, 2)


def _image(height: int, width: int, batch: int = 1, seed: int = 0) -> Tensor:
    return noise(seed, batch, 4 + PLANES, height, width)


@pytest.fixture
def threads() -> Iterator[None]:
    """Give torch its number of threads back."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@torch.inference_mode()
def test_1_a_scene_without_a_living_token_is_finite():
    """A scene of which no token lives has an overview, and patches can be read after it."""
    model, image, dead = make_network(layers=2), _image(64, 96), torch.zeros(6, dtype=torch.bool)
    nothing = model.read_overview(image, None, dead)
    assert nothing.logits.isfinite().all()
    patches = cut(image, 8)[:, [0, 95]]
    assert model.read_patches(nothing, patches, torch.tensor([[0, 95]])).isfinite().all()


@torch.inference_mode()
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -1e30])
def test_2_what_a_dead_token_holds_does_not_leak(bad: float):
    """Whatever stands in a token that is left out, the transformer says the same of all others."""
    model, image, said = make_network(layers=2), _image(64, 96), list[Tensor]()
    living, spoiled = torch.tensor([True, True, False, True, True, True]), image.clone()
    spoiled[..., 15:17, 79:81] = bad  # convolutions take it to the border of the token
    model.from_token.register_forward_hook(lambda module, given, out: said.append(given[0].flatten(2)))
    overviews = [model.read_overview(one, None, living) for one in (image, spoiled)]
    assert (said[0] - said[1]).abs().max() <= 1e-6
    assert said[0][..., living].std() > 0.1
    apart = (overviews[0].logits - overviews[1].logits)[..., :57].abs()  # and 7 px beyond
    assert apart.max() <= 1e-6


@torch.inference_mode()
@pytest.mark.parametrize("count", [0, 3])
def test_3_no_images_give_no_maps(count: int):
    """The whole segmenter takes a batch of no scene, with and without patches, of parts of tokens too."""
    model, numbers = make_network(layers=2), torch.zeros(0, count, dtype=torch.int64)
    image = torch.zeros(0, 4 + PLANES, 32, 48)
    logits, patches = model(image, image, numbers, torch.zeros(0, 2))
    assert logits.shape == (0, 3, 32, 48)
    assert patches.shape == (0, count, 3, 8, 8)
    assert model.composite(logits, patches, numbers).shape == (0, 3, 32, 48)


@pytest.mark.parametrize("images", [0, 2])
@pytest.mark.parametrize("soft_dice", [False, True])
def test_4_nothing_labelled_is_no_loss(images: int, soft_dice: bool):
    """Without a labelled pixel, or with weights that are all 0, the loss is 0 and its gradient is 0."""
    logits = noise(0, images, 3, 4, 4).requires_grad_()
    for value, weight in ((255, torch.ones(3)), (1, torch.zeros(3)), (1, torch.tensor([1.0, 0.0, 1.0]))):
        labels = torch.full((images, 4, 4), value)
        loss = map_loss(logits, pixel_losses(logits, labels), labels, weight, soft_dice=soft_dice)
        assert loss.item() == 0
        (gradient,) = torch.autograd.grad(loss, logits)
        assert not gradient.any()


@torch.inference_mode()
def test_5_no_patch_is_the_overview_bit_by_bit():
    """With K = 0 training's forward, the overview and the survey's map come from one and the same logits."""
    weights, grid = plain_weights(), SceneGrid(48, 64, 8)
    seen = coarse_prediction_of_columns(weights, noise(0, 48, 64, 4).numpy(), grid)
    image, model = torch.from_numpy(with_planes(seen.columns, LineSpec())).permute(2, 0, 1)[None], weights.segmenter
    logits, patches = model(image, image, NONE, PLACE)
    whole = model.composite(logits, patches, NONE)
    assert torch.equal(whole, logits)
    assert (logits[0].softmax(dim=0).permute(1, 2, 0).numpy() == seen.probability).all()
    drawn = segment(weights, seen, np.empty((0, 8, 8, 4), np.float32), np.empty(0, np.int64))
    confidence, classes = whole[0].softmax(dim=0).max(dim=0)
    assert (drawn.classes == classes.numpy()).all()
    assert np.abs(drawn.confidence - confidence.numpy()).max() <= 1e-6


@torch.inference_mode()
def test_6_every_patch_in_any_order_is_one_map():
    """With K = all the order in which a policy ranked the patches does not show, and no pixel is the overview's."""
    model, image, maps = make_network(layers=2), _image(32, 48), []
    for seed in range(3):
        order = torch.randperm(24, generator=torch.Generator().manual_seed(seed))[None]
        logits, patches = model(image, image, order, PLACE)
        maps.append(model.composite(logits, patches, order))
    assert max((other - maps[0]).abs().max().item() for other in maps[1:]) <= 1e-5
    assert ((maps[0] - logits).abs().amax(dim=1) > 1e-5).all()


@pytest.mark.parametrize("fraction", [-0.01, 1.01, float("nan")])
def test_7_fractions_of_patches_that_cannot_be_are_refused(fraction: float):
    """The message names the fraction and the patches that there are."""
    with pytest.raises(ValueError, match=rf"from 0 to 1, got {fraction} \(of 24 patches\)"):
        frame_patches(np.zeros(24), fraction)


def test_8_ties_go_to_the_lowest_patch():
    """Equal scores keep the order of the patches, and a larger choice begins with the smaller one."""
    assert select_patches(np.zeros(256), 5).tolist() == [0, 1, 2, 3, 4]
    assert select_patches(np.array([3, 2, 3, 2, 1, 3]), 2).tolist() == [0, 2]
    score = np.random.default_rng(0).integers(0, 4, 60).astype(float)
    choices = [select_patches(score, count) for count in range(61)]
    assert all((more[:-1] == less).all() for less, more in pairwise(choices))


def test_9_a_dead_score_never_wins():
    """Infinite worth comes first; NaN and minus infinity come last, together, by number."""
    score = np.array([np.nan, 1.0, -np.inf, np.inf, 2.0, np.nan])
    assert select_patches(score, 6).tolist() == [3, 4, 1, 0, 2, 5]


def test_10_a_patch_given_twice_is_refused():
    """A choice names each patch once; where a caller does not, nothing is added up or overwritten: it is told which."""
    with pytest.raises(ValueError, match="patch 4 is given more than once"):
        check_patch_index(np.array([4, 1, 4]), SceneGrid(37, 53, 8))


@torch.inference_mode()
@pytest.mark.parametrize("size", [(32, 32), (64, 96), (96, 128)])
def test_11_bfloat16_agrees(size: tuple[int, int]):
    """Autocast to bfloat16 adds no more error than its rounding, and no class changes where one leads by 0.1.

    A layer rounds input, weights and output, each by at most u = 2^-8 of its size, with a standard deviation below
    u / sqrt(3). Independent errors of ``depth`` layers add up to u sqrt(depth). How large a single error may be differs
    between processors: they sum in other orders and fuse other layers.
    """
    model, image, numbers = make_network(layers=2), _image(*size), torch.arange(0, size[0] * size[1] // 64, 3)[None]
    exact = model.composite(*model(image, image, numbers, PLACE), numbers)
    with warnings.catch_warnings(), torch.autocast("cpu", dtype=torch.bfloat16):
        warnings.filterwarnings("ignore", "Mismatch dtype between input and weight")  # slower, not less exact
        rough = model.composite(*model(image, image, numbers, PLACE), numbers)
    depth = sum(isinstance(part, torch.nn.Conv2d | torch.nn.Linear) for part in model.modules())
    assert (exact - rough).square().mean().sqrt() <= 2.0**-8 * math.sqrt(depth) * exact.square().mean().sqrt()
    best = exact.softmax(dim=1).topk(2, dim=1).values
    sure = best[:, 0] - best[:, 1] >= 0.1
    assert (exact.argmax(dim=1) == rough.argmax(dim=1))[sure].all()


@torch.inference_mode()
@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16])
def test_11_attention_stays_finite_in_half_precision(kind: torch.dtype):
    """Normalised queries and keys keep the logits of inputs of 300 finite in 16 bits."""
    encoder, x = _encoder().to(kind), (300 * noise(0, 1, 8, 16)).to(kind)
    assert encoder(x).isfinite().all()


@torch.inference_mode()
def test_12_a_tile_far_out_has_the_codes_of_its_field():
    """The origin of a tile is added in float64: codes of its tokens are exact to 1e-6 at 1e7 tokens."""
    origin, read = np.array([9_999_997, 10_000_000.25]), list[Tensor]()
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
def test_12_places_in_half_precision_are_refused(kind: torch.dtype):
    """Half precision cannot hold the number of a patch; the message says which kind came."""
    with pytest.raises(ValueError, match=f"got {kind}"):
        code_2d(torch.zeros(3, 2, dtype=kind), 16)


@pytest.mark.parametrize("value", [0.0, 0.3, 4096.1, 1e-20])
def test_15_a_constant_band_is_exactly_zero(value: float):
    """A column without variance is 0 after normalisation, alone or beside others, in any order."""
    sample = np.random.default_rng(0).normal(0.5, 0.1, (500, 4)).astype(np.float32)
    sample[:, 1] = value
    normalisation = Normalisation.measured(sample)
    normal = normalisation.apply(sample, np.ones(4, bool))
    assert normal[:, 1] == pytest.approx(0, abs=1e-5)  # whitening mixes in nothing of the others
    alone = Normalisation.measured(sample[:, [1, 1]])
    assert not alone.apply(sample[:, [1, 1]], np.ones(2, bool)).any()
    order = [1, 3, 0, 2]
    permuted = Normalisation.measured(sample[:, order]).apply(sample[:, order], np.ones(4, bool))
    assert permuted == pytest.approx(normal[:, order], abs=1e-4)


def test_15_a_sample_of_one_pixel_is_finite():
    """One pixel has no spread and becomes 0."""
    normalisation = Normalisation.measured(np.array([[0.2, 0.7]]))
    assert not normalisation.apply(np.array([[0.2, 0.7]], np.float32), np.ones(2, bool)).any()


def test_19_what_is_not_there_is_no_number():
    """A class in neither map is NaN and not averaged; with nothing labelled every figure is NaN, of 0 pixels."""
    counts = confusion(np.array([0, 0, 1, 255]), np.array([0, 1, 1, 2]), 4)
    assert np.isnan(iou_per_class(counts)).tolist() == [False, False, True, True]
    assert mean_iou(counts) == pytest.approx(0.5)
    none = confusion(np.full(5, 255), np.zeros(5, int), 4)
    assert none.sum() == 0
    assert all(np.isnan(figure(none)) for figure in (mean_iou, overall_accuracy, average_accuracy, kappa))


@pytest.mark.parametrize(("label", "guess"), [(8, 0), (254, 0), (0, 8), (0, 255)])
def test_20_numbers_that_are_no_class_are_refused(label: int, guess: int):
    """A label or prediction outside the classes is an error, not a wrapped index."""
    with pytest.raises(ValueError, match=r"none of the 8 classes 0\.\.7"):
        confusion(np.array([label], np.uint8), np.array([guess], np.uint8), 8)


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (37, 53), (100, 31)])
def test_21_any_size_gives_its_own_map(size: tuple[int, int]):
    """Scenes that do not divide are padded and cropped back, from one pixel on."""
    weights, grid = plain_weights(), SceneGrid(*size, 8)
    values = np.random.default_rng(0).uniform(0.1, 0.5, (*size, 5))
    seen = coarse_prediction(weights, values, np.linspace(450, 950, 5), grid)
    patch_index = frame_patches(score_patches("gain", seen), 0.5)
    drawn = segment(weights, seen, np.zeros((len(patch_index), 8, 8, 4), np.float32), patch_index)
    assert drawn.classes.shape == size
    assert drawn.classes.max() < 3


def test_22_a_scene_alike_everywhere_scores_alike():
    """Whole patches score equal to 1e-6, at the border too; partly filled ones rank by their pixels on the scene."""
    grid = SceneGrid(36, 50, 8)
    columns, probability = (np.full((*grid.padded_shape, n), of, np.float32) for n, of in ((4, 0.3), (3, 1 / 3)))
    seen = CoarsePrediction(grid, columns, probability)
    fraction, scores = seen.grid.valid_fraction().ravel(), score_patches("entropy", seen)
    assert np.ptp(scores[fraction == 1]) <= 1e-6
    ranked = fraction[select_patches(scores, len(scores))]
    assert (np.diff(ranked) <= 0).all()
    assert np.ptp(score_patches("sobel", seen)) <= 1e-6


@torch.inference_mode()
def test_23_a_scene_reads_alike_alone_and_in_a_batch():
    """Batch-mates, the size of the batch and the order of patches do not show beyond float32's rounding.

    Some processors multiply matrices of another size in another order: 1.2e-6 was seen.
    """
    model, image, detail = make_network(layers=2), _image(32, 64, 8), _image(32, 64, 8, 1)
    places = torch.arange(16).view(8, 2)
    numbers = torch.stack([torch.randperm(32, generator=torch.Generator().manual_seed(i))[:5] for i in range(8)])
    together = model.composite(*model(image, detail, numbers, places), numbers)
    for i in (0, 3, 7):
        one = slice(i, i + 1)
        alone = model.composite(*model(image[one], detail[one], numbers[one], places[one]), numbers[one])
        assert (alone - together[one]).abs().max() <= 4e-6
    turned = numbers.flip(1)
    reordered = model.composite(*model(image, detail, turned, places), turned)
    assert (reordered - together).abs().max() <= 4e-6


@torch.inference_mode()
def test_23_tokens_in_another_order_say_the_same():
    """Places are told by codes alone: the transformer of permuted tokens is that of the tokens, permuted."""
    encoder, tokens = _encoder(), noise(0, 2, 12, 16)
    order = torch.randperm(12, generator=torch.Generator().manual_seed(1))
    assert (encoder(tokens[:, order]) - encoder(tokens)[:, order]).abs().max() <= 2e-6


@pytest.mark.parametrize("nm", [[0.45, 0.65], [450.0, 3001.0], [199.0, 450.0], [np.nan, 450.0]])
def test_24_wavelengths_in_another_unit_are_refused(nm: list[float]):
    """Micrometres and numbers outside 200-3000 nm are a ValueError that says so."""
    with pytest.raises(ValueError, match="outside 200-3000 nm"):
        coarse_prediction(plain_weights(), np.zeros((16, 16, 2)), np.array(nm), SceneGrid(16, 16, 8))


def test_25_certainty_has_no_entropy():
    """A probability of 0 adds 0: no NaN, and never less than 0 in float32."""
    sure, tiny = np.eye(4, dtype=np.float32), np.array([[1.0, 1e-45, 0, 0]], np.float32)
    entropy = pixel_entropy(np.concatenate([sure, tiny]))
    assert np.isfinite(entropy).all()
    assert entropy.min() >= 0


@pytest.mark.parametrize("size", [0.0, 1e30])
def test_27_corrections_of_nothing_and_of_everything(size: float):
    """A full network that says nothing leaves the overview as it is; huge logits replace it. Gradients stay finite."""
    model, image, numbers = make_network(layers=2), _image(32, 32), torch.tensor([[0, 5]])
    with torch.no_grad():
        for parameter in model.full_classes.parameters():
            parameter.zero_()
        model.full_classes.bias[1] = size
    logits, patches = model(image, image, numbers, PLACE)
    under = cut(logits, 8)[:, numbers[0]]
    assert torch.equal(patches, under) if size == 0 else (patches.argmax(dim=2) == 1).all()
    labels, drawn = torch.full((1, 32, 32), 2), model.composite(logits, patches, numbers)
    assert drawn.softmax(dim=1).isfinite().all()
    map_loss(drawn, pixel_losses(drawn, labels), labels, torch.ones(3), soft_dice=True).backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())
    assert model.full_classes.bias.grad.any()


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_29_bad_steps_are_counted_and_end_a_run(value: float, monkeypatch: pytest.MonkeyPatch):
    """A loss that is not finite is skipped and counted; three in a row stop the run."""
    labels = np.zeros((16, 16), np.uint8)
    example = Example("e", np.zeros((16, 16, 4), np.float16), labels, (16, 16))
    config, settings = SegmenterConfig(**SMALL), TrainingSettings(steps=4, batch=1, crop=16)
    honest, calls = training.batch_loss, iter(range(100))
    monkeypatch.setattr(training, "batch_loss", lambda *a, **k: honest(*a, **k) * (value if next(calls) % 2 else 1))
    _, summary = train(config, [example], np.zeros(4, np.float32), settings)
    assert summary["skipped_steps"] == 2
    monkeypatch.setattr(training, "batch_loss", lambda *a, **k: honest(*a, **k) * value)
    with pytest.raises(RuntimeError, match="not finite in steps 1 to 3"):
        train(config, [example], np.zeros(4, np.float32), settings)


def test_30_a_checkpoint_reads_other_bands(tmp_path: Path):
    """Weights that were saved read any number of bands."""
    weights, path = plain_weights(), tmp_path / "w.safetensors"
    save_weights(weights, path)
    loaded, grid = load_weights(path), SceneGrid(16, 16, 8)
    for bands in (1, 3, 200):
        seen = coarse_prediction(loaded, np.full((16, 16, bands), 0.3), np.linspace(500, 900, bands), grid)
        assert np.isfinite(seen.probability).all()


def test_31_one_and_two_threads_choose_the_same_patches(threads: None):
    """The same scene gives the same plan on 1 and 2 threads, and no global stream is touched."""
    weights, grid = plain_weights(), SceneGrid(96, 96, 8)
    columns = noise(0, 96, 96, 4).numpy()
    before, plans = torch.random.get_rng_state(), []
    for count in (1, 2):
        torch.set_num_threads(count)
        seen = coarse_prediction_of_columns(weights, columns, grid)
        policies = ("gain", "entropy", "sobel", "random")
        plans.append([frame_patches(score_patches(policy, seen), 0.3) for policy in policies])
    assert all((one == two).all() for one, two in zip(*plans, strict=True))
    assert torch.equal(torch.random.get_rng_state(), before)


def test_every_row_of_the_table_has_a_test():
    """The 31 rows are the numbers in the names of the tests in this folder."""
    text = "".join(path.read_text(encoding="utf-8") for path in Path(__file__).parent.glob("test_*.py"))
    assert {int(number) for number in re.findall(r"^def test_(\d{1,2})_", text, re.MULTILINE)} == set(range(1, 32))
