"""Spectrograph and detector: wider bands, smile, gains of elements and columns (fixed pattern), stray light."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType

import numpy as np
import scipy
from numpy.typing import NDArray

from spectralzoom.pipeline.simulator.effects.counting import EXACT, Floats, normal_deviates
from spectralzoom.pipeline.simulator.effects.effect import Bound, Gain, LightChange, Radiance, SweepBlock, stream_of
from spectralzoom.pipeline.simulator.effects.probe import GainRange, Probe, difference_rates, rising_gaps, rising_runs
from spectralzoom.pipeline.simulator.rig_model import Rig

FWHM2_PER_VARIANCE = 8 * math.log(2)
BANDS_AT_ONCE = 32  # bands that one product makes
LEAST_WEIGHT = 1e-8
REACH_SD = 6.0  # the kernel's weight beyond it is below 1e-8


class Response(LightChange):
    """Each band is averaged over its neighbours so that variances add up to the rig's: fwhm_rig^2 - fwhm_scene^2.

    ``exact`` is the heat kernel exp(v/2 D) of the bands' second divided difference D. It has no weight below 0, sum 1,
    mean 0 and variance v exactly, on bands at any distance. The first and the last band keep their light: what lies
    beyond is not known.
    """

    name = "response"
    cost_ns = MappingProxyType({EXACT: 2.2})

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound it by I' sqrt(v); 0 where the scene's bands are as wide."""
        wavelength = np.asarray(probe.wavelength_nm, np.float64)
        known = probe.fwhm_nm
        variance = missing_variance(rig.optics.fwhm_nm, known, len(wavelength))
        if not difference_rates(wavelength).any():
            return Bound(0.0, "no band has a neighbour on either side")
        if known is None or not np.isfinite(known).any():
            return Bound(0.0, "the width of the scene's bands is not known; they are taken as they are")
        if not variance.any():
            return Bound(0.0, f"the scene's bands are {rig.optics.fwhm_nm:g} nm wide already, or wider")
        near = np.abs(wavelength[:, None] - wavelength) <= REACH_SD * np.sqrt(variance)[:, None]
        steep = np.where(near, probe.spectral_slope, 0).max(axis=1) * np.sqrt(variance)
        why = f"bands widen from {np.nanmin(known):.3g} to {rig.optics.fwhm_nm:.3g} nm"
        return Bound(float(steep.max()), f"{why}: {np.sqrt(variance.max()):.2g} nm sd more")

    def change(self, light: Radiance, block: SweepBlock, variant: str) -> Radiance:
        return widen_bands(light, block.wavelength_nm, block.fwhm_nm, block.rig.optics.fwhm_nm)


def widen_bands(spectra: Radiance, wavelength_nm: Floats, fwhm_nm: Floats | None, wanted_nm: float) -> Radiance:
    """Return spectra as bands of width ``wanted_nm`` see them; any linear measure of light, (..., band).

    ``wavelength_nm``, ``fwhm_nm``: (band,) centres, and widths of the spectra's own bands; None or NaN where not known,
    and then nothing is done. Returns the same shape and type; ``spectra`` itself where its bands are all as wide.
    """
    variance = missing_variance(wanted_nm, fwhm_nm, spectra.shape[-1])
    if not variance.any():
        return spectra
    out = np.empty_like(spectra)
    for made, taken, weights in _band_groups(tuple(map(float, wavelength_nm)), tuple(map(float, variance))):
        np.matmul(spectra[..., taken], weights.astype(spectra.dtype, copy=False), out=out[..., made])
    return out


def missing_variance(wanted_nm: float, fwhm_nm: Floats | None, bands: int) -> Floats:
    """Return the variance that Gaussian bands lack to be ``wanted_nm`` wide, (band,); 0 where not known. [nm^2]"""
    if fwhm_nm is None:
        return np.zeros(bands)
    widths = np.nan_to_num(np.asarray(fwhm_nm, np.float64), nan=np.inf, posinf=np.inf)
    return np.maximum(wanted_nm**2 - np.minimum(widths, wanted_nm) ** 2, 0) / FWHM2_PER_VARIANCE


