"""The simulated instrument: footprints against closed forms and rays traced one by one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.geometry.camera import LineCamera, expose, footprint
from pipeline.geometry.scan import Sweep
from pipeline.simulator.render import expected_light
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.simulated import sweep_block
from tests.pipeline.simulator.small_scenes import effects_on, image_scene

CAMERA = LineCamera()
OPTICS = effects_on("rotation", "slit", "smear")
SWEEP = Sweep("s", "fine", "x", swath_px=0.0, start_px=-19.5, lines=40)


def test_flat_scene_gives_flat_lines() -> None:
    """At any pose a flat scene gives each sample the same electrons but for the mirror, by exposure."""
    scene = image_scene(np.full((30, 30, 2), 4.0), CAMERA, [400.0, 900.0])
    far = Sweep("far", "coarse", "y", swath_px=2000.0, start_px=-3000.0, lines=5, step=4, binning=4)
    expected = np.broadcast_to(4 * scene.electrons, (5, 640, 2))
    for camera, times in ((CAMERA, 1), (replace(CAMERA, exposure_ms=250.0), 2.5)):
        light = expected_light(scene, sweep_block(scene, Rig(camera), far, range(5)), OPTICS)
        np.testing.assert_allclose(light, times * expected, rtol=1e-5)


@pytest.mark.parametrize("step", [1, 4])
def test_undeflected_sweep_is_the_operator_on_the_grid(step: int) -> None:
    """Around the undeflected direction lines equal the closed-form operator that training uses, slit and smear."""
    rng, (y, x), values = np.random.default_rng(0), np.mgrid[:40, :640], np.ones((40, 640, 1))
    for _ in range(12):  # waves of 6 to 60 px
        fy, fx = rng.normal(size=2) / rng.uniform(6, 60)
        values += 0.03 * np.cos(2 * np.pi * (fy * y + fx * x) + rng.uniform(0, 6))[..., None]
    scene = image_scene(values, CAMERA, [400.0])
    sweep = replace(SWEEP, lines=40 // step, step=step)
    lines = expected_light(scene, sweep_block(scene, Rig(CAMERA), sweep, range(sweep.lines)), OPTICS)
    exact = replace(CAMERA, electrons_per_dn=1.0, bits=16)  # four of its samples still fit uint16
    viewed = expose(footprint(values.astype(np.float32) * scene.electrons, exact), exact, step=step, rng=None)
    binned = lines.reshape(sweep.lines, 640 // step, step, 1).mean(axis=2)
    assert np.abs(binned - viewed).max() < 0.02 * viewed.std()
