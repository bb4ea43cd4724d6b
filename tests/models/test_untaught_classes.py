"""A class without a training pixel has probability 0 wherever class probabilities are made, mixed or stored."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.models.evaluation.expected_scores import expected_counts
from spectralzoom.models.evaluation.metrics import JudgedMap, fitted_temperature, judge_confidence
from spectralzoom.models.network.sizes import SegmenterConfig, TemporalSizes
from spectralzoom.models.network.temporal_reader import TemporalReader
from spectralzoom.models.policies.policies import class_errors, gain_of, pixel_entropy
from spectralzoom.models.reading.inference import read_coarse_prediction, segment
from spectralzoom.models.reading.prior_map import (
    ClassProbabilities,
    CurrentVisit,
    PriorMap,
    carried,
    first_probabilities,
    fuse,
    in_classes,
    pooled,
)
from spectralzoom.models.training.objective import map_loss
from spectralzoom.models.training.train import halfway, scaled
from spectralzoom.models.weights.files import Weights, with_record
from spectralzoom.pipeline.errors import ShapeError
from spectralzoom.storage.arrays.class_maps import (
    ClassNames,
    ProbabilityStore,
    create_probabilities,
    packed_probabilities,
    write_probabilities_tile,
)
from tests.models.conftest import make_weights, scene_columns

CLASSES = 4
NEVER = st.sets(st.integers(0, CLASSES - 1), min_size=1, max_size=CLASSES - 1).map(sorted).map(tuple)
SEEDS = st.integers(0, 2**16)


def _weights(seed: int, untaught: tuple[int, ...]) -> Weights:
    """Return random weights that would prefer the untaught classes by far."""
    made = make_weights(seed, classes=CLASSES, untaught=untaught)
    with torch.no_grad():
        for last in (made.segmenter.spectral, made.segmenter.overview_classes, made.segmenter.full_classes):
            last.bias[list(untaught)] += 1000.0
    return made


def _check(log_probability: np.ndarray, untaught: tuple[int, ...]) -> None:
    """Expect probability 0 of untaught classes, and a sum of 1 over the others."""
    chance = np.exp(log_probability.astype(np.float64))
    assert not chance[..., untaught].any()
    assert not np.isin(chance.argmax(axis=-1), untaught).any()
    np.testing.assert_allclose(chance.sum(axis=-1), 1, atol=1e-4)


MIXTURES: dict[str, Callable[[Weights, Weights], Weights]] = {
    "network": lambda one, other: one,
    "half of it": lambda one, other: replace(one, segmenter=scaled(one.segmenter, 0.5)),
    "halfway": lambda one, other: replace(one, segmenter=halfway(other.segmenter, one.segmenter)),
    "temperature": lambda one, other: with_record(one, calibration={"temperature": 5.0}),
}


@pytest.mark.parametrize("mixture", MIXTURES)
@given(seed=SEEDS, untaught=NEVER)
def test_untaught_classes_are_never_drawn(mixture: str, seed: int, untaught: tuple[int, ...]) -> None:
    """Neither the overview, nor patches, nor any mixture of classifiers draws them, whatever their logits."""
    weights = MIXTURES[mixture](_weights(seed, untaught), make_weights(seed + 1, classes=CLASSES))
    coarse_pass, fine = scene_columns(weights, 16, 24, seed)
    seen = read_coarse_prediction(weights, coarse_pass)
    assert not seen.probability[..., untaught].any()
    index = np.arange(3)
    drawn = segment(weights, seen, fine[index], index, every_class=True)
    _check(drawn.log_probability, untaught)
    assert not np.isin(drawn.classes, untaught).any()
    np.testing.assert_allclose(drawn.confidence, np.exp(drawn.log_probability).max(axis=-1), rtol=1e-5)
    assert np.isfinite(pixel_entropy(seen.probability)).all()
    errors = class_errors(seen)
    assert np.isfinite(gain_of(errors[:, 0], errors[:, 1].sum(axis=0))).all()


def _reader(seed: int) -> TemporalReader:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        reader = TemporalReader(TemporalSizes(CLASSES, 4, width=8, coarse_width=4)).eval()
        torch.nn.init.normal_(reader.leave.weight, std=0.3)
        torch.nn.init.normal_(reader.leave.bias, std=30.0)  # so that it prefers any class
    return reader


def _visit(seed: int, untaught: tuple[int, ...]) -> CurrentVisit:
    weights = _weights(seed, untaught)
    coarse_pass, fine = scene_columns(weights, 16, 24, seed)
    drawn = segment(weights, coarse_pass, fine, np.arange(len(fine)), every_class=True)
    seen = np.random.default_rng(seed).random((16, 24)) < 0.5
    return CurrentVisit(drawn.log_probability, seen, pooled(coarse_pass.columns[:16, :24]), 0.1, 2)


@pytest.mark.parametrize("with_reader", [False, True])
@given(seed=SEEDS, now=NEVER, before=NEVER | st.just(()), days=st.sampled_from((0.0, 0.5, 3.0, 400.0)))
def test_prior_maps_never_give_untaught_classes(
    with_reader: bool, seed: int, now: tuple[int, ...], before: tuple[int, ...], days: float
) -> None:
    """The earlier weights may have known other classes; a carried map and one of a visit follow today's weights."""
    reader = _reader(seed) if with_reader else None
    earlier = first_probabilities(_visit(seed + 1, before))
    known = in_classes(earlier.log_probability, range(CLASSES), now)
    _check(known, now)
    assert (known[..., np.setdiff1d(range(CLASSES), now)] > -20).all()  # a class that is new today is possible
    prior_map = PriorMap(ClassProbabilities(known, earlier.age_days, earlier.light), None, days)
    _check(carried(prior_map, reader).log_probability, now)
    after = fuse(prior_map, _visit(seed, now), reader)
    _check(after.log_probability, now)
    assert np.isfinite(after.classes()[1]).all()


