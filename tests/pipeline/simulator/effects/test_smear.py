"""Motion smear: held positions, or the footprint that holds them, and what leaving them out changes."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep
from pipeline.simulator.effects.effect import SweepBlock
from pipeline.simulator.effects.line import ROTATION, SLIT, SMEAR, folded_positions, smeared_positions
from pipeline.simulator.effects.probe import noise_electrons
from pipeline.simulator.render import expected_light
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.image_scene import raster_from_values
from pipeline.simulator.selection.survey_probe import probe_scene
from tests.pipeline.simulator.bound_trials import trials
from tests.pipeline.simulator.random_cases import random_case

RIG = Rig(camera=LineCamera(samples=64))


@pytest.mark.parametrize("step", [1, 2, 8])
def test_positions_are_held_by_the_mirror_or_the_footprint(step: int) -> None:
    """All positions of an exposure stand for it, or one in whose footprint they are."""
    sweep = Sweep("s", "coarse", "x", strip_px=0.0, start_px=0.0, lines=4, step=step)
    block = SweepBlock(RIG, sweep, range(4), np.array([550.0]), (30, 60))
    found = {variant: smeared_positions(block, variant).shape[1] for variant in ("off", *SMEAR.variants)}
    assert found == {"off": 1, "positions": step, "folded": 1}
    assert [folded_positions(sweep, variant) for variant in ("off", "positions", "folded")] == [1, 1, step]


def test_no_smear_where_every_line_has_one_position() -> None:
    """Fine lines stand still: the bound is 0 and the position that of mid exposure."""
    sweep = Sweep("s", "fine", "x", strip_px=0.0, start_px=0.0, lines=4)
    scene = raster_from_values(
        np.random.default_rng(0).uniform(0, 1, (30, 60, 1)), RIG.camera, name="t", wavelength_nm=np.array([550.0])
    )
    assert SMEAR.bound(probe_scene(scene, RIG, [sweep]), RIG).value == 0
    block = SweepBlock(RIG, sweep, range(4), scene.wavelength_nm, scene.shape)
    np.testing.assert_array_equal(smeared_positions(block, "positions"), block.middle[:, None])


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
    block = SweepBlock(RIG, sweep, range(sweep.lines), scene.wavelength_nm, scene.shape)
    exact = expected_light(scene, block, {ROTATION: "rays", SMEAR: "positions", SLIT: "3x1"})
    other = expected_light(scene, block, {ROTATION: "rays", SMEAR: variant, SLIT: "3x1"})
    change = (np.abs(other - exact) / noise_electrons(exact, RIG)).max()
    assert change <= 1.2 * bound + 2e-3


def test_folded_smear_counts_what_sways_within_an_exposure() -> None:
    """Wind that pulls held positions apart: a random rig on which the bound without it is broken five times over."""
    (trial,) = (one for one in trials(random_case(194)) if (one.effect, one.variant) == ("smear", "folded"))
    assert trial.measured > 0.03
    assert not trial.is_broken
