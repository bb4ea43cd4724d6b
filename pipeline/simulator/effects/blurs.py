"""Effects that blur the image or shift it band by band: diffraction, the lens itself, defocus, keystone."""

from __future__ import annotations

import math
from functools import cache
from types import MappingProxyType

import numpy as np
import scipy

from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.pipeline.simulator.effects.effect import Blur, Bound
from spectralzoom.pipeline.simulator.effects.probe import UNITS, Probe
from spectralzoom.pipeline.simulator.optics.kernel_fit import Floats, Moments
from spectralzoom.pipeline.simulator.optics.rays import extreme_normals, pupil_contrast, spread_of_rays, spread_of_waves
from spectralzoom.pipeline.simulator.rig_model import Rig

MOST_BLUR_PX = 256  # diameter of a disc that is simulated
FIRST_NM, LAST_NM = 400.0, 1000.0  # of the spectrograph
_ALONE: Floats = np.ones(1)
GAUSSIAN_WAY, DISC_WAY = math.sqrt(2 / math.pi), 8 / (3 * math.pi)  # mean of |x| over the standard deviation


def blurred_bound(
    probe: Probe, cause: str, variance: Floats, fraction: Floats = _ALONE, mean_way: float = GAUSSIAN_WAY
) -> Bound:
    """Bound what a sum of Gaussians changes, of (kernel, 2, band) variance [px^2] and shares (kernel,).

    ``mean_way``: what light is moved along an axis on average, over the standard deviation. ``cause`` says where the
    blur comes from; the sentence names the band that changes most.
    """
    parts = zip(fraction, variance, strict=True)
    change = sum((part * probe.change_blurred(one, mean_way) for part, one in parts), np.zeros(1))
    value = float(change.max(initial=0.0))
    if not variance.any():
        return Bound(value, f"{cause}: none")
    band = int(np.argmax(change))
    nearest = np.sqrt(variance[int(np.argmax(fraction)), :, band])
    return Bound(
        value,
        f"{cause}: {nearest[0]:.2g} px (sd) along the line, {nearest[1]:.2g} px along the scan"
        f" at {probe.wavelength_nm[band]:.0f} nm, on detail of at most {probe.curvature[:, band].max():.3g}"
        f" {UNITS[probe.unit]}/px^2",
    )


def even(variance: Floats, bands: int) -> Moments:
    """Return the moments of a blur that is the same in all bands: no shift, and (2,) variance along line and scan."""
    return Moments(np.zeros((2, bands)), np.repeat(np.asarray(variance, np.float64)[:, None], bands, axis=1))


class Diffraction(Blur):
    """Diffraction at the mirror, the aperture stop: an Airy pattern, stretched along the scan by the elliptic pupil.

    The pattern has no variance: its rings hold 2 / (pi v) of the light beyond v = pi D theta / lambda. It is the
    pupil's own transfer function in every band, by few kernels (`kernel_fit`).
    """

    name = "diffraction"
    cost_ns = MappingProxyType({"airy": 6.5})  # of kernels for the pattern's core, its tails, the bands' own widths

    def moments(self, rig: Rig, wavelength_nm: Floats, variant: str, normal: Floats | None = None) -> Moments:
        none = np.zeros((2, len(wavelength_nm)))
        return Moments(none, none, _waves(rig, wavelength_nm, normal))

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound over all positions of the sweeps, by the variances of Gaussians whose sum is the pattern."""
        fraction, size = airy_gaussians()
        found = [_waves(rig, probe.wavelength_nm, normal) for normal in extreme_normals(probe.sweeps, rig.camera)]
        missing = [[(one * waves) ** 2 for one in size] for waves in found]
        return blurred_bound(probe, "diffraction", np.max(missing, axis=0), fraction)


@cache  # not at import: SciPy takes its time
def airy_gaussians() -> tuple[Floats, Floats]:
    """Return shares, none below 0, of sum 1, and widths (sd) [lambda / D] of Gaussians whose sum is an Airy pattern.

    The fit to the pupil's transfer is within 0.004 of it up to 0.6 of its cut-off: for bounds, not for light.
    """
    size = np.geomspace(0.1, 160.0, 24)
    u = np.concatenate([np.geomspace(1e-3, 0.02, 30), np.linspace(0.03, 1.5, 150)])
    weight = 1 / (1 + (u / 0.5) ** 4)
    passed = np.exp(-2 * (np.pi * np.outer(u, size)) ** 2)
    system = np.concatenate([passed * weight[:, None], np.full((1, len(size)), 1e3)])
    fraction = scipy.optimize.nnls(system, np.append(pupil_contrast(u) * weight, 1e3))[0]
    held = fraction > 0
    return fraction[held] / fraction.sum(), size[held]


def _waves(rig: Rig, wavelength_nm: Floats, normal: Floats | None) -> Floats:
    """Return lambda over the pupil's widths along line and scan, (2, band). [px]"""
    angle = np.asarray(wavelength_nm, np.float64) * 1e-9 / (rig.optics.aperture_mm * 1e-3)
    return angle / rig.camera.ifov_rad * np.sqrt(spread_of_waves(normal))[:, None]


