"""Windows: one track's values at points, from no more raw lines and samples than they need."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.rectify.calibration.calibrate import calibrate
from pipeline.rectify.line_cache import Raw, ReadWindow
from pipeline.rectify.mosaic import MosaicPart, edge_distance
from pipeline.rectify.placed import Placed
from pipeline.rectify.reach import TAPS, member_lines
from pipeline.rectify.resample import Kernel, merge_lines, resample
from pipeline.rectify.tracks import Track

RUN_ELEMENTS = 250_000  # what one more window costs, in elements (sample and band of a line) calibrated


@dataclass(frozen=True)
class LookedUp:
    """A track and the (..., 2) knots and samples at which it saw some points, NaN off it."""

    placed: Placed
    track: Track
    coordinates: NDArray[np.float64]
    read: ReadWindow


def read_part(
    looked: LookedUp, coordinates: NDArray[np.float64], camera: LineCamera, kernel: Kernel
) -> MosaicPart | None:
    """Calibrate and resample one track at lookup coordinates (n, 2); None where it reaches none of them.

    Lines that are not valid or that nothing saw, saturated and uncalibrated elements count nothing; where they leave
    less than half of a kernel's weight the point is NaN with weight 0. The result at a point does not depend on the
    other points.
    """
    box = _boxes(coordinates[None])[0]
    if np.isnan(box[0]):
        return None
    lines, track = looked.placed.lines, looked.track
    count = lines.references.dark.shape[0]
    elements = looked.placed.elements
    knots, samples = _span(box[0], box[1], len(track)), elements.alone(_span(box[2], box[3], count))
    members = member_lines(track, knots)
    values, valid = calibrate(
        _raw_of(looked.read, members, samples),
        elements.part(samples),
        saturated_dn=camera.full_scale_dn * lines.sweep.binning,
        position=lines.position[members],
    )
    starts = track.starts[knots] - track.starts[knots.start]
    usable = lines.valid_line[members] & np.repeat(track.seen[knots], np.diff(starts, append=len(members)))
    if not usable.all():
        valid = valid & usable.reshape(-1, *[1] * (valid.ndim - 1))
    if len(starts) < len(members):
        values, valid = merge_lines(values, valid, starts)
    values_at, weight = resample(values, valid, coordinates - np.array([knots.start, samples.start]), kernel)
    return MosaicPart(values_at, weight, edge_distance(coordinates, len(track), count))


def cut_runs(looked: Sequence[NDArray[np.float64]], bands: int) -> list[slice]:
    """Cut groups of points into runs such that little is calibrated that no point needs.

    Where lines are turned against the grid, the lines and samples behind a long run of pixels are many times as many
    as the pixels; short runs have less beside, but each has a price of its own.

    Parameters
    ----------
    looked
        For each track the (group, n, 2) lookup coordinates.

    Returns
    -------
    Slices of groups, in order, that cover all of them.
    """
    boxes = np.stack([_boxes(coordinates) for coordinates in looked])
    cuts: list[slice] = []
    _cut(boxes, slice(0, boxes.shape[1]), bands, cuts)
    return cuts


def _cut(boxes: NDArray[np.float64], run: slice, bands: int, cuts: list[slice]) -> None:
    middle = (run.start + run.stop) // 2
    one, other = slice(run.start, middle), slice(middle, run.stop)
    if run.stop - run.start > 1 and _price(boxes[:, one], bands) + _price(boxes[:, other], bands) < _price(
        boxes[:, run], bands
    ):
        _cut(boxes, one, bands, cuts)
        _cut(boxes, other, bands, cuts)
    else:
        cuts.append(run)


def _price(boxes: NDArray[np.float64], bands: int) -> float:
    """Elements to calibrate for a run of groups, its fixed price included; nothing where no track reaches."""
    low, high = np.fmin.reduce(boxes[:, :, [0, 2]], axis=1), np.fmax.reduce(boxes[:, :, [1, 3]], axis=1)  # NaN aside
    elements = np.prod(high - low + 2 * TAPS, axis=1) * bands + RUN_ELEMENTS
    return float(np.nansum(elements))


def _boxes(coordinates: NDArray[np.float64]) -> NDArray[np.float64]:
    """First and last knot, first and last sample of each group, (group, 4); NaN where the track reaches none of it."""
    flat = coordinates.reshape(len(coordinates), -1, 2)
    edges = []
    for place in (flat[..., 0].copy(), flat[..., 1].copy()):  # minima of what lies side by side are ten times as fast
        off = np.isnan(place)
        for extreme, away in ((np.min, np.inf), (np.max, -np.inf)):
            edge = extreme(np.where(off, away, place) if off.any() else place, axis=1)
            edges.append(np.where(np.isinf(edge), np.nan, edge))
    return np.stack(edges, axis=1)


def _span(low: float, high: float, size: int) -> slice:
    """Whole pixels from low to high with the kernel's taps, within 0..size."""
    return slice(max(int(np.floor(low)) - TAPS, 0), min(int(np.ceil(high)) + TAPS + 1, size))


def _raw_of(read: ReadWindow, members: NDArray[np.intp], samples: slice) -> Raw:
    """Raw numbers of the lines ``members``, in their order."""
    first, last = int(members.min()), int(members.max()) + 1
    raw = read(slice(first, last), samples)
    if last - first == len(members):
        if (np.diff(members) == 1).all():
            return raw
        if (np.diff(members) == -1).all():
            return raw[::-1]
    return raw[members - first]