@lru_cache(maxsize=8)
def _band_groups(
    wavelength_nm: tuple[float, ...], variance: tuple[float, ...]
) -> tuple[tuple[slice, slice, Radiance], ...]:
    """Cut the kernel into products of few bands: the bands made, those taken, and weights (taken, made)."""
    kernel = np.zeros((len(wavelength_nm), len(wavelength_nm)))
    for run in rising_runs(np.array(wavelength_nm)):
        kernel[run, run] = _heat_kernel(np.array(wavelength_nm[run]), np.array(variance[run]))
    groups = []
    for start in range(0, len(kernel), BANDS_AT_ONCE):
        made = slice(start, min(start + BANDS_AT_ONCE, len(kernel)))
        used = np.flatnonzero((np.abs(kernel[made]) > LEAST_WEIGHT).any(axis=0))
        taken = slice(int(used[0]), int(used[-1]) + 1)
        groups.append((made, taken, np.ascontiguousarray(kernel[made, taken].T, dtype=np.float32)))
    return tuple(groups)


def _heat_kernel(wavelength_nm: Floats, variance: Floats) -> Floats:
    """Return the rows of exp(v/2 D), (band, band), each with its own variance v.

    D keeps the line through a spectrum's ends. On the rest it is a symmetric matrix, scaled by the root of the gaps.
    """
    bands = len(wavelength_nm)
    if bands < 3:
        return np.eye(bands)
    gaps = np.diff(wavelength_nm)
    root = np.sqrt((gaps[:-1] + gaps[1:]) / 2)
    rate, mode = scipy.linalg.eigh_tridiagonal(
        -(1 / gaps[:-1] + 1 / gaps[1:]) / root**2, 1 / gaps[1:-1] / root[:-1] / root[1:]
    )
    grown = np.exp(np.minimum(rate, 0) * variance[1:-1, None] / 2) * (mode / root[:, None])
    inner = grown @ (mode * root[:, None]).T
    place = (wavelength_nm - wavelength_nm[0]) / (wavelength_nm[-1] - wavelength_nm[0])
    kernel = np.eye(bands)
    kernel[1:-1, 1:-1] = inner
    kernel[1:-1, 0] = 1 - place[1:-1] - inner @ (1 - place[1:-1])
    kernel[1:-1, -1] = place[1:-1] - inner @ place[1:-1]
    return kernel


class Smile(LightChange):
    """A sample records in band b the light of wavelength lambda_b + s, s = smile_nm (u / u_end)^2.

    u is the sample's way from the line's centre: s is 0 there and ``smile_nm`` at both ends. Above 0 the ends see
    longer wavelengths than their bands are called, below 0 shorter ones (a frown). Spectra are interpolated by cubics
    with slopes of second order, and never beyond the scene's first and last band.
    """

    name = "smile"
    within_spectra = True  # a factor of a whole spectrum passes through
    cost_ns = MappingProxyType({"cubic": 0.9})

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound it by 1.5 I' s: a cubic lies beside its chord by at most half as much as the chord rises."""
        shift = abs(rig.optics.smile_nm)
        if shift == 0:
            return Bound(0.0, "the slit's image is straight")
        if not rising_gaps(probe.wavelength_nm).size:
            return Bound(0.0, "no two bands of rising wavelength: a shift of wavelengths shows on no single band")
        steep = float(np.max(probe.spectral_slope, initial=0))
        why = f"{shift:.3g} nm at a line's ends, on spectra of at most {steep:.3g} {probe.unit}/nm"
        return Bound(1.5 * steep * shift, why)

    def change(self, light: Radiance, block: SweepBlock, variant: str) -> Radiance:
        """Return light (line, sample, band) [e-] at the wavelengths that each sample sees."""
        from spectralzoom.pipeline.simulator import compiled_loops

        wavelength = tuple(map(float, block.wavelength_nm))
        first, weights = _tap_weights(wavelength, float(block.rig.optics.smile_nm), block.rig.camera.samples)
        out = np.empty(light.shape, np.float32)
        compiled_loops.mix_neighbours(np.ascontiguousarray(light, np.float32), weights, first, out)
        return out


