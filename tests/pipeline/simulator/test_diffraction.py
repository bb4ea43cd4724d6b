"""Diffraction: widths by hand, energy and variance of the Airy pattern, the Gaussian in its place, and the bound."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.special import j1

from pipeline.simulator.effects.diffraction import (
    DIFFRACTION,
    THIRD_RING,
    airy_energy,
    airy_variance,
    diffraction_fwhm,
)
from pipeline.simulator.rig_model import Optics, Rig
from tests.pipeline.simulator.fine_image import FLAT, IMAGES, SWEEP, airy, airy_contrast, change, gaussian, probe_of

RIG = Rig()
NM = np.array([400.0, 700.0, 1000.0])
RADIAN_PX = NM * 1e-9 / 15e-3 / RIG.camera.ifov_rad  # lambda / D


def test_widths_at_rest():
    """0.37 px at 400 nm and 0.92 px at 1000 nm along the scan, where 10.6 mm are seen; 0.71 of it along the line."""
    along, scan = diffraction_fwhm(RIG, NM)
    assert scan[[0, 2]] == pytest.approx([0.37, 0.92], abs=0.005)
    assert along == pytest.approx(scan * np.sqrt(0.5))


def test_width_at_grazing_incidence():
    """1.9 px at 1000 nm and 70 deg incidence, and no wider along the line than at rest."""
    normal = np.array([np.sin(np.deg2rad(70)), 0, -np.cos(np.deg2rad(70))])
    along, scan = diffraction_fwhm(RIG, NM, normal)
    assert scan[2] == pytest.approx(1.9, abs=0.005)
    assert along == pytest.approx(diffraction_fwhm(RIG, NM)[0])


@pytest.mark.parametrize(("ring", "energy"), [(3.831706, 0.838), (7.015587, 0.910), (THIRD_RING, 0.938)])
def test_energy_within_dark_rings(ring: float, energy: float):
    """83.8, 91.0 and 93.8 % of the light lie within the first three; the last is a zero of J1."""
    assert airy_energy(ring) == pytest.approx(energy, abs=5e-4)
    assert j1(ring) == pytest.approx(0, abs=1e-6)


@given(st.floats(0.0, 40.0))
def test_variance_of_a_cut_off_pattern_is_its_integral(v: float):
    """The closed form agrees with the integral of t J1^2 over the energy, from a point's v^2 / 4 on."""
    inside = quad(lambda t: t * j1(t) ** 2, 0, v, limit=200)[0]
    light = quad(lambda t: 2 * j1(t) ** 2 / t if t else 0.0, 0, v, limit=200)[0]
    assert airy_variance(v) == pytest.approx(inside / light if v > 1e-3 else v * v / 4, rel=1e-4, abs=1e-12)


def test_contrast_of_the_gaussian_in_place_of_the_pattern():
    """Within 0.08 behind the footprint, 0.065 up to half a period per px; other Gaussians are worse."""
    u = np.linspace(0, 1, 2001)

    def error(sd: float, most: float = np.inf) -> float:  # over the bands, along line and scan; sd in lambda / D
        boxes = [(size * r, box) for size in RADIAN_PX for r, box in ((1.0, 1.0), (np.sqrt(2), RIG.camera.slit_px))]
        wrong = np.abs(airy_contrast(u) - np.exp(-2 * (np.pi * sd * u) ** 2))
        return max(float((wrong * np.abs(np.sinc(u / size * box)))[u <= most * size].max()) for size, box in boxes)

    sd = np.sqrt(airy_variance(THIRD_RING)) / np.pi
    taken = error(sd)
    assert taken < 0.0801
    assert error(sd, most=0.5) < 0.065
    assert taken < error(1.029 / 2.3548)
    assert taken < error(np.sqrt(airy_variance(3.831706)) / np.pi)
    assert taken < error(np.sqrt(airy_variance(7.015587)) / np.pi)


