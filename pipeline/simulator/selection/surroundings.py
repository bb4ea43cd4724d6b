"""What lies beside the samples of sweeps and is brought to them by what blurs and shifts: its greatest changes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.effects.probe import second_difference, steepest_difference
from pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene, to_bands

Light = NDArray[np.float32]
Floats = NDArray[np.float64]
REACHES = (2.0, 6.0, 24.0)  # px beside the sweeps, within which is looked as closely as where they see
BLOCK_PX = 4  # of the scene, averaged: a blur of `WIDE_PX` and more sees means of two by two of them
_ROWS_AT_ONCE = 64


@dataclass(frozen=True)
class WideLight:
    """Means of several pixels of a scene: their ends (band,) [e-] and derivatives (2, band) [e-/px, e-/px^2].

    ``spectral`` (2, band) are the greatest divided differences over wavelength [e-/nm, e-/nm^2].
    """

    low: Light
    high: Light
    slope: Light
    curvature: Light
    spectral: Light


def seen_widely(scene: RasterScene, exposure_ms: float) -> WideLight:
    """Give what is `WIDE_PX` wide and wider sees of all the scene: means of 2 x 2 blocks of `BLOCK_PX`.

    Derivatives are the greatest along either axis.
    """
    spectra = scene.electrons * np.float32(exposure_ms / DEFAULT_EXPOSURE_MS)
    bands, nm = len(scene.wavelength_nm), np.asarray(scene.wavelength_nm, np.float64)
    low, high = np.full(bands, np.inf, np.float32), np.full(bands, -np.inf, np.float32)
    slope, curvature, spectral = (np.zeros(size, np.float32) for size in (bands, bands, (2, bands)))
    for parts in _means(scene):
        means = to_bands(parts, spectra)
        low, high = np.minimum(low, means.min(axis=(0, 1))), np.maximum(high, means.max(axis=(0, 1)))
        for axis in (0, 1):
            ahead, middle, behind = _thirds(means, axis)
            slope = np.maximum(slope, _largest(ahead - middle))
            curvature = np.maximum(curvature, _largest(ahead + behind - 2 * middle))
        if bands > 1:
            spectral = np.maximum(spectral, _spectral_differences(parts, spectra, nm))
    window = 2 * BLOCK_PX
    steep, bent = np.stack([slope] * 2) / np.float32(window), np.stack([curvature] * 2) / np.float32(window**2)
    return WideLight(low, high, steep, bent, spectral)


def _spectral_differences(parts: Light, spectra: Light, wavelength_nm: Floats) -> Light:
    """Greatest first and second divided differences over wavelength of light, (2, band) [e-/nm, e-/nm^2]."""
    if spectra.ndim == 1:
        light = to_bands(parts, spectra)
        steep, bent = steepest_difference(light, wavelength_nm), second_difference(light, wavelength_nm)
        return np.stack([_largest(steep), _largest(bent)])
    gaps = np.diff(wavelength_nm)
    rate = np.divide(1, gaps, out=np.zeros_like(gaps), where=gaps > 0).astype(np.float32)
    ahead = _largest(parts @ (np.diff(spectra, axis=1) * rate))
    steep = np.maximum(np.append(ahead, np.float32(0)), np.append(np.float32(0), ahead))
    return np.stack([steep, _largest(parts @ second_difference(spectra, wavelength_nm))])


def _largest(values: Light) -> Light:
    """Greatest size of each band, (band,)."""
    return np.asarray(np.maximum(values.max(axis=(0, 1), initial=0.0), -values.min(axis=(0, 1), initial=0.0)))


def _means(scene: RasterScene) -> Iterator[Light]:
    """Components of windows of two by two blocks, a block apart, in overlapping parts of the scene."""
    planes = scene.planes
    short = [-size % BLOCK_PX for size in scene.shape]
    if any(short):
        planes = np.pad(planes, ((0, short[0]), (0, short[1]), (0, 0)), mode="edge")
    rows, columns = (size // BLOCK_PX for size in planes.shape[:2])
    blocks = planes.reshape(rows, BLOCK_PX, columns, BLOCK_PX, -1).sum(axis=1).sum(axis=2) / np.float32(BLOCK_PX**2)
    blocks = np.pad(blocks, ((4, 4), (4, 4), (0, 0)), mode="edge")
    sums = blocks[1:] + blocks[:-1]
    windows = (sums[:, 1:] + sums[:, :-1]) / np.float32(4)
    for first in range(0, len(windows), _ROWS_AT_ONCE):
        part = windows[first : first + _ROWS_AT_ONCE + 4]
        if len(part) > 4 or not first:
            yield part


def _thirds(means: Light, axis: int) -> tuple[Light, Light, Light]:
    """Windows ahead of, at and behind each place, side by side along an axis."""
    size = means.shape[axis] - 4
    ahead, middle, behind = (means[(slice(None),) * axis + (slice(at, at + size),)] for at in (4, 2, 0))
    return ahead, middle, behind
