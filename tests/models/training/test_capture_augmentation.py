"""Capture augmentation: noise of columns by exposure against the camera's own law, and whitening with noise."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.models.network.spectral import LineSpec, Normalisation, SpectralBasis
from spectralzoom.models.training import capture_augmentation
from spectralzoom.models.training.capture_augmentation import (
    CaptureAugmentation,
    ColumnNoise,
    SceneSpectra,
    rows_between,
)
from spectralzoom.pipeline.geometry.camera import LineCamera, expose

BANDS = np.linspace(400.0, 1000.0, 60)
MATRIX, _ = SpectralBasis(400.0, 1000.0, 12).matrix(BANDS)
WHITE_REFERENCE_E = np.linspace(9000.0, 16000.0, 60)  # of a white reference of 1 at the reference exposure


def _noise(read_noise_e: float = 20.0) -> ColumnNoise:
    return ColumnNoise.of_bands(MATRIX, 1 / WHITE_REFERENCE_E, read_noise_e)


@pytest.mark.parametrize("light", [1.0, 0.12])
def test_covariance_is_that_of_camera_noise(light: float) -> None:
    """Shot and read noise of the camera, projected onto columns, have the predicted variance and correlation."""
    camera = LineCamera(electrons_per_dn=0.5, bits=14)  # finer than its noise, so that rounding adds nothing
    electrons = np.broadcast_to((0.3 * WHITE_REFERENCE_E * light).astype(np.float32), (200, 100, 60))
    seen = expose(electrons, camera, rng=np.random.default_rng(2)) / (WHITE_REFERENCE_E * light)
    drawn = np.cov((seen.reshape(-1, 60) @ MATRIX).T)
    np.testing.assert_allclose(np.diag(drawn), np.diag(_noise().covariance(np.full(12, 0.3), light)), rtol=0.06)
    size = np.sqrt(np.diag(drawn))
    np.testing.assert_allclose(drawn / np.outer(size, size), _noise().correlation(), atol=0.05)


@given(light=st.floats(1e-3, 1.0))
def test_more_light_is_less_noise(light: float) -> None:
    """Twice the light is better than the mean of two samples, which has half the variance."""
    one, two = (np.diag(_noise().covariance(np.full(12, 0.2), n * light)) for n in (1, 2))
    assert (two < one / 2).all()


def test_whitening_does_not_amplify_noise() -> None:
    """A direction with as much noise as signal is reduced by the root of two; others keep unit variance."""
    sample = np.random.default_rng(1).normal(size=(50_000, 2)) * [1.0, 1.0] @ np.array([[1.0, 1.0], [0.1, -0.1]])
    plain, told = Normalisation.measured(sample), Normalisation.measured(sample, np.diag([0.02, 0.02]))
    axes = np.array([[1, 1], [1, -1]]) / math.sqrt(2)
    sizes = [(one.apply(sample, np.ones(2, bool)) @ axes).std(axis=0) for one in (plain, told)]
    np.testing.assert_allclose(sizes[0], 1, atol=0.02)
    np.testing.assert_allclose(sizes[1], [1, math.sqrt(0.5)], atol=0.02)


def _augmentation(min_exposure_ms: float = 3.0) -> tuple[CaptureAugmentation, Normalisation]:
    normalisation = Normalisation.measured(0.3 + 0.05 * np.random.default_rng(5).normal(size=(4000, 12)))
    return CaptureAugmentation(normalisation, min_exposure_ms=min_exposure_ms), normalisation


def _flat(normalisation: Normalisation, value: float, shape: tuple[int, int]) -> np.ndarray:
    return normalisation.apply(np.full((*shape, 12), value, np.float32), np.ones(12, bool))


SILENT = ColumnNoise(np.zeros(12), np.zeros((12, 12)))


def _silent_scan(augmentation: CaptureAugmentation, columns: np.ndarray, step: int, light: float = 1.0) -> np.ndarray:
    """Return a scan without random noise."""
    return _seen(augmentation.scan, columns, SILENT, light=light, step=step, rng=np.random.default_rng(0))


def _seen(capture: Any, columns: np.ndarray, *args: Any, **choices: Any) -> np.ndarray:
    return capture(torch.from_numpy(columns.copy()), *args, **choices).numpy()


def test_rows_between_lines_are_interpolated_by_catmull_rom() -> None:
    """A row between lines depends on four of them; a row of a line equals that line, and the border repeats."""
    lines = np.zeros((8, 1, 1), np.float32)
    lines[4] = 1
    t = 0.25
    before, at, after, beyond = (
        np.array([-t + 2 * t**2 - t**3, 2 - 5 * t**2 + 3 * t**3, t + 4 * t**2 - 3 * t**3, t**3 - t**2]) / 2
    )
    seen = rows_between(torch.from_numpy(lines), 16, first=0.5, apart=2)[:, 0, 0].numpy()
    np.testing.assert_allclose(seen[4:14], [0, beyond, before, after, at, at, after, before, beyond, 0], atol=1e-6)
    ramp = np.arange(8, dtype=np.float32)[:, None, None]
    rows = rows_between(torch.from_numpy(ramp), 32, first=3, apart=4)[:, 0, 0].numpy()
    np.testing.assert_allclose(rows[7:28], (np.arange(7, 28) - 3) / 4, atol=1e-5)
    assert (rows[3::4] == np.arange(8)).all()
    assert (rows[:3] <= rows[3]).all()


@pytest.mark.parametrize("step", [1, 2, 4, 8])
def test_a_scan_averages_the_rows_of_each_line(step: int) -> None:
    """Without noise ramps stay ramps, and the order of the rows within a line does not matter."""
    augmentation, _ = _augmentation()
    ramp = np.broadcast_to(0.02 * np.arange(128)[:, None, None], (128, 2, 12)).astype(np.float32)
    inner = slice(3 * step, -3 * step)
    np.testing.assert_allclose(_silent_scan(augmentation, ramp, step)[inner, :, :12], ramp[inner], atol=1e-3)
    image = np.random.default_rng(1).normal(size=(32, 3, 12)).astype(np.float32)
    mixed = np.random.default_rng(2).permuted(image.reshape(-1, step, 36), axis=1).reshape(image.shape)
    seen = _silent_scan(augmentation, image, step)
    np.testing.assert_allclose(seen, _silent_scan(augmentation, mixed, step), atol=1e-4)
    assert (seen[..., 12:] == LineSpec(1.0, step).planes).all()
    if step == 1:
        np.testing.assert_allclose(seen[..., :12], image, atol=1e-4)


@pytest.mark.parametrize(("light", "step"), [(0.25, 1), (0.1, 2), (0.05, 4), (1.0, 4)])
def test_noise_of_a_scan_follows_its_light(light: float, step: int) -> None:
    """The variance added to a line is the law's at its light less what its pixels already had at the reference.

    A line of several pixels is read once for all of them; rows between lines have the noise of these lines.
    """
    augmentation, normalisation = _augmentation()
    noise = _noise()
    unwhiten = np.linalg.inv(normalisation.whitening.astype(np.float64))
    plain = _flat(normalisation, 0.3, (64, 1000))
    seen = _seen(augmentation.scan, plain, noise, light=light, step=step, rng=np.random.default_rng(6))
    assert (seen[..., 12:] == LineSpec(light, step).planes).all()
    one_line = np.zeros((64, 1, 12), np.float32)
    one_line[32 : 32 + step] = 1
    share = np.square(_silent_scan(augmentation, one_line, step)[..., 0]).sum() / step  # mean over rows, of the squares
    spectrum = np.full(12, 0.3)
    added = noise.variance(spectrum, light) - noise.variance(spectrum, 1.0) / step
    inner = seen[2 * step : -2 * step or None, :, :12] @ unwhiten * normalisation.spread
    np.testing.assert_allclose(inner.reshape(-1, 12).var(axis=0), added * share, rtol=0.08)


def _captures(planes: np.ndarray) -> list[LineSpec]:
    """Return the captures of an image, by its planes."""
    logarithms = np.unique(planes.reshape(-1, 3), axis=0) * [4, 2, 2]
    return [LineSpec(2**-light, round(2**step), round(2**binned)) for light, step, binned in logarithms]


def test_uniform_scans_have_every_spacing_and_light(monkeypatch: pytest.MonkeyPatch) -> None:
    """Both networks see one capture, whose exposure lies between the darkest and the reference."""
    monkeypatch.setattr(capture_augmentation, "INTERLACED", 0.0)
    augmentation, _ = _augmentation(12.0)
    rng = np.random.default_rng(4)
    found = []
    image = rng.normal(size=(32, 32, 12)).astype(np.float32)
    for _ in range(60):
        both = augmentation.draw(torch.from_numpy(image), SILENT, rng)
        assert both[0] is both[1]
        overview = both[0].numpy()
        (own,) = _captures(overview[..., 12:])
        np.testing.assert_allclose(overview, _silent_scan(augmentation, image, int(own.step), own.light), atol=1e-4)
        found.append(own)
    assert {own.step for own in found} == set(capture_augmentation.STEPS)
    light = np.array([own.light for own in found])
    assert 0.1199 < light.min() < 0.15
    assert 0.8 < light.max() < 1.0001


@pytest.mark.parametrize("step", [2, 4, 8])
def test_a_first_pass_keeps_its_own_rows(monkeypatch: pytest.MonkeyPatch, step: int) -> None:
    """Without areas every ``step``-th row is read unchanged; the first of them may be any row."""
    monkeypatch.setattr(capture_augmentation, "AREAS", (1.0,))
    augmentation, _ = _augmentation()
    image = np.random.default_rng(1).normal(size=(32, 5, 12)).astype(np.float32)
    begun = set()
    for seed in range(40):
        seen = _seen(augmentation.interlaced, image, SILENT, step=step, rng=np.random.default_rng(seed))
        same = np.isclose(seen[..., :12], image, atol=1e-4).all(axis=(1, 2))
        (first,) = {int(row) % step for row in np.flatnonzero(same)}
        assert same[first::step].all()
        (own,) = _captures(seen[..., 12:])
        assert own.step == step
        begun.add(first)
    assert begun == set(range(step))


def test_later_lines_lie_between_those_of_the_first_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    """In an area each line keeps its own exposure and noise; a pixel has the capture of its nearest line."""
    monkeypatch.setattr(capture_augmentation, "AREAS", (0.0, 1.0))
    monkeypatch.setattr(capture_augmentation, "ACROSS", 1.0)
    augmentation, normalisation = _augmentation(3.0)
    lights = iter([0.5, 0.05])
    monkeypatch.setattr(augmentation, "_light", lambda rng: next(lights))
    unwhiten = np.linalg.inv(normalisation.whitening.astype(np.float64))
    plain = _flat(normalisation, 0.3, (64, 2000))
    seen = _seen(augmentation.interlaced, plain, _noise(), step=8, rng=np.random.default_rng(8))
    captures = {(round(own.light, 3), own.step) for own in _captures(seen[..., 12:])}
    closer = min(step for _, step in captures)
    assert captures == {(0.5, 8), (0.5, closer), (0.05, closer)}
    values = (seen[..., :12] - plain) @ unwhiten * normalisation.spread
    for light in (0.5, 0.05):
        rows = (seen[..., 12:] == LineSpec(light, closer).planes).all(axis=(1, 2))
        told = _noise().variance(np.full(12, 0.3), light) - _noise().variance(np.full(12, 0.3), 1.0)
        np.testing.assert_allclose(values[rows].var(axis=1).max(axis=0), told, rtol=0.15)  # rows of lines have the most


def _spectra(rng: np.random.Generator, sizes: tuple[float, ...], light: float) -> tuple[np.ndarray, ColumnNoise]:
    """Return spectra (200, 100, band) about .3, in smooth directions of some times the noise, and this noise."""
    bumps = np.exp(-0.5 * ((BANDS - np.linspace(430, 970, len(sizes))[:, None]) / 60) ** 2)
    sigma = np.sqrt(0.3 * light * WHITE_REFERENCE_E + 20.0**2) / (light * WHITE_REFERENCE_E)
    axes = np.linalg.qr(bumps.T)[0].T * np.array(sizes)[:, None] * sigma
    spectra = 0.3 + rng.normal(size=(200, 100, len(sizes))) @ axes
    moments = SceneSpectra(np.full(60, 0.3), axes.T @ axes, MATRIX, 1 / WHITE_REFERENCE_E, 20.0)
    return spectra, replace(_noise(), spectra=moments)


@pytest.mark.parametrize(("light", "rtol"), [(0.1, 0.04), (0.5, 0.25)])
def test_a_condensed_crop_has_the_noise_of_a_condensed_survey(light: float, rtol: float) -> None:
    """Noisy spectra, projected onto their components and rounded, give columns of the same covariance.

    Weak components in bright light fit worse: columns of the reference exposure have noise too.
    """
    rng = np.random.default_rng(3)
    augmentation, normalisation = _augmentation()
    spectra, noise = _spectra(rng, (30.0, 5.0, 1.0, 0.3), light)
    sigma = np.sqrt(np.sum(noise.spectra.noise(light), axis=0))
    axes = np.linalg.eigh(noise.spectra.covariance / np.outer(sigma, sigma))[1][:, ::-1][:, :4]
    reference = np.sum(noise.spectra.noise(1.0), axis=0)  # the crop has this noise already
    more = np.sqrt(sigma**2 - reference)
    noisy = spectra + more * rng.normal(size=spectra.shape)
    surveyed = 0.3 + (np.rint((noisy - 0.3) / sigma @ axes) @ axes.T) * sigma
    crop = normalisation.apply(spectra @ MATRIX, np.ones(12, bool))
    seen = _seen(augmentation.scan, crop, noise, light=light, step=1, rng=rng, least_power=0.01)[..., :12]
    columns = seen @ augmentation.unwhiten * normalisation.spread + normalisation.centre
    added, wanted = (np.cov((one - spectra @ MATRIX).reshape(-1, 12).T) for one in (columns, surveyed @ MATRIX))
    np.testing.assert_allclose(np.diag(added), np.diag(wanted), rtol=rtol)
    np.testing.assert_allclose(np.linalg.eigvalsh(added)[:8], 0, atol=1e-3 * np.linalg.eigvalsh(added)[-1])


@pytest.mark.parametrize(("least_power", "left"), [(0.01, 5), (0.5, 4), (40.0, 4)])
def test_a_condensed_crop_keeps_components_above_a_power(least_power: float, left: int) -> None:
    """The fifth component is dropped if its power is below the limit; four always stay."""
    rng = np.random.default_rng(4)
    light = 0.1
    augmentation, normalisation = _augmentation()
    spectra, noise = _spectra(rng, (30.0, 5.0, 3.0, 2.0, 0.5), light)
    crop = normalisation.apply(spectra @ MATRIX, np.ones(12, bool))
    seen = _seen(augmentation.scan, crop, noise, light=light, step=1, rng=rng, least_power=least_power)[..., :12]
    power = np.linalg.eigvalsh(np.cov((seen @ augmentation.unwhiten * normalisation.spread).reshape(-1, 12).T))
    assert np.count_nonzero(power > 1e-6 * power[-1]) == left


def test_later_lines_share_the_components_of_the_first_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lines of several exposures vary in the same four directions."""
    monkeypatch.setattr(capture_augmentation, "AREAS", (0.0, 1.0))
    rng = np.random.default_rng(6)
    augmentation, normalisation = _augmentation()
    spectra, noise = _spectra(rng, (30.0, 5.0, 3.0, 2.0), 0.1)
    crop = normalisation.apply(spectra[:64, :64] @ MATRIX, np.ones(12, bool))
    seen = _seen(augmentation.interlaced, crop, noise, step=4, rng=rng, least_power=0.05)
    assert len(_captures(seen[..., 12:])) > 1
    columns = seen[..., :12] @ augmentation.unwhiten * normalisation.spread
    power = np.linalg.eigvalsh(np.cov(columns.reshape(-1, 12).T))
    assert np.count_nonzero(power > 1e-6 * power[-1]) == 4
