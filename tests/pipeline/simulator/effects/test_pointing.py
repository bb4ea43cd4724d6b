"""Pointing of the mirror: tilt to scene, fields and draws, ends of lines, bounds, and all effects on a ramp."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.mirror import direction_to_scene, position_to_normal, reflect, wire_positions
from spectralzoom.pipeline.geometry.scan import Sweep, line_positions, points_of_scan, sweep_to_scene
from spectralzoom.pipeline.simulator.effects.air import PARALLAX, WIND
from spectralzoom.pipeline.simulator.effects.effect import SweepBlock
from spectralzoom.pipeline.simulator.effects.line import ROTATION, SLIT
from spectralzoom.pipeline.simulator.effects.pointing import (
    HYSTERESIS,
    JITTER,
    LAG,
    STAIRCASE,
    THERMAL_DRIFT,
    PointingErrors,
    at_line_ends,
    end_gains,
    pointing_field,
    tilt_to_scene,
)
from spectralzoom.pipeline.simulator.render import expected_light
from spectralzoom.pipeline.simulator.rig_model import Air, Detector, MirrorMotion, Rig
from spectralzoom.pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS
from spectralzoom.pipeline.simulator.simulated import SimulatedSource, SimulatedSweep
from tests.pipeline.simulator.small_scenes import effects_on, image_scene, made_scene

SWEEP = Sweep("swath", "fine", "x", 0.0, -500.0, 1001)
RIG = Rig(mirror=replace(MirrorMotion(), repeatability_urad=40.0))


@pytest.mark.parametrize("position", [(0.0, 0.0), (0.3, 0.4), (-0.7, 0.5), (0.1, -0.9)])
def test_gains_are_the_derivatives_of_the_reflection(position: tuple[float, float]):
    """Small rotations of the normal around two axes move the view by the gains, anywhere on the disk."""
    normal = position_to_normal(position)
    within = np.cross([0.0, 1.0, 0.0], normal)
    within /= np.linalg.norm(within)
    for column, tilt in enumerate((np.cross(normal, within), within)):
        turned = [normal + angle * tilt for angle in (1e-6, -1e-6)]
        seen = [direction_to_scene(reflect((0.0, 0.0, 1.0), one / np.linalg.norm(one))) for one in turned]
        np.testing.assert_allclose(tilt_to_scene(normal)[:, column], (seen[0] - seen[1]) / 2e-6, atol=1e-6)


def test_jitter_has_the_stated_spread():
    """Lines scatter by .76 px rms along the scan and .54 px along the line, without bias or correlation."""
    shift = JITTER.aim(SweepBlock(RIG, SWEEP, range(1001), np.ones(1), (64, 64)), "exact")[:, 0]
    assert np.std(shift, axis=0) == pytest.approx((0.535, 0.757), rel=0.1)
    assert np.abs(shift.mean(axis=0)).max() < 0.1
    assert abs(np.corrcoef(shift.T)[0, 1]) < 0.1


HYSTERESIS_SWEEP = Sweep("swath", "fine", "x", 640.0, -700.0, 1401)
HYSTERESIS_RIG = Rig(mirror=replace(MirrorMotion(), hysteresis_px=50.0, drift_px_per_min=2.0))


class Returning(Sweep):
    """A sweep that is scanned in the opposite direction."""

    def held_px(self) -> np.ndarray:
        """Return positions from the last to the first."""
        return super().held_px()[::-1, ::-1]


def block(
    lines: range = range(1401), *, sweep: Sweep = HYSTERESIS_SWEEP, rig: Rig = HYSTERESIS_RIG, started_s: float = 0.0
) -> SweepBlock:
    """Return some lines of a sweep as a block."""
    return SweepBlock(rig, sweep, lines, np.ones(1), (64, 64), started_s=started_s)


@pytest.mark.parametrize("unit", range(8))
def test_pointing_field_is_bounded_and_smooth(unit: int):
    """Over the disk the field is at most 1 on either axis and changes by at most 4 per unit of position."""
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 101), np.linspace(-1, 1, 101)), axis=-1)
    inside = np.hypot(*np.moveaxis(grid, -1, 0)) <= 1
    field = np.where(inside[..., None], pointing_field(unit, grid), np.nan)
    assert np.nanmax(np.abs(field)) <= 1 + 1e-12
    assert np.nanmax(np.abs(np.diff(field, axis=0))) < 4.1 * 0.02
    assert np.nanstd(field) > 0.05


def test_hysteresis_depends_on_the_unit_of_the_rig():
    """The field follows from the copy of the rig alone, not from the sweep's name."""
    whole = HYSTERESIS.aim(block(), "exact")
    named = replace(block(), sweep=replace(HYSTERESIS_SWEEP, name="b"))
    np.testing.assert_array_equal(HYSTERESIS.aim(named, "exact"), whole)
    other = replace(HYSTERESIS_RIG, detector=replace(Detector(), unit=1))
    assert not np.isclose(HYSTERESIS.aim(block(rig=other), "exact"), whole).all()


