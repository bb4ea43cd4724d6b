"""The simulated instrument: footprints against closed forms and rays traced one by one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.errors import PoseError
from pipeline.geometry.camera import LineCamera, expose, footprint
from pipeline.geometry.mirror import direction_to_scene, position_to_normal, reflect
from pipeline.geometry.scan import Sweep, line_positions
from pipeline.simulator.render import USUAL, Choice, expected_light
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.scene import RasterScene
from pipeline.simulator.simulated import render_lines, sweep_block
from tests.pipeline.simulator.small_scenes import effects_on, image_scene, seen_at

CAMERA = LineCamera()
OPTICS = effects_on("rotation", "slit", "smear")
SWEEP = Sweep("s", "fine", "x", swath_px=0.0, start_px=-19.5, lines=40)


def scene_of(values: np.ndarray) -> RasterScene:
    """A scene of given values (y, x, band)."""
    return image_scene(values, CAMERA, np.linspace(400, 900, values.shape[2]))


def light_of(
    scene: RasterScene, sweep: Sweep, lines: range, chosen: Choice = OPTICS, camera: LineCamera = CAMERA
) -> np.ndarray:
    """Expected electrons of some lines, (line, sample, band)."""
    return expected_light(scene, sweep_block(scene, Rig(camera), sweep, lines), chosen)


def smooth(shape: tuple[int, int, int], seed: int = 0) -> np.ndarray:
    """Random waves of 6 to 60 px around 1."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: shape[0], : shape[1]]
    values = np.ones(shape)
    for _ in range(12):
        fy, fx = rng.normal(size=2) / rng.uniform(6, 60)
        values += 0.03 * np.cos(2 * np.pi * (fy * y + fx * x) + rng.uniform(0, 6))[..., None]
    return values


def test_flat_scene_gives_flat_lines() -> None:
    """At any pose a flat scene gives each sample the same electrons but for the mirror, by exposure."""
    scene = scene_of(np.full((30, 30, 2), 4.0))
    far = Sweep("far", "coarse", "y", swath_px=2000.0, start_px=-3000.0, lines=5, step=4, binning=4)
    expected = np.broadcast_to(4 * scene.electrons, (5, 640, 2))
    np.testing.assert_allclose(light_of(scene, far, range(5)), expected, rtol=1e-5)
    longer = light_of(scene, far, range(5), camera=replace(CAMERA, exposure_ms=250.0))
    np.testing.assert_allclose(longer, 2.5 * expected, rtol=1e-5)


@pytest.mark.parametrize("step", [1, 4])
def test_undeflected_sweep_is_the_operator_on_the_grid(step: int) -> None:
    """Around the undeflected direction lines equal the closed-form operator that training uses, slit and smear."""
    values = smooth((40, 640, 1))
    scene = scene_of(values)
    sweep = replace(SWEEP, lines=40 // step, step=step)
    lines = light_of(scene, sweep, range(sweep.lines))
    exact = replace(CAMERA, electrons_per_dn=1.0, bits=16)  # four of its samples still fit uint16
    viewed = expose(footprint(values.astype(np.float32) * scene.electrons, exact), exact, step=step, rng=None)
    binned = lines.reshape(sweep.lines, 640 // step, step, 1).mean(axis=2)
    assert np.abs(binned - viewed).max() < 0.02 * viewed.std()


def test_rays_are_those_of_the_mirror() -> None:
    """Without slit and smear a sample sees the point that the reflected ray of its centre meets."""
    scene = scene_of(smooth((200, 700, 1)))
    sweep = Sweep("s", "fine", "x", swath_px=150.0, start_px=-50.0, lines=20)
    line = light_of(scene, sweep, range(7, 8), effects_on("rotation"))[0, :, 0]
    slope = CAMERA.pixel_slopes()
    ray = np.stack([0 * slope, slope, 1 + 0 * slope], axis=-1)
    normal = position_to_normal(line_positions(sweep, CAMERA)[7])
    x, y = direction_to_scene(reflect(ray, normal)).T / CAMERA.ifov_rad
    expected = seen_at(scene, y + 99.5, x + 349.5)[:, 0] * scene.electrons[0]
    np.testing.assert_allclose(line, expected, rtol=1e-4)


def test_lines_beyond_the_mirror_are_refused() -> None:
    """A sweep that the mirror cannot reach is told of, not rendered."""
    with pytest.raises(PoseError):
        render_lines(scene_of(np.ones((4, 4, 1))), Rig(), USUAL, replace(SWEEP, swath_px=2e4), range(1))
