"""Training: crops and patches, losses, skipped steps, linear classifiers, and equal weights from equal seeds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from spectralzoom.models.network.segmenter import Segmenter
from spectralzoom.models.network.sizes import PLANES, SegmenterConfig
from spectralzoom.models.network.spectral import LineSpec, Normalisation
from spectralzoom.models.reading.inference import map_of_columns
from spectralzoom.models.training import train as training
from spectralzoom.models.training.capture_augmentation import CaptureAugmentation, ColumnNoise
from spectralzoom.models.training.examples import CropSampler
from spectralzoom.models.training.objective import PHASES, Phase, batch_loss, class_weights, draw_patches, map_loss
from spectralzoom.models.training.train import LabelledPixels, TrainingSettings, linear_classifier, train
from spectralzoom.pipeline.geometry.grid import SceneGrid
from tests.models.conftest import block_example, make_weights

CONFIG = SegmenterConfig(classes=3, columns=2, patch=8, width=8, dim=16, layers=1, heads=2)
SETTINGS = TrainingSettings(steps=6, batch=2, crop=16, learning_rate=3e-3)
SHIFT = np.zeros(2, np.float32)


def test_training_reduces_the_loss(monkeypatch: pytest.MonkeyPatch):
    """Forty small steps bring the loss of two separable classes below a third; freed memory is given back twice."""
    losses: list[float] = []
    freed: list[None] = []
    monkeypatch.setattr(training, "FREED_EVERY", 15)
    monkeypatch.setattr(training, "give_back_freed_memory", lambda: freed.append(None))
    scene = block_example(64, 16)
    settings = replace(SETTINGS, steps=40, crop=32, learning_rate=1e-2)
    model, summary = train(CONFIG, [scene], SHIFT, settings, lambda now: losses.append(now.loss))
    batch = CropSampler([scene], 8, 32).draw(8, np.random.default_rng(0), SHIFT)
    weight = class_weights([scene.labels], 3, 5.0)
    with torch.no_grad():
        last = batch_loss(model, batch, weight, np.random.default_rng(0), PHASES[0], soft_dice=False)
    assert last < losses[0] / 3
    assert (summary["steps"], summary["skipped_steps"], len(freed)) == (40, 0, 2)
    assert not model.training


def test_training_at_the_reference_ignores_capture_planes():
    """Planes that are 0 in every crop keep kernels of 0, so that every capture gives the same map."""
    scene = block_example()
    model, _ = train(CONFIG, [scene], SHIFT, SETTINGS)
    assert not any(stem.enter.weight[:, 2 : 2 + PLANES].any() for stem in (model.overview_stem, model.full_stem))
    weights = replace(make_weights(columns=2), segmenter=model)
    grid = SceneGrid(32, 32, 8)
    usual, dark = (map_of_columns(weights, scene.columns, grid, one)[1] for one in (LineSpec(), LineSpec(0.1, 4, 4)))
    assert (usual == dark).all()


def test_equal_seeds_give_equal_weights():
    """The weights are equal up to rounding; the global random streams of torch and numpy do not change."""
    torch_before, numpy_before = torch.random.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    models = [train(CONFIG, [block_example()], SHIFT, replace(SETTINGS, steps=3, seed=seed))[0] for seed in (3, 3, 4)]
    assert torch.equal(torch.random.get_rng_state(), torch_before)
    assert (np.random.get_state()[1] == numpy_before).all()  # noqa: NPY002
    weights = [torch.cat([value.flatten() for value in model.parameters()]) for model in models]
    apart = [(weights[0] - other).norm() for other in weights[1:]]
    assert apart[0] < 1e-3 * apart[1]  # sums differ in the last bit with the memory layout
    assert not models[0].training


@pytest.mark.parametrize(("crop", "first", "last"), [(48, 32, (2, 64)), (64, 64, (4, 64)), (16, 32, (4, 32))])
def test_batches_halve_where_crops_grow(crop: int, first: int, last: tuple[int, int], monkeypatch: pytest.MonkeyPatch):
    """The last phase has larger crops and fewer of them; if scenes have no larger ones, their number stays."""
    trainer = training.Trainer(CONFIG, [block_example(64)], SHIFT, replace(SETTINGS, batch=4, crop=crop))
    sizes = []
    loss = training.batch_loss
    monkeypatch.setattr(
        training,
        "batch_loss",
        lambda model, batch, *a, **k: sizes.append(batch.labels.shape) or loss(model, batch, *a, **k),
    )
    for done in (0.1, 0.9):
        trainer.step(done)
    assert [(count, side) for count, side, _ in sizes] == [(4, first), last]


def test_training_stops_at_its_time_limit(monkeypatch: pytest.MonkeyPatch):
    """The processor's time counts on a processor; the summary counts the steps that were taken."""
    clock = iter(range(0, 10_000, 30))
    monkeypatch.setattr(training.time, "process_time", lambda: next(clock))
    seen: list[training.Progress] = []
    _, summary = train(CONFIG, [block_example()], SHIFT, replace(SETTINGS, steps=1000, minutes=2.5), seen.append)
    assert len(seen) == summary["steps"] == 4
    assert seen[-1].done == pytest.approx(0.8)


