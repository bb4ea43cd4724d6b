"""The line camera: timing, rays, footprints, noise, saturation, binning and the noise of the coarse pass."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import ShapeError
from pipeline.geometry.camera import LineCamera, bin_samples, digitise, expose, footprint, footprint_kernel

CAMERA = LineCamera()


def scan_pass(
    electrons: np.ndarray, camera: LineCamera, *, step: int, rng: np.random.Generator | None = None
) -> np.ndarray:
    """Return the values of one pass over a scene that is aligned with the grid."""
    return expose(footprint(electrons, camera), camera, step=step, rng=rng)


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


def test_binning_sums_and_drops_the_remainder():
    """Seven samples binned by three give two sums. Sums of sixteen saturated samples fit into 16 bits."""
    dn = np.arange(7, dtype=np.uint16)[None, :, None]
    assert bin_samples(dn, 3)[0, :, 0].tolist() == [3, 12]
    assert bin_samples(np.full((1, 16, 1), 4095, np.uint16), 16).item() == 65520
    assert bin_samples(dn, 1) is dn
    with pytest.raises(ShapeError, match="cannot bin 7 samples by 8"):
        bin_samples(dn, 8)


def test_sums_beyond_16_bits_are_refused():
    """A sum of 65528 DN is kept. A sum of 65536 DN raises an error with the value and the remedy."""
    full = np.full((2, 8, 3), 8191, np.uint16)
    assert bin_samples(full, 8).max() == 65528
    full[1, 5, 2] = 8199
    with pytest.raises(ShapeError, match=r"sum of 8 samples reaches 65536 DN, above the 65535 .* smaller factor"):
        bin_samples(full, 8)
    assert bin_samples(full[:0], 8).shape == (0, 1, 3)


@pytest.mark.parametrize("step", [1, 2, 4, 8])
def test_coarse_pass_of_an_even_scene_lowers_noise_by_the_root_of_the_step(step: float):
    """The coarse pass averages ``step`` samples of one exposure, so noise falls by sqrt(step), not by step."""
    seen = scan_pass(np.full((256, 256, 2), 5000.0), CAMERA, step=step, rng=np.random.default_rng(2))
    assert seen.shape == (256 // step, 256 // step, 2)
    spread = np.sqrt(5000 + 400 + 25 / 12)
    assert seen.mean() == pytest.approx(5000, abs=5 * spread / np.sqrt(seen.size * step))
    assert seen.std() == pytest.approx(spread / np.sqrt(step), rel=5 / np.sqrt(2 * seen.size))


def test_a_coarse_pixel_is_the_mean_of_its_fine_pixels():
    """Without noise a coarse pixel equals the block mean of the fine pass, to the rounding of DN."""
    electrons = np.random.default_rng(0).uniform(100, 15_000, (16, 24, 3))
    camera = replace(CAMERA, bits=14, electrons_per_dn=1.0)
    fine, coarse = scan_pass(electrons, camera, step=1), scan_pass(electrons, camera, step=4)
    assert coarse == pytest.approx(fine.reshape(4, 4, 6, 4, 3).mean(axis=(1, 3)), abs=1.0)
