"""Motion of the mirror: the matrix exponential at any damping, the staircase of the path, and their bounds."""

from __future__ import annotations

from dataclasses import replace

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.simulator.effects.pointing import LAG, beside_plan, responses, transient
from spectralzoom.pipeline.simulator.rig_model import MirrorMotion, Rig
from tests.pipeline.simulator.made_up_effects import steep_probe

SWEEP = Sweep("swath", "fine", "x", 0.0, -100.0, 200)


def rig(exposure_ms: float = 3.0, **mirror: float) -> Rig:
    """Return a rig with the default mirror, or one with some settings changed."""
    return Rig(camera=LineCamera(exposure_ms=exposure_ms), mirror=replace(MirrorMotion(), **mirror))


@pytest.mark.parametrize("damping", [0.01, 0.7, 1 - 1e-9, 1.0, 1 + 1e-12, 1 + 1e-6, 1.5, 10.0])
@pytest.mark.parametrize("time", [0.0, 1e-12, 1e-4, 0.02, 0.3, 1.0, 30.0, 1e6])
def test_responses_match_arithmetic_of_50_digits(damping: float, time: float):
    """Impulse and step response agree below, at and above damping 1, early and late."""
    with mpmath.workdps(50):
        z, t = mpmath.mpf(damping), mpmath.mpf(time)
        root = mpmath.sqrt(z * z - 1)
        pulse = mpmath.exp(-z * t) * (mpmath.sinh(root * t) / root if root else t)
        rise = 1 - mpmath.exp(-z * t) * mpmath.cosh(root * t) - z * pulse
        truth = float(mpmath.re(pulse)), float(mpmath.re(rise))
    found = [one.item() for one in responses(np.array([time]), damping)]
    assert found == pytest.approx(truth, rel=1e-10, abs=1e-15)


@pytest.mark.parametrize("damping", [0.3, 1.0, 2.5])
@pytest.mark.parametrize(
    ("exposure_ms", "step", "positions"), [(3.0, 1, 1.0), (5.0, 4, 1.0), (4.0, 2, 1.5), (1.0, 3, 1)]
)
def test_transient_matches_the_integrated_motion(damping: float, exposure_ms: float, step: int, positions: float):
    """The motion from rest, minus that after a long run-in, is integrated step by step."""
    of_mirror = rig(exposure_ms, damping=damping, positions_per_line=positions, settled_s=50.0)
    sweep = replace(SWEEP, lines=20, step=step)
    truth = driven(of_mirror, sweep, run_in=0) - driven(of_mirror, sweep, run_in=400)
    np.testing.assert_allclose(transient(of_mirror, sweep, np.arange(20)), truth, atol=2e-6)


def driven(of_mirror: Rig, sweep: Sweep, run_in: int) -> np.ndarray:
    """Return means over held px of the path of a mirror driven step by step, with a run-in of so many lines."""
    camera = of_mirror.camera
    mirror = of_mirror.mirror
    pace = 2e-3 * np.pi * mirror.natural_hz
    count = round(mirror.positions_per_line * sweep.step)
    moves = np.array([[0.0, 1.0], [-1.0, -2 * mirror.damping]])
    tick = camera.exposure_ms / (sweep.step * count) * pace  # divides both held px and positions
    advance = expm(moves * tick)
    mean = np.linalg.solve(moves, advance - np.eye(2)) / tick
    rest = expm(moves * pace * (camera.frame_ms - camera.exposure_ms))
    height = sweep.step / count
    state = np.zeros(2)
    means = []
    for line in range(-run_in, sweep.lines):
        seen = []
        for number in range(sweep.step * count):
            state[0] -= height * (number % sweep.step == 0)
            seen.append(line * sweep.step + height * (number // sweep.step) + (mean @ state)[0])
            state = advance @ state
        state = rest @ state
        means.append(np.reshape(seen, (sweep.step, count)).mean(axis=1))
    return np.array(means[run_in:])


def test_settling_removes_the_initial_transient():
    """Without settling a sweep begins over 10 px off, where the mirror comes from; the default leaves under 1e-4 px."""
    assert transient(rig(100.0, settled_s=0.0), SWEEP, np.arange(1))[0, 0] > 10
    assert abs(transient(rig(100.0), SWEEP, np.arange(1))[0, 0]) < 1e-4


@settings(max_examples=20, deadline=None)
@given(st.floats(0.01, 10.0), st.floats(0.5, 1000.0), st.floats(0.1, 500.0), st.floats(0.0, 1.0), st.integers(1, 5))
def test_any_mirror_is_finite_and_within_its_bound(damping: float, ms: float, hz: float, settled: float, step: int):
    """Stiff and slow mirrors give no NaN, and the change of a wave stays below the bound."""
    of_mirror = rig(ms, damping=damping, natural_hz=hz, settled_s=settled)
    sweep = replace(SWEEP, lines=30, step=step)
    places = np.linspace(0, 2 * np.pi, 25)[:, None]
    shift = transient(of_mirror, sweep, np.arange(30))
    held = np.arange(step)
    assert np.isfinite(shift).all()
    exact, off = (np.sin(places[..., None] + held + one).mean(axis=2) for one in (shift, np.zeros_like(shift)))
    assert np.abs(exact - off).max() <= LAG.bound(steep_probe(sweeps=(sweep,), span=2.0), of_mirror).value + 1e-9


@settings(max_examples=30, deadline=None)
@given(st.floats(0.05, 40.0), st.integers(1, 5), st.integers(1, 4))
def test_staircase_parts_are_means_of_held_positions(positions: float, step: int, parts: int):
    """Each part is compared with the mean of the held position over 4000 moments."""
    found = beside_plan(positions, step, np.arange(7), parts)
    moment = (np.arange(4000) + 0.5) / 4000
    for line in (0, 6):
        time = line * step + (np.arange(step * parts)[:, None] + moment) / parts
        held = np.floor(positions * time) / positions + 0.5 / positions - 0.5
        planned = line * step + np.arange(step * parts) // parts
        np.testing.assert_allclose(found[line], held.mean(axis=1) - planned, atol=1e-3 / positions + 3e-4)
