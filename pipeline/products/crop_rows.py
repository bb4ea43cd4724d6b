"""Crop rows in the coarse image: which way they run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.errors import ShapeError

Floats = NDArray[np.float64]

TILES = 6  # along the shorter side, where the image allows
LEAST_TILE = 12  # pixels a side
LEAST_STRENGTH = 0.12
LEAST_SIGMAS = 4.0  # that the mean over tiles lies from none
STRONG_FRACTION = 0.98  # quantile at which gradients are cut, so that a track or a wall does not speak for the field


@dataclass(frozen=True)
class CropRows:
    """Direction of the rows and how clear it is.

    ``angle_deg`` is that of the rows, from x towards y of the array, from 0 to below 180; None where there are none.
    ``strength`` is 0 where gradients point anywhere and 1 where all lie square to the rows, everywhere the same.
    """

    angle_deg: float | None
    strength: float


def find_rows(image: ArrayLike) -> CropRows:
    """Find the direction of crop rows in a broad-band image (y, x), such as the mean over bands of the coarse mosaic.

    Gradients are taken between the pixels of 2 x 2 blocks, which is right to four degrees for rows four pixels apart
    or more, and averaged with their angles doubled, tile by tile [1]_. Rows are what many tiles agree on: the direction
    counts where the mean over tiles lies four standard errors from none. NaN pixels count nothing.

    Raises ShapeError: the image has not two axes.

    .. [1] Bigun, Granlund, "Optimal orientation detection of linear symmetry", ICCV 1987.
    """
    pixels = np.asarray(image, np.float64)
    if pixels.ndim != 2:
        raise ShapeError(f"rows are looked for in one (y, x) image, got shape {pixels.shape}; take the mean over bands")
    vectors = _tile_vectors(pixels)
    if len(vectors) < 4:
        return CropRows(None, 0.0)
    mean = complex(vectors.mean())
    strength = abs(mean)
    spread = float(np.sqrt(np.mean(np.abs(vectors - mean) ** 2) / (len(vectors) - 1)))
    if strength < LEAST_STRENGTH or strength < LEAST_SIGMAS * spread:
        return CropRows(None, strength)
    across = np.degrees(np.angle(mean)) / 2  # of the gradient; rows run square to it
    return CropRows(float((across + 90.0) % 180.0), strength)


def _tile_vectors(pixels: Floats) -> NDArray[np.complex128]:
    """Mean gradient of each tile with its angle doubled, over the mean size of its gradients, (tile,)."""
    # Diagonal differences, turned back: both parts of a gradient at the same point, the middle of four pixels.
    down, up = pixels[1:, 1:] - pixels[:-1, :-1], pixels[1:, :-1] - pixels[:-1, 1:]
    along, across = (down - up) / 2, (down + up) / 2
    squared: NDArray[np.complex128] = (along + 1j * across) ** 2
    size = np.abs(squared)
    known = np.isfinite(size)
    if not np.any(size[known] > 0):
        return np.zeros(0, np.complex128)
    cut = float(np.quantile(size[known], STRONG_FRACTION)) or float(size[known].max())
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.where(size > cut, cut / size, 1.0)
    pointed: NDArray[np.complex128] = squared * scale
    pointed[~known] = 0
    size = np.where(known, np.minimum(size, cut), 0)
    side = max(min(pixels.shape) // TILES, LEAST_TILE)
    rows, columns = (np.arange(0, max(length - side // 2, 1), side) for length in size.shape)
    total = np.add.reduceat(np.add.reduceat(size, rows, axis=0), columns, axis=1).ravel()
    vector = np.add.reduceat(np.add.reduceat(pointed, rows, axis=0), columns, axis=1).ravel()
    return np.asarray(vector[total > 0] / total[total > 0], np.complex128)
