"""Hard cases of the simulator's light and noise: from no photon to 1e9, points, saturation, one band, no slit, NaN."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.geometry.camera import LineCamera
from pipeline.simulator.effects.blurs import ABERRATION, KEYSTONE
from pipeline.simulator.effects.counting import SHOT
from pipeline.simulator.effects.effect import SweepBlock
from pipeline.simulator.effects.line import ROTATION, SLIT
from pipeline.simulator.readout import read_out
from pipeline.simulator.render import expected_light
from pipeline.simulator.rig_model import Detector, Optics, Rig
from tests.hard_cases.simulated_scene import (
    CAMERA,
    EVERYTHING,
    RIG,
    SWEEP,
    block_of,
    decided,
    left_out,
    probed,
    scene_of,
)

TOLERANCES = [0.0, 0.1, math.inf]
TEXTURE = np.random.default_rng(0).uniform(0.2, 1, (60, 80, 3))
COUNTING = replace(CAMERA, samples=640, bits=16, read_noise_e=0.0, dark_dn=0.0)


def counts_of(level: float, variant: str, electrons_per_dn: float = 1.0) -> NDArray[np.float64]:
    """What 1e5 samples count of so much light, by shot noise alone. [e-]"""
    rig = Rig(camera=replace(COUNTING, electrons_per_dn=electrons_per_dn))
    block = SweepBlock(rig, SWEEP, range(8), np.linspace(400, 1000, 20), (60, 80))
    light = np.full((8, 640, 20), level, np.float32)
    return read_out(light, block, {SHOT: variant}).astype(np.float64) * electrons_per_dn


@pytest.mark.parametrize("variant", SHOT.variants)
@pytest.mark.parametrize("level", [0.0, -0.0, -1.0, -1e9, 1e-30])
def test_no_light_counts_nothing(level: float, variant: str) -> None:
    """Poisson of 0, of less than 0 and of next to nothing is 0 in every draw."""
    assert not counts_of(level, variant).any()


@pytest.mark.parametrize("variant", SHOT.variants)
def test_a_thousand_million_photons_spread_by_their_root(variant: str) -> None:
    """Poisson of 1e9 has mean and variance 1e9, the converter's steps of 20,000 taken off."""
    counts = counts_of(1e9, variant, 2e4)
    variance = 1e9 + 2e4**2 / 12
    assert counts.mean() == pytest.approx(1e9, abs=4 * math.sqrt(variance / counts.size))
    assert counts.var() == pytest.approx(variance, rel=4 * math.sqrt(2 / counts.size) + 2**-24 * 1e9 / 31623)


def test_black_scene_without_dark_current_has_no_shot_noise() -> None:
    """It is unseen at any tolerance but 0, and the raw numbers are the dark level and read noise."""
    rig = replace(RIG, detector=Detector(dark_e_per_s=0.0))
    decision = decided(scene_of(0 * TEXTURE), rig)
    assert {one.name: one.reason for one in decision.taken}["shot"] == "unseen"
    block = block_of(scene_of(0 * TEXTURE), rig, range(2))
    light = expected_light(scene_of(0 * TEXTURE), block, decision.chosen)
    assert not light.any()
    assert read_out(light, block, decision.chosen).mean() == pytest.approx(64, abs=1)


def test_gradient_bounds_a_point_of_infinite_curvature() -> None:
    """Where the image has no second derivative the bound is slope times width, and no axis without blur counts."""
    probe = probed(scene_of(TEXTURE), RIG)
    point = replace(probe, curvature=np.full((2, 3), np.inf))
    width = RIG.optics.aberration_px * math.sqrt(2 / math.pi)  # what a Gaussian moves light on average
    by_slope = np.minimum(width * point.slope.sum(axis=0), point.span).max()
    assert ABERRATION.bound(point, RIG).value == pytest.approx(by_slope)
    assert ABERRATION.bound(probe, RIG).value < by_slope
    assert KEYSTONE.bound(replace(point, slope=np.full((2, 3), np.inf)), RIG).value <= point.span.max()
    assert point.blurred(np.array([[0.0] * 3, [0.04] * 3])) == pytest.approx(
        np.minimum(0.2 * point.slope[1], point.span).max()
    )
    assert point.blurred(np.zeros((2, 3))) == 0
    assert replace(point, slope=point.curvature).moved(0.0, 0.0) == 0


@pytest.mark.parametrize("slit_um", [0.0, 20.0])
def test_point_source_keeps_every_bound(slit_um: float) -> None:
    """One bright pixel in the dark: what is left out, effect by effect, is finite and within what was counted."""
    values = np.zeros((60, 80, 2))
    values[29, 39] = 1.0  # line 15 looks there
    rig = replace(RIG, camera=replace(CAMERA, slit_um=slit_um))
    found = left_out(scene_of(values), rig)
    assert {"diffraction", "aberration", "slit", "keystone"} <= set(found)
    assert max(change for change, _ in found.values()) > 1
    for change, counted in found.values():
        assert change <= counted < math.inf