def wavelength_shift(samples: int, smile_nm: float) -> Floats:
    """Return the excess of each sample's wavelength over its band's, (sample,) [nm]."""
    half = (samples - 1) / 2
    return np.asarray(smile_nm * ((np.arange(samples) - half) / max(half, 0.5)) ** 2, np.float64)  # 0 of one sample


@lru_cache(maxsize=4)
def _tap_weights(wavelength_nm: tuple[float, ...], smile_nm: float, samples: int) -> tuple[int, NDArray[np.float32]]:
    """Return the offset of the first tap and the weights of all, (tap, sample, band)."""
    wavelength = np.array(wavelength_nm)
    shift = wavelength_shift(samples, smile_nm)
    runs = [run for run in rising_runs(wavelength) if run.stop - run.start > 1]
    taps = [(run, off, weight) for run in runs for off, weight in _run_taps(wavelength[run], shift)]
    first = min([0, *(int(off.min()) for _, off, _ in taps)])
    last = max([0, *(int(off.max()) for _, off, _ in taps)])
    weights = np.zeros((last - first + 1, samples, len(wavelength)))
    weights[-first] = 1
    for run in runs:
        weights[-first, :, run] = 0
    for run, off, weight in taps:
        weights[off - first, np.arange(samples)[:, None], np.arange(run.start, run.stop)] += weight
    used = np.flatnonzero(weights.any(axis=(1, 2)))
    low, high = min(used[0], -first), max(used[-1], -first)
    return first + int(low), weights[low : high + 1].astype(np.float32)


def _run_taps(wavelength: Floats, shift: Floats) -> list[tuple[NDArray[np.int64], Floats]]:
    """Return the taps of one run of rising wavelengths, (sample, band) each: band offsets and their weights."""
    wanted = np.clip(wavelength + shift[:, None], wavelength[0], wavelength[-1])
    gap = np.clip(np.searchsorted(wavelength, wanted, side="right") - 1, 0, len(wavelength) - 2)
    width = np.diff(wavelength)[gap]
    t = (wanted - wavelength[gap]) / width
    here = gap - np.arange(len(wavelength))
    near, far = 1 - t, t
    # A cubic with these slopes lies beside its chord by -h^2/2 t (1-t) [(1-t) D I_near + t D I_far].
    down, up = difference_rates(wavelength)
    bend_near, bend_far = -(width**2) / 2 * t * (1 - t) * np.stack([1 - t, t])
    after = gap + 1
    taps = [
        (here - 1, bend_near * down[gap]),
        (here, near - bend_near * (down + up)[gap] + bend_far * down[after]),
        (here + 1, far + bend_near * up[gap] - bend_far * (down + up)[after]),
        (here + 2, bend_far * up[after]),
    ]
    size = len(wavelength) - 1 - np.arange(len(wavelength))
    return [(np.clip(off, -np.arange(len(wavelength)), size), weight) for off, weight in taps]


RESPONSE, SMILE = Response(), Smile()


LEAST_MODE = 1e-8  # of a wide Gaussian's cosines; fainter ones are below float32


