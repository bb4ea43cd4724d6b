"""How the emulated axes move, against the closed form of a second-order system."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.rig.emulator import mirror_motion
from pipeline.rig.emulator.mirror_motion import AxisMotion, Stiffness

STIFF = Stiffness(20.0, 0.7)


def step_response(time_s: NDArray[np.float64], stiffness: Stiffness) -> NDArray[np.float64]:
    """The textbook's step response of an underdamped system."""
    damping, pace = stiffness.damping, stiffness.pace
    turned = pace * math.sqrt(1 - damping**2)
    wave = np.cos(turned * time_s) + damping / math.sqrt(1 - damping**2) * np.sin(turned * time_s)
    return np.where(time_s < 0, 0.0, 1 - np.exp(-damping * pace * time_s) * wave)


@pytest.mark.parametrize("damping", [0.05, 0.7, 0.99])
def test_a_step_is_answered_as_the_closed_form_says(damping: float) -> None:
    """From rest, at any time, before and after the step."""
    stiffness = Stiffness(20.0, damping)
    axis = AxisMotion(stiffness)
    axis.command(0.5, -0.3)
    times = np.linspace(0.4, 1.5, 500)
    np.testing.assert_allclose(axis.places(times), -0.3 * step_response(times - 0.5, stiffness), atol=1e-12)


def test_steps_add_up() -> None:
    """The system is linear: many steps, taken while it still moves, answer as the sum of theirs."""
    random = np.random.default_rng(3)
    when, where = np.sort(random.uniform(0, 0.3, 40)), random.uniform(-1, 1, 40)
    axis = AxisMotion(STIFF)
    for time_s, place in zip(when.tolist(), where.tolist(), strict=True):
        axis.command(time_s, place)
    times = np.linspace(-0.1, 0.6, 300)
    heights = np.diff(where, prepend=0.0)
    expected = sum(h * step_response(times - t, STIFF) for t, h in zip(when, heights, strict=True))
    np.testing.assert_allclose(axis.places(times), expected, atol=1e-11)


def test_one_time_and_many_agree() -> None:
    """The fast way for one time gives what the way for many gives."""
    axis = AxisMotion(STIFF)
    axis.command(1.0, 0.5)
    axis.command(1.01, -0.5)
    for time_s in (0.0, 1.005, 1.02, 3.0):
        assert axis.place(time_s) == pytest.approx(float(axis.places(time_s)), abs=1e-14)


def test_the_bound_on_what_is_left_is_one() -> None:
    """From any time on the axis never is farther off its command than the bound said then."""
    axis = AxisMotion(Stiffness(20.0, 0.05))
    axis.command(0.0, 1.0)
    for time_s in np.linspace(0, 0.5, 50).tolist():
        later = time_s + np.linspace(0, 0.3, 300)
        assert np.max(np.abs(axis.places(later) - 1)) <= axis.unsettled(time_s) * (1 + 1e-9)


def test_an_old_past_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    """The memory of an axis is bounded; what it still knows is unchanged."""
    monkeypatch.setattr(mirror_motion, "KEPT_STEPS", 100)
    axis, short = AxisMotion(STIFF), AxisMotion(STIFF)
    for number in range(1000):
        axis.command(number * 0.01, number % 2)
        if number >= 700:
            short.command(number * 0.01, number % 2)
    assert len(axis._time) <= 200
    assert axis.place(20.0) == pytest.approx(short.place(20.0), abs=1e-9)