@pytest.mark.parametrize("tolerance", TOLERANCES)
@pytest.mark.parametrize("electrons", [1e6, 1e9, 1e20])
def test_all_saturated_light_is_full_scale(electrons: float, tolerance: float) -> None:
    """Every raw number is the converter's last one whatever is left out, and the decision is finite."""
    scene = scene_of(TEXTURE, electrons)
    decision = decided(scene, RIG, tolerance)
    block = block_of(scene, RIG, range(2))
    light = expected_light(scene, block, decision.chosen)
    assert np.isfinite(light).all()
    assert (read_out(light, block, decision.chosen) == 4095).all()
    assert decision.error <= tolerance
    saturation = next(one.menu.off for one in decision.taken if one.name == "saturation")
    assert 0 < saturation.error < math.inf


@pytest.mark.parametrize("tolerance", TOLERANCES)
def test_one_band_has_no_spectral_effects(tolerance: float) -> None:
    """Smile and response need a neighbour and are absent; all else is decided and rendered as usual."""
    scene = scene_of(TEXTURE[..., :1])
    decision = decided(scene, RIG, tolerance)
    reasons = {one.name: one.reason for one in decision.taken}
    assert reasons["smile"] == reasons["response"] == "absent"
    for change, counted in left_out(scene, RIG).values():
        assert change <= counted
    block = block_of(scene, RIG, range(2))
    assert read_out(expected_light(scene, block, decision.chosen), block, decision.chosen).shape == (2, 64, 1)


def test_one_number_is_a_scan() -> None:
    """A scene of one pixel seen by one sample in one line and one band, with everything on, has no detail."""
    scene, rig = scene_of(np.ones((1, 1, 1))), replace(EVERYTHING, camera=LineCamera(samples=1))
    sweep = replace(SWEEP, lines=1)
    decision = decided(scene, rig, 0.0, sweep)
    light = expected_light(scene, block_of(scene, rig, range(1), sweep), decision.chosen)
    assert light.shape == (1, 1, 1)
    assert np.isfinite(light).all()
    errors = {one.name: one.menu.off.error for one in decision.taken}
    assert errors["diffraction"] == errors["lag"] == errors["slit"] == errors["rotation"] == 0


def test_zero_width_slit_is_the_limit_of_a_narrow_one() -> None:
    """Without a width, light is that of a slit of 1e-6 um in every variant, and the decision keeps its tolerance."""
    scene = scene_of(TEXTURE)
    none, narrow = (replace(RIG, camera=replace(CAMERA, slit_um=width)) for width in (0.0, 1e-6))
    for variant in SLIT.variants:
        chosen: dict[Any, str] = {ROTATION: "rays", SLIT: variant}
        lights = [expected_light(scene, block_of(scene, rig), chosen) for rig in (none, narrow)]
        np.testing.assert_allclose(lights[0], lights[1], rtol=1e-5)
    for change, counted in left_out(scene, none).values():
        assert change <= counted


@pytest.mark.filterwarnings("ignore:invalid value encountered:RuntimeWarning")
def test_light_that_is_not_finite_is_refused_with_its_place() -> None:
    """Who renders without a probe is told sweep, line, sample and band; lines that do not see the hole are read out."""
    values = TEXTURE.copy()
    values[31, 39, 1] = np.nan
    scene = scene_of(values)
    decision = decided(scene_of(TEXTURE), RIG)
    block = block_of(scene, RIG, range(30))
    light = expected_light(scene, block, {ROTATION: "rays"})
    line, sample, band = np.argwhere(np.isnan(light))[0]
    with pytest.raises(SceneError, match=f"sweep s: line {line}, sample {sample}, band {band} expects nan electrons"):
        read_out(light, block, decision.chosen)
    assert band == 1
    read_out(light[:4], block_of(scene, RIG, range(4)), decision.chosen)


@pytest.mark.parametrize("tolerance", [5e-324, 1e-300, 1e300])
def test_tolerances_next_to_0_and_infinity_are_kept(tolerance: float) -> None:
    """The least and the greatest numbers that there are decide like 0, but for what is not seen, and like infinity."""
    scene = scene_of(np.ones((60, 80, 3)))
    decision = decided(scene, replace(RIG, optics=Optics(stray_fraction=0.0)), tolerance)
    assert decision.error <= tolerance
    assert ("prnu" in {one.name for one in decision.chosen}) == (tolerance < 1)
