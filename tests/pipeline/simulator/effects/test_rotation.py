"""Line rotation and scale: off on a flat field, bounded by slope and span elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.mirror import line_rotation, position_to_direction
from pipeline.geometry.scan import Sweep, line_positions
from pipeline.simulator.effects.effect import SweepBlock
from pipeline.simulator.effects.line import ROTATION, SLIT
from pipeline.simulator.effects.probe import noise_electrons
from pipeline.simulator.render import expected_light
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.image_scene import raster_from_values
from pipeline.simulator.scenes.scene import RasterScene
from pipeline.simulator.selection.survey_probe import probe_scene

RIG = Rig(camera=LineCamera(samples=80))


def scene_of(values: np.ndarray) -> RasterScene:
    """A scene of one band."""
    return raster_from_values(values[..., None], RIG.camera, name="t", wavelength_nm=np.array([550.0]))


def waves(seed: int) -> np.ndarray:
    """Long waves (400, 500)."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:400, :500]
    return 1 + 0.02 * sum(np.sin((y * a + x * b) / 30 + c) for a, b, c in rng.normal(size=(5, 3)))


def test_flat_field_has_no_rotation() -> None:
    """The bound is 0 where the scene has no slope."""
    sweep = Sweep("s", "fine", "x", strip_px=0.0, start_px=100.0, lines=20)
    probe = probe_scene(scene_of(np.full((40, 40), 2.0)), RIG, [sweep])
    assert ROTATION.bound(probe, RIG).value == 0
    assert ROTATION.bound(probe, RIG, "rays").value == 0


@pytest.mark.parametrize(("strip", "start"), [(0.0, -20.0), (150.0, -150.0), (-120.0, 90.0)])
def test_change_is_within_the_bound_and_not_far_from_it(strip: float, start: float) -> None:
    """Straight lines at nominal scale err by at most 1.2 bounds; the bound is within 6 of the change."""
    sweep, scene = Sweep("s", "fine", "x", strip_px=strip, start_px=start, lines=30), scene_of(waves(2))
    bound = ROTATION.bound(probe_scene(scene, RIG, [sweep]), RIG)
    block = SweepBlock(RIG, sweep, range(30), scene.wavelength_nm, scene.shape)
    exact = expected_light(scene, block, {ROTATION: "rays", SLIT: "3x1"})
    change = np.abs(expected_light(scene, block, {SLIT: "3x1"}) - exact) / noise_electrons(exact, RIG)
    assert change.max() <= 1.2 * bound.value + 1e-3
    assert bound.value <= 6 * change.max()
    assert "px along" in bound.why


def test_ends_of_a_line_are_turned_by_the_line_rotation() -> None:
    """The ends of a line of 640 samples lie 320 px times the sine of its rotation off the plan, and stretched."""
    camera = LineCamera()
    sweep = Sweep("s", "fine", "x", strip_px=1500.0, start_px=800.0, lines=1)
    scene = raster_from_values(np.ones((4, 4, 1)), camera, name="f", wavelength_nm=np.array([550.0]))
    why = ROTATION.bound(probe_scene(scene, Rig(), [sweep]), Rig()).why
    scan = float(why.split(" px along the scan")[0].split()[-1])
    psi = line_rotation(position_to_direction(line_positions(sweep, camera)))[0]
    assert scan == pytest.approx(320 * abs(np.sin(psi)), rel=0.12)
    assert scan > 320 * abs(np.sin(psi))
