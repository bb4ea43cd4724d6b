"""Calibration: the gap between confidence and accuracy of maps, and the one temperature that closes it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from models.evaluation.metrics import CONFIDENCE_BINS, calibration_error, confidence_counts
from pipeline.geometry.grid import UNLABELLED

BAD_ERROR = 0.02  # expected calibration error from which on a temperature is fitted
COOLEST, HOTTEST = 0.2, 5.0
PIXELS = 20_000  # of a scene, drawn by chance, that a temperature is fitted on


@dataclass(frozen=True)
class JudgedMap:
    """Log-probabilities of the pixels of a map that have a label."""

    log_probability: NDArray[np.float32]  # (pixel, class)
    labels: NDArray[np.uint8]  # (pixel,)

    @staticmethod
    def of(log_probability: NDArray[np.float32], labels: NDArray[np.uint8]) -> JudgedMap:
        """Take the labelled pixels of (y, x, class) and (y, x)."""
        fit = (labels != UNLABELLED) & np.isfinite(log_probability[..., 0])
        return JudgedMap(log_probability[fit], labels[fit])


def judge_confidence(maps: list[JudgedMap], seed: int) -> dict[str, Any]:
    """Expected calibration error of maps, 0..1, for a record; with a ``temperature`` where it is bad.

    The temperature divides logits, which leaves the likeliest class what it is. It is the one under which the labels of
    these maps are likeliest; ``expected_error_before`` is then the error without it.
    """
    error = _error(maps, 1.0)
    fit: dict[str, Any] = {"scenes": len(maps), "expected_error": error}
    if not error > BAD_ERROR:
        return fit
    temperature = fitted_temperature(maps, seed)
    return fit | {
        "expected_error": _error(maps, temperature),
        "expected_error_before": error,
        "temperature": temperature,
    }


def fitted_temperature(maps: list[JudgedMap], seed: int) -> float:
    """The temperature under which labels are likeliest."""
    rng = np.random.default_rng([seed, 0x7E3])
    drawn = [rng.choice(len(one.labels), min(PIXELS, len(one.labels)), replace=False) for one in maps]
    values = np.concatenate([one.log_probability[i] for one, i in zip(maps, drawn, strict=True)]).astype(np.float64)
    labels = np.concatenate([one.labels[i] for one, i in zip(maps, drawn, strict=True)])

    def loss(log_temperature: float) -> float:
        fit = scipy.special.log_softmax(values / np.exp(log_temperature), axis=1)
        return float(-fit[np.arange(len(labels)), labels].mean())

    bounds = np.log(COOLEST), np.log(HOTTEST)
    return float(np.exp(scipy.optimize.minimize_scalar(loss, bounds=bounds, method="bounded").x))


def _error(maps: list[JudgedMap], temperature: float) -> float:
    counts = np.zeros((3, CONFIDENCE_BINS))
    for one in maps:
        probability = scipy.special.softmax(one.log_probability / np.float32(temperature), axis=1)
        counts += confidence_counts(probability.max(axis=1), probability.argmax(axis=1) == one.labels)
    return calibration_error(counts)
