"""A line's footprint: boxes of slit and pixel, held positions, rotation, and the changes without them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from spectralzoom.pipeline.geometry.camera import LineCamera, footprint_kernel
from spectralzoom.pipeline.geometry.mirror import position_to_direction
from spectralzoom.pipeline.geometry.scan import Sweep, line_positions
from spectralzoom.pipeline.simulator.effects.effect import SweepBlock
from spectralzoom.pipeline.simulator.effects.line import ROTATION, SLIT
from spectralzoom.pipeline.simulator.render import expected_light
from spectralzoom.pipeline.simulator.rig_model import Rig
from spectralzoom.pipeline.simulator.selection.survey_probe import probe_scene
from tests.pipeline.geometry.paper_equations import line_rotation
from tests.pipeline.simulator.bound_trials import trials
from tests.pipeline.simulator.random_cases import random_case
from tests.pipeline.simulator.small_scenes import image_scene

RIG = Rig(camera=LineCamera(samples=64))
SWEEP = Sweep("s", "fine", "x", swath_px=0.0, start_px=-14.5, lines=30)


@pytest.mark.parametrize("variant", SLIT.variants)
def test_point_is_spread_by_the_closed_form_of_the_box(variant: str) -> None:
    """Lines at pixel centres show a bright pixel as the box over linear interpolation."""
    values = np.zeros((40, 64, 1))
    values[20, 30] = 1.0
    scene = image_scene(values, RIG.camera, [550.0])
    block = SweepBlock(RIG, replace(SWEEP, start_px=-15.5), range(30), scene.wavelength_nm, scene.shape)
    light = expected_light(scene, block, {SLIT: variant})[..., 0] / scene.electrons[0]
    slit, pixel = footprint_kernel(RIG.camera.slit_px), footprint_kernel(1.0)
    down, across = len(slit) // 2, len(pixel) // 2
    got = light[16 - down : 17 + down, 30 - across : 31 + across]
    np.testing.assert_allclose(got, np.outer(slit, pixel), atol=3e-5)


def test_folded_smear_counts_motion_within_an_exposure() -> None:
    """Wind pulls held positions apart: on this random rig the bound without that is exceeded by a factor of five."""
    (trial,) = (one for one in trials(random_case(194), only=["smear"]) if one.variant == "folded")
    assert trial.measured > 0.03
    assert not trial.is_broken


def test_bound_of_rotation_covers_the_ends_of_a_line() -> None:
    """The ends of a line of 640 samples lie 320 px times the sine of its rotation off the plan, and are stretched."""
    camera = LineCamera()
    sweep = Sweep("s", "fine", "x", swath_px=1500.0, start_px=800.0, lines=1)
    why = ROTATION.bound(probe_scene(image_scene(np.ones((4, 4, 1)), camera, [550.0]), Rig(), [sweep]), Rig()).why
    scan = float(why.split(" px along the scan")[0].split()[-1])
    psi = line_rotation(position_to_direction(line_positions(sweep, camera)))[0]
    assert scan == pytest.approx(320 * abs(np.sin(psi)), rel=0.12)
    assert scan > 320 * abs(np.sin(psi))
