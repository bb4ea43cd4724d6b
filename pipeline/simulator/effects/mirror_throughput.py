"""Light that the tilted mirror passes: as the aperture stop (vignetting), and by its coating (polarisation)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.simulator.effects.effect import Bound, Gain, SweepBlock
from pipeline.simulator.effects.probe import GainRange, Probe
from pipeline.simulator.rig_model import Coating, Rig

Floats = NDArray[np.float64]
Radiance = NDArray[np.float32]
EXACT = "exact"
REST_RAD = math.radians(45)
_PROBES = 65  # incidences at which the sweeps' factors are taken for the bounds
Indices = NDArray[np.complex128]
# Rows: wavelength [nm], n, k; straight between. Evaporated films at room temperature.
_ALUMINIUM = np.array([  # [2]
    (309.96, 0.28003, 3.7081), (326.28, 0.31474, 3.9165), (364.66, 0.39877, 4.3957), (413.28, 0.52135, 5.0008),
    (442.80, 0.60790, 5.3676), (476.87, 0.72780, 5.7781), (516.60, 0.87340, 6.2418), (563.57, 1.0728, 6.7839),
    (619.93, 1.3660, 7.4052), (652.25, 1.5724, 7.7354), (688.81, 1.8301, 8.0601), (729.32, 2.1606, 8.3565),
    (774.91, 2.6154, 8.4914), (794.78, 2.7675, 8.3866), (815.69, 2.7668, 8.2573), (837.74, 2.6945, 8.1878),
    (885.61, 2.2802, 8.1134), (911.66, 1.9739, 8.3058), (939.28, 1.6784, 8.5970), (968.63, 1.4867, 9.0655),
    (999.88, 1.4359, 9.4939), (1033.2, 1.3998, 9.8914), (1127.1, 1.3281, 10.969), (1239.9, 1.3157, 12.245),
    (1377.6, 1.3899, 13.784), (1549.8, 1.5782, 15.656), (1771.2, 1.9205, 17.991), (2066.4, 2.4738, 20.982),
])  # fmt: skip
_GOLD = np.array([  # [3]
    (310.7, 1.53, 1.893), (320.4, 1.54, 1.898), (331.5, 1.48, 1.883), (342.5, 1.48, 1.871), (354.2, 1.50, 1.866),
    (367.9, 1.48, 1.895), (381.5, 1.46, 1.933), (397.4, 1.47, 1.952), (413.3, 1.46, 1.958), (430.5, 1.45, 1.948),
    (450.9, 1.38, 1.914), (471.4, 1.31, 1.849), (495.9, 1.04, 1.833), (520.9, 0.62, 2.081), (548.6, 0.43, 2.455),
    (582.1, 0.29, 2.863), (616.8, 0.21, 3.272), (659.5, 0.14, 3.697), (704.5, 0.13, 4.103), (756.0, 0.14, 4.542),
    (821.1, 0.16, 5.083), (892.0, 0.17, 5.663), (984.0, 0.22, 6.350), (1088.0, 0.27, 7.150), (1216.0, 0.35, 8.145),
    (1393.0, 0.43, 9.519), (1610.0, 0.56, 11.21), (1937.0, 0.92, 13.78),
])  # fmt: skip
_SILVER = np.array([  # [3]
    (310.7, 1.13, 0.616), (320.4, 0.81, 0.392), (331.5, 0.17, 0.829), (342.5, 0.14, 1.142), (354.2, 0.10, 1.419),
    (367.9, 0.07, 1.657), (381.5, 0.05, 1.864), (397.4, 0.05, 2.070), (413.3, 0.05, 2.275), (430.5, 0.04, 2.462),
    (450.9, 0.04, 2.657), (471.4, 0.05, 2.869), (495.9, 0.05, 3.093), (520.9, 0.05, 3.324), (548.6, 0.06, 3.586),
    (582.1, 0.05, 3.858), (616.8, 0.06, 4.152), (659.5, 0.05, 4.483), (704.5, 0.04, 4.838), (756.0, 0.03, 5.242),
    (821.1, 0.04, 5.727), (892.0, 0.04, 6.312), (984.0, 0.04, 6.992), (1088.0, 0.04, 7.795), (1216.0, 0.09, 8.828),
    (1393.0, 0.13, 10.10), (1610.0, 0.15, 11.85), (1937.0, 0.24, 14.08),
])  # fmt: skip
METALS: Mapping[str, Floats] = MappingProxyType({"aluminium": _ALUMINIUM, "gold": _GOLD, "silver": _SILVER})


@dataclass(frozen=True)
class Vignetting(Gain):
    """Light goes with the mirror's area as the camera sees it: |n_z| over |n_z| at rest, one factor for each line.

    It is the mean over the positions of an exposure.
    """

    name = "vignetting"
    cost_ns = MappingProxyType({"held": 0.2})

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound by level times the factor furthest from 1.

        It is at the ends of the sweeps: the factor never turns round in between.
        """
        ends = sweep_ends(probe, rig.camera)
        if not ends.size:
            return Bound(0.0, "no line is taken")
        fractions = np.sqrt(1 - ends)  # |n_z|^2 = (1 - o_z) / 2
        why = f"the mirror passes {fractions.min():.3f} to {fractions.max():.3f} of its light at rest"
        return Bound(probe.scaled(float(np.abs(fractions - 1).max())), why)

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        fractions = np.sqrt(1 - sweep_ends(probe, rig.camera))
        least, greatest = float(fractions.min(initial=1.0)), float(fractions.max(initial=1.0))
        return GainRange.between(least, greatest, len(probe.wavelength_nm))

    def gain(self, block: SweepBlock, variant: str) -> Radiance:
        sweep, camera = block.sweep, block.rig.camera
        scan_px = sweep.held_px()
        fraction = np.sqrt(1 - ahead(sweep.swath_px, scan_px[block.numbers], camera)).mean(axis=1)
        return np.asarray(fraction.astype(np.float32)[:, None, None])


