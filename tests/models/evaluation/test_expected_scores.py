"""Expected scores of maps, computed from their own probabilities."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spectralzoom.models.evaluation.expected_scores import (
    LEAST_ERROR,
    MapScores,
    ScoredMap,
    error_of_passes,
    expected_counts,
    expected_score,
    fitted_bias,
)
from spectralzoom.models.evaluation.metrics import confusion, iou_per_class, mean_iou

CLASSES = 4
PLAIN = (LEAST_ERROR, 1, 100.0)
SEEDS = st.integers(0, 2**32 - 1)


def _map(seed: int, pixels: int = 4000, *, hotter: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Return labels and log-probabilities (pixel, class) of a map whose confidence is ``hotter`` times too high."""
    rng = np.random.default_rng(seed)
    logits = rng.normal(size=(pixels, CLASSES)) * 3
    true = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
    labels = (true.cumsum(axis=1) < rng.random((pixels, 1))).sum(axis=1).clip(max=CLASSES - 1)
    said = np.exp(hotter * logits)
    return np.log(said / said.sum(axis=1, keepdims=True)), labels.astype(np.uint8)


def _scored(seed: int, hotter: float = 1.0) -> ScoredMap:
    said, labels = _map(seed, hotter=hotter)
    return ScoredMap(confusion(labels, said.argmax(axis=1).astype(np.uint8), CLASSES), expected_counts([said], CLASSES))


@given(SEEDS, st.integers(0, 200))
def test_expected_counts_sum_to_the_mapped_pixels(seed: int, cut: int):
    """Each column sums to the pixels mapped as its class, ties to the first; parts add up, wherever a map is cut."""
    said, _ = _map(seed, 200)
    said[0] = np.log(1 / CLASSES)
    whole = expected_counts([said], CLASSES)
    assert np.allclose(whole, expected_counts([said[:cut], said[cut:]], CLASSES))
    assert np.allclose(whole.sum(axis=0), np.bincount(said.argmax(axis=1), minlength=CLASSES))


@given(SEEDS)
def test_pixels_without_probabilities_are_left_out(seed: int):
    """NaN in all classes excludes the pixel."""
    said, _ = _map(seed, 50)
    said[::5] = np.nan
    kept = np.isfinite(said).all(axis=1)
    assert np.array_equal(expected_counts([said], CLASSES), expected_counts([said[kept]], CLASSES))


@settings(max_examples=20)
@given(SEEDS)
def test_a_calibrated_map_expects_its_true_score(seed: int):
    """If labels are drawn by the probabilities, IoU is within 0.06 of the expected IoU, and mIoU within 0.04."""
    one = _scored(seed)
    assert np.abs(iou_per_class(one.expected) - iou_per_class(one.counts)).max() < 0.06
    assert abs(expected_score(one.expected, np.zeros(CLASSES), *PLAIN).miou - mean_iou(one.counts)) < 0.04


@pytest.mark.parametrize("hotter", [0.5, 2.0])
def test_fitted_bias_corrects_miscalibrated_maps(hotter: float):
    """The bias of other maps of the same kind leaves a third of the error at most."""
    other = _scored(77, hotter)
    bias = fitted_bias([_scored(seed, hotter) for seed in range(6)])
    truth = mean_iou(other.counts)
    off = expected_score(other.expected, np.zeros(CLASSES), *PLAIN).miou - truth
    assert abs(off) > 0.03
    assert abs(expected_score(other.expected, bias, *PLAIN).miou - truth) < abs(off) / 3
    assert (bias > 0).all() == (hotter < 1)


def test_an_absent_class_has_no_bias():
    """The bias of a class without labels is 0, even if maps show it by mistake."""
    one = _scored(3)
    counts = one.counts.copy()
    counts[2] = 0
    assert fitted_bias([ScoredMap(counts, one.expected)])[2] == 0


@pytest.mark.parametrize(
    ("mapped", "half", "step", "exposure_ms"), [(0, 4738.0, 1, 100.0), (2, 8.94, 1, 100.0), (2, 28.8, 4, 3.0)]
)
def test_a_class_of_few_pixels_counts_by_its_probability(mapped: int, half: float, step: int, exposure_ms: float):
    """One expected pixel hardly moves the mean; ``half`` pixels count half: scattered, sure, or by a quick scan."""
    counts = np.diag([5000.0, 5000.0, 0.0])
    base = expected_score(counts, np.zeros(3), LEAST_ERROR, step, exposure_ms)
    assert base.miou > 0.99
    means, errors = [], []
    for pixels in (1.0, half, 5000.0):
        some = counts.copy()
        some[2, mapped] = pixels  # scattered: all of them mapped as something else
        told = expected_score(some, np.zeros(3), LEAST_ERROR, step, exposure_ms)
        means.append(told.miou)
        errors.append(told.error)
        assert np.isfinite(told.per_class_iou[2]) == (pixels > half)
    of_class, first = (0.995, 0.995) if mapped else (0.005, 5000 / (5000 + half))
    assert means[0] == pytest.approx(base.miou, abs=1e-3)
    assert means[1] == pytest.approx((first + 0.995 + 0.5 * of_class) / 2.5, abs=1e-3)
    assert (means[2] > 0.99) == bool(mapped)
    assert errors[1] > 4 * errors[0]


