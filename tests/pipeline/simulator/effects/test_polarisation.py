"""Polarisation: what a coating reflects over what it reflects at rest, and the bound over whole sweeps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.geometry.scan import Sweep
from pipeline.simulator.effects.effect import SweepBlock
from pipeline.simulator.effects.mirror_throughput import POLARISATION, reflectance
from pipeline.simulator.rig_model import MirrorMotion, Rig
from tests.pipeline.simulator.spectral_light import probe_of, rig_with

NM = np.linspace(400.0, 1000.0, 61)
FLAT = np.full((2, 8, len(NM)), 10_000, np.float32)
METALS = ("aluminium", "gold", "silver")


def sweep_at(strip_px, start_px, lines):
    """A sweep along x."""
    return Sweep("fine", "fine", "x", strip_px=strip_px, start_px=start_px, lines=lines)


def coated(coating="aluminium"):
    """A rig whose mirror is of some metal."""
    return replace(rig_with(), mirror=MirrorMotion(coating=coating))


RIG = coated()


def factors(sweep, rig=RIG):
    """Factor of every line, (line, band)."""
    gain = POLARISATION.gain(SweepBlock(rig, sweep, range(sweep.lines), NM, (640, 640)), "exact")
    assert gain.shape == (sweep.lines, 1, len(NM))
    return gain[:, 0].astype(np.float64)


def looking(view_deg, rig=RIG):
    """Factors of one line that looks so far from rest: twice the mirror's turn, (band,)."""
    return factors(sweep_at(0, np.tan(np.radians(view_deg)) / rig.camera.ifov_rad, 1), rig)[0]


def test_bare_aluminium_by_fresnel():
    """Over 400 to 1000 nm, +0.5 % at 20 deg and -3.7 % at 70; at most 0.7 and 5.4 %, at 820 nm."""
    obtuse, oblique = 100 * (looking(-50) - 1), 100 * (looking(50) - 1)
    assert (obtuse.mean(), oblique.mean()) == pytest.approx((0.49, -3.74), abs=0.02)
    assert (obtuse.max(), oblique.min()) == pytest.approx((0.68, -5.38), abs=0.02)
    assert abs(int(NM[oblique.argmin()]) - 820) <= 10


def test_other_metals_by_fresnel():
    """Gold turns round with wavelength, +17 % in the blue and under 1 % beyond 600 nm; silver changes least."""
    gold, silver = 100 * (looking(50, coated("gold")) - 1), 100 * (looking(50, coated("silver")) - 1)
    assert gold[NM < 480].min() > 16
    assert np.abs(gold[NM > 600]).max() < 1
    assert np.abs(silver).max() < 0.7


@pytest.mark.parametrize("coating", METALS)
def test_rest_is_1(coating):
    """White frames are taken at rest: no band changes there."""
    np.testing.assert_allclose(looking(0, coated(coating)), 1, atol=1e-6)


def test_off_axis_incidence_follows_the_mirror():
    """To the side of the plane of incidence cos i is |n_z| as well: 3000 px to the side at rest is 45 deg."""
    np.testing.assert_allclose(factors(sweep_at(3000, 0, 1)), 1, atol=1e-6)


@given(st.integers(-4500, 4500), st.integers(-11_000, 10_000), st.integers(1, 900), st.sampled_from(METALS))
@settings(max_examples=50, deadline=None)
def test_bound_is_the_greatest_way_from_rest(strip_px, start_px, lines, coating):
    """The bound holds for every line between the ends of a sweep, extremes of the metal included, and is reached."""
    sweep, rig = sweep_at(strip_px, start_px, lines), coated(coating)
    probe = probe_of(FLAT, NM, sweep=sweep)
    way = (probe.level * np.abs(factors(sweep, rig) - 1)).max()
    bound = POLARISATION.bound(probe, rig).value
    assert way <= bound * (1 + 1e-4) + 1e-5
    assert bound <= way * 1.05 + 1e-3
    passed = POLARISATION.gain_range(probe, rig)
    assert (factors(sweep, rig) <= passed.greatest + 1e-4).all()
    assert (factors(sweep, rig) >= passed.least - 1e-4).all()


def test_incidence_is_that_of_the_mirror():
    """The factor follows the angle whose cosine is -n_z, at any place of the field."""
    block = SweepBlock(RIG, sweep_at(-2300, 1700, 50), range(50), NM, (640, 640))
    incidence = np.arccos(-block.normals[:, 2])
    at_rest = reflectance("aluminium", NM, np.radians([45.0]))
    np.testing.assert_allclose(factors(block.sweep), reflectance("aluminium", NM, incidence) / at_rest, rtol=1e-6)


def test_why_tells_metal_band_and_angles():
    """An operator reads by how much and where."""
    bound = POLARISATION.bound(probe_of(FLAT, NM, sweep=sweep_at(0, -320, 640)), rig_with())
    assert bound.why == "aluminium, 0.07 % of the light at 820 nm, at incidences of 44.0 to 46.0 deg"


def test_nothing_from_an_ideal_mirror_or_without_lines():
    """An ideal mirror, no sweep, and the exact variant have bounds of 0; an ideal mirror's factor is 1."""
    probe, none = probe_of(FLAT, NM), coated("ideal")
    assert POLARISATION.bound(probe, none).value == 0
    assert POLARISATION.bound(replace(probe, sweeps=()), RIG).value == 0
    assert POLARISATION.bound(probe, RIG, "exact").value == 0
    np.testing.assert_array_equal(factors(sweep_at(0, 900, 5), none), 1)


def test_aluminium_is_what_a_rig_has():
    """Unless its settings say otherwise."""
    assert Rig().mirror.coating == "aluminium"


def test_blocks_do_not_matter():
    """Lines one at a time have the factors of all at once."""
    sweep = sweep_at(-700, 300, 9)
    parts = [POLARISATION.gain(SweepBlock(RIG, sweep, range(n, n + 1), NM, (9, 9)), "exact")[0, 0] for n in range(9)]
    np.testing.assert_array_equal(parts, factors(sweep))
