"""Mosaic: resampled sweeps become one image, feathered where they overlap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ShapeError

LEAST_EDGE_PX = 1e-3  # the very edge of a sweep counts where nothing else reaches


@dataclass(frozen=True)
class Part:
    """One sweep on the mosaic's pixels: (n, band) values, (n,) weight of the resampling, (n,) distance to its edge."""

    values: NDArray[np.float32]
    weight: NDArray[np.float32]
    edge_px: NDArray[np.float64]


def edge_distance(coordinates: NDArray[np.float64], lines: int, samples: int) -> NDArray[np.float64]:
    """Distance of (..., 2) lookup coordinates to the nearest edge of their sweep, (...) [px of it]; NaN off it."""
    line, sample = coordinates[..., 0], coordinates[..., 1]
    down = np.minimum(line + 0.5, lines - 0.5 - line)
    across = np.minimum(sample + 0.5, samples - 0.5 - sample)
    distance: NDArray[np.float64] = np.minimum(down, across)
    return distance


def mosaic(parts: Sequence[Part]) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Blend sweeps by weights that grow linearly from each sweep's edge.

    The weights are the same for all bands, so every spectrum is a convex mixture of captured ones. One sweep alone
    comes back unchanged, bit by bit.

    Parameters
    ----------
    parts
        Sweeps resampled at the same n points, at least one. What a part holds where its weight is 0 does not matter.

    Returns
    -------
    (n, band) float32, NaN where no sweep reached, and (n,) how many sweeps did.

    Raises
    ------
    ShapeError : no part, or parts of different sizes.
    """
    _check_parts(parts)
    reached = [part.weight > 0 for part in parts]
    coverage: NDArray[np.intp] = np.sum(reached, axis=0, dtype=np.intp)
    shares = [
        np.where(here, part.weight * np.maximum(np.nan_to_num(part.edge_px), LEAST_EDGE_PX), 0.0)
        for part, here in zip(parts, reached, strict=True)
    ]
    total = np.sum(shares, axis=0)
    blended = np.zeros(parts[0].values.shape, np.float32)
    for part, share, here in zip(parts, shares, reached, strict=True):
        blended[here] += part.values[here] * (share[here] / total[here]).astype(np.float32)[:, None]
    blended[coverage == 0] = np.nan
    return blended, coverage


def _check_parts(parts: Sequence[Part]) -> None:
    if not parts:
        raise ShapeError("a mosaic needs at least one sweep, got none")
    for number, part in enumerate(parts):
        points = (parts[0].values.shape[0],)
        if part.values.shape != parts[0].values.shape or part.weight.shape != points or part.edge_px.shape != points:
            raise ShapeError(
                f"part {number} has values {part.values.shape}, weight {part.weight.shape} and edge distance "
                f"{part.edge_px.shape}; expected those of {parts[0].values.shape}: resample all at the same points"
            )
