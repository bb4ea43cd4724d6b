"""What the simulated rig is like beyond its camera, and what lies between it and the scene: numbers with their source.

Nothing here was measured on a unit. A field's metadata holds its unit and where its default comes from: ``measured``,
``data sheet`` (from memory) or ``assumed``; settings and the manifest repeat them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import Field, dataclass, field, fields
from datetime import UTC, datetime
from typing import Any, Literal

from pipeline.errors import SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.simulator.optics.coatings import Coating

Source = Literal["measured", "data sheet", "assumed"]
Relief = Literal["flat", "step", "plane"]


def stated(default: float, unit: str, source: Source, least: float = 0.0, most: float = math.inf) -> Any:
    """A number of the rig: its default, its unit, where the default comes from, and the range that makes sense.

    It is finite, unless its default is infinity.
    """
    return field(default=default, metadata={"unit": unit, "source": source, "least": least, "most": most})


@dataclass(frozen=True)
class Optics:
    """Mirror as a stop, lens, slit spectrograph."""

    aperture_mm: float = stated(15.0, "mm", "data sheet", 0.1, 1e3)  # of the mirror, the aperture stop
    focus_m: float = stated(math.inf, "m", "assumed", 0.01)  # distance that is sharp
    aberration_px: float = stated(0.2, "px", "assumed", 0.0, 1e3)  # sd of the lens's own blur
    keystone_px: float = stated(0.15, "px", "assumed", 0.0, 1e3)  # shift along the line, first wavelength to last
    smile_nm: float = stated(0.3, "nm", "assumed", -100.0, 100.0)  # how much longer wavelengths are at a line's ends
    fwhm_nm: float = stated(6.0, "nm", "data sheet", 0.0, 1e3)  # width of a band
    stray_share: float = stated(1e-3, "", "assumed", 0.0, 0.5)  # of all light of a line, spread over its detector
    stray_even: float = stated(0.5, "", "assumed", 0.0, 1.0)  # of the stray light, falls evenly; the rest is a halo
    stray_halo_px: float = stated(64.0, "px", "assumed", 2.0, 1e6)  # sd of the halo, over samples and bands alike


@dataclass(frozen=True)
class MirrorMotion:
    """How the mirror follows its commands, a second-order system fed from a vector memory, and what coats it."""

    natural_hz: float = stated(20.0, "Hz", "data sheet", 0.1, 1e5)  # full-scale bandwidth
    damping: float = stated(0.7, "", "assumed", 0.01, 10.0)
    settled_s: float = stated(0.2, "s", "assumed", 0.0, 1e4)  # to come to rest one position ahead of a sweep's first
    positions_per_line: float = stated(1.0, "", "assumed", 0.01, 1e4)  # of the vector memory, for each px of the path
    repeatability_urad: float = stated(0.0, "urad", "assumed", 0.0, 1e5)  # sd of the tilt, line by line; vendor: 40
    hysteresis_px: float = stated(0.0, "px", "assumed", 0.0, 1e4)  # systematic, sign by direction; vendor: 50
    drift_px_per_min: float = stated(0.0, "px/min", "assumed", 0.0, 1e4)  # as the unit warms up
    coating: Coating = "aluminium"  # assumed; a bare metal: protecting layers are not modelled


@dataclass(frozen=True)
class Detector:
    """What the sensor adds to the camera's own read noise, gain and well."""

    dark_e_per_s: float = stated(200.0, "e-/s", "assumed", 0.0, 1e9)  # at 25 deg C
    temperature_deg_c: float = stated(25.0, "deg C", "assumed", -80.0, 50.0)  # where dark current's law holds
    response_share: float = stated(0.01, "", "assumed", 0.0, 0.5)  # sd of a pixel's gain (PRNU)
    stripe_share: float = stated(0.002, "", "assumed", 0.0, 0.5)  # sd of the gain that a sample's whole column shares
    dead_share: float = stated(0.0, "", "assumed", 0.0, 0.5)
    hot_share: float = stated(0.0, "", "assumed", 0.0, 0.5)
    hot_e_per_s: float = stated(5e4, "e-/s", "assumed", 0.0, 1e9)  # beyond a sound element's, at 25 deg C
    well_e: float = stated(math.inf, "e-", "assumed", 1.0)  # that an element holds; inf: the converter clips first
    noiseless: bool = False  # an ideal sensor, for references: no shot noise, read noise or dark current
    unit: int = 0  # which copy of the sensor: its fixed pattern follows from this number