def test_hysteresis_changes_sign_with_the_scan_direction():
    """A scan in the opposite direction has the same field with the other sign; a single position counts as forward."""
    forth = HYSTERESIS.aim(block(), "exact")
    np.testing.assert_array_equal(HYSTERESIS.aim(block(sweep=Returning(**vars(HYSTERESIS_SWEEP))), "exact"), -forth)
    alone = block(range(1), sweep=replace(HYSTERESIS_SWEEP, lines=1))
    np.testing.assert_array_equal(HYSTERESIS.aim(alone, "exact"), forth[:1])
    assert np.abs(forth).max() <= 50


def test_thermal_drift_is_linear_in_one_direction():
    """2 px a minute are 2 px after a minute and 120 px after an hour, in any direction."""
    drift = THERMAL_DRIFT.aim(block(range(601)), "exact")[:, 0]
    assert np.hypot(*(drift[600] - drift[0])) == pytest.approx(2.0, rel=1e-9)
    np.testing.assert_allclose(np.diff(drift, axis=0), np.broadcast_to(drift[1] - drift[0], (600, 2)), atol=1e-12)
    late = THERMAL_DRIFT.aim(block(range(3), started_s=3600.0), "exact")[:, 0]
    assert np.hypot(*late[0]) == pytest.approx(120.0, rel=1e-4)


CAMERA = LineCamera()


def test_centres_move_by_the_shift_and_ends_rotate():
    """The centre's derivatives are the identity; an end at 320 px moves .034 px across for every px along."""
    gains = end_gains(Sweep("a", "fine", "x", 0.0, 0.0, 1), CAMERA)[0]
    np.testing.assert_allclose(gains[1], np.eye(2), atol=1e-9)
    np.testing.assert_allclose(np.abs(gains[[0, 2], 1, 0]), 0.0338, atol=2e-4)


@pytest.mark.parametrize("swath_px", [0.0, 2000.0, -4000.0])
def test_no_point_of_a_line_moves_beyond_the_bound(swath_px: float):
    """Shifts of 5 px in four directions move no point beyond the bound, which is at most 1.1 of the greatest motion."""
    sweep = Sweep("a", "fine", "x", swath_px, -1500.0, 301, step=10)
    plan = np.stack(points_of_scan(swath_px, CAMERA, sweep.line_px()[:, None], CAMERA.pixel_slopes()))
    bound = np.array(at_line_ends([sweep], CAMERA, 3.0, 4.0))
    most = np.zeros(2)
    for along, scan in ((3, 4), (3, -4), (-3, 4), (-3, -4)):
        beside = points_of_scan(swath_px + along, CAMERA, sweep.line_px()[:, None] + scan, CAMERA.pixel_slopes())
        most = np.maximum(most, np.abs(np.stack(beside) - plan).max(axis=(1, 2)))
    assert np.all(most <= bound * (1 + 1e-4))
    assert np.all(bound <= 1.1 * most)


POINTING_ERRORS_SWEEP = Sweep("s", "fine", "x", swath_px=0.0, start_px=-19.5, lines=40)


def source_of(pointing: PointingErrors | None) -> SimulatedSource:
    """Return a source without noise over a smooth scene."""
    y, x = np.mgrid[:120, :760]
    scene = image_scene((1 + 0.3 * np.cos(y / 7) * np.cos(x / 11))[..., None], CAMERA, [500.0])
    return SimulatedSource(scene, Rig(CAMERA), chosen=effects_on("rotation", "slit"), pointing=pointing)


