"""The simulated instrument: footprints against closed forms and rays traced one by one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.geometry.camera import LineCamera, expose, footprint
from pipeline.geometry.scan import Sweep
from pipeline.simulator.render import Choice, expected_light
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.scene import RasterScene
from pipeline.simulator.simulated import sweep_block
from tests.pipeline.simulator.small_scenes import effects_on, image_scene

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
