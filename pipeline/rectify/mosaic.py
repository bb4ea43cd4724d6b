"""Mosaic: resampled sweeps become one image, feathered where they overlap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ShapeError

LEAST_EDGE_PX = 1e-3  # the very edge of a sweep counts where nothing else reaches
BLOCK_POINTS = 1024  # what is mixed at once stays in cache


@dataclass(frozen=True)
class MosaicPart:
    """One sweep on the mosaic's pixels: (n, band) values, (n,) weight of the resampling, (n,) distance to its edge.

    A point of weight 0 has no value at all; one of more may still be NaN in single bands.
    """

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


def mosaic(parts: Sequence[MosaicPart]) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Blend sweeps by weights that grow linearly from each sweep's edge.

    The weights are the same for all bands, so every spectrum is a convex mixture of captured ones; only a band that a
    sweep has no value in is the others' alone. One sweep alone comes back unchanged, bit by bit (it may be the very
    array that went in).

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
    for part, here in zip(parts, reached, strict=True):
        if here.all() and (coverage == 1).all():
            return part.values, coverage
    blended = np.empty(parts[0].values.shape, np.float32)
    blended[coverage == 0] = np.nan
    for part, here in zip(parts, reached, strict=True):
        alone = np.flatnonzero(here & (coverage == 1))
        blended[alone] = part.values[alone]
    _blend_shared(blended, parts, np.flatnonzero(coverage > 1))
    return blended, coverage


def _blend_shared(blended: NDArray[np.float32], parts: Sequence[MosaicPart], points: NDArray[np.intp]) -> None:
    """Write the mixtures at ``points``, which several parts reach."""
    shares = np.stack([_share(part, points) for part in parts])
    total = reduce(np.add, shares)  # part by part: ndarray.sum takes another order where there is one point alone
    weights = (shares / total).astype(np.float32)
    for first in range(0, len(points), BLOCK_POINTS):
        block = points[first : first + BLOCK_POINTS]
        mixed = np.zeros((len(block), blended.shape[1]), np.float32)
        for part, weight in zip(parts, weights[:, first : first + BLOCK_POINTS], strict=True):
            here = np.flatnonzero(weight)
            mixed[here] += part.values[block[here]] * weight[here, None]
        torn = np.flatnonzero(np.isnan(mixed).any(axis=1))
        if len(torn):
            mixed[torn] = _by_band(parts, weights[:, first + torn], block[torn])
        blended[block] = mixed


def _by_band(
    parts: Sequence[MosaicPart], weights: NDArray[np.floating], points: NDArray[np.intp]
) -> NDArray[np.floating]:
    """Mixtures at points where a part has no value in some bands: there the others count alone."""
    values = np.stack([part.values[points] for part in parts])
    counts = np.where(np.isnan(values), 0, weights[..., None])
    total = reduce(np.add, counts)
    mixed = np.where(counts > 0, values, 0) * counts
    found: NDArray[np.floating] = np.full(total.shape, np.nan)
    np.divide(reduce(np.add, mixed), total, out=found, where=total > 0)
    return found


def _share(part: MosaicPart, points: NDArray[np.intp]) -> NDArray[np.float64]:
    """What a part counts at points: its weight times the distance to its edge, 0 where it does not reach."""
    weight = part.weight[points]
    share: NDArray[np.float64] = np.where(
        weight > 0, weight * np.maximum(np.nan_to_num(part.edge_px[points]), LEAST_EDGE_PX), 0.0
    )
    return share


def _check_parts(parts: Sequence[MosaicPart]) -> None:
    if not parts:
        raise ShapeError("a mosaic needs at least one sweep, got none")
    for number, part in enumerate(parts):
        points = (parts[0].values.shape[0],)
        if part.values.shape != parts[0].values.shape or part.weight.shape != points or part.edge_px.shape != points:
            raise ShapeError(
                f"part {number} has values {part.values.shape}, weight {part.weight.shape} and edge distance "
                f"{part.edge_px.shape}; expected those of {parts[0].values.shape}: resample all at the same points"
            )
