"""Noise of columns by exposure, against draws of the camera's own law, and whitening that knows it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.network.spectral import LineSpec, Normalisation, SpectralBasis
from models.training import capture_augmentation
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


def _augmentation(darkest_ms: float = 3.0) -> tuple[CaptureAugmentation, Normalisation]:
    rng = np.random.default_rng(5)
    normalisation = Normalisation.measured(0.3 + 0.05 * rng.normal(size=(4000, 12)))
    return CaptureAugmentation(normalisation, darkest_ms=darkest_ms), normalisation


def _flat(normalisation: Normalisation, value: float, shape: tuple[int, int]) -> np.ndarray:
    return normalisation.apply(np.full((*shape, 12), value, np.float32), np.ones(12, bool))


SILENT = ColumnNoise(np.zeros(12), np.zeros((12, 12)))


def _silent_scan(augmentation: CaptureAugmentation, columns: np.ndarray, step: int) -> np.ndarray:
    """A scan in which nothing is drawn by chance."""
    return augmentation.scan(columns, SILENT, light=1.0, step=step, rng=np.random.default_rng(0))


def test_rows_between_two_lines_are_interpolated_by_their_cubic() -> None:
    """Lines two rows apart lie between two rows each, which see four lines by Catmull-Rom a quarter of the way."""
    augmentation, _ = _augmentation()
    image = np.zeros((32, 1, 12), np.float32)
    image[16:18] = 1  # one line
    t = 0.25
    before, at, after, beyond = (
        np.array([-t + 2 * t**2 - t**3, 2 - 5 * t**2 + 3 * t**3, t + 4 * t**2 - 3 * t**3, t**3 - t**2]) / 2
    )
    seen = _silent_scan(augmentation, image, 2)[..., :12]
    expected = [0, beyond, before, after, at, at, after, before, beyond, 0]
    np.testing.assert_allclose(seen[12:22, 0, 0], expected, atol=1e-6)


@pytest.mark.parametrize("step", [1, 2, 4, 8])
def test_a_scan_shows_means_as_wide_as_its_lines(step: int) -> None:
    """In full light every line is read as it is, what is alike stays, ramps stay ramps, and rows of a line mix."""
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
def test_a_scan_is_as_noisy_as_its_light_makes_it(light: float, step: int) -> None:
    """What is added to a line is the law's variance at its light less what its pixels already had at the reference.

    A line of several pixels is read once, for all of them; rows between lines have the noise of those they are of.
    """
    augmentation, normalisation = _augmentation()
    noise, unwhiten = _noise(), np.linalg.inv(normalisation.whitening.astype(np.float64))
    plain = _flat(normalisation, 0.3, (64, 1000))
    seen = augmentation.scan(plain, noise, light=light, step=step, rng=np.random.default_rng(6))
    assert (seen[..., 12:] == LineSpec(light, step).planes).all()
    one_line = np.zeros((64, 1, 12), np.float32)
    one_line[32 : 32 + step] = 1
    share = np.square(_silent_scan(augmentation, one_line, step)[..., 0]).sum() / step  # mean over rows, of the squares
    spectrum = np.full(12, 0.3)
    added = noise.variance(spectrum, light) - noise.variance(spectrum, 1.0) / step
    inner = seen[2 * step : -2 * step or None, :, :12] @ unwhiten * normalisation.spread
    np.testing.assert_allclose(inner.reshape(-1, 12).var(axis=0), added * share, rtol=0.08)


def test_a_coarse_pass_repeats_means_that_are_read_four_times() -> None:
    """Each 4 x 4 pixels are alike, their mean in silence; noise is that of four readings less that of their pixels."""
    augmentation, normalisation = _augmentation()
    image, unwhiten = np.random.default_rng(1).normal(size=(16, 24, 12)).astype(np.float32), augmentation.unwhiten
    seen = augmentation.coarse_pass(image, SILENT, light=0.5, rng=np.random.default_rng(0))
    means = image.reshape(4, 4, 6, 4, 12).mean(axis=(1, 3))
    np.testing.assert_allclose(seen[..., :12], means.repeat(4, 0).repeat(4, 1), atol=1e-4)
    assert (seen[..., 12:] == LineSpec(0.5, 4, 4).planes).all()
    noise, plain = _noise(), _flat(normalisation, 0.3, (400, 400))
    seen = augmentation.coarse_pass(plain, noise, light=0.1, rng=np.random.default_rng(3))
    pixels = seen.reshape(100, 4, 100, 4, 15)
    assert (pixels == pixels[:, :1, :, :1]).all()
    told = (pixels[:, 0, :, 0, :12] @ unwhiten * normalisation.spread).reshape(-1, 12).var(axis=0)
    spectrum = np.full(12, 0.3)
    added = noise.variance(spectrum, 0.1) / 4 - noise.variance(spectrum, 1.0) / 16
    np.testing.assert_allclose(told, added, rtol=0.08)


def _drawn(kind: int, monkeypatch: pytest.MonkeyPatch) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """An image, and what is shown of it to the overview and the full network, of many captures of one kind."""
    monkeypatch.setattr(capture_augmentation, "KINDS_OF_CAPTURE", np.eye(3)[kind])
    augmentation, _ = _augmentation(12.0)
    rng = np.random.default_rng(4)
    image = rng.normal(size=(32, 32, 12)).astype(np.float32)
    return [(image, *augmentation.draw(image, SILENT, rng)) for _ in range(60)]


def _captures(planes: np.ndarray) -> list[LineSpec]:
    """The captures of an image, by its planes."""
    logarithms = np.unique(planes.reshape(-1, 3), axis=0) * [4, 2, 2]
    return [LineSpec(2**-light, round(2**step), round(2**binned)) for light, step, binned in logarithms]


def test_uniform_scans_have_every_spacing_and_light(monkeypatch: pytest.MonkeyPatch) -> None:
    """Both networks see one capture, whose exposure lies between the darkest and the reference."""
    augmentation, found = _augmentation()[0], []
    for image, overview, detail in _drawn(capture_augmentation.UNIFORM, monkeypatch):
        assert detail is overview
        (own,) = _captures(overview[..., 12:])
        scan = _silent_scan(augmentation, image, int(own.step))
        np.testing.assert_allclose(overview[..., :12], scan[..., :12], atol=1e-4)
        found.append(own)
    assert {own.step for own in found} == set(capture_augmentation.STEPS)
    light = np.array([own.light for own in found])
    assert 0.1199 < light.min() < 0.15
    assert 0.8 < light.max() < 1.0001


def test_lines_between_others_are_a_second_capture_beside_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a rectangle of whole lines there are finer ones, in a light of their own; around it nothing changes."""
    augmentation, both = _augmentation()[0], 0
    for image, overview, detail in _drawn(capture_augmentation.INTERLACED, monkeypatch):
        assert detail is overview
        planes = overview[..., 12:]
        finest = planes[..., 1].min()
        inside = (planes != planes[np.unravel_index(planes[..., 1].argmax(), (32, 32))]).any(axis=-1)
        captures = _captures(planes)
        wide = max(int(own.step) for own in captures)
        expected = _silent_scan(augmentation, image, wide)[..., :12]
        if inside.any():
            both += 1
            rows, columns = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
            part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
            assert inside[part].all()
            assert rows[0] % wide == columns[0] % wide == len(rows) % wide == len(columns) % wide == 0
            fine = min(int(own.step) for own in captures)
            assert wide % fine == 0
            assert fine < wide
            assert finest == LineSpec(step=fine).planes[1]
            expected[part] = _silent_scan(augmentation, image[part], fine)[..., :12]
            assert len(captures) == 2
        np.testing.assert_allclose(overview[..., :12], expected, atol=1e-4)
    assert both > 10


def test_two_passes_show_the_overview_binned_pixels_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """The full network sees a scan of its own, of the same place."""
    augmentation = _augmentation()[0]
    for image, overview, detail in _drawn(capture_augmentation.TWO_PASSES, monkeypatch)[:10]:
        (coarse,), (fine,) = _captures(overview[..., 12:]), _captures(detail[..., 12:])
        assert (coarse.step, coarse.binned, fine.binned) == (4, 4, 1)
        means = image.reshape(8, 4, 8, 4, 12).mean(axis=(1, 3)).repeat(4, 0).repeat(4, 1)
        np.testing.assert_allclose(overview[..., :12], means, atol=1e-4)
        scan = _silent_scan(augmentation, image, int(fine.step))
        np.testing.assert_allclose(detail[..., :12], scan[..., :12], atol=1e-4)