def test_an_empty_map_has_no_expected_score():
    """Without a pixel, score and error are NaN, not 0."""
    told = expected_score(np.zeros((3, 3)), np.zeros(3), *PLAIN)
    assert np.isnan(told.miou)
    assert np.isnan(told.error)


@given(st.integers(1, 5), st.integers(0, 3000), st.floats(0, 1), st.integers(1, 8), SEEDS)
def test_the_error_of_a_value_between_0_and_1_is_at_most_half(
    classes: int, pixels: int, sure: float, step: int, seed: int
) -> None:
    """Fields of one pixel, of one class, and of classes without a pixel, by slow and by quick scans."""
    fractions = np.random.default_rng(seed).dirichlet(np.full(classes, 0.3))
    counts = pixels * np.diag(fractions) * sure + pixels * np.outer(fractions, fractions) * (1 - sure)
    for exposure_ms in (3.0, 100.0):
        told = expected_score(counts, np.zeros(classes), LEAST_ERROR, step, exposure_ms)
        assert told.error <= 0.5 or (pixels == 0 and np.isnan(told.error))


@pytest.mark.parametrize(
    ("shape", "told"), [((0, 9), False), ((1, 1), False), ((16, 16), False), ((3, 200), False), ((45, 45), True)]
)
def test_few_pixels_have_no_expected_score(shape: tuple[int, int], told: bool) -> None:
    """Those without probabilities do not count, in a map of one class and in one of several."""
    rng = np.random.default_rng(3)
    for sure in (0.0, 60.0):
        said = rng.normal(size=(*shape, CLASSES)) + np.array([sure, 0, 0, 0])
        said = np.concatenate([said, np.full((100, shape[1], CLASSES), np.nan)])
        found = _scores().expected(
            expected_counts([said - np.log(np.exp(said).sum(-1, keepdims=True))], CLASSES), 1, 16
        )
        assert (found is not None) == told


def test_the_error_of_one_scene_is_the_least_error():
    """A single map is corrected by itself, which must not count as an error of 0."""
    assert error_of_passes([_scored(1)], 1, 100.0) == LEAST_ERROR


def test_the_error_of_passes_is_cross_validated():
    """Each of two maps is corrected by the bias of the other; the result is that worked out by hand."""
    one, other = _scored(1, 0.5), _scored(2, 2.0)
    pairs = ((one, other), (other, one))
    told = [(a, expected_score(a.expected, fitted_bias([b]), 0.0, 1, 100.0)) for a, b in pairs]
    off, explained = [said.miou - mean_iou(a.counts) for a, said in told], [said.error for _, said in told]
    by_hand = np.sqrt(np.mean(np.square(off) - np.square(explained)))
    assert by_hand > 0.05
    assert error_of_passes([one, other], 1, 100.0) == pytest.approx(by_hand)


def _scores() -> MapScores:
    maps = {(step, ms): [_scored(7 * step + k, 1 + 2 / ms) for k in range(3)] for step in (2, 1) for ms in (4.0, 64.0)}
    return MapScores.fitted(maps)


def test_scores_round_trip_through_a_record():
    """The record rounds bias and error."""
    scores = _scores()
    again = MapScores.read(scores.as_dict())
    assert (again.steps, again.exposures_ms, again.scenes) == ((1, 2), (4.0, 64.0), 3)
    assert np.allclose(again.bias, scores.bias, atol=1e-4)
    assert np.allclose(again.error, scores.error, atol=1e-5)


def test_scores_are_interpolated_by_the_logarithm_of_exposure():
    """16 ms lies halfway between 4 and 64 ms; the scores at the ends are those measured."""
    scores = _scores()
    counts = _scored(50).expected
    first, middle, last = (scores.expected(counts, 2, ms) for ms in (4.0, 16.0, 64.0))
    assert first.miou == expected_score(counts, scores.bias[1, 0], scores.error[1, 0], 2, 4.0).miou
    assert middle.miou == pytest.approx((first.miou + last.miou) / 2, abs=0.005)
    assert middle.miou != last.miou
    rounded = scores.expected(counts, 2, 3.96)  # exposures are rounded to a tenth of a millisecond
    assert rounded.miou == pytest.approx(first.miou, abs=1e-6)


@pytest.mark.parametrize(("step", "exposure_ms"), [(4, 16.0), (1, 3.9), (1, 65.0)])
def test_scans_beyond_those_measured_have_no_score(step: int, exposure_ms: float):
    """Other line spacings, shorter and longer exposures, and maps of other classes have no expected score."""
    scores = _scores()
    assert scores.expected(_scored(50).expected, step, exposure_ms) is None
    assert scores.expected(np.eye(CLASSES + 1), 1, 16.0) is None


@pytest.mark.parametrize("part", ["steps", "exposures_ms", "bias", "error", "scenes"])
def test_an_incomplete_record_is_refused(part: str):
    """Each part is needed, and tables have to fit the steps and exposures."""
    content = _scores().as_dict()
    with pytest.raises(KeyError, match=part):
        MapScores.read({name: value for name, value in content.items() if name != part})
    with pytest.raises(ValueError, match="scans"):
        MapScores.read(content | {"error": [[0.1]]})
