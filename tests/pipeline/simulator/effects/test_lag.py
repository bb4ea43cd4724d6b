"""Mirror lag: the matrix exponential at any damping and step, and where a rig's own transients matter."""

from __future__ import annotations

from dataclasses import replace

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep
from pipeline.simulator.effects.effect import SweepBlock
from pipeline.simulator.effects.mirror_path import LAG, responses, transient
from pipeline.simulator.effects.probe import Probe
from pipeline.simulator.rig_model import MirrorMotion, Rig

SWEEP = Sweep("strip", "fine", "x", 0.0, -100.0, 200)


def rig(exposure_ms: float = 3.0, **mirror: float) -> Rig:
    """A rig with the default mirror, or one changed in some numbers."""
    return Rig(camera=LineCamera(exposure_ms=exposure_ms), mirror=replace(MirrorMotion(), **mirror))


def probe(slope: float, span: float = 1e9, sweeps: tuple[Sweep, ...] = (SWEEP,)) -> Probe:
    """A scene of one band, known by its slope along the scan."""
    one, none = np.ones(1), np.zeros(1)
    both = np.stack([none, one])
    return Probe(
        "sigma", sweeps, 500 * one, None, one, one, span * one, slope * both, both, none, none, 1e4, 0.0, 1.0, 200, 1.0
    )


@pytest.mark.parametrize("damping", [0.01, 0.7, 1 - 1e-9, 1.0, 1 + 1e-12, 1 + 1e-6, 1.5, 10.0])
@pytest.mark.parametrize("time", [0.0, 1e-12, 1e-4, 0.02, 0.3, 1.0, 30.0, 1e6])
def test_responses_agree_with_fifty_digits(damping: float, time: float):
    """Impulse and step response have no cancellation below, at or above damping 1, early or late."""
    with mpmath.workdps(50):
        z, t = mpmath.mpf(damping), mpmath.mpf(time)
        root = mpmath.sqrt(z * z - 1)
        pulse = mpmath.exp(-z * t) * (mpmath.sinh(root * t) / root if root else t)
        rise = 1 - mpmath.exp(-z * t) * mpmath.cosh(root * t) - z * pulse
        truth = float(mpmath.re(pulse)), float(mpmath.re(rise))
    found = [one.item() for one in responses(np.array([time]), damping)]
    assert found == pytest.approx(truth, rel=1e-10, abs=1e-18 if time < 1 else 1e-15)


@settings(max_examples=40, deadline=None)
@given(st.floats(0.01, 10.0), st.floats(0.0, 50.0))
def test_responses_are_the_matrix_exponential(damping: float, time: float):
    """[[1 - h, g], [-g, 1 - h - 2 zeta g]] is the exponential of the free system."""
    g, h = (one.item() for one in responses(np.array([time]), damping))
    truth = expm(np.array([[0.0, 1.0], [-1.0, -2 * damping]]) * time)
    np.testing.assert_allclose([[1 - h, g], [-g, 1 - h - 2 * damping * g]], truth, atol=1e-9)


@pytest.mark.parametrize(("damping", "overshoot"), [(0.2, 0.5266), (0.7, 0.0460), (1.0, 0.0), (3.0, 0.0)])
def test_overshoot(damping: float, overshoot: float):
    """A step is overshot by exp(-pi zeta / sqrt(1 - zeta^2)), not at all from damping 1 on."""
    rise = responses(np.linspace(0, 60, 60001), damping)[1]
    assert max(rise.max() - 1, 0) == pytest.approx(overshoot, abs=1e-4)


@pytest.mark.parametrize("damping", [0.3, 1.0, 2.5])
@pytest.mark.parametrize(
    ("exposure_ms", "step", "positions"), [(3.0, 1, 1.0), (5.0, 4, 1.0), (4.0, 2, 1.5), (1.0, 3, 1)]
)
def test_transient_is_that_of_the_whole_motion(damping: float, exposure_ms: float, step: int, positions: float):
    """Integrating the mirror step by step from rest, less the same after a long run-in, gives the transient."""
    of_mirror = rig(exposure_ms, damping=damping, positions_per_line=positions, settled_s=50.0)
    sweep = replace(SWEEP, lines=20, step=step)
    found = transient(of_mirror, sweep, np.arange(20))
    truth = driven(of_mirror, sweep, run_in=0) - driven(of_mirror, sweep, run_in=400)
    np.testing.assert_allclose(found, truth, atol=2e-6)