def test_moments_grow_with_wavelength_squared_and_do_not_shift():
    """Variance of lambda squared, twice as large along the scan as along the line at rest; no shift."""
    moments = DIFFRACTION.moments(RIG, NM, "airy")
    assert not moments.shift.any()
    assert moments.variance == pytest.approx(0.34868 * np.outer([1, 2], RADIAN_PX**2), rel=1e-4)


def test_one_width_errs_alike_at_both_ends():
    """All bands get one variance, halfway between those of the first and the last; one band keeps its own."""
    exact, taken = (DIFFRACTION.moments(RIG, NM, variant).variance for variant in DIFFRACTION.variants)
    assert np.ptp(taken, axis=1) == pytest.approx([0, 0])
    assert taken[:, 0] - exact[:, 0] == pytest.approx(exact[:, 2] - taken[:, 2])
    one = NM[:1]
    assert DIFFRACTION.moments(RIG, one, "one-width").variance == pytest.approx(
        DIFFRACTION.moments(RIG, one, "airy").variance
    )


@pytest.mark.parametrize("name", IMAGES)
def test_bound_holds(name: str):
    """Neither the folded Gaussian nor, with the span of the light beyond the ring, the whole pattern changes more."""
    image = IMAGES[name]()
    probe = probe_of(image, NM[2:])
    along, scan = np.sqrt(DIFFRACTION.moments(RIG, NM[2:], "airy").variance[:, 0])
    measured, bound = change(image, gaussian(along, scan)), DIFFRACTION.bound(probe, RIG).value
    assert bound / 6 < measured <= bound
    whole = change(image, airy(RADIAN_PX[2], RADIAN_PX[2] * np.sqrt(2)))
    assert whole <= bound + (1 - airy_energy(THIRD_RING)) * probe.span[0]


@pytest.mark.parametrize("name", IMAGES)
def test_bound_of_one_width_holds(name: str):
    """Every band as wide as the middle one changes no band by more than the bound."""
    image = IMAGES[name]()
    bound = DIFFRACTION.bound(probe_of(image, NM), RIG, "one-width").value
    exact, taken = (np.sqrt(DIFFRACTION.moments(RIG, NM, variant).variance) for variant in DIFFRACTION.variants)
    wrong = [change(image, 1 + gaussian(*exact[:, band]) - gaussian(*taken[:, band])) for band in (0, 2)]
    assert bound / 6 < max(wrong) <= bound


def test_bound_covers_every_tilt_of_the_sweeps():
    """A sweep towards grazing incidence raises the bound; one away from it leaves the bound of the rest position."""
    probe = probe_of(IMAGES["edges"](), NM)
    rest = DIFFRACTION.bound(probe, RIG).value
    steep, flat = (replace(SWEEP, start_px=start) for start in (4000.0, -5000.0))
    assert DIFFRACTION.bound(replace(probe, sweeps=(steep,)), RIG).value > rest
    assert DIFFRACTION.bound(replace(probe, sweeps=(flat,)), RIG).value == pytest.approx(rest, rel=2e-3)


def test_nothing_to_blur():
    """A flat scene and the exact variant have a bound of 0; a wide aperture has nearly none."""
    flat = probe_of(FLAT, NM)
    assert DIFFRACTION.bound(flat, RIG).value == pytest.approx(0, abs=1e-9)
    probe = probe_of(IMAGES["edges"](), NM)
    assert DIFFRACTION.bound(probe, RIG, "airy").value == 0
    assert DIFFRACTION.bound(probe, Rig(optics=Optics(aperture_mm=1e3))).value < 1e-3


def test_the_sentence_names_band_and_size():
    """Why: blur in px at the band that it changes most, and the detail that it meets."""
    why = DIFFRACTION.bound(probe_of(IMAGES["edges"](), NM), RIG).why
    assert why.startswith("diffraction: 0.37 px (sd) along the line, 0.53 px along the scan at 1000 nm")
