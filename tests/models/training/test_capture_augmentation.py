"""Noise of columns by exposure, against draws of the camera's own law, and whitening that knows it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.network.spectral import Normalisation, SpectralBasis
from models.training.capture_augmentation import CaptureAugmentation, ColumnNoise
from pipeline.geometry.camera import LineCamera, expose

BANDS = np.linspace(400.0, 1000.0, 60)
BASIS = SpectralBasis(400.0, 1000.0, 12)
MATRIX, _ = BASIS.matrix(BANDS)
WHITE_REFERENCE_E = np.linspace(9000.0, 16000.0, 60)  # of a white reference of 1 at the reference exposure


def _noise(read_noise_e: float = 20.0) -> ColumnNoise:
    return ColumnNoise.of_bands(MATRIX, 1 / WHITE_REFERENCE_E, read_noise_e)


@pytest.mark.parametrize("light", [1.0, 0.12])
def test_variance_is_that_of_the_camera(light: float) -> None:
    """Shot and read noise that the camera draws, projected onto columns, have the variance and correlation said."""
    camera = LineCamera(electrons_per_dn=0.5, bits=14)  # finer than its noise, so that rounding adds nothing
    electrons = np.broadcast_to((0.3 * WHITE_REFERENCE_E * light).astype(np.float32), (200, 100, 60))
    seen = expose(electrons, camera, step=1, rng=np.random.default_rng(2)) / (WHITE_REFERENCE_E * light)
    drawn = np.cov((seen.reshape(-1, 60) @ MATRIX).T)
    told = _noise().covariance(np.full(12, 0.3), light)
    np.testing.assert_allclose(np.diag(drawn), np.diag(told), rtol=0.06)
    size = np.sqrt(np.diag(drawn))
    np.testing.assert_allclose(drawn / np.outer(size, size), _noise().correlation(), atol=0.05)


@given(light=st.floats(1e-3, 1.0), samples=st.integers(1, 64))
def test_more_light_and_more_samples_are_less_noise(light: float, samples: int) -> None:
    """Twice the light is better than the mean of two samples, which is just half the variance."""
    noise, spectrum = _noise(), np.full(12, 0.2)
    one = np.diag(noise.covariance(spectrum, light, samples))
    np.testing.assert_allclose(np.diag(noise.covariance(spectrum, light, 2 * samples)), one / 2, rtol=1e-12)
    assert (np.diag(noise.covariance(spectrum, 2 * light, samples)) < one / 2).all()


def test_whitening_leaves_alone_what_noise_hides() -> None:
    """A direction whose variance noise exceeds is made smaller, by what noise adds; others stay as they are."""
    rng = np.random.default_rng(1)
    sample = rng.normal(size=(50_000, 2)) * [1.0, 1.0] @ np.array([[1.0, 1.0], [0.1, -0.1]])
    plain, told = Normalisation.measured(sample), Normalisation.measured(sample, np.diag([0.02, 0.02]))
    sizes = [
        (one.apply(sample, np.ones(2, bool)) @ np.array([[1, 1], [1, -1]]) / math.sqrt(2)).std(axis=0)
        for one in (plain, told)
    ]
    np.testing.assert_allclose(sizes[0], 1, atol=0.02)
    np.testing.assert_allclose(sizes[1], [1, math.sqrt(0.5)], atol=0.02)


def _augmentation() -> tuple[CaptureAugmentation, Normalisation]:
    rng = np.random.default_rng(5)
    normalisation = Normalisation.measured(0.3 + 0.05 * rng.normal(size=(4000, 12)))
    return CaptureAugmentation(normalisation), normalisation


def _flat(normalisation: Normalisation, value: float, shape: tuple[int, int]) -> np.ndarray:
    return normalisation.apply(np.full((*shape, 12), value, np.float32), np.ones(12, bool))


@pytest.mark.parametrize(("light", "step"), [(0.25, 1), (0.1, 1), (0.1, 2), (0.05, 4), (0.9, 2), (1.0, 4)])
def test_a_scan_is_as_noisy_as_its_light_makes_it(light: float, step: int) -> None:
    """What is added to a line is the law's variance at its light less what its pixels already had at the reference.

    A line of several pixels is read once, for all of them; coarse pixels are means over as many of its readings.
    """
    augmentation, normalisation = _augmentation()
    noise, unwhiten = _noise(), np.linalg.inv(normalisation.whitening.astype(np.float64))
    plain = _flat(normalisation, 0.3, (256, 256))
    fine, means = augmentation.scan(plain, noise, 4, light=light, step=step, rng=np.random.default_rng(6))
    spectrum = np.full(12, 0.3)
    added = noise.variance(spectrum, light) - noise.variance(spectrum, 1.0) / step
    for seen, readings in ((means, 16 / step), *(((fine, 1.0),) if step == 1 else ())):
        told = (seen @ unwhiten * normalisation.spread).reshape(-1, 12).var(axis=0)
        np.testing.assert_allclose(told, added / readings, rtol=0.08)


@pytest.mark.parametrize("step", [1, 2, 4])
def test_a_scan_in_full_light_shows_the_scene_as_wide_as_its_lines(step: int) -> None:
    """Ramps stay ramps where light is that of the reference, away from the border; coarse pixels are their means."""
    augmentation, normalisation = _augmentation()
    ramp = np.broadcast_to(0.2 + 0.001 * np.arange(64)[:, None, None], (64, 8, 12)).astype(np.float32)
    plain = normalisation.apply(ramp, np.ones(12, bool))
    silent = ColumnNoise(np.zeros(12), 1e-18 * np.eye(12))
    fine, means = augmentation.scan(plain, silent, 4, light=1.0, step=step, rng=np.random.default_rng(7))
    inner = slice(2 * step, -2 * step)
    np.testing.assert_allclose(fine[inner], plain[inner], atol=2e-3)
    np.testing.assert_allclose(means, plain.reshape(16, 4, 2, 4, 12).mean(axis=(1, 3)), atol=2e-3)


def test_a_coarse_pass_is_read_as_often_as_it_has_samples() -> None:
    """In the light of the reference nothing is added to a scan of every line, nor to a coarse pass of its own."""
    _, normalisation = _augmentation()
    augmentation = CaptureAugmentation(normalisation, darkest_ms=100.0, steps={1: 1.0}, own_coarse=1.0)
    fine, coarse = _flat(normalisation, 0.3, (16, 16)), _flat(normalisation, 0.25, (4, 4))
    plain, own = augmentation.draw(fine, coarse, _noise(), 4, np.random.default_rng(8))
    np.testing.assert_allclose(plain, fine, atol=2e-3)
    np.testing.assert_allclose(own, coarse, atol=2e-3)
