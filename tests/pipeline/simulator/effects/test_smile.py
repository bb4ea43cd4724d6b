"""Smile: its sign and course, cubics exact on parabolas, nothing beyond the bands, and the bound on random spectra."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.simulator.effects.effect import SweepBlock
from pipeline.simulator.effects.sensor import STRAY_LIGHT
from pipeline.simulator.effects.spectrometer import RESPONSE, SMILE, wavelength_shift
from pipeline.simulator.render import expected_light
from tests.pipeline.simulator.spectral_light import (
    SAMPLES,
    SWEEP,
    block_of,
    probe_of,
    random_light,
    rig_with,
    small_scene,
    worst,
)

ROUNDED = 1e-3  # DN: two of the last places of 16,384 electrons in float32


def bent(light, wavelength, smile_nm, variant="cubic", **more):
    """Light after smile."""
    return SMILE.change(
        light.copy(), block_of(rig_with(light.shape[1], smile_nm=smile_nm), wavelength, **more), variant
    )


def test_shift_is_0_at_the_centre_and_smile_at_both_ends():
    """641 samples: 0 in the middle, a quarter half way, all at the ends; one sample is all centre."""
    shift = wavelength_shift(641, 0.3)
    np.testing.assert_allclose(shift[[0, 160, 320, 480, 640]], [0.3, 0.075, 0, 0.075, 0.3])
    assert wavelength_shift(1, 0.3) == [0]


@pytest.mark.parametrize(("smile_nm", "sign"), [(0.5, 1), (-0.5, -1)])
def test_sign_is_that_of_the_wavelengths_seen(smile_nm, sign):
    """On a spectrum of 10 e-/nm a smile of 0.5 nm adds 5 e- at the ends, a frown takes as much."""
    wavelength = np.linspace(400, 500, 51)
    light = np.tile((10 * (wavelength - 300)).astype(np.float32), (2, SAMPLES, 1))
    change = bent(light, wavelength, smile_nm, lines=range(2)) - light
    np.testing.assert_allclose(change[:, [0, -1], 1:-1], 5 * sign, atol=1e-3)
    np.testing.assert_allclose(change[:, 31:33], 0, atol=2e-3)


def test_cubic_is_exact_on_parabolas_between_inner_bands():
    """A parabola on uneven bands comes back to rounding, where straight lines miss I'' s (h - s) / 2."""
    wavelength = 500 + np.cumsum(np.random.default_rng(0).uniform(1, 3, 20))
    light = np.tile((50 * (wavelength - 510) ** 2).astype(np.float32), (1, 3, 1))
    wanted = 50 * (wavelength + 0.8 - 510) ** 2
    made = bent(light, wavelength, 0.8, lines=range(1))[0, 0]
    np.testing.assert_allclose(made[1:-2], wanted[1:-2], rtol=2e-5, atol=0.05)
    missed = bent(light, wavelength, 0.8, "linear", lines=range(1))[0, 0] - wanted
    np.testing.assert_allclose(missed[:-1], 50 * 0.8 * (np.diff(wavelength) - 0.8), rtol=2e-3)


@pytest.mark.parametrize("variant", SMILE.variants)
@pytest.mark.parametrize("smile_nm", [0.4, -0.4, 7.0, 100.0])
def test_nothing_is_invented_beyond_the_bands(variant, smile_nm):
    """Bands that would see beyond the first or last take that one's light, however far the shift."""
    wavelength, light = random_light(3, bands=30)
    made = bent(light, wavelength, smile_nm, variant)
    end = -1 if smile_nm > 0 else 0
    np.testing.assert_allclose(made[..., end], light[..., end], rtol=1e-6)
    if smile_nm == 100:
        np.testing.assert_allclose(made[:, 0], np.broadcast_to(light[:, 0, -1:], made[:, 0].shape), rtol=1e-6)


def test_detectors_do_not_mix():
    """Two runs of rising wavelengths are bent apart, each as if alone; a run of one band stays."""
    first, light = random_light(1, bands=30)
    second, other = random_light(2, bands=20)
    wavelength = np.concatenate([first, second, [405.0]])
    both = bent(np.concatenate([light, other, other[..., :1]], axis=2), wavelength, 1.0)
    np.testing.assert_allclose(both[..., :30], bent(light, first, 1.0), rtol=1e-6)
    np.testing.assert_allclose(both[..., 30:50], bent(other, second, 1.0), rtol=1e-6)
    np.testing.assert_array_equal(both[..., 50], other[..., 0])