@pytest.mark.parametrize(("helps", "steps"), [(True, 6), (False, 3)])
def test_training_stops_where_its_first_check_finds_no_help(helps: bool, steps: int):
    """The one check comes after a fourth of the run."""
    asked: list[Segmenter] = []
    found = train(CONFIG, [block_example()], SHIFT, SETTINGS, helps=lambda model: asked.append(model) or helps)
    assert (found[1]["steps"], len(asked)) == (steps, 1)


def test_an_infinite_gradient_is_no_step():
    """The loss is finite, and every weight stays as it was."""
    model = Segmenter(CONFIG)
    optimiser = torch.optim.AdamW(model.parameters(), 0.1)
    before = torch.nn.utils.parameters_to_vector(model.parameters()).clone()
    assert not training._step(model, optimiser, (model.to_token.bias.sum() * 0).abs().sqrt())
    assert torch.equal(torch.nn.utils.parameters_to_vector(model.parameters()), before)
    assert training._step(model, optimiser, model.to_token.bias.square().sum() + model.to_token.bias.sum())


def test_learning_rate_warms_up_and_falls():
    """The rate rises from 5 % to 100 % over the first twentieth, then falls to 1 %."""
    assert [training.rate_at(done) for done in (0.0, 0.025, 0.05, 1.0)] == pytest.approx([0.05, 0.525, 1.0, 0.01])
    falling = [training.rate_at(done) for done in np.linspace(0.05, 1, 50)]
    assert falling == sorted(falling, reverse=True)


def test_rare_classes_weigh_more():
    """Weights are 1 over the root of the fraction, with mean 1 over pixels; a class without a pixel has weight 0."""
    labels = np.full((10, 10), 255, np.uint8)
    labels[:8], labels[8:9, :8], labels[9:, :0] = 0, 1, 2
    weight = class_weights([labels], 3, 100.0).numpy()
    assert weight[1] / weight[0] == pytest.approx(np.sqrt(10))
    assert (80 * weight[0] + 8 * weight[1]) / 88 == pytest.approx(1)
    assert weight[2] == 0
    assert class_weights([labels], 3, 2.0).max() == 2


def test_most_patches_of_a_late_phase_are_drawn_by_entropy():
    """In the first phase half of them are, in the last four of five."""
    overview = torch.zeros(1, 3, 64, 64)
    overview[:, 0] = 30.0
    overview[:, :, :8, :8] = 0.0  # unsure in patch 0 alone

    def first(phase: Phase) -> float:
        streams = (np.random.default_rng(seed) for seed in range(60))
        return float(np.mean([draw_patches(overview, CONFIG, rng, phase)[0, 0] == 0 for rng in streams]))

    assert 0.35 < first(PHASES[0]) < 0.65
    assert 0.7 < first(PHASES[-1]) < 0.95


@pytest.mark.parametrize(("deep", "least", "most"), [(False, 1.0, 1.0), (True, 0.04, 0.2)])
def test_deep_networks_read_patches_in_few_steps(deep: bool, least: float, most: float):
    """The full network of a deep segmenter learns in about a tenth of the steps, that of others in every step."""
    model = Segmenter(replace(CONFIG, deep=deep))
    rng = np.random.default_rng(0)
    weight = torch.ones(3)
    batch = CropSampler([block_example()], 8, 32).draw(1, rng, SHIFT)
    losses = [batch_loss(model, batch, weight, rng, PHASES[0], soft_dice=False) for _ in range(100 if deep else 10)]
    read = [torch.autograd.grad(loss, model.full_classes.bias, allow_unused=True)[0] is not None for loss in losses]
    assert least <= np.mean(read) <= most


DEEP = SegmenterConfig(classes=3, columns=2, patch=32, width=4, overview_width=4, dim=16, layers=1, heads=2, deep=True)


def test_an_encoder_that_is_known_learns_slowly() -> None:
    """Convolutions and norms of ImageNet learn by 0.3 of the rate; only matrices and kernels decay."""
    trainer = training.Trainer(DEEP, [block_example(64, 32)], SHIFT, SETTINGS)
    trainer.step(0.05)  # the highest rate
    groups = {id(group["params"][0]): (group["lr"], group["weight_decay"]) for group in trainer.optimiser.param_groups}
    stem = trainer.model.overview_stem
    assert groups[id(stem.first.norm.weight)] == (pytest.approx(0.3 * 3e-3), 0)
    assert groups[id(stem.stages[1][0].project.conv.weight)] == (pytest.approx(0.3 * 3e-3), 0.02)
    assert groups[id(stem.colours.weight)] == (pytest.approx(3e-3), 0.02)


