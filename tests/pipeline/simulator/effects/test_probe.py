"""Units and ranges: differences over bands, gains of light and errors, coloured edges, noise of stored sums."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from spectralzoom.pipeline.simulator.effects.blurs import DIFFRACTION, KEYSTONE
from spectralzoom.pipeline.simulator.effects.probe import (
    GainRange,
    difference_rates,
    fixed_variance,
    rising_gaps,
    rising_runs,
    steepest_difference,
)
from spectralzoom.pipeline.simulator.optics.rays import pupil_contrast
from spectralzoom.pipeline.simulator.rig_model import Optics, Rig
from spectralzoom.pipeline.simulator.selection.options import error_growth, light_after
from tests.pipeline.simulator.made_up_effects import RIG, even_probe

NM = np.linspace(400.0, 1000.0, 25)


@pytest.mark.parametrize("seed", range(10))
def test_spectra_after_gains_keep_the_stated_slope(seed: int):
    """Random spectra get two random gains and added light; the greatest gains are divided out."""
    rng = np.random.default_rng(seed)
    spectra = rng.uniform(50, 100, (4, 25))
    first, second = rng.uniform(0.5, 1.5, (3, 25)), rng.uniform(0.1, 1, (3, 25))
    added = rng.uniform(0, 20, (3, 25))
    ranges = [GainRange.of(first, uneven=1.0), replace(GainRange.of(second, uneven=1.0), added_e=added.max(axis=0))]
    probe = even_probe(
        wavelength_nm=NM,
        level=spectra.max(axis=0) / 5,
        spectral_slope=steepest_difference(spectra, NM).max(axis=0) / 5,
        unit_least_dn=5 / RIG.camera.electrons_per_dn,
    )
    after = light_after(probe, RIG, ranges)
    greatest = np.maximum(first.max(axis=0), 1).max()
    for way in range(3):
        light = spectra * first[way] * second[way] + added[way]
        assert (steepest_difference(light, NM) / 5 <= greatest * after.spectral_slope + 1e-9).all()


def test_even_gains_do_not_change_the_spectral_slope():
    """Their factors count in the growth of errors instead."""
    probe = even_probe(spectral_slope=np.full(1, 0.3))
    assert light_after(probe, RIG, [GainRange.between(1.0, 2.0, 1)]).spectral_slope == probe.spectral_slope


def test_errors_grow_with_the_light_over_its_noise():
    """Doubling the darkest 100 e-, with 402 e-^2 of fixed noise, turns an error of 1 unit into 2 sqrt(502 / 602)."""
    probe = even_probe()
    fixed = fixed_variance(RIG.camera)
    assert error_growth(probe, RIG, None, 2.0) == pytest.approx(2 * np.sqrt((100 + fixed) / (200 + fixed)))
    assert error_growth(replace(probe, unit="dn"), RIG, None, 2.0) == 2.0


def test_shadow_counts_by_the_noise_within_it():
    """Half of 10,000 e- counts as 5,000 e- over the noise of 5,000 e-."""
    rig = Rig()
    growth = error_growth(even_probe(darkest_e=1e4), rig, GainRange.between(0.5, 1, 1), 1.0)
    fixed = fixed_variance(rig.camera)
    lost = 1e4 / np.sqrt(1e4 + fixed) / 2 * growth
    assert lost == pytest.approx(5e3 / np.sqrt(5e3 + fixed))


def test_spectral_slope_is_that_of_the_steeper_neighbour():
    """Steps of 2 over 1 nm and of 9 over 3 nm have slopes of 2 and 3; the middle band takes the greater."""
    found = steepest_difference(np.array([[0.0, 2.0, 11.0]]), np.array([400.0, 401.0, 404.0]))
    np.testing.assert_allclose(found, [[2, 3, 3]])


def test_bands_of_two_detectors_are_not_neighbours():
    """A run ends if wavelengths fall or repeat: numbers are finite, and no difference crosses the seam."""
    nm = np.array([400.0, 402.0, 404.0, 403.0, 405.0, 405.0])
    spectrum = np.array([1.0, 3.0, 1.0, 50.0, 52.0, 9e9])
    assert rising_runs(nm) == [slice(0, 3), slice(3, 5), slice(5, 6)]
    np.testing.assert_array_equal(rising_gaps(nm), [2, 2, 2])
    np.testing.assert_allclose(steepest_difference(spectrum, nm), [1, 1, 1, 1, 1, 0])


def test_one_band_has_no_spectral_slope():
    """One band, or two, have no second difference; one has no first."""
    one, two = np.array([500.0]), np.array([500.0, 501.0])
    assert not steepest_difference(np.ones((3, 1), np.float32), one).any()
    assert not difference_rates(one).any()
    assert not difference_rates(two).any()


COLOURED_RIG = Rig(optics=Optics(keystone_px=0.6))


@pytest.mark.parametrize("px", [3.0, 8.0, 30.0])
def test_coloured_edges_keep_the_stated_slope(px: float):
    """A grey wave passes a pupil and shifts that differ from band to band, in closed form."""
    k = 2 * np.pi / px
    x = np.linspace(0, px, 200)
    bands = np.ones(len(NM))
    grey = even_probe(unit="dn", wavelength_nm=NM, level=bands, span=2 * bands, slope=k * np.ones((2, 25)))
    grey = replace(grey, spectral_slope=0 * bands, curvature=k**2 * np.ones((2, 25)))
    diffraction, keystone = (blur.moments(COLOURED_RIG, NM, blur.variants[0]) for blur in (DIFFRACTION, KEYSTONE))
    light = np.sin(k * (x[:, None] + keystone.shift[0])) * pupil_contrast(diffraction.waves[0] / px)
    blurred = sum(blur.bound(grey, COLOURED_RIG).value for blur in (DIFFRACTION, KEYSTONE))
    said = light_after(grey, RIG, [], blurred)
    assert (steepest_difference(light, NM).max(axis=0) <= said.spectral_slope).all()
