"""Polarisation: a straight line of the incidence, 1 at rest, and the bound over whole sweeps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.scan import Sweep
from pipeline.simulator.block import Block
from pipeline.simulator.effects.polarisation import POLARISATION
from tests.pipeline.simulator.spectral_light import probe_of, rig_with

NM, FLAT = np.array([700.0]), np.full((2, 8, 1), 10_000, np.float32)
RIG = rig_with(polarisation=0.03)


def sweep_at(strip_px, start_px, lines):
    """A sweep along x."""
    return Sweep("fine", "fine", "x", strip_px=strip_px, start_px=start_px, lines=lines)


def factors(sweep, rig=RIG):
    """Factor of every line, (line,)."""
    gain = POLARISATION.gain(Block(rig, sweep, range(sweep.lines), NM, (640, 640)), "exact")
    assert gain.shape == (sweep.lines, 1, 1)
    return gain[:, 0, 0].astype(np.float64)


@pytest.mark.parametrize(("view_deg", "factor"), [(0, 1.0), (49.9, 0.97006), (-49.9, 1.02994), (20, 0.988)])
def test_straight_in_the_incidence(view_deg, factor):
    """A view turned by 2 x deg meets the mirror x deg more obliquely: 3 % from 45 to 70 deg, as much more at 20."""
    start = np.tan(np.radians(view_deg)) / RIG.camera.ifov_rad
    np.testing.assert_allclose(factors(sweep_at(0, start, 1)), factor, atol=1e-6)


def test_off_axis_incidence_follows_the_mirror():
    """To the side of the plane of incidence cos i is |n_z| as well: 3000 px to the side at rest is 45 deg."""
    np.testing.assert_allclose(factors(sweep_at(3000, 0, 1)), 1, atol=1e-6)


@given(st.integers(-4500, 4500), st.integers(-4500, 4000), st.integers(1, 60))
@settings(max_examples=50, deadline=None)
def test_bound_is_the_greatest_way_from_rest(strip_px, start_px, lines):
    """The ends of a sweep are its extremes: the bound holds and is reached."""
    sweep = sweep_at(strip_px, start_px, lines)
    probe = probe_of(FLAT, NM, sweep=sweep)
    way = float(probe.level[0]) * np.abs(factors(sweep) - 1).max()
    np.testing.assert_allclose(POLARISATION.bound(probe, RIG).value, way, rtol=1e-4, atol=1e-5)


def test_incidence_is_that_of_the_mirror():
    """The factor follows the angle whose cosine is -n_z, at any place of the field."""
    block = Block(RIG, sweep_at(-2300, 1700, 50), range(50), NM, (640, 640))
    degrees = np.degrees(np.arccos(-block.normals[:, 2]))
    np.testing.assert_allclose(factors(block.sweep), 1 - 0.03 * (degrees - 45) / 25, rtol=1e-7)


def test_why_tells_the_angles():
    """An operator reads by how much and where."""
    bound = POLARISATION.bound(probe_of(FLAT, NM, sweep=sweep_at(0, -320, 640)), rig_with())
    assert bound.why == "0.077 % of the light, at incidences of 44.0 to 46.0 deg"


def test_nothing_without_polarisation_or_lines():
    """A share of 0, no sweep, and the exact variant have bounds of 0; a share of 0 is a factor of 1."""
    probe, none = probe_of(FLAT, NM), rig_with(polarisation=0.0)
    assert POLARISATION.bound(probe, none).value == 0
    assert POLARISATION.bound(replace(probe, sweeps=()), RIG).value == 0
    assert POLARISATION.bound(probe, RIG, "exact").value == 0
    np.testing.assert_array_equal(factors(sweep_at(0, 900, 5), none), 1)


def test_blocks_do_not_matter():
    """Lines one at a time have the factors of all at once."""
    sweep = sweep_at(-700, 300, 9)
    parts = [POLARISATION.gain(Block(RIG, sweep, range(n, n + 1), NM, (9, 9)), "exact")[0, 0, 0] for n in range(9)]
    np.testing.assert_array_equal(parts, factors(sweep))
