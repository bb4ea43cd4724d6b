"""Light on the detector: band widths, smile, stray light and fixed patterns, by hand and by plain convolutions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from spectralzoom.pipeline.simulator.effects import spectrometer
from spectralzoom.pipeline.simulator.rig_model import Detector, Rig
from tests.pipeline.simulator.spectral_light import SAMPLES, block_of, probe_of, random_light, rig_with, units, worst

VARIANCE_OF_6 = 36 / (8 * np.log(2))


@pytest.mark.parametrize("fwhm_nm", [0.0, 2.0, 5.9])
def test_kernel_has_the_missing_variance_on_uneven_bands(fwhm_nm):
    """Weights are not below 0, sum to 1, have mean 0, and the variance to 1e-5, however few bands a width spans."""
    nm = 400 + np.cumsum(np.random.default_rng(0).uniform(1, 3, 60))
    rows = spectrometer.widen_bands(np.eye(60), nm, np.full(60, fwhm_nm), 6.0).T  # (band made, band taken)
    way = nm - nm[:, None]
    np.testing.assert_allclose(rows.sum(axis=1), 1, atol=1e-6)
    np.testing.assert_allclose((rows * way).sum(axis=1), 0, atol=1e-5)
    wanted = spectrometer.missing_variance(6.0, np.array([fwhm_nm]), 1)[0]
    np.testing.assert_allclose((rows * way**2).sum(axis=1)[15:45], wanted, rtol=1e-5, atol=1e-5)
    assert rows.min() > -1e-7


def test_narrow_line_becomes_a_gaussian_of_6_nm():
    """A line of 2 nm on bands 0.5 nm apart gets a FWHM of 6 nm and keeps its area."""
    nm = np.arange(450, 550.5, 0.5)
    line = np.exp(-4 * np.log(2) * ((nm - 500) / 2) ** 2)
    made = spectrometer.widen_bands(line, nm, np.full(len(nm), 2.0), 6.0)
    np.testing.assert_allclose(made, np.exp(-4 * np.log(2) * ((nm - 500) / 6) ** 2) / 3, atol=2e-3)
    np.testing.assert_allclose(made.sum(), line.sum(), rtol=1e-6)


def test_straight_spectra_and_end_bands_are_kept():
    """A straight spectrum is kept up to its ends; the first and last band of any spectrum keep their light."""
    wavelength, light = random_light(1)
    narrow = np.full(90, 1.0)
    straight = 3 * wavelength
    np.testing.assert_allclose(spectrometer.widen_bands(straight, wavelength, narrow, 6.0), straight, rtol=1e-6)
    made = spectrometer.widen_bands(light, wavelength, narrow, 6.0)
    np.testing.assert_allclose(made[..., [0, -1]], light[..., [0, -1]], rtol=1e-6)


def test_response_is_off_for_wide_or_unknown_bands():
    """The light itself is returned, and the reason of the bound of 0 states which of the two it is."""
    wavelength, light = random_light(2)
    for fwhm, word in ((np.full(90, 6), "6 nm wide already"), (None, "not known"), (np.full(90, np.nan), "not known")):
        assert spectrometer.RESPONSE.change(light, block_of(rig_with(), wavelength, fwhm_nm=fwhm), "exact") is light
        bound = spectrometer.RESPONSE.bound(probe_of(light, wavelength, fwhm_nm=fwhm), rig_with())
        assert bound.value == 0
        assert word in bound.why


@pytest.mark.parametrize("bands", [1, 2])
def test_response_keeps_one_or_two_bands(bands):
    """A band without neighbours on both sides cannot be averaged."""
    nm = np.linspace(500, 510, bands)
    light = np.full((2, 3, bands), 7, np.float32)
    light[..., -1] = 9
    np.testing.assert_allclose(spectrometer.widen_bands(light, nm, np.zeros(bands), 6.0), light)
    assert spectrometer.RESPONSE.bound(probe_of(light, nm, fwhm_nm=np.zeros(bands)), rig_with()).value == 0


def test_steep_step_is_bounded_by_its_slope():
    """At a step between two bands I'' v / 2 is far above I' sqrt(v): the smaller of the two counts, and holds."""
    wavelength = np.linspace(400, 500, 101)
    light = np.where(wavelength < 450, 100, 5000).astype(np.float32) * np.ones((1, 2, 1), np.float32)
    fwhm = np.zeros(101)
    probe = probe_of(light, wavelength, fwhm_nm=fwhm)
    bound = spectrometer.RESPONSE.bound(probe, rig_with()).value
    made = spectrometer.RESPONSE.change(light, block_of(rig_with(), wavelength, range(1), fwhm_nm=fwhm), "exact")
    assert worst(made, light, "sigma") <= bound
    steepest = 4900 / units(light, "sigma").min()
    np.testing.assert_allclose(bound, steepest * np.sqrt(VARIANCE_OF_6), rtol=1e-6)
    assert spectrometer.RESPONSE.bound(probe, rig_with(), "exact").value == 0