def driven(of_mirror: Rig, sweep: Sweep, run_in: int) -> np.ndarray:
    """Means over held px of path of a mirror fed step by step, its motion starting so many lines earlier."""
    camera, mirror = of_mirror.camera, of_mirror.mirror
    pace, count = 2e-3 * np.pi * mirror.natural_hz, round(mirror.positions_per_line * sweep.step)
    moves = np.array([[0.0, 1.0], [-1.0, -2 * mirror.damping]])
    tick = camera.exposure_ms / (sweep.step * count) * pace  # divides held px and positions alike
    advance = expm(moves * tick)
    mean = np.linalg.solve(moves, advance - np.eye(2)) / tick
    rest = expm(moves * pace * (camera.frame_ms - camera.exposure_ms))
    height, state, means = sweep.step / count, np.zeros(2), []
    for line in range(-run_in, sweep.lines):
        seen = []
        for number in range(sweep.step * count):
            state[0] -= height * (number % sweep.step == 0)
            seen.append(line * sweep.step + height * (number // sweep.step) + (mean @ state)[0])
            state = advance @ state
        state = rest @ state
        means.append(np.reshape(seen, (sweep.step, count)).mean(axis=1))
    return np.array(means[run_in:])


def test_on_for_short_lines_and_off_for_long_ones():
    """At 0.1 sigma on detail of 30 sigma/px the default mirror's lag is on at 3 ms lines and off at 100 ms."""
    short, long = LAG.bound(probe(30.0), rig(3.0)), LAG.bound(probe(30.0), rig(100.0))
    assert short.value > 1
    assert "3 ms a line" in short.why
    assert 0 < 1.2 * long.value < 0.1


def test_fast_lines_tend_to_the_steady_lag():
    """A mirror at rest is ahead of one in steady motion by 2 zeta / (omega t) px, 3.7 px at 3 ms lines of 20 Hz."""
    of_mirror = rig(3.0, positions_per_line=1000.0, settled_s=50.0)
    assert transient(of_mirror, SWEEP, np.arange(1))[0, 0] == pytest.approx(2 * 0.7 / (2 * np.pi * 20 * 3e-3), rel=0.3)


def test_settling_takes_the_way_back_away():
    """Without time to settle the sweep begins where the mirror comes from; the default leaves nothing of it."""
    slow = rig(100.0, settled_s=0.0)
    assert transient(slow, SWEEP, np.arange(1))[0, 0] > 10
    assert abs(transient(rig(100.0), SWEEP, np.arange(1))[0, 0]) < 1e-4


@pytest.mark.parametrize("variant", ["exact", "euler"])
@pytest.mark.parametrize("size", [1, 7, 200])
def test_blocks_do_not_change_lines(variant: str, size: int):
    """Lines are bit for bit the same in blocks of any size."""
    shift = [
        LAG.aim(SweepBlock(rig(), SWEEP, range(a, min(a + size, 200)), np.ones(1), (9, 9)), variant)
        for a in range(0, 200, size)
    ]
    whole = LAG.aim(SweepBlock(rig(), SWEEP, range(200), np.ones(1), (9, 9)), variant)
    np.testing.assert_array_equal(np.concatenate(shift), whole)
    assert not whole[..., 0].any()


@settings(max_examples=40, deadline=None)
@given(st.floats(0.01, 10.0), st.floats(0.5, 1000.0), st.floats(0.1, 500.0), st.floats(0.0, 1.0), st.integers(1, 5))
def test_any_mirror_is_finite_and_within_its_bound(damping: float, ms: float, hz: float, settled: float, step: int):
    """Stiff or slack, no NaN; and the change of a wave stays below the bound, whichever the variant."""
    of_mirror = rig(ms, damping=damping, natural_hz=hz, settled_s=settled)
    sweep = replace(SWEEP, lines=30, step=step)
    numbers, places = np.arange(30), np.linspace(0, 2 * np.pi, 25)[:, None]
    shifts = {variant: transient(of_mirror, sweep, numbers, variant) for variant in ("exact", "euler")}
    assert all(np.isfinite(one).all() for one in shifts.values())
    shifts["off"] = np.zeros_like(shifts["exact"])
    held = np.arange(step)
    seen = {key: np.sin(places[..., None] + held + one).mean(axis=2) for key, one in shifts.items()}
    for variant in ("off", "euler"):
        bound = LAG.bound(probe(1.0, 2.0, (sweep,)), of_mirror, variant).value
        assert np.abs(seen["exact"] - seen[variant]).max() <= bound + 1e-9


@pytest.mark.parametrize("variant", ["off", "euler"])
@pytest.mark.parametrize("exposure_ms", [3.0, 5.0, 20.0, 100.0])
def test_bound_is_tight(variant: str, exposure_ms: float):
    """A wave of 6 px period changes by at least a sixth of the bound."""
    of_mirror, places = rig(exposure_ms), np.linspace(0, 2 * np.pi, 50)[:, None]
    exact = transient(of_mirror, SWEEP, np.arange(200))[:, 0]
    other = transient(of_mirror, SWEEP, np.arange(200), "euler")[:, 0] if variant == "euler" else 0 * exact
    measured = np.abs(np.sin(places + exact) - np.sin(places + other)).max()
    assert measured <= LAG.bound(probe(1.0, 2.0), of_mirror, variant).value <= 6 * measured


def test_nothing_to_see_in_a_flat_scene_or_without_lines():
    """No slope, no lines or the exact variant: no error."""
    assert LAG.bound(probe(0.0), rig()).value == 0
    assert LAG.bound(probe(1.0, sweeps=()), rig()).value == 0
    assert LAG.bound(probe(1.0, sweeps=(replace(SWEEP, lines=0),)), rig()).value == 0
    assert LAG.bound(probe(1.0), rig(), "exact").value == 0
