"""Jitter: the tilt's way into the scene, its draws, and the bound of the worst of many lines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.geometry.mirror import direction_to_scene, position_to_normal, reflect
from pipeline.geometry.scan import Sweep
from pipeline.simulator.effects.effect import SweepBlock
from pipeline.simulator.effects.pointing import JITTER, tilt_to_scene
from pipeline.simulator.effects.probe import Probe
from pipeline.simulator.rig_model import MirrorMotion, Rig
from tests.pipeline.geometry.test_second_order import pointing_error

SWEEP = Sweep("strip", "fine", "x", 0.0, -500.0, 1001)
RIG = Rig(mirror=replace(MirrorMotion(), repeatability_urad=40.0))
REST = np.array([1.0, 0.0, -1.0]) / np.sqrt(2)


def shifts(lines: range = range(1001), *, seed: int = 0, rig: Rig = RIG, sweep: Sweep = SWEEP) -> np.ndarray:
    """The shift of some lines."""
    return JITTER.aim(SweepBlock(rig, sweep, lines, np.ones(1), (64, 64), seed), "exact")


def probe(slope: tuple[float, float], sweeps: tuple[Sweep, ...] = (SWEEP,), span: float = 1e9) -> Probe:
    """A scene of one band, known by its slope along the line and along the scan."""
    one, none, both = np.ones(1), np.zeros(1), np.array(slope)[:, None]
    lines = sum(sweep.lines for sweep in sweeps)
    return Probe(
        "sigma", sweeps, 500 * one, None, one, one, span * one, both, both, none, none, 1e4, 0.0, 1.0, lines, 60.0
    )


def test_at_rest_the_view_moves_as_the_pointing_error_says():
    """40 urad move the view by .76 px in the plane of incidence, along the scan, and by .54 px along the line."""
    gain = np.abs(tilt_to_scene(REST)) * 40e-6 / RIG.camera.ifov_rad
    in_plane, across = pointing_error(RIG.camera, 40e-6)
    np.testing.assert_allclose(gain, [[across, 0], [0, in_plane]], atol=1e-12)
    assert (in_plane, across) == pytest.approx((0.757, 0.535), abs=1e-3)


@pytest.mark.parametrize("position", [(0.0, 0.0), (0.3, 0.4), (-0.7, 0.5), (0.1, -0.9)])
def test_gains_are_the_derivatives_of_the_reflection(position: tuple[float, float]):
    """Small turns of the normal about two axes of its own move the view by the gains, anywhere on the disk."""
    normal = position_to_normal(position)
    within = np.cross([0.0, 1.0, 0.0], normal)
    within /= np.linalg.norm(within)
    for column, tilt in enumerate((np.cross(normal, within), within)):
        turned = [normal + angle * tilt for angle in (1e-6, -1e-6)]
        seen = [direction_to_scene(reflect((0.0, 0.0, 1.0), one / np.linalg.norm(one))) for one in turned]
        np.testing.assert_allclose(tilt_to_scene(normal)[:, column], (seen[0] - seen[1]) / 2e-6, atol=1e-6)


def test_spread_of_the_draws():
    """Lines scatter by .76 px rms along the scan and .54 px along the line, without bias or correlation."""
    shift = shifts()[:, 0]
    assert np.std(shift, axis=0) == pytest.approx((0.535, 0.757), rel=0.1)
    assert np.abs(shift.mean(axis=0)).max() < 0.1
    assert abs(np.corrcoef(shift.T)[0, 1]) < 0.1


@pytest.mark.parametrize("size", [1, 7])
def test_blocks_do_not_change_lines(size: int):
    """Lines are bit for bit the same in blocks of any size; another seed or sweep has other draws."""
    whole = shifts(range(64))
    parts = [shifts(range(start, min(start + size, 64))) for start in range(0, 64, size)]
    np.testing.assert_array_equal(np.concatenate(parts), whole)
    assert not np.isclose(whole, shifts(range(64), seed=1)).any()
    assert not np.isclose(whole, shifts(range(64), sweep=replace(SWEEP, name="next"))).any()


def test_samples_do_not_change_lines():
    """A block of some samples has the shifts of the whole line."""
    some = SweepBlock(RIG, SWEEP, range(5), np.ones(1), (64, 64), samples=range(3, 9))
    np.testing.assert_array_equal(JITTER.aim(some, "exact"), shifts(range(5)))


def test_bound_holds_and_is_tight():
    """Waves in random directions change by less than the bound in 8 surveys, at the median by a sixth at least."""
    rng = np.random.default_rng(5)
    ratios = []
    for seed in range(8):
        wave = rng.normal(0, 0.4, (3, 2))
        place, phase = rng.uniform(-9, 9, (400, 2)), rng.uniform(0, 7, 3)
        slope = np.abs(np.cos(place @ wave.T + phase) @ wave).max(axis=0) * 1.02
        look = np.sin(place @ wave.T + phase)
        shift = shifts(seed=seed)
        measured = max(np.abs((np.sin((place + one) @ wave.T + phase) - look).sum(axis=1)).max() for one in shift[:, 0])
        bound = JITTER.bound(probe((slope[0], slope[1]), span=6.0), RIG).value
        assert measured <= bound
        ratios.append(bound / measured)
    assert np.median(ratios) < 6


def test_more_lines_have_a_worse_worst():
    """The bound grows with the root of the logarithm of the lines: 5.4 sigma for 2560."""
    found = JITTER.bound(probe((0.0, 1.0), (replace(SWEEP, start_px=0.0, lines=1),)), RIG).value
    assert found == pytest.approx(np.sqrt(2 * np.log(1000)) * 0.757, rel=1e-3)
    many = JITTER.bound(probe((0.0, 1.0), (replace(SWEEP, start_px=-1280.0, lines=2560),)), RIG)
    assert "5.4 times" in many.why
    assert many.value > found


def test_nothing_without_jitter_slope_or_lines():
    """A mirror that repeats, a flat scene and no sweep have no jitter."""
    assert JITTER.bound(probe((5.0, 5.0)), Rig()).value == 0
    assert JITTER.bound(probe((0.0, 0.0)), RIG).value == 0
    assert JITTER.bound(probe((5.0, 5.0), ()), RIG).value == 0
    assert not shifts(range(5), rig=Rig()).any()
    assert shifts(range(3, 3)).shape == (0, 1, 2)