def test_pointing_offset_moves_the_view_but_not_reported_positions():
    """The scene appears moved by the offset, while the lines and the sweep report planned positions."""
    errors = PointingErrors(offset_px=20.0, seed=1)
    along, scan = errors.offset("s")
    start_px = float(POINTING_ERRORS_SWEEP.start_px + scan)
    moved = replace(POINTING_ERRORS_SWEEP, swath_px=float(along), start_px=start_px, name="moved")
    seen = SimulatedSweep(source_of(errors), POINTING_ERRORS_SWEEP)
    np.testing.assert_allclose(seen.read(0, 40), SimulatedSweep(source_of(None), moved).read(0, 40), atol=1)
    np.testing.assert_array_equal(seen.position, wire_positions(line_positions(POINTING_ERRORS_SWEEP, CAMERA)))
    assert next(source_of(errors).lines(POINTING_ERRORS_SWEEP)).mirror_x == seen.position[0, 0]


MIRROR_EFFECTS_CAMERA = LineCamera(samples=64, exposure_ms=4.0)
MOTION = MirrorMotion(positions_per_line=1.5, repeatability_urad=40.0, hysteresis_px=5.0, drift_px_per_min=500.0)
AIR = Air(distance_m=30.0, relief="step", nearest_m=3.0, wind_amplitude_m=0.005, wind_hz=20.0)
MIRROR_EFFECTS_RIG = Rig(camera=MIRROR_EFFECTS_CAMERA, mirror=MOTION, air=AIR)
SWATH = Sweep("swath", "fine", "x", 3.0, -25.0, 40)
ACROSS = replace(SWATH, along="y")
PLAIN: dict[Any, str] = {ROTATION: "rays", SLIT: "3x1"}
SLOPE = (8.0, 13.0)  # along x and along y [e-/px]
MOVERS = [STAIRCASE, LAG, JITTER, HYSTERESIS, THERMAL_DRIFT, PARALLAX, WIND]


def scan_pass(chosen: dict[Any, str], sweep: Sweep = SWATH, lines: range = range(40), **more: Any) -> np.ndarray:
    """Return the light of some lines of a ramp along x and y, in two bands of which the second is half as bright."""
    y, x = np.mgrid[:161, :161]
    plane = (2000 + SLOPE[0] * (x - 80) + SLOPE[1] * (y - 80)).astype(np.float32)[..., None]
    electrons = np.array([[1.0, 0.5]], np.float32) * np.float32(DEFAULT_EXPOSURE_MS / MIRROR_EFFECTS_CAMERA.exposure_ms)
    scene = made_scene(plane, electrons, [500.0, 600.0])
    block = SweepBlock(MIRROR_EFFECTS_RIG, sweep, lines, scene.wavelength_nm, scene.shape, **more)
    return expected_light(scene, block, {**chosen, **PLAIN})


@pytest.mark.parametrize("sweep", [SWATH, ACROSS], ids=["x", "y"])
@pytest.mark.parametrize("effect", MOVERS, ids=lambda effect: effect.name)
def test_light_on_a_ramp_changes_by_slope_times_displacement(effect: Any, sweep: Sweep):
    """The displacement is the stated shift of each effect, in either orientation."""
    found = scan_pass({effect: "exact"}, sweep) - scan_pass({}, sweep)
    block = SweepBlock(MIRROR_EFFECTS_RIG, sweep, range(40), np.array([500.0, 600.0]), (161, 161))
    if hasattr(effect, "aim"):
        along, scan = np.moveaxis(effect.aim(block, "exact").mean(axis=1), -1, 0)[..., None]
    else:
        along, scan = effect.displaced(block, *sweep_to_scene(sweep, MIRROR_EFFECTS_CAMERA), "exact")
    x, y = (along, scan) if sweep.along == "x" else (scan, along)
    stated = np.broadcast_to(SLOPE[0] * x + SLOPE[1] * y, found.shape[:2])
    away = (
        np.abs(sweep_to_scene(sweep, MIRROR_EFFECTS_CAMERA)[sweep.along == "x"]) > 2
    )  # a depth step splits footprints on it
    np.testing.assert_allclose(found[..., 0][away], stated[away], rtol=5e-3, atol=0.05)
    np.testing.assert_allclose(found[..., 1], found[..., 0] / 2, atol=2e-3)
    assert np.abs(found).max() > 0.1


def test_offset_of_a_sweep_depends_on_the_seed() -> None:
    """Two surveys have different offsets for sweeps of the same name."""
    one, other = (PointingErrors(6.0, seed).offset("full-0") for seed in (1, 2))
    assert (one != other).all()
