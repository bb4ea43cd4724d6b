"""What the mirror, wind and depth do to the light of a scene, through the renderer, on a scene that is a ramp."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep, sweep_to_scene
from pipeline.lazy import Once
from pipeline.simulator.effects.air import PARALLAX, WIND
from pipeline.simulator.effects.effect import SweepBlock
from pipeline.simulator.effects.line import ROTATION, SLIT
from pipeline.simulator.effects.mirror_path import LAG, STAIRCASE
from pipeline.simulator.effects.pointing import HYSTERESIS, JITTER, THERMAL_DRIFT
from pipeline.simulator.effects.probe import Probe
from pipeline.simulator.render import expected_light
from pipeline.simulator.rig_model import Air, MirrorMotion, Rig
from pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene, SceneLight, SceneRaster

CAMERA = LineCamera(samples=64, exposure_ms=4.0)
MOTION = replace(
    MirrorMotion(), positions_per_line=1.5, repeatability_urad=40.0, hysteresis_px=5.0, drift_px_per_min=500.0
)
AIR = Air(distance_m=30.0, relief="step", nearest_m=3.0, wind_amplitude_m=0.005, wind_hz=20.0)
RIG = Rig(camera=CAMERA, mirror=MOTION, air=AIR)
STRIP = Sweep("strip", "fine", "x", 3.0, -25.0, 40)
ACROSS = replace(STRIP, along="y")
PLAIN: dict[Any, str] = {ROTATION: "rays", SLIT: "3x1"}
SLOPE = (8.0, 13.0)  # along x and along y [e-/px]
MOVERS = [STAIRCASE, LAG, JITTER, HYSTERESIS, THERMAL_DRIFT, PARALLAX, WIND]


def ramp() -> RasterScene:
    """A scene that rises evenly along x and along y, in two bands of which the second is half as bright."""
    y, x = np.mgrid[:161, :161]
    plane = (2000 + SLOPE[0] * (x - 80) + SLOPE[1] * (y - 80)).astype(np.float32)[..., None]
    electrons = np.array([[1.0, 0.5]], np.float32) * np.float32(DEFAULT_EXPOSURE_MS / CAMERA.exposure_ms)
    light = Once.of(SceneLight(electrons, electrons[0]))
    return RasterScene("ramp", "ramp", SceneRaster.of(plane), light, np.ones(2, np.float32), np.array([500.0, 600.0]))


def look(chosen: dict[Any, str], sweep: Sweep = STRIP, lines: range = range(40), **more: Any) -> np.ndarray:
    """Light of some lines of the ramp."""
    scene = ramp()
    block = SweepBlock(RIG, sweep, lines, scene.wavelength_nm, scene.shape, **more)
    return expected_light(scene, block, {**chosen, **PLAIN})


@pytest.mark.parametrize("sweep", [STRIP, ACROSS], ids=["x", "y"])
@pytest.mark.parametrize("effect", MOVERS, ids=lambda effect: effect.name)
def test_light_changes_by_slope_times_way(effect: Any, sweep: Sweep):
    """On a ramp the light changes by the slope times the stated shift or displacement, in either orientation."""
    found = look({effect: "exact"}, sweep) - look({}, sweep)
    block = SweepBlock(RIG, sweep, range(40), np.array([500.0, 600.0]), (161, 161))
    if hasattr(effect, "aim"):
        along, scan = np.moveaxis(effect.aim(block, "exact").mean(axis=1), -1, 0)[..., None]
    else:
        along, scan = effect.displaced(block, *sweep_to_scene(sweep, CAMERA), "exact")
    x, y = (along, scan) if sweep.along == "x" else (scan, along)
    stated = np.broadcast_to(SLOPE[0] * x + SLOPE[1] * y, found.shape[:2])
    away = np.abs(sweep_to_scene(sweep, CAMERA)[sweep.along == "x"]) > 2  # a step of depth splits footprints on it
    np.testing.assert_allclose(found[..., 0][away], stated[away], rtol=5e-3, atol=0.05)
    np.testing.assert_allclose(found[..., 1], found[..., 0] / 2, atol=2e-3)
    assert np.abs(found).max() > 0.1


@pytest.mark.parametrize("effect", MOVERS, ids=lambda effect: effect.name)
def test_the_change_stays_below_the_bound(effect: Any):
    """The bound from the ramp's slopes holds for the rendered light and is at most six times as much."""
    one, none = np.ones(2), np.zeros(2)
    slope = np.array([[SLOPE[0]] * 2, [SLOPE[1]] * 2])
    probe = Probe(
        "dn",
        (STRIP,),
        500 * one,
        None,
        4000 * one,
        one,
        4000 * one,
        slope,
        none * slope,
        none,
        none,
        1e4,
        0.0,
        1.0,
        40,
        40 * 4e-3,
    )
    measured = np.abs(look({effect: "exact"}) - look({})).max()
    bound = effect.bound(probe, RIG).value
    assert measured <= bound + 2e-3
    assert bound <= 6 * measured


@pytest.mark.parametrize("size", [1, 7])
def test_blocks_and_samples_do_not_change_light(size: int):
    """With all of them on, lines and samples are the same in blocks of any size."""
    chosen = dict.fromkeys(MOVERS, "exact")
    whole = look(chosen, lines=range(20))
    parts = [look(chosen, lines=range(a, min(a + size, 20))) for a in range(0, 20, size)]
    np.testing.assert_array_equal(np.concatenate(parts), whole)
    np.testing.assert_array_equal(look(chosen, lines=range(20), samples=range(5, 30, 2)), whole[:, 5:30:2])


@pytest.mark.parametrize("effect", MOVERS, ids=lambda effect: effect.name)
@pytest.mark.parametrize("step", [1, 4])
def test_extreme_rigs_give_numbers(effect: Any, step: int):
    """At either end of what a rig may be, shifts and bounds are finite, for a block of no line as well."""
    slow = MirrorMotion(0.1, 0.01, 0.0, 0.01, 1e5, 1e4, 1e4)
    stiff = MirrorMotion(1e5, 10.0, 1e4, 1e4, 0.0, 0.0, 0.0)
    far = Air(distance_m=np.inf, relief="plane", nearest_m=1e-3, wind_amplitude_m=100.0, wind_hz=50.0)
    sweep, one = replace(STRIP, step=step, lines=5, start_px=-9.0), np.ones(1)
    both = np.ones((2, 1))
    probe = Probe("dn", (sweep,), one, None, one, one, one, both, both, one, one, 1e4, 0.0, 1.0, 5, 1e4)
    for mirror in (slow, stiff):
        rig = Rig(camera=CAMERA, mirror=mirror, air=far)
        for lines in (range(5), range(2, 2)):
            block = SweepBlock(rig, sweep, lines, one, (161, 161))
            points = np.zeros((len(lines), 64)), np.ones((len(lines), 64))
            for variant in effect.variants:
                moved = (
                    effect.aim(block, variant) if hasattr(effect, "aim") else effect.displaced(block, *points, variant)
                )
                assert np.isfinite(moved).all()
        for variant in ("off", *effect.variants):
            assert 0 <= effect.bound(probe, rig, variant).value <= 1
