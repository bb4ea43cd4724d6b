"""Hysteresis and thermal drift: smooth, of the rig's own, and bounded by what they are known to be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.geometry.scan import Sweep
from pipeline.simulator.effects.effect import SweepBlock
from pipeline.simulator.effects.pointing import HYSTERESIS, THERMAL_DRIFT, pointing_field, scan_sign
from pipeline.simulator.effects.probe import Probe
from pipeline.simulator.rig_model import Detector, MirrorMotion, Rig

SWEEP = Sweep("strip", "fine", "x", 640.0, -700.0, 1401)
RIG = Rig(mirror=replace(MirrorMotion(), hysteresis_px=50.0, drift_px_per_min=2.0))


class Returning(Sweep):
    """A sweep that is scanned the other way."""

    def held_px(self) -> np.ndarray:
        """From the last position to the first."""
        return super().held_px()[::-1, ::-1]


def block(lines: range = range(1401), *, sweep: Sweep = SWEEP, rig: Rig = RIG, started_s: float = 0.0) -> SweepBlock:
    """Some lines of a sweep."""
    return SweepBlock(rig, sweep, lines, np.ones(1), (64, 64), started_s=started_s)


def probe(slope: tuple[float, float], sweeps: tuple[Sweep, ...] = (SWEEP,), span: float = 1e9) -> Probe:
    """A scene of one band, known by its slope along the line and along the scan."""
    one, none, both = np.ones(1), np.zeros(1), np.array(slope)[:, None]
    return Probe(
        "sigma", sweeps, 500 * one, None, one, one, span * one, both, both, none, none, 1e4, 0.0, 1.0, 1401, 140.1
    )


@pytest.mark.parametrize("unit", range(8))
def test_field_stays_within_one_and_is_smooth(unit: int):
    """Over the disk the field is at most 1 in either axis and changes by at most 4 per unit of position."""
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 101), np.linspace(-1, 1, 101)), axis=-1)
    inside = np.hypot(*np.moveaxis(grid, -1, 0)) <= 1
    field = np.where(inside[..., None], pointing_field(unit, grid), np.nan)
    assert np.nanmax(np.abs(field)) <= 1 + 1e-12
    assert np.nanmax(np.abs(np.diff(field, axis=0))) < 4.1 * 0.02
    assert np.nanstd(field) > 0.05


def test_units_differ_and_a_unit_keeps_its_field():
    """The field follows from the copy of the rig alone: not from seed, sweep or block."""
    whole = HYSTERESIS.aim(block(), "exact")
    for size in (1, 7):
        parts = [HYSTERESIS.aim(block(range(a, min(a + size, 40))), "exact") for a in range(0, 40, size)]
        np.testing.assert_array_equal(np.concatenate(parts), whole[:40])
    np.testing.assert_array_equal(HYSTERESIS.aim(replace(block(), seed=9, sweep=replace(SWEEP, name="b")), ""), whole)
    other = replace(RIG, detector=replace(Detector(), unit=1))
    assert not np.isclose(HYSTERESIS.aim(block(rig=other), "exact"), whole).all()


def test_sign_is_that_of_the_scan():
    """A scan that comes back meets the same field with the other sign; one position counts as forward."""
    forth, back = HYSTERESIS.aim(block(), "exact"), HYSTERESIS.aim(block(sweep=Returning(**vars(SWEEP))), "exact")
    np.testing.assert_array_equal(back, -forth)
    assert scan_sign(replace(SWEEP, lines=1)) == 1
    assert np.abs(forth).max() <= 50


def test_drift_walks_evenly_in_one_direction():
    """2 px a minute are 2 px after a minute, whatever the direction."""
    drift = THERMAL_DRIFT.aim(block(range(601)), "exact")[:, 0]
    assert np.hypot(*(drift[600] - drift[0])) == pytest.approx(2.0, rel=1e-9)
    np.testing.assert_allclose(np.diff(drift, axis=0), np.broadcast_to(drift[1] - drift[0], (600, 2)), atol=1e-12)
    late = THERMAL_DRIFT.aim(block(range(3), started_s=3600.0), "exact")[:, 0]
    assert np.hypot(*late[0]) == pytest.approx(120.0, rel=1e-4)


@pytest.mark.parametrize("effect", [HYSTERESIS, THERMAL_DRIFT])
@pytest.mark.parametrize("reach_px", [10.0, 300.0])
def test_bound_holds_and_is_tight(effect: object, reach_px: float):
    """The change of a wave, long or short beside the shift, is below the bound and at least a sixth of it."""
    shift = effect.aim(block(), "exact")[:, 0]  # type: ignore[attr-defined]
    wave = np.array([0.6, 0.8]) / reach_px
    phase = np.linspace(0, 2 * np.pi, 60)[:, None]
    measured = np.abs(np.sin(phase + shift @ wave) - np.sin(phase)).max()
    bound = effect.bound(probe((wave[0], wave[1]), span=2.0), RIG).value  # type: ignore[attr-defined]
    assert measured <= bound <= 6 * measured


@pytest.mark.parametrize("effect", [HYSTERESIS, THERMAL_DRIFT])
def test_nothing_without_the_effect_or_slope(effect: object):
    """A mirror without it, a flat scene and no sweep: nothing to compute."""
    assert effect.bound(probe((5.0, 5.0)), Rig()).value == 0  # type: ignore[attr-defined]
    assert effect.bound(probe((0.0, 0.0)), RIG).value == 0  # type: ignore[attr-defined]
    assert effect.bound(probe((5.0, 5.0), ()), RIG).value == 0  # type: ignore[attr-defined]
    assert not effect.aim(block(range(4), rig=Rig()), "exact").any()  # type: ignore[attr-defined]
