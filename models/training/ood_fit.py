"""Fit the out-of-distribution detector: components of training spectra, and limits by validation scenes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import NDArray

from models.network.ood import Exact, Limits, OodDetector
from models.network.spectral import Normalisation
from models.training.capture_augmentation import REFERENCE_MS, STEPS, CaptureAugmentation, ColumnNoise
from models.training.examples import Example
from pipeline.errors import SceneError
from pipeline.geometry.grid import UNLABELLED

OF_A_CLASS = 6  # components
SPECTRA = 40_000  # of each class in all training scenes, to fit components to
RATES = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05)
LIGHT = (0.03, 0.06, 0.12, 0.25, 0.5, 1.0)  # fractions of the reference exposure
GAIN = 0.04  # standard deviation of the brightness of crops in training
USUAL = 0.98  # fraction of a component's spectra within its unit distance
LEAST_SPECTRA = 200  # least number to fit to
RIDGE = 1e-6  # of the mean variance: makes the covariance of equal columns invertible
Spectra = NDArray[np.float32]  # (pixel, column)
Classes = NDArray[np.uint8]  # (pixel,)


def fit_ood(
    train: Sequence[Example],
    validation: Sequence[Example],
    normalisation: Normalisation,
    *,
    min_exposure_ms: float,
    bands: int,
    seed: int,
    report: Callable[[float], None] = lambda done: None,
) -> OodDetector:
    """Fit components to training scenes, and limits to validation scenes, at the exposures of the training.

    ``bands`` are those of the camera. Raises SceneError: no validation scene, or too few labelled pixels.
    """
    if not validation:
        raise SceneError(
            "no scene was kept for validation, which the false-alarm rate needs; train with --validation 1 or more"
        )
    rng = np.random.default_rng([seed, 0xFA3])
    augmentation = CaptureAugmentation(normalisation, min_exposure_ms=min_exposure_ms)
    gathered = []
    for number, example in enumerate(train):
        gathered += _drawn_spectra(example, normalisation, rng, SPECTRA // len(train) + 1)
        report(0.3 * (number + 1) / len(train))
    pixels, classes = (np.concatenate(parts) for parts in zip(*gathered, strict=True))
    centres, covariance = components(pixels, classes, seed)
    noises = [example.noise for example in train if example.noise is not None]
    noises = noises or [ColumnNoise(np.zeros(pixels.shape[1]), np.zeros((pixels.shape[1], pixels.shape[1])))]
    noise = ColumnNoise(np.mean([one.shot for one in noises], axis=0), np.mean([one.read for one in noises], axis=0))
    shot, read = _noise_of_columns(noise, centres, normalisation)
    nothing = Limits(np.ones(1), np.ones(1), (1,), np.zeros((1, 1, 1)))
    draft = OodDetector(centres, covariance, shot, read, nothing, bands)
    limits = measured_limits(draft, validation, augmentation, rng, lambda done: report(0.5 + done / 2))
    return replace(draft, limits=limits)


def _noise_of_columns(noise: ColumnNoise, centres: Exact, normalisation: Normalisation) -> tuple[Exact, Exact]:
    """Return shot noise (component, column, column) and read noise of normalised columns at the reference exposure."""
    whitening = normalisation.whitening.astype(np.float64)
    values = centres @ np.linalg.inv(whitening) * normalisation.spread + normalisation.centre
    mixing = whitening / normalisation.spread[:, None]
    sizes = np.sqrt(np.maximum(values, 0) * noise.shot)
    shot = np.stack([mixing.T @ (noise.correlation() * np.outer(one, one)) @ mixing for one in sizes])
    return shot, mixing.T @ noise.read @ mixing


def _drawn_spectra(
    example: Example, normalisation: Normalisation, rng: np.random.Generator, most: int
) -> list[tuple[Spectra, Classes]]:
    """Draw labelled pixels of a scene, at most ``most`` of each class, with the brightness jitter of training."""
    gain = np.float32(rng.normal(1.0, GAIN))
    image = np.asarray(example.columns, np.float32) * gain + (gain - 1) * normalisation.gain_shift
    parts = []
    for number in np.unique(example.labels[example.labels != UNLABELLED]):
        own = image[example.labels == number]
        chosen = own[rng.choice(len(own), min(most, len(own)), replace=False)]
        parts.append((chosen, np.full(len(chosen), number, np.uint8)))
    return parts


def components(pixels: Spectra, classes: Classes, seed: int) -> tuple[Exact, Exact]:
    """Return means and covariances of components of spectra (pixel, column), by k-means in each class.

    Spectra belong to the nearest mean of any class. The covariance of a small component is shrunk towards the common
    one. It is widened until `USUAL` of its spectra have at most the expected distance of a normal distribution. Raises
    SceneError: too few spectra.
    """
    if len(pixels) < LEAST_SPECTRA:
        raise SceneError(f"{len(pixels)} labelled pixels are too few to fit a detector; it takes {LEAST_SPECTRA}")
    exact = pixels.astype(np.float64)
    columns = pixels.shape[1]
    middles = []
    for number in np.unique(classes):
        own = exact[classes == number]
        count = min(OF_A_CLASS, 1 + len(own) // (4 * columns))
        rng = np.random.default_rng(seed + int(number))
        middles.append(scipy.cluster.vq.kmeans2(own, count, minit="++", rng=rng)[0])
    first = np.concatenate(middles)
    near = (exact @ first.T - 0.5 * (first**2).sum(axis=1)).argmax(axis=1)
    parts = [exact[near == number] for number in np.unique(near)]
    centres = [part.mean(axis=0) for part in parts]
    scatter = [(part - middle).T @ (part - middle) for part, middle in zip(parts, centres, strict=True)]
    common = np.sum(scatter, axis=0) / len(pixels)
    common += (RIDGE * float(np.trace(common)) / columns or RIDGE) * np.eye(columns)
    weight = 2.0 * columns  # of the common covariance, in spectra
    covariance = []
    for part, middle, own in zip(parts, centres, scatter, strict=True):
        mixed = (own + weight * common) / (len(part) + weight)
        apart = scipy.linalg.solve_triangular(np.linalg.cholesky(mixed), (part - middle).T, lower=True)
        covariance.append(mixed * max(float(np.quantile((apart**2).sum(axis=0), USUAL)) / columns, 1.0))
    return np.stack(centres), np.stack(covariance)


def measured_limits(
    ood_detector: OodDetector,
    examples: Sequence[Example],
    augmentation: CaptureAugmentation,
    rng: np.random.Generator,
    report: Callable[[float], None] = lambda done: None,
) -> Limits:
    """Return quantiles of the distances of labelled pixels, for each line spacing and exposure."""
    noisy = all(example.noise is not None for example in examples)
    light = [one for one in LIGHT if one * REFERENCE_MS >= augmentation.min_exposure_ms] if noisy else [1.0]
    varied = noisy and augmentation.min_exposure_ms < REFERENCE_MS
    steps = tuple(step for step in STEPS if all(len(one.labels) % step == 0 for one in examples)) if varied else (1,)
    fine = np.empty((len(steps), len(light), len(RATES)))
    for j, fraction in enumerate(light):
        for i, step in enumerate(steps):
            distances = []
            for one in examples:
                pixels = np.asarray(one.columns, np.float32)
                if one.noise is not None:
                    pixels = augmentation.scanned(pixels, one.noise, light=fraction, step=step, rng=rng)
                distances.append(ood_detector.lit(fraction).distance(pixels[one.labels != UNLABELLED]))
            fine[i, j] = np.quantile(np.concatenate(distances).astype(np.float64), 1 - np.array(RATES))
            report((j * len(steps) + i + 1) / (len(steps) * len(light)))
    return Limits(np.array(RATES), np.array(light), steps, fine)