@dataclass(frozen=True)
class SensorGain(Gain):
    """Parts of the sensor have gains of their own, normal about 1, never below 0."""

    name: str = "prnu"
    parts: str = "elements"  # or columns: samples of all bands
    cost_ns = MappingProxyType({"exact": 0.2})

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound it by the greatest signal of each band times the greatest gain beside 1 that the sensor has there."""
        fraction = self._deviation(rig)
        if fraction == 0:
            return Bound(0.0, f"all {self.parts} respond alike")
        off = np.abs(self.gains(rig, len(probe.wavelength_nm)) - 1).max(axis=0)
        return Bound(probe.scaled(off), f"gains of {self.parts} differ by {fraction:.2%} (sd), {off.max():.2%} at most")

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        gains = self.gains(rig, len(probe.wavelength_nm))
        least, greatest = float(gains.min(initial=1.0)), float(gains.max(initial=1.0))
        return GainRange.between(least, greatest, len(probe.wavelength_nm), uneven=greatest - least)

    def gain(self, block: SweepBlock, variant: str) -> Radiance:
        return self.gains(block.rig, len(block.wavelength_nm))[None]

    def gains(self, rig: Rig, bands: int) -> Radiance:
        """Return the gains of the sensor's parts, (sample, band) or (sample, 1) of the whole camera."""
        own = bands if self.parts == "elements" else 1
        return _gains(rig.detector.unit, self.name, rig.camera.samples, own, fraction=self._deviation(rig))

    def _deviation(self, rig: Rig) -> float:
        return float(getattr(rig.detector, f"{self.name}_std"))


@lru_cache(maxsize=8)
def _gains(unit: int, kind: str, samples: int, bands: int, *, fraction: float) -> Radiance:
    stream = stream_of(unit, kind)
    drawn = np.stack([normal_deviates(stream, samples) for _ in range(bands)], axis=1)
    gains: Radiance = np.maximum(1 + np.float32(fraction) * drawn, 0)
    gains.setflags(write=False)
    return gains


class StrayLight(LightChange):
    """A fraction of all the light in a line is scattered over its detector: (1 - f) S + f K S. A band is a row.

    A fraction ``stray_even`` of it falls evenly, the rest as a Gaussian ``stray_halo_px`` wide (sd), reflected at the
    detector's edges. K has no weight below 0 and keeps all light. The Gaussian passes only the slowest cosines of a
    frame, so it is a product with few of them.
    """

    name = "stray-light"
    cost_ns = MappingProxyType({"halo": 1.2})

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound it by f (S - H): what is scattered to a sample is between the least and the greatest light."""
        fraction = rig.optics.stray_fraction
        if fraction == 0:
            return Bound(0.0, "no light is scattered")
        range_e = max(probe.brightest_e - probe.darkest_e, 0.0)
        why = f"{fraction:.2g} times a line's light, signals up to {range_e:.3g} e- from others"
        return Bound(probe.added(fraction * range_e, rig.camera.electrons_per_dn), why)

    def change(self, light: Radiance, block: SweepBlock, variant: str) -> Radiance:
        """Return the light after scattering; works in place."""
        optics = block.rig.optics
        along, along_kept = _cosines(light.shape[1], optics.stray_halo_px)
        across, across_kept = _cosines(light.shape[2], optics.stray_halo_px)
        kept = np.outer(along_kept, across_kept) * (1 - optics.stray_even)
        kept[0, 0] = 1
        weakened = (optics.stray_fraction * kept).astype(np.float32)  # as the kernel f K weakens the slowest cosines
        for line in light:  # line by line: rounding, too, does not depend on the block
            modes = along @ (line @ across.T) * weakened
            line *= np.float32(1 - optics.stray_fraction)
            line += (along.T @ modes) @ across
        return light


@lru_cache(maxsize=16)
def _cosines(count: int, sd_px: float) -> tuple[Radiance, NDArray[np.float64]]:
    """Return orthonormal cosines (mode, count), passed by a Gaussian reflected at both ends, and fractions passed."""
    passed = np.exp(-((np.pi * sd_px / count * np.arange(count)) ** 2) / 2)
    modes = np.arange(count)[passed > LEAST_MODE]
    waves = np.cos(np.pi / count * np.outer(modes, np.arange(count) + 0.5))
    waves *= np.sqrt(np.where(modes == 0, 1, 2) / count)[:, None]
    return waves.astype(np.float32), passed[modes]


PRNU, STRIPING, STRAY_LIGHT = SensorGain(), SensorGain("striping", "columns"), StrayLight()
