"""Vignetting: the hand-worked shares of the geometry, the bound over whole sweeps, and lines free of each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.geometry.mirror import mirror_throughput
from pipeline.geometry.scan import Sweep, line_positions
from pipeline.simulator.effects.effect import SweepBlock
from pipeline.simulator.effects.mirror_throughput import MOST_BEND, VIGNETTING
from pipeline.simulator.render import expected_light
from pipeline.simulator.rig_model import Rig
from tests.pipeline.simulator.spectral_light import probe_of, rig_with, small_scene, worst

RIG, NM = Rig(), np.array([700.0])
FLAT = np.full((2, 8, 1), 10_000, np.float32)


def sweep_at(strip_px, start_px, lines, step=1):
    """A sweep along x."""
    return Sweep("fine", "fine", "x", strip_px=strip_px, start_px=start_px, lines=lines, step=step)


def factors(sweep, variant="held"):
    """Factor of every line, (line,)."""
    gain = VIGNETTING.gain(SweepBlock(RIG, sweep, range(sweep.lines), NM, (640, 640)), variant)
    assert gain.shape == (sweep.lines, 1, 1)
    assert gain.dtype == np.float32
    return gain[:, 0, 0].astype(np.float64)


def test_shares_over_a_field_of_10240_px():
    """Over 10240 x 10240 px the mirror passes 0.72 to 1.21 of its light at rest, and 1 at rest."""
    held = factors(sweep_at(0, -5120, 10_241))
    np.testing.assert_allclose(held[[0, 5120, -1]], [1.215, 1, 0.724], atol=5e-4)
    assert np.all(np.diff(held) < 0)


@pytest.mark.parametrize(("variant", "at"), [("held", "positions"), ("middle", "middle")])
def test_shares_are_those_of_the_mirror(variant, at):
    """What calibration divides by is what the lines are multiplied by, at any place of the field."""
    sweep = sweep_at(-2300, 1700, 50, 4)
    shares = mirror_throughput(getattr(SweepBlock(RIG, sweep, range(50), NM, (640, 640)), at)).reshape(50, -1)
    np.testing.assert_allclose(factors(sweep, variant), shares.mean(axis=1), rtol=1e-7)


def test_shares_over_the_disk():
    """At the rim, along the plane of incidence, 0.48 and 1.33."""
    np.testing.assert_allclose(mirror_throughput([[-1.0, 0.0], [1.0, 0.0]]), [0.484, 1.329], atol=5e-4)


def test_one_sweep_of_640_lines_changes_138_dn():
    """3.4 % from end to end, 138 of 4095 DN (139 if rounded first), of which the bound counts the way from rest."""
    sweep = sweep_at(0, -320, 640)
    held = factors(sweep)
    assert 4095 * np.ptp(held) == pytest.approx(138.5, abs=0.5)
    bound = VIGNETTING.bound(probe_of(FLAT, NM, "dn", sweep=sweep), RIG)
    assert bound.value == pytest.approx(2000 * np.abs(held - 1).max(), rel=1e-5)
    assert "0.983 to 1.017" in bound.why


def test_flat_field_keeps_it_on():
    """A field without any structure has its greatest signal: at 10,000 e- the sweep's ends are 1.6 sigma off."""
    assert VIGNETTING.bound(probe_of(FLAT, NM, sweep=sweep_at(0, -320, 640)), RIG).value > 1


def test_single_patch_is_nearly_constant():
    """320 lines around 2000 px differ by 2 %, though they pass 0.89 of the light at rest."""
    held = factors(sweep_at(0, 1840, 320))
    assert np.ptp(held) < 0.021
    np.testing.assert_allclose(held.mean(), 0.889, atol=2e-3)


@given(st.integers(-4500, 4500), st.integers(-4500, 4000), st.integers(1, 60), st.integers(1, 8))
@settings(max_examples=60, deadline=None)
def test_bounds_hold_and_are_tight(strip_px, start_px, lines, step):
    """The greatest way from 1 among all lines is the bound's, within 1 %; the middle of an exposure stands for all."""
    sweep = sweep_at(strip_px, start_px, lines, step)
    probe, held = probe_of(FLAT, NM, sweep=sweep), factors(sweep)
    bound, signal = VIGNETTING.bound(probe, RIG).value, float(probe.level[0])
    way = signal * np.abs(held - 1).max()
    assert way <= bound + signal * 1e-7
    assert bound <= 1.01 * way + signal * 2e-4 * step
    middle = mirror_throughput(line_positions(sweep, RIG.camera))
    exact = mirror_throughput(SweepBlock(RIG, sweep, range(lines), NM, (640, 640)).positions).mean(axis=1)
    assert signal * np.abs(middle - exact).max() <= VIGNETTING.bound(probe, RIG, "middle").value + signal * 1e-14


def test_bend_covers_the_disk():
    """The second derivative of the share over the scan's tangent is nowhere above what the bound takes."""
    eta = np.linspace(-1.19, 1.19, 2001)
    for xi in (0.0, 0.3, 0.8):
        share = np.sqrt(1 - eta / np.sqrt(1 + xi**2 + eta**2))
        bend = np.abs(np.gradient(np.gradient(share, eta), eta))[2:-2].max()
        assert bend < MOST_BEND
        assert xi > 0 or bend > 0.98 * MOST_BEND


def test_through_the_render():
    """Light of a scene with and without: the lines' factors, and no sample off by more than the bound."""
    wavelength, scene = small_scene()
    sweep = sweep_at(0, 900, 6)
    block = SweepBlock(rig_with(), sweep, range(6), wavelength, scene.shape)
    plain, made = expected_light(scene, block, {}), expected_light(scene, block, {VIGNETTING: "held"})
    np.testing.assert_allclose(made / plain, factors(sweep)[:, None, None] * np.ones(plain.shape), rtol=1e-5)
    bound = VIGNETTING.bound(probe_of(plain, wavelength, sweep=sweep), block.rig).value
    assert bound / 2 < worst(made, plain, "sigma") <= bound * 1.001


def test_exact_variant_one_line_and_no_line():
    """The exact variant misses nothing, a line at rest nothing either, and no sweep has nothing to lose."""
    probe = probe_of(FLAT, NM, sweep=sweep_at(900, 0, 1))
    assert VIGNETTING.bound(probe, RIG).value == 0
    assert VIGNETTING.bound(probe, RIG, "held").value == 0
    assert VIGNETTING.bound(probe, RIG, "middle").value == 0
    assert VIGNETTING.bound(replace(probe, sweeps=()), RIG).value == 0


def test_blocks_do_not_matter():
    """Lines in blocks of 1 and 7 have the factors of all at once."""
    sweep = sweep_at(-700, 300, 20, 4)
    whole = factors(sweep)
    for size in (1, 7):
        for start in range(0, 20, size):
            lines = range(start, min(start + size, 20))
            part = VIGNETTING.gain(SweepBlock(RIG, sweep, lines, NM, (640, 640)), "held")[:, 0, 0]
            np.testing.assert_array_equal(part, whole[start : start + size].astype(np.float32))
