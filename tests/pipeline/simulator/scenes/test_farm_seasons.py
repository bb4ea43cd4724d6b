"""The farm's year, its sun and its spectra: calendars, growth stages, shadows, bands and the white reference."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.pipeline.geometry.camera import LineCamera, digitise
from spectralzoom.pipeline.simulator.scenes.farm.farm_scene import crown_shadows
from spectralzoom.pipeline.simulator.scenes.farm.land import (
    CROPS,
    LATITUDE_DEG,
    Sun,
    land_on,
    stage_fractions,
    sun_over_farm,
)
from spectralzoom.pipeline.simulator.scenes.farm.spectra import (
    FWHM_NM,
    MATERIALS,
    band_centres,
    band_response,
    spectral_library,
)


@given(st.sampled_from(sorted(CROPS)), st.floats(-50, 350))
def test_fractions_of_growth_stages_sum_to_1(use: str, age: float) -> None:
    """The fractions are not negative, and at most two neighbouring stages mix."""
    fractions = stage_fractions(CROPS[use], np.array([age]))
    assert 1 <= len(fractions) <= 2
    assert sum(float(fraction[0]) for fraction in fractions.values()) == pytest.approx(1, abs=1e-6)
    assert all(fraction[0] >= 0 and name in MATERIALS for name, fraction in fractions.items())


@pytest.mark.parametrize(
    ("use", "day", "phase", "days"),
    [
        ("wheat_a", 213, "stubble", 0),
        ("wheat_a", 212, "crop", 281),
        ("wheat_a", 280, "soil", 16),
        ("wheat_a", 1, "crop", 70),
        ("maize", 127, "soil", 42),
        ("maize", 128, "crop", 0),
        ("maize", 20, "stubble", 116),
        ("sugar_beet", 289, "crop", 184),
        ("sugar_beet", 290, "soil", 0),
        ("grass", 150, "grass", 9),
        ("soil", 150, "soil", 2),
        ("stubble", 211, "stubble", 365),
        ("late_maize", 172, "crop", 20),
    ],
)
def test_fields_follow_their_calendar(use: str, day: int, phase: str, days: float) -> None:
    """Phase and days of each use match the calendar, also across the turn of the year."""
    assert land_on(use, day, 0.0) == (phase, days)


SHAPE = (161, 161)


def test_sun_position_agrees_with_the_solar_position_algorithm() -> None:
    """At the same true solar time, elevation and azimuth differ from pvlib's by less than 0.7 degrees."""
    from pvlib.spa import solar_position

    at_ground = {"elev": 0.0, "pressure": 1013.25, "temp": 12.0, "delta_t": 69.0, "atmos_refract": 0.5667}
    start = np.datetime64("2025-01-01T00:00:00").astype(np.int64)
    for day in (20, 110, 172, 250, 340):
        moments = start + (day - 1) * 86400.0 + np.arange(8 * 3600, 15 * 3600, 600.0)
        found = solar_position(moments, LATITUDE_DEG, 0.0, **at_ground)
        noon = np.interp(180.0, found[4], moments)  # azimuth rises through the day
        hours = 12 + (moments - noon) / 3600
        for hour, elevation, azimuth in list(zip(hours, found[3], found[4], strict=True))[::7]:
            if elevation > 8:
                ours = sun_over_farm(day, float(hour))
                assert ours.elevation_deg == pytest.approx(elevation, abs=0.7)
                assert ours.azimuth_deg == pytest.approx(azimuth, abs=0.7)


@pytest.mark.parametrize("azimuth", [90.0, 135.0, 180.0, 240.0])
def test_shadows_point_away_from_the_sun_and_lengthen(azimuth: float) -> None:
    """The shadow's centre lies opposite the sun; the lower the sun, the farther it is and the longer the shadow."""
    lengths = []
    for elevation in (60.0, 35.0, 20.0):
        shadow = crown_shadows(np.zeros((1, 2)), np.array([8.0]), Sun(azimuth, elevation), SHAPE)
        y, x = np.mgrid[: SHAPE[0], : SHAPE[1]] - 80.0
        centre = np.array([(shadow * y).sum(), (shadow * x).sum()]) / shadow.sum()
        to_sun = np.array([-np.cos(np.deg2rad(azimuth)), np.sin(np.deg2rad(azimuth))])
        assert centre @ to_sun == pytest.approx(-9.6 / np.tan(np.deg2rad(elevation)), abs=0.1)
        assert centre[0] * to_sun[1] - centre[1] * to_sun[0] == pytest.approx(0, abs=0.05)
        assert shadow.sum() == pytest.approx(np.pi * 8 * np.hypot(8, 7.2 / np.tan(np.deg2rad(elevation))), rel=0.02)
        lengths.append(shadow.sum())
    assert lengths == sorted(lengths)


@pytest.mark.parametrize("bands", [2, 4, 15, 200, 270, 939])
def test_spectral_library_has_any_number_of_bands(bands: int) -> None:
    """Libraries of 2 to 939 bands span 400 to 1000 nm, with positive light that has a maximum of 1."""
    library = spectral_library(bands)
    assert band_centres(bands)[0][[0, -1]].tolist() == [400.0, 1000.0]
    assert library.reflectance.shape == (len(MATERIALS), bands)
    assert library.light.max() == 1
    assert library.light.min() > 0


def test_band_response_is_centred_with_the_stated_width() -> None:
    """Bands weigh a straight line to its value at their centre and have the stated width at half maximum."""
    centre = np.array([500.0, 700.0])
    weight = band_response(centre, np.full(2, FWHM_NM))
    np.testing.assert_allclose(weight @ np.arange(400.0, 1031.0), centre, rtol=1e-9)
    np.testing.assert_allclose(weight[0, 103] / weight[0, 100], 0.5, rtol=1e-9)


def test_white_reference_never_saturates() -> None:
    """Six standard deviations of shot and read noise fit below the full well, and DN stay below full scale."""
    camera = LineCamera()
    white_reference = spectral_library(270).white_reference_electrons(camera)
    assert (white_reference + 6 * np.sqrt(white_reference + camera.read_noise_e**2)).max() < camera.full_scale_e
    assert digitise(white_reference, camera, np.random.default_rng(0)).max() < camera.full_scale_dn
