"""Smile: the slit's image is bent on the detector, so that wavelengths shift from the centre of a line to its ends."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.band_differences import difference_rates, rising_gaps, rising_runs
from pipeline.simulator.block import SweepBlock
from pipeline.simulator.effects.effect import OFF, Bound
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

Floats = NDArray[np.float64]
Light = NDArray[np.float32]
CUBIC, LINEAR = "cubic", "linear"
GROUP = 32  # samples at a time: they stay in the processor's cache


@dataclass(frozen=True)
class Smile:
    """A sample records in band b the light of wavelength lambda_b + s, s = smile_nm (u / u_end)^2.

    u is the sample's way from the line's centre: s is 0 there and ``smile_nm`` at both ends. Above 0 the ends see
    longer wavelengths than their bands are called, below 0 shorter ones (a frown). Spectra are interpolated by cubics
    with slopes of second order, or by straight lines, and never beyond the scene's first and last band.
    """

    name = "smile"
    variants = (CUBIC, LINEAR)
    within_spectra = True  # a factor of a whole spectrum passes through
    cost_ns = MappingProxyType({CUBIC: 0.9, LINEAR: 0.5})

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound it by I' s, and a cubic beside its chord by I'' s (h - s) / 2 in a gap h between bands."""
        wavelength = np.asarray(probe.wavelength_nm, np.float64)
        shift = abs(rig.optics.smile_nm)
        if shift == 0:
            return Bound(0.0, "the slit's image is straight")
        gaps = rising_gaps(wavelength)
        if not gaps.size:
            return Bound(0.0, "no two bands of rising wavelength: a shift of wavelengths shows on no single band")
        if variant == CUBIC:
            return Bound(0.0, "exact")
        bent = _most_bent(shift, wavelength, probe.spectral_curvature)
        if variant == LINEAR:
            return Bound(bent, f"{shift:.3g} nm at a line's ends, between bands {gaps.max():.3g} nm apart by lines")
        steep = float(np.max(probe.spectral_slope, initial=0))
        why = f"{shift:.3g} nm at a line's ends, on spectra of at most {steep:.3g} {probe.unit}/nm"
        # No slope of the cubic at a band is above the steepest: it adds at most 2 t (1 - t) to the way, t = s / h.
        part = min(shift / float(gaps.min()), 0.5)
        return Bound(steep * shift + min(bent, steep * shift * 2 * part * (1 - part)), why)

    def change(self, light: Light, block: SweepBlock, variant: str) -> Light:
        """Give the light at the wavelengths that each sample sees."""
        camera, smile = block.rig.camera, block.rig.optics.smile_nm
        if smile == 0 or light.shape[-1] < 2:
            return light
        bands = tuple(map(float, block.wavelength_nm))
        first, weights = _tap_weights(bands, float(smile), camera.samples, variant)
        if block.samples is not None:
            weights = np.take(weights, block.columns, axis=1)
        out = np.empty_like(light)
        for start in range(0, light.shape[1], GROUP):
            some = slice(start, start + GROUP)
            _mix_bands(light[:, some], out[:, some], first, weights[:, some])
        return out


SMILE = Smile()


def wavelength_shift(samples: int, smile_nm: float) -> Floats:
    """Give by how much longer the wavelength of each sample is than its band's, (sample,). [nm]"""
    half = (samples - 1) / 2
    if half == 0:
        return np.zeros(samples)
    return np.asarray(smile_nm * ((np.arange(samples) - half) / half) ** 2, np.float64)


def _mix_bands(light: Light, made: Light, first: int, weights: Light) -> None:
    """Sum shifted bands times weights into ``made``: tap k takes band b + first + k for band b."""
    import torch

    bands, (from_light, into, shares) = light.shape[-1], map(torch.from_numpy, (light, made, weights))
    torch.mul(from_light, shares[-first], out=into)
    for tap, share in enumerate(shares, start=first):
        if tap != 0:  # one pass over the light, not a product and a sum
            low, high = max(0, -tap), bands - max(0, tap)
            into[..., low:high].addcmul_(from_light[..., low + tap : high + tap], share[:, low:high])


@lru_cache(maxsize=4)
def _tap_weights(
    wavelength_nm: tuple[float, ...], smile_nm: float, samples: int, variant: str
) -> tuple[int, NDArray[np.float32]]:
    """Give the offset of the first tap and the weights of all, (tap, sample, band)."""
    wavelength, shift = np.array(wavelength_nm), wavelength_shift(samples, smile_nm)
    taps: list[tuple[slice, NDArray[np.int64], Floats]] = []
    for run in rising_runs(wavelength):
        if run.stop - run.start > 1:
            taps += [(run, off, weight) for off, weight in _run_taps(wavelength[run], shift, variant)]
    first = min((int(off.min()) for _, off, _ in taps), default=0)
    last = max((int(off.max()) for _, off, _ in taps), default=0)
    first, last = min(first, 0), max(last, 0)
    weights = np.zeros((last - first + 1, samples, len(wavelength)))
    weights[-first] = 1
    sample = np.arange(samples)[:, None]
    for run in {run.start: run for run, _, _ in taps}.values():
        weights[-first, :, run] = 0
    for run, off, weight in taps:
        weights[off - first, sample, np.arange(run.start, run.stop)] += weight
    used = np.flatnonzero(weights.any(axis=(1, 2)))
    low, high = min(used[0], -first), max(used[-1], -first)
    return first + int(low), weights[low : high + 1].astype(np.float32)


def _run_taps(wavelength: Floats, shift: Floats, variant: str) -> list[tuple[NDArray[np.int64], Floats]]:
    """Taps of one run of rising wavelengths: which band beside its own, and how much of it, (sample, band) each."""
    wanted = np.clip(wavelength + shift[:, None], wavelength[0], wavelength[-1])
    gap = np.clip(np.searchsorted(wavelength, wanted, side="right") - 1, 0, len(wavelength) - 2)
    width = np.diff(wavelength)[gap]
    t = (wanted - wavelength[gap]) / width
    here = gap - np.arange(len(wavelength))
    near, far = 1 - t, t
    if variant == LINEAR:
        return [(here, near), (here + 1, far)]
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


def _most_bent(shift: float, wavelength: Floats, bend: Floats) -> float:
    """Greatest distance of a cubic from its chord on the way of a shift: that way times the rest of the gap, over 2."""
    gaps = np.diff(wavelength)
    rising = gaps > 0
    part = np.minimum(shift, gaps / 2)
    beside = np.maximum(bend[:-1], bend[1:])
    if shift > gaps[rising].min():  # bands see gaps that are not next to them
        beside = np.full_like(beside, bend.max())
    return float((part * (gaps - part) * beside)[rising].max()) / 2