class Aberration(Blur):
    """Blur by the lens itself: a Gaussian of ``optics.aberration_px`` (sd) in all bands and both directions."""

    name = "aberration"
    cost_ns = MappingProxyType({"gaussian": 0.0})  # saves 4 beside diffraction: a wider footprint has fewer kernels

    def moments(self, rig: Rig, wavelength_nm: Floats, variant: str, normal: Floats | None = None) -> Moments:
        return even(np.full(2, rig.optics.aberration_px**2), len(wavelength_nm))

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        return blurred_bound(probe, "blur of the lens", self.moments(rig, probe.wavelength_nm, variant).variance[None])


class Defocus(Blur):
    """Blur by the distance from the plane of focus, that of ``air.distance_m`` for all of the scene.

    A point beside the distance of focus is an image of the pupil: a disc foreshortened along the scan. Few points stand
    for it (`defocus_disc`); the bound is that of any kernel of its variance.
    """

    name = "defocus"
    cost_ns = MappingProxyType({"disc": 5.7})  # of seven points

    def moments(self, rig: Rig, wavelength_nm: Floats, variant: str, normal: Floats | None = None) -> Moments:
        none = np.zeros((2, len(wavelength_nm)))
        along, scan = defocus_px(rig, rig.air.distance_m, normal).tolist()
        return Moments(none, none, disc=(along, scan))

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        if rig.distances_m is None:
            return Bound(0.0, "the scene has no distance")
        normals = extreme_normals(probe.sweeps, rig.camera)
        # the variance of an even disc is a sixteenth of its diameter squared
        worst = np.max([defocus_px(rig, rig.air.distance_m, normal) ** 2 / 16 for normal in normals], axis=0)
        cause = f"defocus at {rig.air.distance_m:g} m, focused at {rig.optics.focus_m:g} m"
        return blurred_bound(probe, cause, even(worst, len(probe.wavelength_nm)).variance[None], mean_way=DISC_WAY)


def defocus_px(rig: Rig, distance_m: float | None, normal: Floats | None = None) -> Floats:
    """Return the axes of the disc along line and scan, (2,): pupil |1/d - 1/d_f| / IFOV; 0 without a distance [px].

    Raises SettingsError: the disc is wider than `MOST_BLUR_PX`.
    """
    if distance_m is None or distance_m == rig.optics.focus_m:
        return np.zeros(2)
    round_px = rig.optics.aperture_mm * 1e-3 * abs(1 / distance_m - 1 / rig.optics.focus_m) / rig.camera.ifov_rad
    if round_px > MOST_BLUR_PX:
        raise SettingsError(
            f"a scene at {distance_m:g} m, with the focus at {rig.optics.focus_m:g} m, is blurred over {round_px:.0f} "
            f"px; at most {MOST_BLUR_PX} px are simulated: give optics.focus_m near air.distance_m"
        )
    return round_px * np.sqrt(spread_of_rays(normal))


class Keystone(Blur):
    """Shift along the line, of its own in each band: a line is imaged longer at one wavelength than at another.

    At the last wavelength a sample sees the scene ``keystone_px / 2`` further along the line (towards higher samples)
    than the mirror model says, at the first as much less far. It is linear from 400 to 1000 nm, and held beyond.
    """

    name = "keystone"
    cost_ns = MappingProxyType({"linear": 6.5})  # beside diffraction, each of whose widths has to be shifted

    def moments(self, rig: Rig, wavelength_nm: Floats, variant: str, normal: Floats | None = None) -> Moments:
        shift = np.zeros((2, len(wavelength_nm)))
        shift[0] = keystone_shift(rig, wavelength_nm)
        return Moments(shift, np.zeros_like(shift))

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound by the slope along the line times each band's shift, never more than the span."""
        shift = np.abs(keystone_shift(rig, probe.wavelength_nm))
        change = np.minimum(probe.slope[0] * shift, probe.span)
        if not shift.any():
            return Bound(0.0, "no shift along the line")
        band = int(np.argmax(change))
        return Bound(
            float(change[band]),
            f"{shift[band]:.2g} px along the line at {probe.wavelength_nm[band]:.0f} nm,"
            f" on edges of at most {probe.slope[0, band]:.3g} {UNITS[probe.unit]}/px",
        )


def keystone_shift(rig: Rig, wavelength_nm: Floats) -> Floats:
    """Return the shift of each band along the line from the mirror model's place, (band,) from -k/2 to k/2 [px]."""
    fraction = (np.asarray(wavelength_nm, np.float64) - FIRST_NM) / (LAST_NM - FIRST_NM)
    return rig.optics.keystone_px * (np.clip(fraction, 0.0, 1.0) - 0.5)


DIFFRACTION, ABERRATION, DEFOCUS, KEYSTONE = Diffraction(), Aberration(), Defocus(), Keystone()
