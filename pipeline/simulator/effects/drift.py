"""Illumination drift: the daylight changes with the sun's course, through a sweep and through a day."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.block import SweepBlock
from pipeline.simulator.daylight import knots_within, relative_daylight, sun_elevation_deg
from pipeline.simulator.effects.effect import OFF, Bound, Light
from pipeline.simulator.gain_range import GainRange
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig, Sky

Floats = NDArray[np.float64]
SPECTRAL, SCALAR, LINEAR = "spectral", "scalar", "linear"
_RATE_OVER_S = 60.0
_KNOTS_AT_ONCE = 512


@dataclass(frozen=True)
class Drift:
    """Light at a line's mid exposure over the light at the survey's start, to which the scene is stated.

    ``spectral`` is SPECTRL2 under a clear sky, band by band, by the air that the sun shines through. ``scalar`` is the
    mean of that over the bands, ``linear`` a straight line in time by the mean's rate in the survey's first minute,
    never below 0. A survey that starts in the night is relative to the light of a sun 1 deg high.
    Without a time of day there is no drift. With the sun at the horizon or below the light is 0.
    """

    name = "drift"
    variants = (SPECTRAL, SCALAR, LINEAR)
    cost_ns = MappingProxyType({SPECTRAL: 0.4, SCALAR: 0.2, LINEAR: 0.2})

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound by level times the greatest change of the light, or its difference to a variant, through the survey.

        The light is straight between its knots, so that its extremes lie on them.
        """
        if rig.sky.started is None:
            return Bound(0.0, "the survey has no time of day")
        if variant == SPECTRAL:
            return Bound(0.0, "band by band")
        seconds = probe.seconds + rig.camera.frame_ms * 1e-3  # to the end of the last line
        worst = np.zeros(len(probe.wavelength_nm))
        for some in _parts(_corners(rig.sky, probe.wavelength_nm, seconds, variant)):
            exact = _daylight(rig.sky, probe.wavelength_nm, some, SPECTRAL)
            missed = exact - (1 if variant == OFF else _daylight(rig.sky, probe.wavelength_nm, some, variant))
            worst = np.maximum(worst, np.abs(missed).max(axis=0))
        low, high = sun_elevation_deg(rig.sky, np.array([0.0, seconds]))
        course = f"with the sun from {low:.1f} to {high:.1f} deg in {_spoken(seconds)}"
        verb = "changes" if variant == OFF else "at this variant is wrong"
        return Bound(probe.scaled(worst), f"light {verb} by at most {100 * worst.max(initial=0.0):.3g} % {course}")

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        """Give the daylight of the survey."""
        return daylight_range(probe, rig)

    def gain(self, block: SweepBlock, variant: str) -> Light:
        """Give (line, 1, band), or (line, 1, 1) of the variants that take all bands as one."""
        sky = block.rig.sky
        if sky.started is None:
            return np.ones((1, 1, 1), np.float32)
        return _daylight(sky, block.wavelength_nm, block.time_s, variant)[:, None].astype(np.float32)


DRIFT = Drift()


def daylight_range(probe: Probe, rig: Rig) -> GainRange:
    """Give the daylight of the survey over that at its start; 1 without a time of day."""
    nm = np.asarray(probe.wavelength_nm, np.float64)
    if rig.sky.started is None:
        return GainRange.between(1.0, 1.0, len(nm))
    times = knots_within(rig.sky, probe.seconds + rig.camera.frame_ms * 1e-3)
    light = relative_daylight(rig.sky, nm, times)
    return GainRange.of(light, nm, uneven=float(np.ptp(light, axis=1).max(initial=0.0)))


def _daylight(sky: Sky, wavelength_nm: Floats, seconds: Floats, variant: str) -> Floats:
    """Give (time, band), or (time, 1), over the light at the start."""
    if variant == LINEAR:
        return np.maximum(1 + _first_rate(sky, wavelength_nm) * seconds[:, None], 0.0)
    if variant == SCALAR:
        return _of_all(sky, wavelength_nm, seconds)
    return relative_daylight(sky, wavelength_nm, seconds)


def _of_all(sky: Sky, wavelength_nm: Floats, seconds: Floats) -> Floats:
    """Mean over the bands, (time, 1): every band counts by its light at the start, so as 1."""
    mean: Floats = relative_daylight(sky, wavelength_nm, seconds).mean(axis=1, keepdims=True)
    return mean


def _first_rate(sky: Sky, wavelength_nm: Floats) -> float:
    """Change of the mean in the survey's first minute [1/s], from its own value: 0 in the night."""
    first, later = _of_all(sky, wavelength_nm, np.array([0.0, _RATE_OVER_S])).ravel()
    return float(later - first) / _RATE_OVER_S


def _corners(sky: Sky, wavelength_nm: Floats, seconds: float, variant: str) -> Floats:
    """Times between which both the light and the variant are straight, (time,) [s]."""
    times = knots_within(sky, seconds)
    rate = _first_rate(sky, wavelength_nm) if variant == LINEAR else 0.0
    dark = -1 / rate if rate < 0 else np.inf  # from here on the straight line is 0
    return np.append(times, dark) if dark < seconds else times


def _parts(times: Floats) -> list[Floats]:
    return np.array_split(times, len(times) // _KNOTS_AT_ONCE + 1)


def _spoken(seconds: float) -> str:
    return f"{seconds / 3600:.1f} h" if seconds >= 3600 else f"{seconds:.0f} s"
