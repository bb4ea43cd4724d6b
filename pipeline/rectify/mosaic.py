"""Read one scan path's values at points, from the needed lines and samples only, and blend several sweeps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.rectify.kernels import Kernel
from spectralzoom.pipeline.rectify.placed import TAPS, PlacedSweep, member_lines
from spectralzoom.pipeline.rectify.resample import merge_lines, resample
from spectralzoom.pipeline.rectify.scan_paths import ScanPath
from spectralzoom.pipeline.signal.lines import ReadWindow

LEAST_EDGE_PX = 1e-3  # the very edge of a sweep counts where no other sweep reaches
RUN_ELEMENTS = 250_000  # cost of one more window, in calibrated elements (sample and band of a line)
BLOCK_POINTS = 1024  # points blended at once stay in cache


@dataclass(frozen=True)
class MosaicPart:
    """One sweep on the mosaic's pixels: (n, band) values, (n,) weight of the resampling, (n,) distance to its edge.

    A point of weight 0 has no value. One with weight may still be NaN in single bands.
    """

    values: NDArray[np.float32]
    weight: NDArray[np.float32]
    edge_px: NDArray[np.float64]
    step: int = 1  # distance of its lines [px]


def edge_distance(coordinates: NDArray[np.float64], lines: int, samples: int) -> NDArray[np.float64]:
    """Return the distance (...) of coordinates (..., 2) to the nearest edge of their sweep [px of it]; NaN off it."""
    line, sample = coordinates[..., 0], coordinates[..., 1]
    return np.minimum(np.minimum(line + 0.5, lines - 0.5 - line), np.minimum(sample + 0.5, samples - 0.5 - sample))


def mosaic(parts: Sequence[MosaicPart]) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Blend sweeps, resampled at the same n points, by weights that grow linearly from each sweep's edge.

    The weights are equal for all bands, so every spectrum is a convex mixture of captured ones. A band without a value
    in one sweep is that of the others. A single sweep is returned unchanged, bit by bit, possibly as the same array.
    Values of weight 0 do not matter. At points that lines of several distances reach, only the closest lines count.

    The result is (n, band) float32, NaN where no sweep reached, and (n,) how many sweeps did.
    """
    if len({part.step for part in parts}) > 1:
        steps = np.stack([np.where(part.weight > 0, part.step, np.inf) for part in parts])
        beyond = steps > steps.min(axis=0)
        parts = [replace(part, weight=np.where(far, 0, part.weight)) for part, far in zip(parts, beyond, strict=True)]
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
    """Write the mixtures at ``points`` that several parts reach."""
    weight = np.stack([part.weight[points] for part in parts])
    edge = np.stack([part.edge_px[points] for part in parts])
    fractions = np.where(weight > 0, weight * np.maximum(np.nan_to_num(edge), LEAST_EDGE_PX), 0.0)
    total = reduce(np.add, fractions)  # part by part: ndarray.sum takes another order where there is one point alone
    weights = (fractions / total).astype(np.float32)
    for first in range(0, len(points), BLOCK_POINTS):
        block = points[first : first + BLOCK_POINTS]
        mixed = np.zeros((len(block), blended.shape[1]), np.float32)
        for part, weight in zip(parts, weights[:, first : first + BLOCK_POINTS], strict=True):
            here = np.flatnonzero(weight)
            mixed[here] += part.values[block[here]] * weight[here, None]
        torn = np.flatnonzero(np.isnan(mixed).any(axis=1))
        if len(torn):  # a part has no value in some bands: the others count there
            values = np.stack([part.values[block[torn]] for part in parts])
            counts = np.where(np.isnan(values), 0, weights[:, first + torn][..., None])
            sums = reduce(np.add, counts)
            found = np.full(sums.shape, np.nan)
            np.divide(reduce(np.add, np.where(counts > 0, values, 0) * counts), sums, out=found, where=sums > 0)
            mixed[torn] = found
        blended[block] = mixed


