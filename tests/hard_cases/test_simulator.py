"""Hard cases of the simulator's light: black, one bright point, a slit without width, one sample, tolerance limits."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.simulator.effects.line import ROTATION, SLIT
from spectralzoom.pipeline.simulator.readout import read_out
from spectralzoom.pipeline.simulator.render import expected_light
from spectralzoom.pipeline.simulator.rig_model import Detector, Optics
from tests.hard_cases.simulated_scene import CAMERA, EVERYTHING, RIG, SWEEP, block_of, decided, left_out, scene_of

TEXTURE = np.random.default_rng(0).uniform(0.2, 1, (60, 80, 3))


def test_black_scene_without_dark_current_has_no_shot_noise() -> None:
    """At a tolerance of 0.1 shot noise is ``unseen``; raw numbers average the dark level of 64 DN."""
    rig = replace(RIG, detector=Detector(dark_e_per_s=0.0))
    decision = decided(scene_of(0 * TEXTURE), rig)
    assert {one.name: one.reason for one in decision.taken}["shot"] == "unseen"
    block = block_of(scene_of(0 * TEXTURE), rig, range(2))
    light = expected_light(scene_of(0 * TEXTURE), block, decision.chosen)
    assert not light.any()
    assert read_out(light, block, decision.chosen).mean() == pytest.approx(64, abs=1)


@pytest.mark.parametrize("slit_um", [0.0, 20.0])
def test_point_source_keeps_every_bound(slit_um: float) -> None:
    """One bright pixel on black: leaving out each effect changes the light by a finite amount within its bound."""
    values = np.zeros((60, 80, 2))
    values[29, 39] = 1.0  # line 15 points there
    found = left_out(scene_of(values), replace(RIG, camera=replace(CAMERA, slit_um=slit_um)))
    assert {"diffraction", "aberration", "slit", "keystone"} <= set(found)
    assert max(change for change, _ in found.values()) > 1
    for change, counted in found.values():
        assert change <= counted < math.inf


def test_scene_of_one_pixel_can_be_scanned() -> None:
    """One sample of one line in one band, every part on, is finite; effects that need detail have an error of 0."""
    scene = scene_of(np.ones((1, 1, 1)))
    rig = replace(EVERYTHING, camera=LineCamera(samples=1))
    sweep = replace(SWEEP, lines=1)
    decision = decided(scene, rig, 0.0, sweep)
    light = expected_light(scene, block_of(scene, rig, range(1), sweep), decision.chosen)
    assert light.shape == (1, 1, 1)
    assert np.isfinite(light).all()
    errors = {one.name: one.menu.off.error for one in decision.taken}
    assert errors["diffraction"] == errors["lag"] == errors["slit"] == errors["rotation"] == 0


def test_zero_width_slit_is_the_limit_of_a_narrow_one() -> None:
    """A slit of 0 um gives the light of 1e-6 um in every variant, and leaving out each effect keeps its bound."""
    scene = scene_of(TEXTURE)
    none, narrow = (replace(RIG, camera=replace(CAMERA, slit_um=width)) for width in (0.0, 1e-6))
    for variant in SLIT.variants:
        chosen: dict[Any, str] = {ROTATION: "rays", SLIT: variant}
        lights = [expected_light(scene, block_of(scene, rig), chosen) for rig in (none, narrow)]
        np.testing.assert_allclose(lights[0], lights[1], rtol=1e-5)
    for change, counted in left_out(scene, none).values():
        assert change <= counted


@pytest.mark.parametrize("tolerance", [5e-324, 1e-300, 1e300])
def test_extreme_tolerances_are_kept(tolerance: float) -> None:
    """Errors stay within 5e-324, 1e-300 and 1e300; the fixed pattern (PRNU) is on for the first two only."""
    decision = decided(scene_of(np.ones((60, 80, 3))), replace(RIG, optics=Optics(stray_fraction=0.0)), tolerance)
    assert decision.error <= tolerance
    assert ("prnu" in {one.name for one in decision.chosen}) == (tolerance < 1)
