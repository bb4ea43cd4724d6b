"""What gains make of light and of errors: laws on made-up light, and units that follow the light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.simulator.effects.probe import (
    GainRange,
    fixed_variance,
    lights_within,
    second_difference,
    steepest_difference,
    unit_electrons,
)
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.selection.options import Growth, light_after
from tests.pipeline.simulator.made_up_effects import RIG, even_probe

NM = np.linspace(400.0, 1000.0, 25)


def spectra_probe(spectra: np.ndarray, unit_e: float):
    """A probe in a unit that is the same everywhere."""
    return even_probe(
        unit="dn",
        wavelength_nm=NM,
        level=spectra.max(axis=0) / unit_e,
        spread=np.ptp(spectra, axis=0) / unit_e,
        spectral_slope=steepest_difference(spectra, NM).max(axis=0) / unit_e,
        spectral_curvature=np.abs(second_difference(spectra, NM)).max(axis=0) / unit_e,
        unit_least_dn=unit_e / RIG.camera.electrons_per_dn,
    )


@pytest.mark.parametrize("seed", range(10))
def test_spectra_behind_gains_are_no_steeper_than_said(seed: int):
    """Random spectra, two random gains and added light; the greatest gains are taken off."""
    rng = np.random.default_rng(seed)
    spectra, first, second = rng.uniform(50, 100, (4, 25)), rng.uniform(0.5, 1.5, (3, 25)), rng.uniform(0.1, 1, (3, 25))
    added = rng.uniform(0, 20, (3, 25))
    ranges = [GainRange.of(first, NM, uneven=1.0), GainRange.of(second, NM, uneven=1.0, added_e=added)]
    after = light_after(spectra_probe(spectra, 5.0), ranges, RIG)
    greatest = np.maximum(first.max(axis=0), 1).max()
    for way in range(3):
        light = spectra * first[way] * second[way] + added[way]
        slope, bend = steepest_difference(light, NM) / 5, np.abs(second_difference(light, NM)) / 5
        assert (slope <= greatest * after.spectral_slope + 1e-9).all()
        assert (bend <= greatest * after.spectral_curvature + 1e-9).all()


def test_even_gains_leave_spectra_as_they_are():
    """Their factors are for the growth of errors."""
    probe = even_probe(spectral_slope=np.full(1, 0.3))
    after = light_after(probe, [GainRange.between(1.0, 2.0, 1)], RIG)
    assert after.spectral_slope == probe.spectral_slope
    assert after.spread == probe.spread


def test_errors_grow_with_the_light_over_its_noise():
    """At the darkest sample: 100 e- and 400 e- of read noise doubled, an error of 1 unit is 2 sqrt(502 / 602)."""
    probe, fixed = even_probe(), fixed_variance(RIG)
    expected = 2 * np.sqrt((100 + fixed) / (200 + fixed))
    assert Growth(probe, RIG).of_errors(2.0) == pytest.approx(expected)
    assert Growth(replace(probe, unit="dn"), RIG).of_errors(2.0) == 2.0


def test_what_a_shadow_takes_counts_by_the_noise_within_it():
    """Half of 10,000 e- is 5,000 e- over the noise of 5,000 e-."""
    probe, rig = even_probe(darkest_e=1e4), Rig()
    lost = 1e4 / np.sqrt(1e4 + fixed_variance(rig)) / 2 * Growth(probe, rig).of_gain(GainRange.between(0.5, 1, 1), 1.0)
    assert lost == pytest.approx(5e3 / np.sqrt(5e3 + fixed_variance(rig)))


@pytest.mark.parametrize("unit", ["sigma", "dn"])
def test_least_and_greatest_light_follow_from_level_and_span(unit: str):
    """Two lights of every band, their level and span in either unit: solved back to the lights."""
    low, high = np.array([5.0, 200.0, 3_000.0]), np.array([5.0, 900.0, 20_000.0])
    probe = even_probe(unit=unit, unit_least_dn=1.0, darkest_e=0.0, brightest_e=2e4)
    level, span = high / unit_electrons(high, probe, RIG), (high - low) / unit_electrons(low, probe, RIG)
    found = lights_within(replace(probe, level=level, span=span), RIG)
    np.testing.assert_allclose(found, [low, high], rtol=1e-9)
