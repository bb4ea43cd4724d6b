"""Hard cases of the light of the simulator: none, one bright point, a slit without width, one number, tolerances."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pipeline.geometry.camera import LineCamera
from pipeline.simulator.effects.line import ROTATION, SLIT
from pipeline.simulator.readout import read_out
from pipeline.simulator.render import expected_light
from pipeline.simulator.rig_model import Detector, Optics
from tests.hard_cases.simulated_scene import CAMERA, EVERYTHING, RIG, SWEEP, block_of, decided, left_out, scene_of

TEXTURE = np.random.default_rng(0).uniform(0.2, 1, (60, 80, 3))


def test_black_scene_without_dark_current_has_no_shot_noise() -> None:
    """It is unseen at any tolerance but 0, and the raw numbers are the dark level and read noise."""
    rig = replace(RIG, detector=Detector(dark_e_per_s=0.0))
    decision = decided(scene_of(0 * TEXTURE), rig)
    assert {one.name: one.reason for one in decision.taken}["shot"] == "unseen"
    block = block_of(scene_of(0 * TEXTURE), rig, range(2))
    light = expected_light(scene_of(0 * TEXTURE), block, decision.chosen)
    assert not light.any()
    assert read_out(light, block, decision.chosen).mean() == pytest.approx(64, abs=1)


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


@pytest.mark.parametrize("tolerance", [5e-324, 1e-300, 1e300])
def test_tolerances_next_to_0_and_infinity_are_kept(tolerance: float) -> None:
    """The least and the greatest numbers that there are decide like 0, but for what is not seen, and like infinity."""
    scene = scene_of(np.ones((60, 80, 3)))
    decision = decided(scene, replace(RIG, optics=Optics(stray_fraction=0.0)), tolerance)
    assert decision.error <= tolerance
    assert ("prnu" in {one.name for one in decision.chosen}) == (tolerance < 1)
