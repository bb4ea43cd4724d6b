"""Motion smear: held positions, fewer in their place, and what leaving them out changes."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.camera import LineCamera
from pipeline.scan import Sweep
from pipeline.simulator.block import Block
from pipeline.simulator.effects.rotation import ROTATION
from pipeline.simulator.effects.slit import SLIT
from pipeline.simulator.effects.smear import SMEAR, fewer_positions, held_variance, smeared_positions
from pipeline.simulator.render import expected_light
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scene import raster_from_values
from pipeline.simulator.survey_probe import noise_electrons, probe_scene

RIG = Rig(camera=LineCamera(samples=64))


@pytest.mark.parametrize("count", [1, 2, 3, 8, 16])
def test_fewer_positions_keep_mean_and_variance(count: int) -> None:
    """Gauss's positions weigh 1, lie about mid exposure, and have the variance (n^2 - 1) / 12."""
    offset, weight = fewer_positions(count, 2.7)
    assert weight.sum() == pytest.approx(1)
    assert offset @ weight == pytest.approx(0, abs=1e-9)
    assert offset**2 @ weight == pytest.approx(held_variance(count))
    assert len(offset) <= count


def test_no_smear_where_every_line_has_one_position() -> None:
    """Fine lines stand still: the bound is 0 and the position that of mid exposure."""
    sweep = Sweep("s", "fine", "x", strip_px=0.0, start_px=0.0, lines=4)
    scene = raster_from_values(np.random.default_rng(0).uniform(0, 1, (30, 60, 1)), RIG.camera, name="t",
                               wavelength_nm=np.array([550.0]))  # fmt: skip
    assert SMEAR.bound(probe_scene(scene, RIG, [sweep]), RIG).value == 0
    block = Block(RIG, sweep, range(4), scene.wavelength_nm, scene.shape)
    np.testing.assert_array_equal(smeared_positions(block, "positions")[0], block.middle[:, None])


@pytest.mark.parametrize("variant", ["off", "folded"])
@pytest.mark.parametrize("period", [8.0, 30.0, 100.0])
@pytest.mark.parametrize("step", [2, 4, 8])
def test_change_is_within_the_bound(step: int, period: float, variant: str) -> None:
    """On waves of any length, smear off or folded errs by at most 1.2 bounds."""
    y, x = np.mgrid[:90, :80]
    values = 1 + 0.4 * np.sin(2 * np.pi * y / period) + 0.1 * np.cos(2 * np.pi * x / 17)
    scene = raster_from_values(values[..., None], RIG.camera, name="t", wavelength_nm=np.array([550.0]))
    sweep = Sweep("s", "coarse", "x", strip_px=3.0, start_px=-36.0, lines=72 // step, step=step, binning=step)
    bound = SMEAR.bound(probe_scene(scene, RIG, [sweep]), RIG, variant).value
    block = Block(RIG, sweep, range(sweep.lines), scene.wavelength_nm, scene.shape)
    exact = expected_light(scene, block, {ROTATION: "rays", SMEAR: "positions", SLIT: "4x2"})
    other = expected_light(scene, block, {ROTATION: "rays", SMEAR: variant, SLIT: "4x2"})
    change = (np.abs(other - exact) / noise_electrons(exact, RIG)).max()
    assert change <= 1.2 * bound + 2e-3
