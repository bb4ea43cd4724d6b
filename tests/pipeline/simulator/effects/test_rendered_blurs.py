"""Blurs and jitter through the renderer on a small raster: the contrast they leave, and laws of blocks and samples."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.geometry.scan import Sweep
from pipeline.lazy import Once
from pipeline.simulator.effects.air import TURBULENCE
from pipeline.simulator.effects.blurs import ABERRATION, DEFOCUS, DIFFRACTION, KEYSTONE
from pipeline.simulator.effects.effect import SweepBlock
from pipeline.simulator.effects.line import SLIT
from pipeline.simulator.optics.rays import pupil_contrast
from pipeline.simulator.render import expected_light
from pipeline.simulator.rig_model import Air, Optics, Rig
from pipeline.simulator.scenes.scene import RasterScene, SceneLight, SceneRaster

NM = np.array([400.0, 600.0, 1000.0])
RIG = Rig(optics=Optics(aberration_px=0.3, keystone_px=0.4), air=Air(distance_m=120.0))
SWEEP = Sweep("fine", "fine", "x", strip_px=0.0, start_px=-20.0, lines=40)
ALL = {DIFFRACTION: "airy", DEFOCUS: "disc", ABERRATION: "gaussian", KEYSTONE: "linear", TURBULENCE: "jitter"}


def scene_of(planes: NDArray[np.float32]) -> RasterScene:
    """A raster of one component, of the same 1000 e- in all bands."""
    electrons = np.full((1, 3), 1000.0, np.float32)
    light = Once.of(SceneLight(electrons, electrons[0]))
    return RasterScene("waves", "waves", SceneRaster.of(planes), light, np.ones(3, np.float32), NM)


def waves(period: float) -> RasterScene:
    """Light of 1 + cos along the scan."""
    wave = 1 + np.cos(2 * np.pi * (np.arange(120) - 59.5) / period)
    return scene_of(np.repeat(wave[:, None, None], 60, axis=1).astype(np.float32))


def light_of(scene: RasterScene, lines: range, chosen: dict[Any, str], samples: range | None = None) -> NDArray[Any]:
    """Electrons of some lines through the footprint and what is chosen."""
    block = SweepBlock(RIG, SWEEP, lines, NM, scene.shape, samples=samples)
    return expected_light(scene, block, {SLIT: "3x1", **chosen})


@pytest.mark.parametrize("blur", [DIFFRACTION, DEFOCUS, ABERRATION], ids=lambda blur: blur.name)
def test_contrast_is_that_of_the_variance(blur: Any):
    """A wave of 16 px along the scan keeps exp(-2 pi^2 s^2 / 16^2) of what the footprint left of it, or the pupil's."""
    scene, samples = waves(16.0), range(310, 330)
    before, after = (light_of(scene, range(40), chosen, samples) for chosen in ({}, {blur: blur.variants[0]}))
    moments = blur.moments(RIG, NM, blur.variants[0])
    passed = np.exp(-2 * np.pi**2 * moments.variance[1] / 16**2)
    if moments.waves is not None:
        passed = passed * pupil_contrast(moments.waves[1] / 16)
    left = np.ptp(after, axis=(0, 1)) / np.ptp(before, axis=(0, 1))
    assert left == pytest.approx(passed, abs=1.5e-3)


@pytest.mark.parametrize("size", [1, 7])
def test_blocks_and_samples_change_nothing(size: int):
    """All blurs and the jitter give the same light in blocks of any size, and for some samples as for all."""
    grain = np.random.default_rng(0).uniform(0, 1, (120, 60, 1)).astype(np.float32)
    scene = scene_of(grain)
    whole = light_of(scene, range(14), ALL)
    parts = [light_of(scene, range(start, start + size), ALL, range(300, 340)) for start in range(0, 14, size)]
    assert np.array_equal(np.concatenate(parts), whole[:, 300:340])