@dataclass(frozen=True)
class Air:
    """What lies between rig and scene. A scene without a distance is light at the aperture: no air, no parallax."""

    distance_m: float | None = None
    relief: Relief = "flat"
    nearest_m: float | None = None  # None is distance_m
    farthest_m: float | None = None
    lever_m: float = stated(0.1, "m", "assumed", 0.0, 10.0)  # virtual pinhole behind the pivot
    visibility_km: float = stated(23.0, "km", "assumed", 0.05, 1e6)
    airlight_share: float = stated(0.3, "", "assumed", 0.0, 5.0)  # light of endless air over the white panel's
    vapour_g_per_m3: float = stated(10.0, "g/m^3", "assumed", 0.0, 100.0)  # of water, absolute humidity
    turbulence_cn2: float = stated(1e-13, "m^(-2/3)", "assumed", 0.0, 1e-6)
    wind_amplitude_m: float = stated(0.0, "m", "assumed", 0.0, 100.0)  # of the canopy's sway
    wind_hz: float = stated(1.0, "Hz", "assumed", 0.0, 50.0)


@dataclass(frozen=True)
class Sky:
    """The light: sun, its course through the survey, clouds. None for the time: the sun stands still overhead."""

    started: datetime | None = None  # with its time zone
    latitude_deg: float = stated(52.0, "deg", "assumed", -90.0, 90.0)
    longitude_deg: float = stated(10.0, "deg", "assumed", -180.0, 180.0)
    cloud_share: float = stated(0.0, "", "assumed", 0.0, 1.0)  # light that a cloud takes; 0 is a clear sky
    cloud_px_per_s: float = stated(20.0, "px/s", "assumed", 0.0, 1e6)  # speed of the shadow's edge over the scene
    cloud_size_px: float = stated(600.0, "px", "assumed", 1.0, 1e9)
    brdf_per_rad: float = stated(0.1, "1/rad", "assumed", 0.0, 5.0)  # change of reflectance with the view angle
    hot_spot: float = stated(0.0, "", "assumed", 0.0, 2.0)  # brightening where the view looks along the sun's rays


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
        for place, item, value in self._numbers():
            if math.isnan(value) or (math.isinf(value) and item.default != math.inf):
                raise SettingsError(f"{place} must be a finite number, got {value:g}")
            least, most = item.metadata.get("least", -math.inf), item.metadata.get("most", math.inf)
            if not least <= value <= most:
                raise SettingsError(f"{place} must be between {least:g} and {most:g}, got {value:g}")
        for name in ("distance_m", "nearest_m", "farthest_m"):
            metres = getattr(self.air, name)
            if metres is not None and not metres > 0:
                raise SettingsError(f"air.{name} must be above 0 m, got {metres:g}")
        if self.sky.started is not None and self.sky.started.tzinfo is None:
            raise SettingsError(f"sky.started needs a time zone, got {self.sky.started}; add +00:00 for UTC")

    def _numbers(self) -> Iterator[tuple[str, Field[Any], float]]:
        """Give the camera's numbers, and all that have a range, with their places as settings name them."""
        for part in ("camera", "optics", "mirror", "detector", "air", "sky"):
            for item in fields(getattr(self, part)):
                if part == "camera" or "least" in item.metadata:
                    yield f"{part}.{item.name}", item, float(getattr(getattr(self, part), item.name))

    @property
    def distances_m(self) -> tuple[float, float] | None:
        """Nearest and farthest part of the scene [m]; None for a scene without a distance."""
        air = self.air
        if air.distance_m is None:
            return None
        return (air.nearest_m or air.distance_m, air.farthest_m or air.distance_m)

    def moment(self, seconds: float) -> datetime | None:
        """Time of day so many seconds after the survey's start; None where it has none."""
        started = self.sky.started
        return None if started is None else datetime.fromtimestamp(started.timestamp() + seconds, UTC)
