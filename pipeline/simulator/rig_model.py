"""Model of the simulated rig beyond its camera, and of what lies between it and the scene: numbers with sources.

Nothing here was measured on a unit: what is not of a data sheet (from memory) is assumed. Settings are what belongs
to a rig or switches an effect on; the other numbers are parameters of the models.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import Sweep, exposing
from spectralzoom.pipeline.setting_fields import Moment, assumed, settings_table, stated

Coating = Literal["aluminium", "ideal"]  # ideal: reflects everything, at any angle
Relief = Literal["flat", "step", "plane"]
Cover = Literal["clear", "overcast"]
LIGHT_UNDER: dict[Cover, float] = {"clear": 1.0, "overcast": 1 / 8}  # thick stratus passes 10 to 20 % (assumed)
OF_THE_SCENE = ("light", "light_fraction")  # of a sky: the scene's electrons and its key have them
LEAST_DISTANCE_M = 1e-3


@settings_table
class Optics:
    """Mirror as a stop, lens, slit spectrograph."""

    aperture_mm: float = stated(15.0, "Diameter of the mirror, the aperture stop", "mm", 0.1, 1e3, source="data sheet")
    focus_m: float = assumed(math.inf, "Distance that is sharp", "m", 0.01)
    fwhm_nm: float = stated(6.0, "Width of a band", "nm", 0.0, 1e3, source="data sheet")
    aberration_px: float = 0.2  # standard deviation of the lens's own blur
    keystone_px: float = 0.15  # shift along the line, first wavelength to last
    smile_nm: float = 0.3  # excess of the wavelengths at a line's ends
    stray_fraction: float = 1e-3  # of a line's light, spread over its detector
    stray_even: float = 0.5  # of the stray light, falls evenly; the rest is a halo
    stray_halo_px: float = 64.0  # standard deviation of the halo, over samples and bands alike


@settings_table
class MirrorMotion:
    """Motion of the mirror, a second-order system fed from a vector memory, and its coating."""

    natural_hz: float = stated(20.0, "Full-scale bandwidth", "Hz", 0.1, 1e5, source="data sheet")
    repeatability_urad: float = assumed(
        0.0, "Standard deviation of the tilt, line by line; vendor: 40", "urad", 0.0, 1e5
    )
    hysteresis_px: float = assumed(
        0.0, "Systematic error whose sign is that of the direction; vendor: 50", "px", 0.0, 1e4
    )
    drift_px_per_min: float = assumed(0.0, "Drift as the unit warms up", "px/min", 0.0, 1e4)
    damping: float = 0.7  # ratio
    settled_s: float = 0.2  # to come to rest one position ahead of a sweep's first
    positions_per_line: float = 1.0  # of the vector memory, for each px of the path
    coating: Coating = "aluminium"  # bare metal, no protecting layer


@settings_table
class Detector:
    """Noise and faults of the sensor beside the camera's own read noise, gain and well."""

    dead_fraction: float = assumed(0.0, "Fraction of dead pixels", "", 0.0, 0.5)
    hot_fraction: float = assumed(0.0, "Fraction of hot pixels", "", 0.0, 0.5)
    hot_e_per_s: float = 5e4  # dark current of a hot pixel over a sound one
    dark_e_per_s: float = 200.0  # dark current at the temperature of the sensor
    prnu_std: float = 0.01  # standard deviation of a pixel's gain
    striping_std: float = 0.002  # of the gain that a sample's whole column shares
    noiseless: bool = False  # an ideal sensor, for references: no shot noise, read noise or dark current
    unit: int = 0  # number of the sensor; its fixed pattern follows from it


@settings_table
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
    visibility_km: float = assumed(23.0, "Meteorological visibility", "km", 0.05, 1e6)
    wind_amplitude_m: float = assumed(0.0, "Amplitude of the canopy's sway", "m", 0.0, 100.0)
    wind_hz: float = 1.0  # frequency of the sway
    lever_m: float = 0.1  # virtual pinhole behind the pivot
    airlight_fraction: float = 0.3  # light of endless air over the white reference's
    vapour_g_per_m3: float = 10.0  # water in the air, absolute humidity
    turbulence_cn2: float = 1e-13  # strength of the turbulence [m^(-2/3)]


@settings_table
class Sky:
    """The light: sun, its course through the survey, clouds. None for the time: the sun stands still overhead."""

    started: Moment | None = stated(
        None,
        "When the survey begins, with its time zone; without it the sun stands still",
        example="2026-06-01T10:00:00+02:00",
    )
    cloud_fraction: float = assumed(0.0, "Fraction of the light that a cloud takes; 0 is a clear sky", "", 0.0, 1.0)
    light: Cover = stated("clear", "Cover of clouds: under an overcast sky exposures gather an eighth of the light")
    light_fraction: float | None = stated(
        None,
        "Light on the field over that of a clear sky; by default 1 under a clear sky, 0.125 under an overcast one",
        "",
        0.01,
        1.0,
        example=0.2,
    )
    hot_spot: float = assumed(0.0, "Brightening where the view looks along the sun's rays", "", 0.0, 2.0)
    brdf_per_rad: float = 0.1  # change of reflectance with the view angle
    latitude_deg: float = 52.0  # of a field without a [pose]
    longitude_deg: float = 10.0  # likewise
    cloud_px_per_s: float = 20.0  # speed of a shadow's edge over the scene
    cloud_size_px: float = 600.0  # size of the clouds' shadows

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
