"""The line camera: timing, rays, footprints, noise and saturation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.pipeline.geometry.camera import LineCamera, digitise, expose, footprint, footprint_kernel

CAMERA = LineCamera()


def test_defaults_describe_the_rig():
    """Pixels of 7.4 um behind 70 mm see 105.714 urad; a slit of 20 um is 2.70 px; 12 bits end at 4095."""
    assert CAMERA.ifov_rad == pytest.approx(105.714e-6, rel=1e-5)
    assert CAMERA.slit_px == pytest.approx(2.70, abs=0.005)
    assert CAMERA.full_scale_dn == 4095
    assert CAMERA.full_scale_e == (4095 - 64) * 5


@given(st.floats(0.01, 500), st.floats(0, 50), st.floats(1, 400))
def test_frame_period_respects_the_highest_rate(exposure: float, readout: float, rate: float):
    """The period is exposure plus readout, or the period of the highest rate if that is longer (erratum E13)."""
    camera = replace(CAMERA, exposure_ms=exposure, readout_ms=readout, max_rate_hz=rate)
    assert camera.frame_ms == max(exposure + readout, 1000 / rate)
    assert camera.scan_seconds(7) == pytest.approx(7 * camera.frame_ms / 1000)


@pytest.mark.parametrize("binning", [1, 2, 3, 4, 7])
def test_a_binned_ray_is_the_mean_of_its_samples(binning: int):
    """A binned sample looks along the mean slope of its samples. Unbinned rays are symmetric about the axis."""
    fine = CAMERA.pixel_slopes()
    count = CAMERA.samples // binning
    expected = fine[: count * binning].reshape(count, binning).mean(axis=1)
    assert CAMERA.pixel_slopes(binning) == pytest.approx(expected, abs=1e-16)
    assert fine.sum() == pytest.approx(0, abs=1e-12)
    assert np.diff(fine) == pytest.approx(CAMERA.ifov_rad)


@given(st.floats(0.2, 9))
def test_footprint_is_a_box_over_linear_interpolation(width: float):
    """Weights sum to 1, are symmetric and not negative. Interpolation adds at most 0.25 px^2 to the box's variance."""
    kernel = footprint_kernel(width)
    place = np.arange(len(kernel)) - len(kernel) // 2
    assert kernel.sum() == pytest.approx(1, abs=1e-12)
    assert kernel == pytest.approx(kernel[::-1], abs=1e-12)
    assert kernel.min() >= 0
    assert width**2 / 12 <= (kernel * place**2).sum() <= width**2 / 12 + 0.25


@pytest.mark.parametrize("read_noise", [20.0, 3.0])
@pytest.mark.parametrize("expected", [0.0, 50.0, 3000.0])
def test_noise_has_the_moments_of_shot_and_read_noise(read_noise: float, expected: float):
    """Mean, variance and third moment are those of Poisson plus normal noise plus rounding, in both code branches."""
    camera = replace(CAMERA, read_noise_e=read_noise, electrons_per_dn=1.0, bits=16)
    dn = digitise(np.full((400, 1000), expected, np.float32), camera, np.random.default_rng(3))
    electrons = dn.astype(np.float64) - camera.dark_dn
    variance = expected + read_noise**2 + 1 / 12
    assert electrons.mean() == pytest.approx(expected, abs=5 * np.sqrt(variance / 4e5))
    assert electrons.var() == pytest.approx(variance, rel=0.015)
    third = ((electrons - electrons.mean()) ** 3).mean()
    assert third == pytest.approx(expected, abs=5 * np.sqrt(15 * variance**3 / 4e5))


def test_faint_light_is_as_skewed_as_shot_noise():
    """The third moment of noise from one draw is that of the Poisson part: its standard error is 22 of 400."""
    camera = replace(CAMERA, read_noise_e=10.0, electrons_per_dn=1.0, bits=16)
    dn = digitise(np.full((2000, 2000), 400.0, np.float32), camera, np.random.default_rng(4))
    third = ((dn.astype(np.float64) - camera.dark_dn - 400) ** 3).mean()
    assert third == pytest.approx(400, abs=100)


def test_digitising_without_noise_rounds_to_even_and_clips():
    """Half a DN rounds to even. Light beyond the full well gives full scale, negative light the dark level."""
    electrons = np.array([2.5, 7.5, 1e9, -50.0, CAMERA.full_scale_e])
    assert digitise(electrons, CAMERA, None).tolist() == [64, 66, 4095, 64, 4095]


def test_exposures_of_an_even_scene_have_the_noise_of_the_camera() -> None:
    """Shot noise, read noise and rounding add up as variances, and the mean is the light's."""
    seen = expose(footprint(np.full((256, 256, 2), 5000.0), CAMERA), CAMERA, rng=np.random.default_rng(2))
    spread = np.sqrt(5000 + 400 + 25 / 12)
    assert seen.mean() == pytest.approx(5000, abs=5 * spread / np.sqrt(seen.size))
    assert seen.std() == pytest.approx(spread, rel=5 / np.sqrt(2 * seen.size))