@given(seed=SEEDS, untaught=NEVER)
def test_stored_probabilities_keep_untaught_classes_at_0(
    tmp_path_factory: pytest.TempPathFactory, seed: int, untaught: tuple[int, ...]
) -> None:
    """A class that is only unlikely keeps a probability above 0; expected counts have none of an untaught class."""
    path = tmp_path_factory.mktemp("store") / "class_probabilities.zarr"
    left = first_probabilities(_visit(seed, untaught))
    names = ClassNames(tuple("abcd"), np.zeros((CLASSES, 3), np.uint8))
    create_probabilities(path, left.age_days.shape, names)
    packed = packed_probabilities(left.log_probability)
    write_probabilities_tile(path, (0, 0), packed, left.age_days, left.light)
    found, _, _ = ProbabilityStore(path).read()
    _check(found, untaught)
    assert np.isfinite(np.delete(found, untaught, axis=-1)).all()
    counts = expected_counts([found], CLASSES)
    assert not counts[list(untaught)].any()
    assert counts.sum() == pytest.approx(16 * 24)


def test_temperature_ignores_labels_of_untaught_classes() -> None:
    """Their pixels are wrong at any temperature, and count in the calibration error alone."""
    rng = np.random.default_rng(0)
    values = np.full((400, 3), -np.inf, np.float32)
    values[:, :2] = rng.normal(0, 4, (400, 2))
    labels = rng.integers(0, 2, 400).astype(np.uint8)
    fitted = fitted_temperature([JudgedMap(values, labels)], 0)
    more = JudgedMap(np.concatenate([values, values]), np.concatenate([labels, np.full(400, 2, np.uint8)]))
    assert 0.2 < fitted < 5.1
    assert fitted_temperature([JudgedMap(values, np.full(400, 2, np.uint8))], 0) == 1.0
    assert 0 < judge_confidence([more], 0)["expected_error"] < 1


def test_crops_without_a_label_have_no_loss_of_untaught_classes() -> None:
    """Minus infinity times 0 would be NaN."""
    labels, logits = torch.full((1, 8, 8), 255), torch.randn(1, 3, 8, 8).requires_grad_()
    masked = logits.index_fill(1, torch.tensor([1]), -torch.inf)
    loss = map_loss(masked, labels, torch.ones(3), soft_dice=True)
    loss.backward()
    assert (loss.item(), logits.grad.abs().max().item()) == (0.0, 0.0)


@pytest.mark.parametrize("untaught", [(3,), (-1,), (0, 1, 2)])
def test_impossible_untaught_classes_are_refused(untaught: tuple[int, ...]) -> None:
    """Each is one of the classes, and one class at least is taught."""
    with pytest.raises(ShapeError, match="untaught must be some of the 3 classes"):
        SegmenterConfig(3, untaught=untaught)