@given(st.integers(0, 10**6), st.floats(-3, 3), st.sampled_from(["sigma", "dn"]))
@settings(max_examples=40, deadline=None)
def test_bounds_hold(seed, smile_nm, unit):
    """Neither leaving smile out nor lines for cubics changes more than the bound, factor 1.2, and what floats round."""
    wavelength, light = random_light(seed)
    rig, probe = rig_with(smile_nm=smile_nm), probe_of(light, wavelength, unit)
    made = bent(light, wavelength, smile_nm)
    assert worst(made, light, unit) <= 1.2 * SMILE.bound(probe, rig).value + ROUNDED
    linear = bent(light, wavelength, smile_nm, "linear")
    assert worst(linear, made, unit, like=light) <= 1.2 * SMILE.bound(probe, rig, "linear").value + ROUNDED


@pytest.mark.parametrize("variant", ["off", "linear"])
def test_bounds_are_within_6_times_at_the_median(variant):
    """Over 30 random spectra and smiles the bound is at most 6 times what happens."""
    ratios = []
    for seed in range(30):
        wavelength, light = random_light(seed)
        smile_nm = float(np.random.default_rng(seed).uniform(0.1, 1.2))
        made = bent(light, wavelength, smile_nm)
        beside = light if variant == "off" else bent(light, wavelength, smile_nm, "linear")
        bound = SMILE.bound(probe_of(light, wavelength), rig_with(smile_nm=smile_nm), variant)
        ratios.append(bound.value / worst(beside, made, "sigma", like=light))
    assert np.median(ratios) < 6


def test_off_where_there_is_nothing_to_bend():
    """One band, a straight slit, or a flat spectrum: bound 0 with a reason, and light stays as it is."""
    one, light = np.array([550.0]), np.full((6, SAMPLES, 1), 900, np.float32)
    bound = SMILE.bound(probe_of(light, one), rig_with())
    assert bound.value == 0
    assert "single band" in bound.why
    np.testing.assert_array_equal(bent(light, one, 0.3), light)
    wavelength, varied = random_light(0)
    assert SMILE.bound(probe_of(varied, wavelength), rig_with(smile_nm=0.0)).value == 0
    flat = np.full_like(varied, 700)
    assert SMILE.bound(probe_of(flat, wavelength), rig_with()).value == 0


def test_blocks_and_samples_do_not_matter():
    """Lines 7 at a time, and some samples alone, are the same numbers as all at once."""
    wavelength, light = random_light(5, lines=9)
    rig = rig_with(smile_nm=0.3)
    whole = SMILE.change(light, block_of(rig, wavelength, range(9)), "cubic")
    for lines in (range(7), range(7, 9)):
        part = SMILE.change(light[lines.start : lines.stop], block_of(rig, wavelength, lines), "cubic")
        np.testing.assert_array_equal(part, whole[lines.start : lines.stop])
    some = range(3, 50, 4)
    cut = SMILE.change(light[:, 3:50:4], block_of(rig, wavelength, range(9), samples=some), "cubic")
    np.testing.assert_array_equal(cut, whole[:, 3:50:4])


def test_through_the_render_after_the_response():
    """On a scene of narrow bands response, smile and stray light together stay within the sum of their bounds."""
    wavelength, scene = small_scene(fwhm_nm=2.0)
    rig = rig_with(smile_nm=0.8, stray_share=0.01)
    block = SweepBlock(rig, SWEEP, range(316, 324), wavelength, scene.shape, fwhm_nm=scene.fwhm_nm)
    plain = expected_light(scene, block, {})
    probe = probe_of(plain, wavelength, fwhm_nm=scene.fwhm_nm)
    chain = (RESPONSE, SMILE, STRAY_LIGHT)
    bounds = [effect.bound(probe, rig).value for effect in chain]
    for effect, bound in zip(chain, bounds, strict=True):
        alone = worst(expected_light(scene, block, {effect: effect.variants[0]}), plain, "sigma")
        assert bound / 10 < alone <= bound
    every = expected_light(scene, block, {effect: effect.variants[0] for effect in chain})
    assert worst(every, plain, "sigma") <= sum(bounds)