def test_the_norms_of_averaged_weights_are_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last crops set their means: what the averaged weights give for many crops has mean 0 and variance 1."""
    monkeypatch.setattr(training, "NORM_BATCHES", 200)
    scene = block_example(64, 32)
    model, _ = train(DEEP, [scene], SHIFT, replace(SETTINGS, steps=3, crop=32))
    stem, drawn = model.overview_stem, CropSampler([scene], 32, 32, zoomed=True)
    image = drawn.draw(400, np.random.default_rng(1), SHIFT).image
    with torch.no_grad():
        found = stem.first.conv(torch.nn.functional.pad(stem.colours(image), (0, 1, 0, 1)))
    norm = stem.first.norm
    torch.testing.assert_close(norm.running_var, found.var(dim=(0, 2, 3)), rtol=0.1, atol=1e-6)
    assert ((norm.running_mean - found.mean(dim=(0, 2, 3))).abs() < 0.1 * norm.running_var.sqrt()).all()


def test_unlabelled_pixels_do_not_change_the_loss():
    """Logits of unlabelled pixels have no gradient, and other logits there give the same loss."""
    labels = torch.randint(0, 3, (1, 8, 8), generator=torch.Generator().manual_seed(0))
    labels[:, 2:5] = 255
    logits = torch.randn(1, 3, 8, 8, generator=torch.Generator().manual_seed(1)).requires_grad_()
    loss = map_loss(logits, labels, torch.ones(3), soft_dice=True)
    loss.backward()
    assert not logits.grad[:, :, 2:5].any()
    other = logits.detach().clone()
    other[:, :, 2:5] += 9
    same = map_loss(other, labels, torch.ones(3), soft_dice=True)
    assert same.item() == pytest.approx(loss.item(), abs=1e-6)


def test_few_very_bright_pixels_do_not_mislead_the_linear_classifier() -> None:
    """Discriminants alone get 64 % of these pixels right; the logistic regression repairs them."""
    labels = np.repeat(np.array([0, 1], np.uint8), 200)
    features = np.random.default_rng(0).normal(0, 1, (400, 2)).astype(np.float32)
    features[:, 0] += 4 * labels
    features[380:, 0] += 60
    found = linear_classifier(LabelledPixels(features, labels), 2)
    logits = features @ found["spectral.weight"][:, :, 0, 0].numpy().T + found["spectral.bias"].numpy()
    assert (logits.argmax(axis=1) == labels).mean() > 0.95


def test_linear_classifiers_do_not_rely_on_brightness() -> None:
    """A feature that depends on brightness loses its weight; one that does not keeps it."""
    labels = np.repeat(np.array([0, 1], np.uint8), 500)
    features = (np.random.default_rng(0).normal(0, 0.1, (1000, 2)) + 1.5 * labels[:, None]).astype(np.float32)
    shift = np.array([100.0, 0.0], np.float32)  # twice the light moves the first feature by so much
    own = LabelledPixels(features, labels)
    weights = [
        linear_classifier(one, 2)["spectral.weight"][1, :, 0, 0].abs()
        for one in (own, own.brightened(shift, np.random.default_rng(1)))
    ]
    assert weights[0][0] > 0.5 * weights[0][1]
    assert weights[1][0] < 0.05 * weights[1][1]


def test_linear_classifiers_are_fitted_to_dark_pixels() -> None:
    """Weights for dark crops are less than half of those for bright ones; scenes without known noise stay bright."""
    plain = Normalisation(np.zeros(2, np.float32), np.ones(2, np.float32), np.eye(2, dtype=np.float32))
    augmentation = CaptureAugmentation(plain, min_exposure_ms=3.0)
    silent = block_example(64, 16)
    noisy = replace(silent, noise=ColumnNoise(np.zeros(2), 0.01 * np.eye(2)))
    drawn = [
        LabelledPixels.drawn([scene], np.random.default_rng(0), how)
        for scene, how in ((noisy, None), (noisy, augmentation), (silent, augmentation))
    ]
    bright, dark, same = (linear_classifier(one, 3)["spectral.weight"].abs().max().item() for one in drawn)
    assert dark < bright / 2
    assert same == pytest.approx(bright, rel=0.2)
    assert {len(one.labels) for one in drawn} == {64 * 64}


@pytest.mark.parametrize("deep", [False, True])
def test_halfway_network_has_the_mean_of_each_weight(deep: bool) -> None:
    """The means and variances of batch norms are those of both too; both networks themselves stay as they are."""
    one, other = (Segmenter(replace(DEEP, deep=deep)) for _ in range(2))
    for norm in (one for one in other.modules() if isinstance(one, torch.nn.BatchNorm2d)):
        norm.running_mean.fill_(3.0)
    before = [tensor.clone() for tensor in (*one.state_dict().values(), *other.state_dict().values())]
    for middle, first, second in zip(
        *(net.state_dict().values() for net in (training.halfway(one, other), one, other)), strict=True
    ):
        torch.testing.assert_close(middle, ((first + second) / 2).to(middle.dtype))
    assert all(map(torch.equal, before, (*one.state_dict().values(), *other.state_dict().values())))