def sweep_ends(probe: Probe, camera: LineCamera) -> Floats:
    """Return o_z at the first and the last position of every sweep, (2 sweep,); it never turns round in between."""
    ends = [sweep.held_px().ravel()[[0, -1]] for sweep in probe.sweeps]
    found = [ahead(sweep.swath_px, px, camera) for sweep, px in zip(probe.sweeps, ends, strict=True)]
    return np.concatenate(found) if found else np.zeros(0)


def ahead(along_px: float, scan_px: Floats, camera: LineCamera) -> Floats:
    """Return o_z, the part along the camera's axis, of the unit directions to points of the scene."""
    xi, eta = along_px * camera.ifov_rad, scan_px * camera.ifov_rad
    return eta / np.sqrt(1 + xi**2 + eta**2)


@dataclass(frozen=True)
class Polarisation(Gain):
    """Light goes with the coating's reflectance at the chief ray's incidence over that at rest, 45 deg.

    Fresnel's equations for bare metal give it. From 20 to 70 deg aluminium goes from +0.5 to -3.7 % (mean of 400 to
    1000 nm; -5.4 % at 820 nm). Gold goes from -1.8 to +18 % in the blue. Valid for unpolarised light and a spectrograph
    that takes both polarisations alike. One factor for each line and band, at mid exposure.
    """

    name = "polarisation"
    cost_ns = MappingProxyType({EXACT: 0.2})

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound by level times the factor furthest from 1 in each band, over all incidences that the sweeps have.

        Factors are taken at some incidences, and what a chord between two of them may miss is added.
        """
        incidence = _incidence(sweep_ends(probe, rig.camera))
        if rig.mirror.coating == "ideal" or not incidence.size:
            return Bound(0.0, "the mirror reflects everything" if incidence.size else "no line is taken")
        factors = _factors_between(incidence, rig, probe.wavelength_nm)
        between = np.abs(np.diff(factors, 2, axis=0)).max(axis=0) / 8  # most that a chord misses of what it cuts off
        most = np.abs(factors - 1).max(axis=0) + between
        least_deg, most_deg = np.degrees(incidence.min()), np.degrees(incidence.max())
        where = f" at {probe.wavelength_nm[int(most.argmax())]:.0f} nm" if most.size else ""
        why = (
            f"{rig.mirror.coating}, {100 * most.max(initial=0.0):.2g} % of the light{where}, at incidences of"
            f" {least_deg:.1f} to {most_deg:.1f} deg"
        )
        return Bound(probe.scaled(most), why)

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        incidence, nm = _incidence(sweep_ends(probe, rig.camera)), np.asarray(probe.wavelength_nm, np.float64)
        if not incidence.size:
            return GainRange.between(1.0, 1.0, len(nm))
        return GainRange.of(_factors_between(incidence, rig, nm), nm, uneven=0.0)

    def gain(self, block: SweepBlock, variant: str) -> Radiance:
        probes = ahead(block.sweep.swath_px, block.scan_px, block.rig.camera)
        factor: Radiance = _factors(_incidence(probes), block.rig, block.wavelength_nm).astype(np.float32)
        return factor[:, None, :]


def _incidence(view_directions: Floats) -> Floats:
    """Return the angle between chief ray and mirror normal for unit look directions with this o_z. [rad]"""
    return np.arccos(np.sqrt((1 - view_directions) / 2))


def _factors(incidence_rad: Floats, rig: Rig, wavelength_nm: Floats) -> Floats:
    at_rest = reflectance(rig.mirror.coating, wavelength_nm, np.array([REST_RAD]))
    return reflectance(rig.mirror.coating, wavelength_nm, incidence_rad) / at_rest


def _factors_between(incidence_rad: Floats, rig: Rig, wavelength_nm: Floats) -> Floats:
    return _factors(np.linspace(incidence_rad.min(), incidence_rad.max(), _PROBES), rig, wavelength_nm)


def reflectance(coating: Coating, wavelength_nm: Floats, incidence_rad: Floats) -> Floats:
    """Return the fraction of unpolarised light that a coating reflects, (incidence, band): both polarisations' mean.

    Valid from 311 to 1937 nm, and for films that no light passes (50 nm or more). Beyond, the index of the nearest end
    is held.
    """
    if coating == "ideal":
        return np.ones((len(incidence_rad), len(wavelength_nm)))
    nm, n, k = METALS[coating].T
    index = np.interp(wavelength_nm, nm, n) + 1j * np.interp(wavelength_nm, nm, k)
    across, within = fresnel(index, incidence_rad[:, None])
    return (across + within) / 2


def fresnel(index: Indices, incidence_rad: Floats) -> tuple[Floats, Floats]:
    """Return what a surface in air reflects of light polarised across (s) and within (p) the plane of incidence [1]."""
    cosine, square = np.cos(incidence_rad), index**2
    beyond = np.sqrt(square - np.sin(incidence_rad) ** 2)  # index times the cosine behind the surface
    across = np.abs((cosine - beyond) / (cosine + beyond)) ** 2
    within = np.abs((square * cosine - beyond) / (square * cosine + beyond)) ** 2
    return across, within


VIGNETTING, POLARISATION = Vignetting(), Polarisation()