@dataclass(frozen=True)
class LocatedSweep:
    """A scan path and the (..., 2) knots and samples at which it saw some points, NaN off it."""

    placed: PlacedSweep
    scan_path: ScanPath
    coordinates: NDArray[np.float64]
    read: ReadWindow


def read_part(
    located: LocatedSweep, coordinates: NDArray[np.float64], camera: LineCamera, kernel: Kernel
) -> MosaicPart | None:
    """Resample one scan path at coordinates (n, 2) of the geolocation grid; None if it reaches none of them.

    Lines that are not valid or that nothing saw, and saturated or uncalibrated elements, do not count. If they leave
    less than half of a kernel's weight the point is NaN with weight 0. The result at a point does not depend on the
    other points.
    """
    box = _boxes(coordinates[None])[0]
    if np.isnan(box[0]):
        return None
    signal = located.placed.signal
    scan_path = located.scan_path
    knots, samples = _span(box[0], box[1], len(scan_path)), _span(box[2], box[3], signal.samples)
    members = member_lines(scan_path, knots)
    values, valid = signal.values(located.read, members, samples, camera.full_scale_dn)
    starts = scan_path.starts[knots] - scan_path.starts[knots.start]
    seen = np.repeat(scan_path.seen[knots], np.diff(starts, append=len(members)))
    if not seen.all():
        valid = valid & seen.reshape(-1, *[1] * (valid.ndim - 1))
    if len(starts) < len(members):
        values, valid = merge_lines(values, valid, starts)
    values_at, weight = resample(values, valid, coordinates - np.array([knots.start, samples.start]), kernel)
    edge_px = edge_distance(coordinates, len(scan_path), signal.samples)
    return MosaicPart(values_at, weight, edge_px, located.placed.lines.sweep.step)


def cut_runs(located: Sequence[NDArray[np.float64]], bands: int) -> list[slice]:
    """Cut groups of points into runs (slices, in order) such that few unneeded elements are calibrated.

    If lines are turned against the grid, a long run of pixels needs many times as many lines and samples. Short runs
    need fewer, but each has a fixed cost. ``located`` holds the (group, n, 2) coordinates of each scan path.
    """
    boxes = np.stack([_boxes(coordinates) for coordinates in located])

    def price(run: slice) -> float:  # elements to calibrate and the cost of a run; 0 where no scan path reaches
        low = np.fmin.reduce(boxes[:, run][:, :, [0, 2]], axis=1)  # NaN aside
        high = np.fmax.reduce(boxes[:, run][:, :, [1, 3]], axis=1)
        return float(np.nansum(np.prod(high - low + 2 * TAPS, axis=1) * bands + RUN_ELEMENTS))

    def cut(run: slice) -> list[slice]:
        if run.stop - run.start == 1:
            return [run]
        middle = (run.start + run.stop) // 2
        # both halves first: one cut may gain nothing, as where two sweeps meet, but those within it much
        parts = cut(slice(run.start, middle)) + cut(slice(middle, run.stop))
        return parts if sum(map(price, parts)) < price(run) else [run]

    return cut(slice(0, boxes.shape[1]))


def _boxes(coordinates: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return first and last knot, first and last sample of each group, (group, 4); NaN if it is off the scan path."""
    flat = coordinates.reshape(len(coordinates), -1, 2)
    edges = []
    for place in (flat[..., 0].copy(), flat[..., 1].copy()):  # minima of contiguous values are ten times as fast
        off = np.isnan(place)
        for extreme, away in ((np.min, np.inf), (np.max, -np.inf)):
            edge = extreme(np.where(off, away, place) if off.any() else place, axis=1)
            edges.append(np.where(np.isinf(edge), np.nan, edge))
    return np.stack(edges, axis=1)


def _span(low: float, high: float, size: int) -> slice:
    """Return whole pixels from low to high with the kernel's taps, within 0..size."""
    return slice(max(int(np.floor(low)) - TAPS, 0), min(int(np.ceil(high)) + TAPS + 1, size))
