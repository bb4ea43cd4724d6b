"""Match the bands of a reference frame, or of a part of a cube, with those of the cube by their wavelengths."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.storage.readers.band_facts import Bands

ROUNDING_NM = 0.05
SAME_BAND = 0.1  # of a step between bands; wavelengths that are farther apart are noted
MOST_WIDER = 1.25  # ratio of the widths of a band
ALONE = 0.01  # half a step of a single band, of its wavelength


def match_bands(own: Bands, wanted: Bands, where: str, cube: str) -> tuple[NDArray[np.intp] | None, list[str]]:
    """Return the band of a frame for each band of a cube, and notes; None if either has no wavelengths.

    Bands in the order of the cube stay, else each is the nearest one. Messages call the frame ``where``. Raises
    SceneError: the frame lacks a band of the cube, or widths differ.
    """
    one, other = own.wavelength_nm, wanted.wavelength_nm
    if one is None or other is None:
        return None, []
    order, near = np.arange(len(other)), half_steps(other)
    if one.shape != other.shape or _off(one, other, near).any():
        order = np.argmin(np.nan_to_num(np.abs(one[:, None] - other), nan=np.inf), axis=0)
        ranked = np.argsort(other)
        near[ranked] = half_steps(other[ranked])
    both = f"{where} has {_span(one)}, {cube} {_span(other)}"
    if _off(one[order], other, near).any() or len(set(order.tolist())) < len(order):
        raise SceneError(f"{both}; give a frame with the cube's own bands, or correct the wavelengths")
    moved = not np.array_equal(order, np.arange(len(one)))
    notes = [f"{both}: its bands are read in the order of the cube's wavelengths"] if moved else []
    off = np.abs(one[order] - other)
    if (off > np.maximum(2 * SAME_BAND * near, ROUNDING_NM)).any():
        most = f"{np.nanmax(off):.3g} nm"
        notes.append(f"{where} has wavelengths up to {most} off those of {cube}: the nearest bands are taken")
    if own.fwhm_nm is not None and wanted.fwhm_nm is not None:
        ratio = own.fwhm_nm[order] / wanted.fwhm_nm
        worst = float(ratio[np.nanargmax(np.abs(np.log(ratio)))])
        if not 1 / MOST_WIDER <= worst <= MOST_WIDER:
            what = f"{where} has bands {worst:.3g} times as wide (fwhm) as {cube}"
            raise SceneError(f"{what}; give a frame with the cube's own bands, or correct the widths")
    return order, notes


def half_steps(nm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (band,) half of the distance to the nearer one of the bands before and after."""
    steps = np.abs(np.diff(nm)) / 2
    near = np.fmin(np.append(steps, np.nan), np.append(np.nan, steps))
    return np.maximum(np.where(np.isnan(near), ALONE * nm, near), ROUNDING_NM)


def _off(one: NDArray[np.float64], other: NDArray[np.float64], near: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return (band,) whether wavelengths are of different bands; two unknown ones are not."""
    return ~(np.abs(one - other) <= near) & ~(np.isnan(one) & np.isnan(other))


def _span(nm: NDArray[np.float64]) -> str:
    return f"{len(nm)} bands from {nm[0]:g} to {nm[-1]:g} nm"
