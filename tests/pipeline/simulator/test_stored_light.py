"""Light as it is stored: means over the samples of a sum, and noise and tolerance of that mean."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.geometry.camera import LineCamera, bin_samples
from pipeline.simulator.effects.probe import noise_electrons, stored_mean, unit_at
from pipeline.simulator.rig_model import Detector, Rig

RIG = Rig()


@given(binning=st.integers(1, 16), samples=st.integers(16, 70), seed=st.integers(0, 99))
def test_means_are_those_of_the_sums_that_are_stored(binning: int, samples: int, seed: int) -> None:
    """Of the same samples as the raw numbers sum, a remainder dropped."""
    dn = np.random.default_rng(seed).integers(0, 4095, (2, samples, 3)).astype(np.uint16)
    np.testing.assert_allclose(stored_mean(dn.astype(np.float64), binning) * binning, bin_samples(dn, binning))


@given(binning=st.integers(1, 16), signal=st.floats(0, 1e6), noiseless=st.booleans())
def test_noise_of_a_sum_is_that_of_its_samples_together(binning: int, signal: float, noiseless: bool) -> None:
    """Variances add up: the sum has root n times the noise of a sample, so its mean has a root n-th of it."""
    rig = Rig(detector=Detector(noiseless=noiseless))
    light = np.full(1, signal, np.float32)
    of_sum = binning * noise_electrons(light, rig, binning)
    np.testing.assert_allclose(of_sum, np.sqrt(binning) * noise_electrons(light, rig), rtol=1e-6)


def test_drawn_noise_is_what_a_unit_says() -> None:
    """Sums of 4 samples of drawn noise, over 4 units of their mean, have a deviation of 1."""
    rng, light = np.random.default_rng(1), np.full((2000, 40, 1), 900.0, np.float32)
    camera = LineCamera()
    drawn = rng.poisson(light) + rng.normal(0, camera.read_noise_e, light.shape)
    rounded = np.rint(drawn / camera.electrons_per_dn) * camera.electrons_per_dn
    off = (stored_mean(rounded - light, 4)) / unit_at(stored_mean(light, 4), RIG, "sigma", 4)
    assert off.std() == pytest.approx(1, rel=0.01)


def test_a_dn_of_a_sum_is_shared_by_its_samples() -> None:
    """Where the mean of 4 samples changes by a quarter of a DN, the stored number does by one."""
    unit = unit_at(np.ones(1, np.float32), RIG, "dn", 4)
    np.testing.assert_allclose(unit, RIG.camera.electrons_per_dn / 4)
