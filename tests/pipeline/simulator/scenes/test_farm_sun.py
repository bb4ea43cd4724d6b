"""The sun over the farm and its shadows: against another algorithm, and where and how long shadows fall."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import SceneError
from pipeline.simulator.scenes.farm.farm_scene import crown_shadows
from pipeline.simulator.scenes.farm.seasons import LATITUDE_DEG, Sun, sun_over_farm

SHAPE = (161, 161)


def test_the_sun_stands_as_the_declination_says() -> None:
    """At true noon the sun is in the south, as high as declination and latitude add up to."""
    for day, declination in ((80, -0.4), (172, 23.45), (266, 0.0), (355, -23.45)):
        sun = sun_over_farm(day, 12.0)
        assert sun.azimuth_deg == pytest.approx(180, abs=1e-6)
        assert sun.elevation_deg == pytest.approx(90 - LATITUDE_DEG + declination, abs=0.5)


@given(st.integers(60, 300), st.floats(0, 3.5))
def test_mornings_mirror_afternoons(day: int, hours: float) -> None:
    """As long before noon as after it the sun is as high, and as far to the east as to the west."""
    before, after = sun_over_farm(day, 12 - hours), sun_over_farm(day, 12 + hours)
    assert before.elevation_deg == pytest.approx(after.elevation_deg)
    assert before.azimuth_deg == pytest.approx(360 - after.azimuth_deg)


def test_the_sun_agrees_with_the_surveys() -> None:
    """Place by the survey's algorithm for the same true solar time differs by less than 0.7 degrees."""
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
def test_shadows_point_away_and_lengthen(azimuth: float) -> None:
    """The shadow's centre lies opposite the sun, further off and longer the lower the sun."""
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


def test_shadows_at_the_edge_and_beyond() -> None:
    """Shadows that leave the scene are cut, trees outside may throw theirs into it, and no tree throws none."""
    sun = Sun(180.0, 30.0)
    inside = crown_shadows(np.array([[0.0, 0.0]]), np.array([9.0]), sun, (300, 300))
    cut = crown_shadows(np.array([[0.0, 0.0]]), np.array([9.0]), sun, (20, 14))
    np.testing.assert_allclose(cut, inside[140:160, 143:157], atol=1e-6)
    far = np.array([[500.0, 0.0], [0.0, -500.0], [-500.0, 0.0], [0.0, 500.0]])
    assert crown_shadows(far, np.full(4, 9.0), sun, (20, 14)).max() == 0
    assert crown_shadows(np.zeros((0, 2)), np.zeros(0), sun, (3, 4)).shape == (3, 4)
    assert crown_shadows(np.array([[16.0, 0.0]]), np.array([6.0]), sun, (16, 16)).max() > 0.9


def test_night_and_no_day_are_refused() -> None:
    """A sun below five degrees and a day of no year are refused with the value."""
    with pytest.raises(SceneError, match=r"at hour 3 of day 172 the sun stands at .* at least 5"):
        sun_over_farm(172, 3.0)
    with pytest.raises(SceneError, match="got 400"):
        sun_over_farm(400, 12.0)
