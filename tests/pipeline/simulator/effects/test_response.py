"""Spectral response: variances that add up, straight spectra kept, nothing where bands are wide, and the bound."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.simulator.effects.spectrometer import RESPONSE, missing_variance, widen_bands
from tests.pipeline.simulator.spectral_light import block_of, probe_of, random_light, rig_with, units, worst

VARIANCE_OF_6 = 36 / (8 * np.log(2))


def kernel(wavelength, fwhm, wanted=6.0):
    """What each band takes of each other, (band made, band taken)."""
    return widen_bands(np.eye(len(wavelength)), wavelength, fwhm, wanted).T


def test_widths_add_in_squares():
    """From 2 to 6 nm 32 / 5.545 = 5.771 nm^2 are missing; from 6 nm on, or where not known, none."""
    found = missing_variance(6.0, np.array([2.0, 6.0, 9.0, np.nan, np.inf, 0.0]), 6)
    np.testing.assert_allclose(found, [5.7708, 0, 0, 0, 0, VARIANCE_OF_6], atol=1e-4)
    assert not missing_variance(6.0, None, 3).any()


@pytest.mark.parametrize("fwhm_nm", [0.0, 2.0, 5.9])
def test_kernel_has_the_missing_variance_on_uneven_bands(fwhm_nm):
    """No weight below 0, sum 1, mean 0 and the variance to 1e-6, however few bands a width spans."""
    nm = 400 + np.cumsum(np.random.default_rng(0).uniform(1, 3, 60))
    rows = kernel(nm, np.full(60, fwhm_nm))
    way = nm - nm[:, None]
    np.testing.assert_allclose(rows.sum(axis=1), 1, atol=1e-6)
    np.testing.assert_allclose((rows * way).sum(axis=1), 0, atol=1e-5)
    wanted = missing_variance(6.0, np.array([fwhm_nm]), 1)[0]
    np.testing.assert_allclose((rows * way**2).sum(axis=1)[15:45], wanted, rtol=1e-5, atol=1e-5)
    assert rows.min() > -1e-7


def test_narrow_line_becomes_a_gaussian_of_6_nm():
    """A line of 2 nm on bands 0.5 nm apart gets 6 nm at half its height and keeps its area."""
    nm = np.arange(450, 550.5, 0.5)
    line = np.exp(-4 * np.log(2) * ((nm - 500) / 2) ** 2)
    made = widen_bands(line, nm, np.full(len(nm), 2.0), 6.0)
    np.testing.assert_allclose(made, np.exp(-4 * np.log(2) * ((nm - 500) / 6) ** 2) / 3, atol=2e-3)
    np.testing.assert_allclose(made.sum(), line.sum(), rtol=1e-6)


def test_straight_spectra_and_both_ends_stay():
    """A straight spectrum is kept up to its ends; the first and last band of any spectrum keep their light."""
    wavelength, light = random_light(1)
    narrow = np.full(90, 1.0)
    straight = 3 * wavelength
    np.testing.assert_allclose(widen_bands(straight, wavelength, narrow, 6.0), straight, rtol=1e-6)
    made = widen_bands(light, wavelength, narrow, 6.0)
    np.testing.assert_allclose(made[..., [0, -1]], light[..., [0, -1]], rtol=1e-6)


def test_nothing_where_bands_are_wide_or_not_known():
    """Light itself comes back, and the bound of 0 says which of the two it is."""
    wavelength, light = random_light(2)
    for fwhm, word in (
        (np.full(90, 6.0), "6 nm wide already"),
        (None, "not known"),
        (np.full(90, np.nan), "not known"),
    ):
        assert RESPONSE.change(light, block_of(rig_with(), wavelength, fwhm_nm=fwhm), "exact") is light
        bound = RESPONSE.bound(probe_of(light, wavelength, fwhm_nm=fwhm), rig_with())
        assert bound.value == 0
        assert word in bound.why


@pytest.mark.parametrize("bands", [1, 2])
def test_one_or_two_bands_stay(bands):
    """Without a band on either side nothing can be averaged."""
    nm = np.linspace(500, 510, bands)
    light = np.full((2, 3, bands), 7, np.float32)
    light[..., -1] = 9
    made = widen_bands(light, nm, np.zeros(bands), 6.0)
    np.testing.assert_allclose(made, light)
    assert RESPONSE.bound(probe_of(light, nm, fwhm_nm=np.zeros(bands)), rig_with()).value == 0


def test_detectors_do_not_mix():
    """Bands whose wavelengths fall back begin another run, widened as if alone."""
    first, light = random_light(1, bands=30)
    second, other = random_light(2, bands=20)
    made = widen_bands(np.concatenate([light, other], axis=2), np.concatenate([first, second]), np.ones(50), 6.0)
    np.testing.assert_allclose(made[..., :30], widen_bands(light, first, np.ones(30), 6.0), rtol=1e-6)
    np.testing.assert_allclose(made[..., 30:], widen_bands(other, second, np.ones(20), 6.0), rtol=1e-6)


def test_factors_of_light_serve_as_well():
    """Widening (component, band) electrons and mixing them is mixing and widening the light."""
    wavelength, light = random_light(4)
    spectra, narrow = light[0, :3], np.full(90, 2.0)
    share = np.random.default_rng(0).uniform(0, 1, (5, 7, 3)).astype(np.float32)
    both = widen_bands(share @ spectra, wavelength, narrow, 6.0)
    np.testing.assert_allclose(share @ widen_bands(spectra, wavelength, narrow, 6.0), both, rtol=1e-5)


def test_lines_do_not_matter_to_each_other():
    """Lines one at a time give the very numbers of all at once."""
    wavelength, light = random_light(6, lines=9)
    block = block_of(rig_with(), wavelength, fwhm_nm=np.full(90, 2.0))
    whole = RESPONSE.change(light, block, "exact")
    for line in range(9):
        np.testing.assert_array_equal(RESPONSE.change(light[line : line + 1], block, "exact")[0], whole[line])


@given(st.integers(0, 10**6), st.floats(0.5, 7), st.sampled_from(["sigma", "dn"]))
@settings(max_examples=30, deadline=None)
def test_bound_holds(seed, fwhm_nm, unit):
    """Leaving the response out changes no number by more than the bound, factor 1.2; widths may differ by band."""
    wavelength, light = random_light(seed)
    fwhm = np.random.default_rng(seed).uniform(0.7, 1.3, 90) * fwhm_nm
    probe = probe_of(light, wavelength, unit, fwhm)
    made = RESPONSE.change(light, block_of(rig_with(), wavelength, fwhm_nm=fwhm), "exact")
    assert worst(made, light, unit) <= 1.2 * RESPONSE.bound(probe, rig_with()).value + 1e-4


def test_bound_is_within_6_times_at_the_median():
    """Over 30 random spectra and widths the bound is at most 6 times what happens."""
    ratios = []
    for seed in range(30):
        wavelength, light = random_light(seed)
        fwhm = np.full(90, np.random.default_rng(seed).uniform(0.5, 5.5))
        made = RESPONSE.change(light, block_of(rig_with(), wavelength, fwhm_nm=fwhm), "exact")
        bound = RESPONSE.bound(probe_of(light, wavelength, fwhm_nm=fwhm), rig_with())
        ratios.append(bound.value / worst(made, light, "sigma"))
    assert np.median(ratios) < 6


def test_steep_step_is_bounded_by_its_slope():
    """A step between two bands has I'' v / 2 far above I' sqrt(v): the smaller of the two counts, and holds."""
    wavelength = np.linspace(400, 500, 101)
    light = np.where(wavelength < 450, 100, 5000).astype(np.float32) * np.ones((1, 2, 1), np.float32)
    fwhm = np.zeros(101)
    probe = probe_of(light, wavelength, fwhm_nm=fwhm)
    bound = RESPONSE.bound(probe, rig_with()).value
    made = RESPONSE.change(light, block_of(rig_with(), wavelength, range(1), fwhm_nm=fwhm), "exact")
    assert worst(made, light, "sigma") <= bound
    steepest = 4900 / units(light, "sigma").min()
    np.testing.assert_allclose(bound, steepest * np.sqrt(VARIANCE_OF_6), rtol=1e-6)
    assert RESPONSE.bound(probe, rig_with(), "exact").value == 0
