"""What factors an effect gives light anywhere in a survey, and their course over wavelength, by neighbouring bands."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Real = TypeVar("Real", np.float32, np.float64)


@dataclass(frozen=True)
class GainRange:
    """Factors of light that a gain has anywhere in a survey, (band,) each.

    ``uneven`` is the greatest difference of two factors within one line. ``steepest`` and ``bend`` are the greatest
    first and second differences of the factor over wavelength; ``added_e`` is light that is added, with differences
    of its own.
    """

    least: Floats
    greatest: Floats
    uneven: float
    steepest: Floats  # [1/nm]
    bend: Floats  # [1/nm^2]
    added_e: Floats
    added_steepest: Floats  # [e-/nm]
    added_bend: Floats  # [e-/nm^2]

    @staticmethod
    def between(least: float, greatest: float, bands: int, *, uneven: float = 0.0) -> GainRange:
        """The same in all bands."""
        no = np.zeros(bands)
        return GainRange(np.full(bands, least), np.full(bands, greatest), uneven, no, no, no, no, no)

    @staticmethod
    def of(factors: Floats, wavelength_nm: Floats, *, uneven: float, added_e: Floats | None = None) -> GainRange:
        """Those of (state, band) factors that stand for all that there are, with (state, band) light added."""
        added = np.zeros((1, factors.shape[1])) if added_e is None else added_e
        own, of_added = _differences(factors, wavelength_nm), _differences(added, wavelength_nm)
        return GainRange(factors.min(axis=0), factors.max(axis=0), uneven, *own, added.max(axis=0), *of_added)


def _differences(factors: Floats, wavelength_nm: Floats) -> tuple[Floats, Floats]:
    nm = np.asarray(wavelength_nm, np.float64)
    if len(nm) < 2:
        return np.zeros(len(nm)), np.zeros(len(nm))
    return steepest_difference(factors, nm).max(axis=0), np.abs(second_difference(factors, nm)).max(axis=0)


def rising_runs(wavelength_nm: Floats) -> list[slice]:
    """Give the runs of bands whose wavelengths rise: where they fall back or stay, another detector begins."""
    breaks = np.flatnonzero(~(np.diff(wavelength_nm) > 0)) + 1
    ends = [0, *breaks.tolist(), len(wavelength_nm)]
    return [slice(start, stop) for start, stop in pairwise(ends)]


def rising_gaps(wavelength_nm: Floats) -> Floats:
    """Give the distances of neighbouring bands within runs. [nm]"""
    gaps = np.diff(wavelength_nm)
    return gaps[gaps > 0]


def difference_rates(wavelength_nm: Floats) -> Floats:
    """Weights of the second difference D, (2, band): of the steps down and up to the neighbours. [1/nm^2]

    D I = up (I_next - I) + down (I_last - I) is the second derivative of any parabola. 0 at both ends of a run.
    """
    rates = np.zeros((2, len(wavelength_nm)))
    gaps = np.diff(wavelength_nm)
    inner = 1 + np.flatnonzero((gaps[:-1] > 0) & (gaps[1:] > 0))
    before, after = gaps[inner - 1], gaps[inner]
    rates[:, inner] = 2 / (before + after) / np.stack([before, after])
    return rates


def second_difference(spectra: NDArray[Real], wavelength_nm: Floats) -> NDArray[Real]:
    """Give D I of spectra (..., band), as :func:`difference_rates` defines it. [1/nm^2]"""
    down, up = difference_rates(wavelength_nm).astype(spectra.dtype)
    steps, out = np.diff(spectra, axis=-1), np.zeros_like(spectra)
    out[..., :-1] = up[:-1] * steps
    out[..., 1:] -= down[1:] * steps
    return out


def steepest_difference(spectra: NDArray[Real], wavelength_nm: Floats) -> NDArray[Real]:
    """Give |I'| of spectra (..., band) towards the steeper neighbour of each band; 0 for a run of one band. [1/nm]"""
    gaps = np.diff(wavelength_nm)
    rate = np.divide(1, gaps, out=np.zeros_like(gaps), where=gaps > 0).astype(spectra.dtype)
    steep, out = np.abs(np.diff(spectra, axis=-1)) * rate, np.zeros_like(spectra)
    out[..., :-1] = steep
    np.maximum(out[..., 1:], steep, out=out[..., 1:])
    return out
