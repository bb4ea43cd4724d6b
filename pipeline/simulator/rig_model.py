"""Model of the simulated rig beyond its camera, and of what lies between it and the scene: numbers with sources.

Nothing here was measured on a unit: what is not of a data sheet (from memory) is assumed.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from typing import Any, Literal

from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import Sweep, exposing
from spectralzoom.pipeline.setting_fields import assumed, misfits, stated

Coating = Literal["aluminium", "ideal"]  # ideal: reflects everything, at any angle
Relief = Literal["flat", "step", "plane"]
Cover = Literal["clear", "overcast"]
LIGHT_UNDER: dict[Cover, float] = {"clear": 1.0, "overcast": 1 / 8}  # thick stratus passes 10 to 20 % (assumed)
OF_THE_SCENE = ("light", "light_fraction")  # of a sky: the scene's electrons and its key have them
LEAST_DISTANCE_M = 1e-3


@dataclass(frozen=True)
class Optics:
    """Mirror as a stop, lens, slit spectrograph."""

    aperture_mm: float = stated(15.0, "Diameter of the mirror, the aperture stop", "mm", 0.1, 1e3, source="data sheet")
    focus_m: float = assumed(math.inf, "Distance that is sharp", "m", 0.01)
    aberration_px: float = assumed(0.2, "Standard deviation of the lens's own blur", "px", 0.0, 10.0)
    keystone_px: float = assumed(0.15, "Shift along the line, first wavelength to last", "px", 0.0, 20.0)
    smile_nm: float = assumed(0.3, "Excess of the wavelengths at a line's ends", "nm", -100.0, 100.0)
    fwhm_nm: float = stated(6.0, "Width of a band", "nm", 0.0, 1e3, source="data sheet")
    stray_fraction: float = assumed(1e-3, "Fraction of a line's light that is spread over its detector", "", 0.0, 0.5)
    stray_even: float = assumed(0.5, "Fraction of the stray light that falls evenly; the rest is a halo", "", 0.0, 1.0)
    stray_halo_px: float = assumed(64.0, "Standard deviation of the halo, over samples and bands alike", "px", 2.0, 1e6)


@dataclass(frozen=True)
class MirrorMotion:
    """Motion of the mirror, a second-order system fed from a vector memory, and its coating."""

    natural_hz: float = stated(20.0, "Full-scale bandwidth", "Hz", 0.1, 1e5, source="data sheet")
    damping: float = assumed(0.7, "Damping ratio", "", 0.01, 10.0)
    settled_s: float = assumed(0.2, "Time to come to rest one position ahead of a sweep's first", "s", 0.0, 1e4)
    positions_per_line: float = assumed(1.0, "Positions of the vector memory for each px of the path", "", 0.01, 1e4)
    repeatability_urad: float = assumed(
        0.0, "Standard deviation of the tilt, line by line; vendor: 40", "urad", 0.0, 1e5
    )
    hysteresis_px: float = assumed(
        0.0, "Systematic error whose sign is that of the direction; vendor: 50", "px", 0.0, 1e4
    )
    drift_px_per_min: float = assumed(0.0, "Drift as the unit warms up", "px/min", 0.0, 1e4)
    coating: Coating = assumed("aluminium", "Bare metal, no protecting layer; ideal reflects everything")


@dataclass(frozen=True)
class Detector:
    """Noise and faults of the sensor beside the camera's own read noise, gain and well."""

    dark_e_per_s: float = assumed(200.0, "Dark current at the temperature of the sensor", "e-/s", 0.0, 1e9)
    prnu_std: float = assumed(0.01, "Standard deviation of a pixel's gain (PRNU)", "", 0.0, 0.5)
    striping_std: float = assumed(
        0.002, "Standard deviation of the gain that a sample's whole column shares", "", 0.0, 0.5
    )
    dead_fraction: float = assumed(0.0, "Fraction of dead pixels", "", 0.0, 0.5)
    hot_fraction: float = assumed(0.0, "Fraction of hot pixels", "", 0.0, 0.5)
    hot_e_per_s: float = assumed(5e4, "Dark current of a hot pixel over a sound one", "e-/s", 0.0, 1e9)
    noiseless: bool = stated(False, "An ideal sensor, for references: no shot noise, read noise or dark current")
    unit: int = stated(0, "Number of the sensor; its fixed pattern follows from it", "", 0, 2**31 - 1)


