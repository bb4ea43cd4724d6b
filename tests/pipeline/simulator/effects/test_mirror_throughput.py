"""Throughput of the tilted mirror: Fresnel's laws, published metals, projected area, and bounds of sweeps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.pipeline.geometry.mirror import mirror_throughput
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.simulator.effects.effect import SweepBlock
from spectralzoom.pipeline.simulator.effects.lighting import POLARISATION, VIGNETTING, fresnel, reflectance
from spectralzoom.pipeline.simulator.rig_model import MirrorMotion, Rig
from tests.pipeline.simulator.spectral_light import probe_of, rig_with

NM = np.linspace(400.0, 1000.0, 61)


def sweep_at(swath_px, start_px, lines, step=1):
    """Return a sweep along x."""
    return Sweep("fine", "fine", "x", swath_px=swath_px, start_px=start_px, lines=lines, step=step)


RIG = replace(rig_with(), mirror=MirrorMotion(coating="aluminium"))


def factors(sweep, effect=POLARISATION, rig=RIG, nm=NM):
    """Return the factor of every line, (line, band)."""
    gain = effect.gain(SweepBlock(rig, sweep, range(sweep.lines), nm, (640, 640)), effect.variants[0])
    assert gain.shape == (sweep.lines, 1, len(nm))
    assert gain.dtype == np.float32
    return gain[:, 0].astype(np.float64)


def looking(view_deg):
    """Return the factors (band,) of one line with this view angle from rest, twice the mirror's rotation."""
    return factors(sweep_at(0, np.tan(np.radians(view_deg)) / RIG.camera.ifov_rad, 1))[0]


def test_bare_aluminium_matches_fresnel_by_hand():
    """Means over 400 to 1000 nm are +0.5 % at 20 deg and -3.7 % at 70; extremes are +0.7 and -5.4 %, at 820 nm."""
    obtuse, oblique = 100 * (looking(-50) - 1), 100 * (looking(50) - 1)
    assert (obtuse.mean(), oblique.mean()) == pytest.approx((0.49, -3.74), abs=0.02)
    assert (obtuse.max(), oblique.min()) == pytest.approx((0.68, -5.38), abs=0.02)
    assert abs(int(NM[oblique.argmin()]) - 820) <= 10


def test_factor_follows_the_angle_of_incidence():
    """The cosine of the angle of incidence is -n_z, at any place of the field."""
    block = SweepBlock(RIG, sweep_at(-2300, 1700, 50), range(50), NM, (640, 640))
    incidence = np.arccos(-block.normals[:, 2])
    at_rest = reflectance("aluminium", NM, np.radians([45.0]))
    np.testing.assert_allclose(factors(block.sweep), reflectance("aluminium", NM, incidence) / at_rest, rtol=1e-6)


VIGNETTING_RIG = Rig()
VIGNETTING_NM = np.array([700.0])


def test_vignetting_equals_the_throughput_of_the_calibration():
    """Lines are multiplied by the throughput that calibration divides by, at any place of the field."""
    sweep = sweep_at(-2300, 1700, 50, 4)
    block = SweepBlock(VIGNETTING_RIG, sweep, range(50), VIGNETTING_NM, (640, 640))
    fractions = mirror_throughput(block.positions).reshape(50, -1)
    found = factors(sweep, VIGNETTING, VIGNETTING_RIG, VIGNETTING_NM)[:, 0]
    np.testing.assert_allclose(found, fractions.mean(axis=1), rtol=1e-7)


def test_vignetting_changes_by_138_dn_over_640_lines():
    """The change is 3.4 %, 138 of 4095 DN (139 if rounded first); the bound counts the difference from rest."""
    sweep = sweep_at(0, -320, 640)
    held = factors(sweep, VIGNETTING, VIGNETTING_RIG, VIGNETTING_NM)[:, 0]
    assert 4095 * np.ptp(held) == pytest.approx(138.5, abs=0.5)
    flat = np.full((2, 8, 1), 10_000, np.float32)
    bound = VIGNETTING.bound(probe_of(flat, VIGNETTING_NM, "dn", sweep=sweep), VIGNETTING_RIG)
    assert bound.value == pytest.approx(2000 * np.abs(held - 1).max(), rel=1e-5)
    assert "0.983 to 1.017" in bound.why


PARTS = st.floats(0.02, 20.0)


def of(n: float, k: float, degrees: float) -> tuple[float, float]:
    """Return both reflectances of one index at one angle."""
    across, within = fresnel(np.array([n + 1j * k]), np.radians([degrees]))
    return float(across[0]), float(within[0])


@given(PARTS, PARTS)
def test_parallel_reflectance_at_45_deg_is_the_square_of_perpendicular(n: float, k: float) -> None:
    """For any index, Rp(45 deg) = Rs(45 deg)^2: measuring at one angle gives both reflectances."""
    across, within = of(n, k, 45.0)
    assert within == pytest.approx(across**2, rel=1e-9)


def test_glass_matches_fresnel_by_hand() -> None:
    """n = 1.5 gives 4 % at normal incidence; at Brewster's angle, 56.31 deg, 0 in the plane and 14.79 % across it."""
    assert of(1.5, 0.0, 0.0) == pytest.approx((0.04, 0.04))
    assert of(1.5, 0.0, np.degrees(np.arctan(1.5))) == pytest.approx(((1.25 / 3.25) ** 2, 0.0), abs=1e-12)


@pytest.mark.parametrize(
    ("coating", "nm", "fraction"), [("aluminium", 550, 0.916), ("aluminium", 800, 0.867), ("aluminium", 1000, 0.94)]
)
def test_metals_match_published_reflectances_at_normal_incidence(coating: str, nm: float, fraction: float) -> None:
    """Evaporated films (Hass in the American Institute of Physics Handbook, table 6g) agree within 2 points."""
    assert reflectance(coating, np.array([nm]), np.zeros(1))[0, 0] == pytest.approx(fraction, abs=0.02)
