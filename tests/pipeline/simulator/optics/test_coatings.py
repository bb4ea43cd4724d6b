"""Coatings: Fresnel's laws for any index, and published reflectances of the three metals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.simulator.effects.mirror_throughput import METALS, fresnel, reflectance, refractive_index

PARTS = st.floats(0.02, 20.0)
ANGLES = np.radians(np.linspace(0.0, 89.9, 400))
NM = np.linspace(400.0, 1000.0, 61)


def of(n: float, k: float, degrees: float) -> tuple[float, float]:
    """Both reflectances of one index at one angle."""
    across, within = fresnel(np.array([n + 1j * k]), np.radians([degrees]))
    return float(across[0]), float(within[0])


@given(PARTS, PARTS)
def test_ends_of_the_range(n: float, k: float) -> None:
    """Head on both are ((n - 1)^2 + k^2) / ((n + 1)^2 + k^2); grazing light is reflected whole."""
    head_on = ((n - 1) ** 2 + k**2) / ((n + 1) ** 2 + k**2)
    assert of(n, k, 0.0) == pytest.approx((head_on, head_on), rel=1e-9)
    assert of(n, k, 90.0) == pytest.approx((1.0, 1.0), abs=1e-9)


@given(PARTS, PARTS)
def test_at_45_deg_one_is_the_square_of_the_other(n: float, k: float) -> None:
    """For any index, Rp(45 deg) = Rs(45 deg)^2: how reflectances are measured by one angle."""
    across, within = of(n, k, 45.0)
    assert within == pytest.approx(across**2, rel=1e-9)


@given(PARTS, PARTS)
def test_across_rises_with_the_angle_and_is_the_greater(n: float, k: float) -> None:
    """No share is negative or above 1."""
    across, within = fresnel(np.array([n + 1j * k]), ANGLES)
    assert (np.diff(across) > -1e-12).all()
    assert (within <= across + 1e-12).all()
    assert within.min() >= 0
    assert across.max() <= 1 + 1e-12


def test_glass_by_hand() -> None:
    """n = 1.5: 4 % head on, nothing within the plane at Brewster's angle of 56.31 deg, 14.79 % across it there."""
    assert of(1.5, 0.0, 0.0) == pytest.approx((0.04, 0.04))
    assert of(1.5, 0.0, np.degrees(np.arctan(1.5))) == pytest.approx(((1.25 / 3.25) ** 2, 0.0), abs=1e-12)


@pytest.mark.parametrize(
    ("coating", "nm", "share"),
    [
        ("aluminium", 550, 0.916),
        ("aluminium", 800, 0.867),
        ("aluminium", 1000, 0.94),
        ("gold", 600, 0.919),
        ("gold", 700, 0.97),
        ("silver", 550, 0.983),
    ],
)
def test_published_reflectances_head_on(coating: str, nm: float, share: float) -> None:
    """Of evaporated films (Hass in the American Institute of Physics Handbook, table 6g): within 2 points."""
    found = reflectance(coating, np.array([nm]), np.zeros(1))  # type: ignore[arg-type]
    assert found[0, 0] == pytest.approx(share, abs=0.02)


def test_aluminium_by_hand() -> None:
    """At 619.93 nm, a row of the table, and 70 deg: Rs and Rp from real arithmetic alone (a^2 + b^2 form)."""
    n, k, sine = 1.3660, 7.4052, np.sin(np.radians(70.0))
    cosine, tangent = np.sqrt(1 - sine**2), sine / np.sqrt(1 - sine**2)
    real = n**2 - k**2 - sine**2
    root = np.hypot(real, 2 * n * k)
    a, both = np.sqrt((root + real) / 2), root
    across = (both - 2 * a * cosine + cosine**2) / (both + 2 * a * cosine + cosine**2)
    slope = sine * tangent
    within = across * (both - 2 * a * slope + slope**2) / (both + 2 * a * slope + slope**2)
    found = reflectance("aluminium", np.array([619.93]), np.radians([70.0]))[0, 0]
    assert found == pytest.approx((across + within) / 2, rel=1e-9)
    assert found == pytest.approx(0.8731, abs=1e-4)


@pytest.mark.parametrize("coating", METALS)
def test_tables_rise_and_their_ends_are_held(coating: str) -> None:
    """Wavelengths in order; what lies beyond has the index of the nearest."""
    nm, n, k = METALS[coating].T
    assert (np.diff(nm) > 0).all()
    assert nm[0] <= 311
    assert nm[-1] >= 1937
    found = refractive_index(coating, np.array([200.0, 5000.0]))  # type: ignore[arg-type]
    np.testing.assert_array_equal(found, [n[0] + 1j * k[0], n[-1] + 1j * k[-1]])


def test_an_ideal_mirror_reflects_everything() -> None:
    """At any angle, in every band."""
    assert (reflectance("ideal", NM, ANGLES) == 1).all()
