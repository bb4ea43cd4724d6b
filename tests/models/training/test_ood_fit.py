"""Fitting the out-of-distribution detector and the temperature on scenes of Gaussian spectra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from models.evaluation.metrics import JudgedMap, fitted_temperature, judge_confidence
from models.network.spectral import LineSpec, Normalisation
from models.training.capture_augmentation import ColumnNoise
from models.training.examples import Example
from models.training.ood_fit import components, fit_ood
from pipeline.errors import SceneError

COLUMNS = 3
PLAIN = Normalisation(*(np.zeros(COLUMNS, np.float32), np.ones(COLUMNS, np.float32), np.eye(COLUMNS, dtype=np.float32)))


def scene(seed: int, side: int = 48) -> Example:
    """Return a scene of two classes of Gaussian spectra, one of them rare, with the noise of a camera."""
    labels = np.zeros((side, side), np.uint8)
    labels[:, -side // 8 :] = 1
    labels[:2, :2] = 255
    middles = np.array([[1.0, 2.0, 3.0], [3.0, 2.0, 1.0], [50.0, 50.0, 50.0]])
    columns = middles[np.minimum(labels, 2)] + 0.1 * np.random.default_rng(seed).standard_normal((side, side, COLUMNS))
    noise = ColumnNoise(np.full(COLUMNS, 1e-5), 1e-6 * np.eye(COLUMNS))
    return Example(f"{seed}", columns.astype(np.float16), labels, labels.shape, noise)


def test_known_spectra_are_unknown_at_the_stated_rate() -> None:
    """The scenes were not used for the fit; spectra of no class, also of unlabelled pixels, are unknown."""
    fitted, validated = ([scene(i) for i in numbers] for numbers in (range(4), range(10, 13)))
    ood_detector = fit_ood(fitted, validated, PLAIN, min_exposure_ms=3.0, bands=9, seed=0)
    fresh = np.concatenate([scene(i).columns[4:].reshape(-1, COLUMNS) for i in range(20, 26)])
    assert 0.004 < ood_detector.unknown(fresh, rate=0.01, capture=LineSpec(), bands=9).mean() < 0.02
    out_of_range = np.array([[2.0, 0.0, 2.0], [3.0, 3.0, 3.0], [50.0, 50.0, 50.0], [1.0, 4.0, 3.0]])
    assert ood_detector.unknown(out_of_range, rate=0.01, capture=LineSpec(), bands=9).all()


def test_every_capture_that_training_shows_has_limits() -> None:
    """Limits cover each spacing and light, down to the darkest; without known noise only one of each."""
    given = [scene(0)], [scene(1, 40)], PLAIN
    limits = fit_ood(*given, min_exposure_ms=12.0, bands=9, seed=0).limits
    assert (limits.steps, limits.light.tolist()) == ((1, 2, 4, 8), [0.12, 0.25, 0.5, 1.0])
    assert limits.fine.shape == (4, 4, 7)
    assert (np.diff(limits.fine, axis=-1) <= 0).all()
    silent = [[replace(one, noise=None) for one in some] for some in given[:2]]
    bare = fit_ood(silent[0], silent[1], PLAIN, min_exposure_ms=12.0, bands=9, seed=0).limits
    assert (bare.steps, bare.light.tolist(), bare.fine.shape) == ((1,), [1.0], (1, 1, 7))


def test_fit_needs_validation_scenes() -> None:
    """Without them the rate of known pixels that are called unknown cannot be measured."""
    with pytest.raises(SceneError, match="no scene was kept"):
        fit_ood([scene(0)], [], PLAIN, min_exposure_ms=3.0, bands=9, seed=0)


def test_repeated_columns_have_an_invertible_covariance() -> None:
    """The centres are those of the data; a class of one pixel is allowed."""
    one = np.random.default_rng(0).normal(0, 1, (400, 1))
    pixels = np.concatenate([one, one, np.ones((400, 1))], axis=1).astype(np.float32)
    classes = np.zeros(400, np.uint8)
    classes[-1] = 1
    centres, covariance = components(pixels, classes, 0)
    assert np.isfinite(np.linalg.cholesky(covariance)).all()
    np.testing.assert_allclose(centres[:, 2], 1)


def judged(sharpness: float, seed: int = 0) -> JudgedMap:
    """Return maps whose labels are drawn from the probabilities, with logits ``sharpness`` times as large."""
    rng = np.random.default_rng(seed)
    logits = rng.normal(0, 2, (6000, 4))
    odds = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
    labels = (rng.random((6000, 1)) > odds.cumsum(axis=1)).sum(axis=1).astype(np.uint8)
    told = sharpness * logits
    return JudgedMap((told - np.log(np.exp(told).sum(axis=1, keepdims=True))).astype(np.float32), labels)


def test_temperature_corrects_the_confidence_of_maps() -> None:
    """The temperature is within 10 % of the factor of the logits, and the calibration error falls below 0.02."""
    told = judge_confidence([judged(2.5)], seed=0)
    assert told["temperature"] == pytest.approx(2.5, rel=0.1)
    assert told["expected_error"] < 0.02 < told["expected_error_before"]
    assert fitted_temperature([judged(0.5, 1)], 0) == pytest.approx(0.5, rel=0.1)
