"""Effects of the readout: the scenes that need them, their bounds, and silicon's dark current."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.simulator.effects import counting
from spectralzoom.pipeline.simulator.effects.probe import Probe, Unit
from spectralzoom.pipeline.simulator.readout import read_out
from spectralzoom.pipeline.simulator.rig_model import Detector, Rig
from tests.pipeline.simulator.spectral_light import block_of, probe_of

TOLERANCE = 0.1 / 1.2  # 0.1 sigma with the decision's factor of safety
NM = np.array([500.0, 700.0, 900.0])
RIG = Rig()


def probe(darkest_e: float, brightest_e: float, unit: Unit = "sigma") -> Probe:
    """Return the probe of light from the darkest to the brightest, in every band."""
    return probe_of(np.linspace(darkest_e, brightest_e, 60).reshape(2, 10, 3).astype(np.float32), NM, unit)


def apart(wide: float, narrow: float) -> float:
    """Return twice the total variation of two centred normal distributions, by integration."""
    x = np.linspace(-8 * wide, 8 * wide, 100_001)
    return float(np.trapezoid(np.abs(stats.norm.pdf(x, scale=wide) - stats.norm.pdf(x, scale=narrow)), x))


def test_bright_scene_needs_shot_noise_but_no_read_noise() -> None:
    """At 10,000 e- a read noise of 20 e- turns a noise of 100 e- into 102 e-."""
    bright = probe(10_000, 10_000)
    assert counting.SHOT.bound(bright, RIG).value > TOLERANCE
    bound = counting.READ_NOISE.bound(bright, RIG)
    assert bound.value == pytest.approx(0.019, abs=1e-3)
    assert bound.value < TOLERANCE
    assert bound.why == "20 e- beside at least 100 e- of shot noise make 102 e-"


def test_dim_scene_at_1_s_needs_dark_current() -> None:
    """The current of 200 e- exceeds the noise of 24 e-; a cooled sensor does not need it."""
    bound = counting.DARK_CURRENT.bound(probe(200, 400), replace(RIG, camera=LineCamera(exposure_ms=1000.0)))
    assert bound.value > 8
    assert bound.why == "200 e- in 1000 ms, beside 24.5 e- of noise"
    cold = Rig(detector=Detector(dark_e_per_s=1.0))
    assert counting.DARK_CURRENT.bound(probe(200, 400), cold).value < TOLERANCE


@pytest.mark.parametrize("unit", ["sigma", "dn"])
@pytest.mark.parametrize(("darkest", "brightest"), [(50.0, 300.0), (1000.0, 1200.0), (10.0, 15_000.0)])
def test_noise_bounds_are_the_total_variation(unit: Unit, darkest: float, brightest: float) -> None:
    """Distributions with and without a noise differ by the bound at the worst sample, and by at most it elsewhere."""
    rig = Rig(detector=Detector(dark_e_per_s=0.0))
    levels = np.linspace(darkest, brightest, 7)
    seen = probe(darkest, brightest, unit)
    for effect, without in ((counting.SHOT, np.full(7, 20.0)), (counting.READ_NOISE, np.sqrt(levels))):
        total = np.sqrt(levels + 400)
        scale = total / 5 if unit == "dn" else np.ones(7)
        found = max(apart(a, b) * one for a, b, one in zip(total, without, scale, strict=True))
        assert effect.bound(seen, rig).value == pytest.approx(found, rel=2e-3)


def test_bound_of_the_cheap_draw_is_stated_for_a_patch() -> None:
    """A number errs by at most sqrt(divergence) of a sigma, and a patch of 1e6 numbers by the stated variation."""
    bound = counting.SHOT.bound(probe(100, 10_000), RIG, "gaussian")
    assert bound.value <= 2 * counting.MOST_VARIATION / np.sqrt(counting.CHIP_SAMPLES)
    assert bound.value >= np.sqrt(counting.divergence(np.geomspace(1, 1e5, 500), 20.0)).max()
    assert "1e+06 numbers have a total variation of at most 0.05" in bound.why
    assert "exact below 0 e-, without read noise 681 e-" in bound.why
    assert counting.SHOT.bound(probe(100, 10_000), RIG, "exact").value == 0


def test_sensor_with_empty_masks_has_a_bound_of_0() -> None:
    """A noiseless sensor has no hot elements."""
    few = Rig(detector=Detector(dead_fraction=1e-9, hot_fraction=1e-9))
    assert not counting.dead_elements(few, 3).any()
    assert not counting.hot_electrons(few, 3).any()
    assert counting.DEFECTS.bound(probe(100, 1000), few).value == 0
    assert not counting.hot_electrons(Rig(detector=Detector(hot_fraction=0.1, noiseless=True)), 3).any()


def test_larger_defect_fraction_keeps_the_defects_of_a_smaller_one() -> None:
    """A larger fraction adds elements; another unit has others; dead and hot elements are drawn separately."""
    few, many, other = (
        Rig(detector=Detector(dead_fraction=fraction, hot_fraction=fraction, unit=unit))
        for fraction, unit in ((0.01, 0), (0.05, 0), (0.05, 1))
    )
    assert (counting.dead_elements(many, 20) >= counting.dead_elements(few, 20)).all()
    assert not np.array_equal(counting.dead_elements(many, 20), counting.dead_elements(other, 20))
    assert not np.array_equal(counting.dead_elements(many, 20), counting.hot_electrons(many, 20) > 0)


@pytest.mark.parametrize("unit", ["sigma", "dn"])
def test_bright_roof_saturates(unit: Unit) -> None:
    """Six standard deviations below full scale the bound is 0; above it the bound is the clipped light."""
    well = LineCamera().full_scale_e
    below = counting.SATURATION.bound(probe(100, well - 6.2 * np.sqrt(well + 400) - 20, unit), RIG)
    assert below.value == 0
    assert "stay below" in below.why
    bound = counting.SATURATION.bound(probe(100, 30_000, unit), RIG)
    lost = 30_000 + 20 - well
    assert lost / (5.0 if unit == "dn" else np.sqrt(30_400)) < bound.value
    assert "above the limit of 2.02e+04 e-" in bound.why
    ideal = Rig(detector=Detector(noiseless=True))
    seen = replace(probe(100, 30_000, unit), unit_least_dn=0.29)
    assert counting.SATURATION.bound(seen, ideal).value == pytest.approx((lost - 20) / 5 / 0.29)


def test_quantisation_is_half_a_dn() -> None:
    """The bound is in units of the smallest noise, or of one DN; rounding changes no number by more than half a DN."""
    assert counting.QUANTISATION.bound(probe(100, 1000, "dn"), RIG).value == 0.5
    assert counting.QUANTISATION.bound(probe(0, 1000), RIG).value == pytest.approx(0.5 / 4)
    light: NDArray[np.float32] = np.random.default_rng(0).uniform(0, 9000, (6, 640, 3)).astype(np.float32)
    assert np.abs(read_out(light, block_of(RIG, NM), {}) - (light / 5 + 64)).max() <= 0.5
