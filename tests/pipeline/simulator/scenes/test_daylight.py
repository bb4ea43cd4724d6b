"""Daylight: the sun where and when it is known to stand, and the light from noon to the night."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from pipeline.errors import SettingsError
from pipeline.simulator.rig_model import Sky
from pipeline.simulator.scenes.daylight import knots_within, relative_daylight, sun_elevation_deg

BANDS = np.array([400.0, 550.0, 760.0, 1000.0])
EQUINOX = Sky(started=datetime(2026, 3, 20, 0, 0, tzinfo=UTC), latitude_deg=29.5, longitude_deg=0.0)


def test_the_sun_stands_at_the_latitudes_complement_at_an_equinox() -> None:
    """At noon of an equinox the sun is 90 deg less the latitude high, at midnight as far below."""
    high = sun_elevation_deg(EQUINOX, np.arange(0, 86400, 300.0))
    assert high.max() == pytest.approx(60.5, abs=0.1)
    assert high.min() == pytest.approx(-60.5, abs=0.3)


@pytest.mark.parametrize(
    ("day", "elevation", "percent"), [((4, 16), 20.0, 1.04), ((4, 29), 30.0, 0.66), ((5, 23), 45.0, 0.38)]
)
def test_rates_worked_by_hand(day: tuple[int, int], elevation: float, percent: float) -> None:
    """Due east at 29.5 deg north the sun rises by 13.05 deg an hour: cot(h) dh/dt is 1.04, 0.66, 0.38 % in 60 s."""
    sky = replace(EQUINOX, started=datetime(2026, *day, tzinfo=UTC))
    seconds = np.arange(4 * 3600.0, 12 * 3600.0, 60.0)
    height = sun_elevation_deg(sky, seconds)
    start = float(np.interp(elevation, height, seconds))
    before, after = np.sin(np.deg2rad(sun_elevation_deg(sky, np.array([start, start + 60]))))
    assert 100 * (after / before - 1) == pytest.approx(percent, abs=0.02)


def test_light_is_relative_to_the_start() -> None:
    """It is 1 at the start in every band."""
    sky = replace(EQUINOX, started=datetime(2026, 3, 20, 9, 30, tzinfo=UTC))
    np.testing.assert_allclose(relative_daylight(sky, BANDS, np.zeros(1)), 1, rtol=1e-12)


def test_a_low_sun_is_redder() -> None:
    """At 5 deg green has lost more than the near infrared; at 20 deg green has fallen by more than the sine."""
    sky = replace(EQUINOX, started=datetime(2026, 3, 20, 15, 0, tzinfo=UTC))
    seconds = np.arange(0, 4 * 3600, 60.0)
    height = sun_elevation_deg(sky, seconds)
    light = relative_daylight(sky, BANDS, seconds)
    low = light[np.abs(height - 5).argmin()]
    assert low[1] < 0.8 * low[3]
    twenty = np.abs(height - 20).argmin()
    assert light[twenty, 1] < np.sin(np.deg2rad(height[twenty])) / np.sin(np.deg2rad(height[0]))


@pytest.mark.parametrize("hour", [0, 5, 12, 17])
def test_night_is_dark_and_finite(hour: int) -> None:
    """Through a day from any hour the light is finite and 0 exactly with the sun down, the start's sun down or not."""
    sky = replace(EQUINOX, started=datetime(2026, 3, 20, hour, tzinfo=UTC))
    seconds = np.arange(0, 86400, 300.0)
    light = relative_daylight(sky, BANDS, seconds)
    height = sun_elevation_deg(sky, seconds)
    assert np.isfinite(light).all()
    assert (light[height < -0.1] == 0).all()
    assert (light[height > 0.1] > 0).all()


def test_sunset_is_even() -> None:
    """The light goes to 0 at the horizon without a step: by less than 0.2 % of that at 1 deg in a second."""
    sky = replace(EQUINOX, started=datetime(2026, 3, 20, 17, 55, tzinfo=UTC))
    light = relative_daylight(sky, BANDS, np.arange(0, 1200.0))
    assert light[-1].max() == 0
    assert np.abs(np.diff(light, axis=0)).max() < 0.01


@pytest.mark.parametrize("latitude", [90.0, -90.0])
def test_poles(latitude: float) -> None:
    """At the poles a day is all light or all night."""
    sky = Sky(started=datetime(2026, 6, 21, tzinfo=UTC), latitude_deg=latitude)
    light = relative_daylight(sky, BANDS, np.arange(0, 86400, 1800.0))
    assert (light > 0.9).all() if latitude > 0 else (light == 0).all()


def test_knots_are_fine_enough() -> None:
    """Between its knots the light is right to 2e-6 of the start's, up to sunset, and a new year makes no jump."""
    sky = Sky(started=datetime(2026, 12, 31, 22, 0, tzinfo=UTC), latitude_deg=0.0, longitude_deg=-150.0)
    seconds = np.arange(0, 7 * 3600, 10.0)
    on, half = (relative_daylight(sky, BANDS, seconds + shift) for shift in (0.0, 5.0))
    near = sun_elevation_deg(sky, seconds)[1:-2] > 1
    bend = np.abs(on[:-3] - on[1:-2] - on[2:-1] + on[3:]) / 16  # of a parabola, at the middle
    assert bend[near].max() < 2e-6
    np.testing.assert_allclose(half[:-1], (on[:-1] + on[1:]) / 2, rtol=1e-9, atol=1e-12)


def test_knots_within_a_survey() -> None:
    """The survey's ends and the full ten seconds of the day between them."""
    sky = replace(EQUINOX, started=datetime(2026, 3, 20, 9, 0, 7, tzinfo=UTC))
    np.testing.assert_allclose(knots_within(sky, 20.0), [0, 3, 13, 20])


def test_no_time_of_day() -> None:
    """Without a start there is no sun to ask for."""
    with pytest.raises(SettingsError, match=r"sky\.started is not set"):
        relative_daylight(Sky(), BANDS, np.zeros(1))