def bent(light, wavelength, smile_nm, **more):
    """Return light after smile."""
    block = block_of(rig_with(light.shape[1], smile_nm=smile_nm), wavelength, **more)
    return spectrometer.SMILE.change(light.copy(), block, "cubic")


def test_wavelength_shift_is_parabolic_along_the_line():
    """With 641 samples the shift is 0 in the middle, a quarter halfway, all at the ends; one sample has no shift."""
    shift = spectrometer.wavelength_shift(641, 0.3)
    np.testing.assert_allclose(shift[[0, 160, 320, 480, 640]], [0.3, 0.075, 0, 0.075, 0.3])
    assert spectrometer.wavelength_shift(1, 0.3) == [0]


@pytest.mark.parametrize(("smile_nm", "sign"), [(0.5, 1), (-0.5, -1)])
def test_smile_has_the_sign_of_the_wavelength_shift(smile_nm, sign):
    """On a spectrum of 10 e-/nm a smile of 0.5 nm adds 5 e- at the ends, and a frown takes as much."""
    wavelength = np.linspace(400, 500, 51)
    light = np.tile((10 * (wavelength - 300)).astype(np.float32), (2, SAMPLES, 1))
    change = bent(light, wavelength, smile_nm, lines=range(2)) - light
    np.testing.assert_allclose(change[:, [0, -1], 1:-1], 5 * sign, atol=1e-3)
    np.testing.assert_allclose(change[:, 31:33], 0, atol=2e-3)


def test_cubic_is_exact_on_parabolas_between_inner_bands():
    """A parabola on uneven bands is reproduced to rounding."""
    wavelength = 500 + np.cumsum(np.random.default_rng(0).uniform(1, 3, 20))
    light = np.tile((50 * (wavelength - 510) ** 2).astype(np.float32), (1, 3, 1))
    wanted = 50 * (wavelength + 0.8 - 510) ** 2
    made = bent(light, wavelength, 0.8, lines=range(1))[0, 0]
    np.testing.assert_allclose(made[1:-2], wanted[1:-2], rtol=2e-5, atol=0.05)


@pytest.mark.parametrize("smile_nm", [0.4, -0.4, 7.0, 100.0])
def test_smile_does_not_extrapolate_beyond_the_bands(smile_nm):
    """Bands that would lie beyond the first or last one take its light, for any shift."""
    wavelength, light = random_light(3, bands=30)
    made = bent(light, wavelength, smile_nm)
    end = -1 if smile_nm > 0 else 0
    np.testing.assert_allclose(made[..., end], light[..., end], rtol=1e-6)
    if smile_nm == 100:
        np.testing.assert_allclose(made[:, 0], np.broadcast_to(light[:, 0, -1:], made[:, 0].shape), rtol=1e-6)


def test_smile_does_not_mix_detectors():
    """Two runs of rising wavelengths are shifted apart, each as if alone; a run of one band is unchanged."""
    first, light = random_light(1, bands=30)
    second, other = random_light(2, bands=20)
    wavelength = np.concatenate([first, second, [405.0]])
    both = bent(np.concatenate([light, other, other[..., :1]], axis=2), wavelength, 1.0)
    np.testing.assert_allclose(both[..., :30], bent(light, first, 1.0), rtol=1e-6)
    np.testing.assert_allclose(both[..., 30:50], bent(other, second, 1.0), rtol=1e-6)
    np.testing.assert_array_equal(both[..., 50], other[..., 0])


