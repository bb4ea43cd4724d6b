"""What arithmetic alone may change: as much as the light about a sample, and only where kernels differ all of it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep
from pipeline.simulator.effects.blurs import ABERRATION, DIFFRACTION, KEYSTONE
from pipeline.simulator.effects.effect import Light, SweepBlock
from pipeline.simulator.effects.line import ROTATION, SLIT, SMEAR
from pipeline.simulator.optics.kernel_fit import NEGLIGIBLE
from pipeline.simulator.render import expected_light
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.image_scene import raster_from_values
from pipeline.simulator.selection.verification import ROUNDING, contrast_about, misplaced_electrons, misplaced_share
from pipeline.simulator.simulated import sweep_block

RIG = Rig(camera=LineCamera(samples=64, exposure_ms=10_000.0))
SWEEP = Sweep("s", "coarse", "x", 0.0, -24.0, 12, 4, 4)
EXACT: dict[Any, str] = {
    ROTATION: "rays",
    SLIT: "9x3",
    SMEAR: "positions",
    DIFFRACTION: "airy",
    ABERRATION: "gaussian",
    KEYSTONE: "linear",
}


def test_contrast_is_that_of_the_scene_about_a_sample() -> None:
    """A bright pixel between two lines of a chip counts 8 px around it, and no farther; even light counts nothing."""
    values = np.zeros((48, 64, 1))
    values[23, 40] = 1.0
    scene = raster_from_values(values, RIG.camera, name="t", wavelength_nm=np.array([550.0]))
    block = sweep_block(scene, RIG, SWEEP, range(6, 8))  # looks at rows 24 to 31

    def render(block: SweepBlock, chosen: Any) -> Light:
        return expected_light(scene, block, chosen)

    contrast = contrast_about(block, render)[0, :, 0]
    full = float(scene.electrons.max()) * 100
    assert contrast[33:48].min() > 0.5 * full
    assert contrast[:30].max() == contrast[52:].max() == 0
    assert contrast_about(replace(block, lines=range(9, 11)), render).max() == 0


def test_kernels_that_differ_misplace_more() -> None:
    """Another blur, or held positions folded; not the parts of a slit nor an effect without a kernel."""
    same = misplaced_share(EXACT, {**EXACT, SLIT: "3x1"})
    assert same == misplaced_share(EXACT, EXACT) < NEGLIGIBLE
    without = {effect: way for effect, way in EXACT.items() if effect is not KEYSTONE}
    boxless = {effect: way for effect, way in EXACT.items() if effect is not SLIT}
    for other in (without, boxless, {**EXACT, SMEAR: "folded"}, {**EXACT, DIFFRACTION: "one-width"}):
        assert misplaced_share(EXACT, other) == pytest.approx(same + NEGLIGIBLE)


@pytest.mark.parametrize("pattern", ["rows", "columns"])
def test_two_ways_to_fold_the_same_light_differ_by_no_more(pattern: str) -> None:
    """Light of 60 full wells that no keystone can change, along rows, or that no held position can, along columns."""
    y, x = np.mgrid[:48, :64]
    plane = (y if pattern == "rows" else x) // 2 % 2
    values = plane[..., None] * np.array([1.0, 0.7, 0.9])
    nm = np.array([450.0, 640.0, 980.0])
    scene = raster_from_values(values, RIG.camera, name="t", wavelength_nm=nm)
    block = sweep_block(scene, RIG, SWEEP, range(12))
    unshifted = {effect: way for effect, way in EXACT.items() if effect is not KEYSTONE}
    other = unshifted if pattern == "rows" else {**EXACT, SMEAR: "folded"}
    light, full = (expected_light(scene, block, one) for one in (other, EXACT))
    contrast = contrast_about(block, lambda block, chosen: expected_light(scene, block, chosen))
    bound = misplaced_electrons(full, contrast, misplaced_share(EXACT, other))
    assert (np.abs(light.astype(np.float64) - full) <= bound).all()


def test_even_light_differs_by_float32_alone() -> None:
    """Without contrast nothing can be misplaced."""
    light = np.full((3, 10, 2), 1e4, np.float32)
    assert misplaced_electrons(light, np.zeros((1, 10, 2)), 1.0).max() == pytest.approx(1e4 * ROUNDING)
