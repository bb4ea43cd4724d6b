"""Daylight through a survey: where the sun stands, and how much light falls on level ground in each band.

Package ``pvlib`` gives the sun's place by the algorithm of Reda and Andreas [1], and the light by Bird and Riordan's
SPECTRL2 [2]. The sky is clear, at sea level. Times are seconds since the survey's start.

[1] Reda and Andreas, "Solar position algorithm for solar radiation applications", Solar Energy 76, 2004.
   doi:10.1016/j.solener.2003.12.003
[2] Bird and Riordan, "Simple solar spectral model for direct and diffuse irradiance on horizontal and tilted
   planes at the earth's surface for cloudless atmospheres", TR-215-2436, 1984. doi:10.2172/5986936
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.pipeline.simulator.rig_model import Sky

Floats = NDArray[np.float64]
KNOT_S = 10.0  # light is straight between such times: right to 2e-6 of that of a high sun
FAINTEST_DEG = 1.0  # the sun's least height in whose light an exposure is chosen (assumed)
_KNOTS_AN_HOUR = 360
_DAY_S = 86400.0


def sun_elevation_deg(sky: Sky, seconds: Floats) -> Floats:
    """Return the sun's height over the horizon at some times, refraction included, (time,) [deg].

    Raises SettingsError: the sky has no time of day.
    """
    return _elevation_deg(sky.latitude_deg, sky.longitude_deg, _started(sky) + seconds)


def relative_daylight(sky: Sky, wavelength_nm: Floats, seconds: Floats) -> Floats:
    """Return the light on level ground over that at the survey's start, (time, band).

    It is 0 with the sun at the horizon or below. No exposure fits the night: a survey that starts in less light than
    the sun gives from 1 deg is relative to that light. Raises SettingsError: the sky has no time of day.
    """
    start = _started(sky)
    first = _irradiance(sky, np.array([start]), wavelength_nm)
    faintest = _at_bands(_light_of(np.array([FAINTEST_DEG]), np.array([start])), wavelength_nm)
    return _irradiance(sky, start + np.asarray(seconds), wavelength_nm) / np.maximum(first, faintest)


def knots_within(sky: Sky, seconds: float) -> Floats:
    """Return the times between which ``relative_daylight`` is straight: 0, its knots and the last, (time,) [s]."""
    start = _started(sky)
    first, last = np.floor(start / KNOT_S) + 1, np.ceil((start + seconds) / KNOT_S)
    return np.concatenate([[0.0], np.arange(first, last) * KNOT_S - start, [seconds]])


def _started(sky: Sky) -> float:
    if sky.started is None:
        raise SettingsError("sky.started is not set, so there is no course of the sun; set it, with its time zone")
    return sky.started.timestamp()


def _irradiance(sky: Sky, moments: Floats, wavelength_nm: Floats) -> Floats:
    """Return light at moments [s since 1970], (time, band) [W/m^2/nm], linear between knots."""
    knot = moments / KNOT_S
    low = np.floor(knot)
    hours, row = np.divmod(low.astype(np.int64), _KNOTS_AN_HOUR)
    fraction = (knot - low)[:, None]
    light = np.empty((len(moments), len(wavelength_nm)))
    for hour in np.unique(hours):
        here = hours == hour
        table = _table(sky.latitude_deg, sky.longitude_deg, int(hour))
        before, after = table[row[here]], table[row[here] + 1]
        light[here] = _at_bands(before + fraction[here] * (after - before), wavelength_nm)
    return light


@lru_cache(maxsize=64)
def _table(latitude: float, longitude: float, hour: int) -> Floats:
    """Return light at the knots of one hour and the first of the next, (knot, wavelength of the model)."""
    moments = (hour * _KNOTS_AN_HOUR + np.arange(_KNOTS_AN_HOUR + 1.0)) * KNOT_S
    table = _light_of(_elevation_deg(latitude, longitude, moments), moments)
    table.setflags(write=False)
    return table


def _elevation_deg(latitude: float, longitude: float, moments: Floats) -> Floats:
    import pvlib

    at_ground = {"elev": 0.0, "pressure": 1013.25, "temp": 12.0, "delta_t": 69.0, "atmos_refract": 0.5667}
    found = pvlib.spa.solar_position(np.asarray(moments, np.float64), latitude, longitude, **at_ground)
    return 90.0 - np.asarray(found[0], np.float64)  # of the zenith angle with refraction


def clear_sky(zenith_deg: Floats | float, airmass: Floats | float, day: Floats | float) -> tuple[Floats, Floats]:
    """Return SPECTRL2's wavelengths [nm] and light on level ground (wavelength, sun) [W/m^2/nm]."""
    import pvlib

    turned = {"apparent_zenith": zenith_deg, "aoi": zenith_deg, "surface_tilt": 0.0, "relative_airmass": airmass}
    air = {"surface_pressure": 101325.0, "precipitable_water": 1.5, "ozone": 0.31, "aerosol_turbidity_500nm": 0.1}
    sky = pvlib.spectrum.spectrl2(**turned, **air, ground_albedo=0.2, dayofyear=day)  # Pa, cm, atm cm
    return np.asarray(sky["wavelength"], np.float64), np.asarray(sky["poa_global"], np.float64)


def _light_of(elevation_deg: Floats, moments: Floats) -> Floats:
    """Return light on level ground by the sun's height, (time, wavelength of the model); 0 at the horizon and below."""
    import pvlib

    zenith = 90.0 - np.maximum(elevation_deg, 0.0)
    moment = np.asarray(moments * 1e6, "datetime64[us]")
    start_of_year = moment.astype("datetime64[Y]").astype("datetime64[us]")
    day = (moment - start_of_year).astype(np.float64) / (1e6 * _DAY_S) + 1  # with parts: nothing jumps at midnight
    light = clear_sky(zenith, pvlib.atmosphere.get_relative_airmass(zenith, "kastenyoung1989"), day)[1]
    return np.where(elevation_deg[:, None] > 0, np.maximum(light.T, 0.0), 0.0)


def _at_bands(light: Floats, wavelength_nm: Floats) -> Floats:
    """Read (time, wavelength of the model) at bands, (time, band), straight between; the ends are carried on."""
    model = _model_wavelengths()
    high = np.clip(np.searchsorted(model, wavelength_nm), 1, len(model) - 1)
    low = high - 1
    fraction = np.clip((wavelength_nm - model[low]) / (model[high] - model[low]), 0.0, 1.0)
    return light[:, low] + fraction * (light[:, high] - light[:, low])


@lru_cache(maxsize=1)
def _model_wavelengths() -> Floats:
    return clear_sky(0.0, 1.0, 172)[0]