def test_smile_without_any_effect_has_a_bound_of_0():
    """One band and a flat spectrum have a bound of 0; a single band is unchanged and is the reason."""
    one = np.array([550.0])
    light = np.full((6, SAMPLES, 1), 900, np.float32)
    bound = spectrometer.SMILE.bound(probe_of(light, one), rig_with())
    assert bound.value == 0
    assert "single band" in bound.why
    np.testing.assert_array_equal(bent(light, one, 0.3), light)
    wavelength, varied = random_light(0)
    assert spectrometer.SMILE.bound(probe_of(np.full_like(varied, 700), wavelength), rig_with()).value == 0


def scattered(light, **optics):
    """Return light after scattering; names in ``optics`` are without their prefix stray_."""
    rig = rig_with(light.shape[1], **{f"stray_{name}": value for name, value in optics.items()})
    wavelength = np.linspace(400, 1000, light.shape[2])
    return spectrometer.STRAY_LIGHT.change(light.copy(), block_of(rig, wavelength, range(len(light))), "halo")


@pytest.mark.parametrize("halo_px", [3.0, 64.0, 1e4])
def test_stray_light_conserves_the_light_of_each_line(halo_px):
    """Light that leaves a sample lands on the same line's detector, also at its edges, and no light is negative."""
    light = random_light(0)[1]
    light[:, :3] = 0
    light[:, :, -1] *= 20
    made = scattered(light, fraction=0.3, halo_px=halo_px)
    np.testing.assert_allclose(made.sum(axis=(1, 2)), light.sum(axis=(1, 2)), rtol=1e-5)
    assert made.min() > -1e-3


def test_halo_is_a_gaussian_reflected_at_the_edges():
    """The product with few cosines matches the plain convolution, sample by sample and band by band, to 2e-5."""
    light = random_light(1)[1]
    made = scattered(light, fraction=0.2, even=0.25, halo_px=6.0)
    for line, before in zip(made, light.astype(np.float64), strict=True):
        halo = gaussian_filter(before, 6.0, mode="reflect", truncate=8)
        np.testing.assert_allclose(line, 0.8 * before + 0.2 * (0.25 * before.mean() + 0.75 * halo), rtol=2e-5)


def test_even_stray_light_matches_hand_calculation():
    """One line of one sample with bands of 0 and 100, a tenth scattered evenly, becomes 5 and 95."""
    light = np.array([[[0, 100]]], np.float32)
    np.testing.assert_allclose(scattered(light, fraction=0.1, even=1.0), [[[5, 95]]], rtol=1e-6)
    alone = np.array([[[70]]], np.float32)
    np.testing.assert_allclose(scattered(alone, fraction=0.1), alone, rtol=1e-6)


RIG = Rig()


def test_fixed_pattern_gains_have_the_stated_spread() -> None:
    """The spread is 1 % an element and 0.2 % a column, the mean is 1, and the two are not correlated."""
    elements, columns = spectrometer.PRNU.gains(RIG, 270), spectrometer.STRIPING.gains(RIG, 1)
    assert elements.shape == (640, 270)
    assert elements.mean() == pytest.approx(1, abs=1e-4)
    assert elements.std() == pytest.approx(0.01, rel=0.02)
    assert columns.std() == pytest.approx(0.002, rel=0.1)
    assert abs(np.corrcoef(elements.mean(axis=1), columns[:, 0])[0, 1]) < 0.15


def test_fixed_pattern_gains_belong_to_the_unit() -> None:
    """Another sensor has other gains; more bands keep the gains of the first ones."""
    gains = spectrometer.PRNU.gains
    assert not np.array_equal(gains(RIG, 5), gains(Rig(detector=Detector(unit=1)), 5))
    np.testing.assert_array_equal(gains(RIG, 9)[:, :5], gains(RIG, 5))


def test_fixed_pattern_gains_never_fall_below_0() -> None:
    """A spread of 50 % leaves elements without response, but none with a negative one."""
    gains = spectrometer.PRNU.gains(Rig(detector=Detector(prnu_std=0.5)), 50)
    assert gains.min() == 0
    assert gains.max() > 2