@dataclass(frozen=True)
class Air:
    """Air between rig and scene. A scene without a distance is light at the aperture: no air, no parallax."""

    distance_m: float | None = stated(None, "Distance of the scene's middle", "m", LEAST_DISTANCE_M, example=30.0)
    relief: Relief = stated("flat", "Course of the distance over the scene")
    nearest_m: float | None = stated(
        None, "Nearest part of the scene; by default distance_m", "m", LEAST_DISTANCE_M, example=25.0
    )
    farthest_m: float | None = stated(
        None, "Farthest part of the scene; by default distance_m", "m", LEAST_DISTANCE_M, example=40.0
    )
    lever_m: float = assumed(0.1, "Virtual pinhole behind the pivot", "m", 0.0, 10.0)
    visibility_km: float = assumed(23.0, "Meteorological visibility", "km", 0.05, 1e6)
    airlight_fraction: float = assumed(0.3, "Light of endless air over the white reference's", "", 0.0, 5.0)
    vapour_g_per_m3: float = assumed(10.0, "Water in the air, absolute humidity", "g/m^3", 0.0, 100.0)
    turbulence_cn2: float = assumed(1e-13, "Strength of the turbulence", "m^(-2/3)", 0.0, 1e-6)
    wind_amplitude_m: float = assumed(0.0, "Amplitude of the canopy's sway", "m", 0.0, 100.0)
    wind_hz: float = assumed(1.0, "Frequency of the canopy's sway", "Hz", 0.0, 50.0)


@dataclass(frozen=True)
class Sky:
    """The light: sun, its course through the survey, clouds. None for the time: the sun stands still overhead."""

    started: datetime | None = stated(
        None,
        "When the survey begins, with its time zone; without it the sun stands still",
        example="2026-06-01T10:00:00+02:00",
    )
    latitude_deg: float = assumed(52.0, "Latitude of the field; south is negative", "deg", -90.0, 90.0)
    longitude_deg: float = assumed(10.0, "Longitude of the field; west is negative", "deg", -180.0, 180.0)
    cloud_fraction: float = assumed(0.0, "Fraction of the light that a cloud takes; 0 is a clear sky", "", 0.0, 1.0)
    cloud_px_per_s: float = assumed(20.0, "Speed of the shadow's edge over the scene", "px/s", 0.0, 1e6)
    cloud_size_px: float = assumed(600.0, "Size of the clouds' shadows", "px", 1.0, 1e9)
    light: Cover = stated("clear", "Cover of clouds: under an overcast sky exposures gather an eighth of the light")
    light_fraction: float | None = stated(
        None,
        "Light on the field over that of a clear sky; by default 1 under a clear sky, 0.125 under an overcast one",
        "",
        0.01,
        1.0,
        example=0.2,
    )
    brdf_per_rad: float = assumed(0.1, "Change of reflectance with the view angle", "1/rad", 0.0, 5.0)
    hot_spot: float = assumed(0.0, "Brightening where the view looks along the sun's rays", "", 0.0, 2.0)

    @property
    def fraction_of_clear(self) -> float:
        """Return the light on the field over that of a clear sky."""
        return LIGHT_UNDER[self.light] if self.light_fraction is None else self.light_fraction


@dataclass(frozen=True)
class Rig:
    """Camera and all that the effects know about. The defaults are a rig at rest in calm, clear air."""

    camera: LineCamera = field(default_factory=LineCamera)
    optics: Optics = field(default_factory=Optics)
    mirror: MirrorMotion = field(default_factory=MirrorMotion)
    detector: Detector = field(default_factory=Detector)
    air: Air = field(default_factory=Air)
    sky: Sky = field(default_factory=Sky)

    def __post_init__(self) -> None:
        for name, value in asdict(self.camera).items():
            if not math.isfinite(value):
                raise SettingsError(f"camera.{name} must be a finite number, got {value:g}")
        for place in ("optics", "mirror", "detector", "air", "sky"):
            for name, fault in misfits(getattr(self, place)):
                raise SettingsError(f"{place}.{name} {fault}")
        if self.sky.started is not None and self.sky.started.tzinfo is None:
            raise SettingsError(f"sky.started needs a time zone, got {self.sky.started}; add +00:00 for UTC")

    @property
    def key(self) -> dict[str, Any]:
        """Return the rig as tables, without the light, which is in the key of the scene."""
        parts = asdict(self)
        sky = {name: value for name, value in parts["sky"].items() if name not in OF_THE_SCENE}
        started = None if self.sky.started is None else self.sky.started.isoformat()
        return {**parts, "sky": {**sky, "started": started}}

    def taking(self, sweep: Sweep) -> Rig:
        """Return the rig as it takes the lines of a sweep: with the sweep's exposure, if it has one of its own."""
        camera = exposing(self.camera, sweep)
        return self if camera is self.camera else replace(self, camera=camera)

    @property
    def distances_m(self) -> tuple[float, float] | None:
        """Return nearest and farthest part of the scene [m]; None for a scene without a distance."""
        air = self.air
        return None if air.distance_m is None else (air.nearest_m or air.distance_m, air.farthest_m or air.distance_m)
