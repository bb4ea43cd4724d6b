"""The simulator's loops over samples: where parts of kernels lie, their taps' weights, sums over windows of pixels.

All are compiled, for arrays of one type each, and may be called by several threads at once. What a sample sees depends
on nothing but itself: it is summed tap after tap, in the same order wherever it stands.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from pipeline.compiled import DOUBLES, FLOATS, OFFSETS, compiled, record_of, rows_of
from pipeline.simulator.optics.tap_tables import TapTable

Floats = NDArray[np.float64]
Radiance = NDArray[np.float32]
Places = NDArray[np.int64]
AT_ONCE = 64  # samples whose weights are worked out together: they stay in the processor's first cache
TAPS_AT_ONCE = 8  # terms of a sum between two looks at its total
FEW = 4  # components that are summed one by one
LANES = 16  # components at a time: those of the next pixel are summed with them, and left


class PartedKernels(NamedTuple):
    """PartedKernels and their parts: shifts (2, kernel) [px], variances (2, kernel) [px^2], places (2, part) [px]."""

    shift: Radiance
    variance: Floats
    between: float  # variance across of the parts' places
    place: Radiance


class PixelTable(NamedTuple):
    """How pixels lie in a table: how many along its inner and its outer axis, and whether lines lie along the outer."""

    inner: int
    outer: int
    components: int
    along_outer: bool


_PIXELS, _VIEWS = rows_of(FLOATS, 1, read_only=True), rows_of(DOUBLES, 2)
_LIGHT2, _LIGHT3, _FLOATS2 = rows_of(FLOATS, 2), rows_of(FLOATS, 3), rows_of(DOUBLES, 2)
_TABLE = record_of(TapTable, _LIGHT2, OFFSETS, DOUBLES, DOUBLES, OFFSETS, OFFSETS, OFFSETS, DOUBLES)
_KERNELS = record_of(PartedKernels, _LIGHT2, _FLOATS2, DOUBLES, _LIGHT2)
_RASTER = record_of(PixelTable, OFFSETS, OFFSETS, OFFSETS, types.boolean)
_NUMBERS, _PLACES = rows_of(types.intp, 1), rows_of(OFFSETS, 2)


@compiled(_VIEWS, _LIGHT2, OFFSETS, _KERNELS, _FLOATS2, _LIGHT3)
def place_parts(
    views: Floats, beside: Radiance, kernel: int, kernels: PartedKernels, scale: Floats, off: Radiance
) -> None:
    """Write the scales (2, n) of a kernel and how far beside their pixel its parts lie, (2, part, n) [px].

    All along the line, then the scan. ``views`` (6, n) are `RayViews`, ``beside`` (2, n) how far from their pixel they
    look. Scales, and the lean of the parts by which they are moved along the line per px across, are such that all
    parts together have the second moments that rays give the footprint.
    """
    run, turn = kernels.variance[0, kernel], kernels.variance[1, kernel]
    runs, turns = kernels.shift[0, kernel], kernels.shift[1, kernel]
    between, place = kernels.between, kernels.place
    parts = place.shape[1]
    for n in range(scale.shape[1]):
        a, b, c, d = views[2, n], views[3, n], views[4, n], views[5, n]
        lean = (a * b * run + c * d * turn) / (d * between) if between > 0 else 0.0
        wide = a * a * run + c * c * turn - lean * (2 * c + lean) * between
        high = b * b * run + d * d * turn
        scale[0, n] = np.sqrt(max(wide / run, 1e-4)) if run > 0 else 1.0
        scale[1, n] = np.sqrt(max(high / turn, 1e-4)) if turn > 0 else 1.0
        for part in range(parts):
            across, along = place[0, part], runs + place[1, part]
            leaning = np.float32(c + lean) * across + beside[0, n]
            upright = np.float32(d) * across + beside[1, n]
            off[0, part, n] = np.float32(a) * along + (np.float32(c) * turns + leaning)
            off[1, part, n] = np.float32(b) * along + (np.float32(d) * turns + upright)


@compiled(_TABLE, OFFSETS, _FLOATS2, _LIGHT3, OFFSETS, OFFSETS, _LIGHT2)
def read_weights(
    table: TapTable, kernel: int, scale: Floats, off: Radiance, axis: int, part: int, weight: Radiance
) -> None:
    """Write the weights (tap, n) of a kernel at places ``off`` px beside their pixel, linear between rows.

    ``scale`` is (axis, n), ``off`` (axis, part, n): of which axis and part is told.
    """
    taps, last_scale, last_row = table.weight.shape[1], table.scales - 1, np.float32(table.rows - 2)
    ahead, per_px = np.float32(table.left - table.first), np.float32(table.per_px)
    for n in range(weight.shape[1]):
        number = np.rint((scale[axis, n] - table.least_scale) * table.per_scale)
        number = number if number > 0 else 0.0  # not a number is not either
        number = number if number < last_scale else float(last_scale)
        row = (off[axis, part, n] + ahead) * per_px
        row = row if row > 0 else np.float32(0)
        row = row if row < last_row else last_row
        whole = int(row)
        fraction = row - np.float32(whole)
        at = np.uint64((kernel * table.scales + int(number)) * table.rows + whole)
        for tap in range(taps):
            near, far = table.weight[at, tap], table.weight[at + np.uint64(1), tap]
            weight[tap, n] = near + fraction * (far - near)


@compiled(_LIGHT2, _LIGHT2, types.boolean, _LIGHT2)
def join_weights(outer: Radiance, inner: Radiance, more: bool, joint: Radiance) -> None:
    """Write the products (outer * inner, n) of weights (outer, n) and (inner, n), or add them where there are more."""
    count, wide = joint.shape[1], len(inner)
    for row in range(len(outer)):
        for column in range(wide):
            tap = row * wide + column
            if more:
                for n in range(count):
                    joint[tap, n] += outer[row, n] * inner[column, n]
            else:
                for n in range(count):
                    joint[tap, n] = outer[row, n] * inner[column, n]


@compiled(_VIEWS, OFFSETS, _FLOATS2, _FLOATS2, _LIGHT2)
def _take_views(views: Floats, first: int, some: Floats, nearest: Floats, beside: Radiance) -> None:
    """Write some views (6, n) from the first one on, the last again where there are no more, and their pixels."""
    last = views.shape[1] - 1
    for n in range(some.shape[1]):
        at = min(first + n, last)
        for one in range(6):
            some[one, n] = views[one, at]
        for axis in range(2):
            nearest[axis, n] = np.rint(views[axis, at])
            beside[axis, n] = np.float32(views[axis, at] - nearest[axis, n])


@compiled(_FLOATS2, OFFSETS, OFFSETS, OFFSETS, OFFSETS, _PLACES)
def _within(nearest: Floats, axis: int, left: int, size: int, step: int, places: Places) -> None:
    """Write where the pixels (n, tap) of windows lie in the table; outside of the scene its edge is repeated."""
    count, taps = places.shape
    for n in range(count):
        first = nearest[axis, n] - left
        first = first if first > -taps else -float(taps)  # not a number is not either
        first = first if first < size else float(size)
        start = int(first)
        for tap in range(taps):
            places[n, tap] = min(max(start + tap, 0), size - 1) * step


@compiled(_PLACES, _PLACES, _PLACES)
def _join_places(rows: Places, columns: Places, places: Places) -> None:
    """Write the places (n, outer * inner) of a window's pixels; the last one again where there is room for more."""
    count, high, wide = rows.shape[0], rows.shape[1], columns.shape[1]
    for n in range(count):
        for row in range(high):
            for column in range(wide):
                places[n, row * wide + column] = rows[n, row] + columns[n, column]
        for tap in range(high * wide, places.shape[1]):
            places[n, tap] = rows[n, high - 1] + columns[n, wide - 1]


@compiled(_PIXELS, _PLACES, _LIGHT2, OFFSETS, OFFSETS, rows_of(FLOATS, 1), OFFSETS)
def _sum_taps(
    planes: Radiance, places: Places, weight: Radiance, taps: int, n: int, total: Radiance, components: int
) -> None:
    """Write sums over the pixels at places (n, tap) of a sample of their components times the weights (tap, n)."""
    if components <= FEW:
        for one in range(components):
            summed = np.float32(0)
            for tap in range(taps):
                summed += weight[tap, n] * planes[np.uint64(places[n, tap]) + np.uint64(one)]
            total[one] = summed
        return
    for one in range(components):
        total[one] = np.float32(0)
    here = np.uint64(n)
    for tap in range(0, places.shape[1], TAPS_AT_ONCE):
        t0 = np.uint64(tap)
        t1, t2, t3, t4 = t0 + np.uint64(1), t0 + np.uint64(2), t0 + np.uint64(3), t0 + np.uint64(4)
        t5, t6, t7 = t0 + np.uint64(5), t0 + np.uint64(6), t0 + np.uint64(7)
        w0, w1, w2, w3 = weight[t0, here], weight[t1, here], weight[t2, here], weight[t3, here]
        w4, w5, w6, w7 = weight[t4, here], weight[t5, here], weight[t6, here], weight[t7, here]
        p0, p1, p2, p3 = places[here, t0], places[here, t1], places[here, t2], places[here, t3]
        p4, p5, p6, p7 = places[here, t4], places[here, t5], places[here, t6], places[here, t7]
        p0, p1, p2, p3 = np.uint64(p0), np.uint64(p1), np.uint64(p2), np.uint64(p3)
        p4, p5, p6, p7 = np.uint64(p4), np.uint64(p5), np.uint64(p6), np.uint64(p7)
        for one in range(components):
            c = np.uint64(one)
            total[one] += (
                w0 * planes[p0 + c]
                + w1 * planes[p1 + c]
                + w2 * planes[p2 + c]
                + w3 * planes[p3 + c]
                + w4 * planes[p4 + c]
                + w5 * planes[p5 + c]
                + w6 * planes[p6 + c]
                + w7 * planes[p7 + c]
            )


@compiled(_PIXELS, _RASTER, _VIEWS, _KERNELS, _TABLE, _TABLE, _NUMBERS, _LIGHT2, _LIGHT3)
def gather_windows(
    planes: Radiance,
    raster: PixelTable,
    views: Floats,
    kernels: PartedKernels,
    along: TapTable,
    scan: TapTable,
    numbers: NDArray[np.intp],
    gains: Radiance,
    out: Radiance,
) -> None:
    """Add what samples see through kernels, times gains (kernel, component), to ``out`` (number, n, component)."""
    outer, inner = (along, scan) if raster.along_outer else (scan, along)
    by_outer, by_inner = (0, 1) if raster.along_outer else (1, 0)
    high, wide, components = outer.weight.shape[1], inner.weight.shape[1], raster.components
    taps = high * wide
    parts, padded = kernels.place.shape[1], -(-taps // TAPS_AT_ONCE) * TAPS_AT_ONCE
    some, nearest, scale = np.empty((6, AT_ONCE)), np.empty((2, AT_ONCE)), np.empty((2, AT_ONCE))
    beside, off = np.empty((2, AT_ONCE), np.float32), np.empty((2, parts, AT_ONCE), np.float32)
    turn, run = np.empty((high, AT_ONCE), np.float32), np.empty((wide, AT_ONCE), np.float32)
    joint, places = np.zeros((padded, AT_ONCE), np.float32), np.empty((AT_ONCE, padded), np.int64)
    rows, columns = np.empty((AT_ONCE, high), np.int64), np.empty((AT_ONCE, wide), np.int64)
    total = np.empty(-(-components // LANES) * LANES, np.float32)
    for first in range(0, views.shape[1], AT_ONCE):
        count = min(AT_ONCE, views.shape[1] - first)
        _take_views(views, first, some, nearest, beside)
        _within(nearest, by_outer, outer.left, raster.outer, raster.inner * components, rows)
        _within(nearest, by_inner, inner.left, raster.inner, components, columns)
        _join_places(rows, columns, places)
        for kernel in range(len(numbers)):
            place_parts(some, beside, kernel, kernels, scale, off)
            for part in range(parts):
                read_weights(outer, kernel, scale, off, by_outer, part, turn)
                read_weights(inner, kernel, scale, off, by_inner, part, run)
                join_weights(turn, run, part > 0, joint)
            number = numbers[kernel]
            for n in range(count):
                room = len(planes) - places[n, taps - 1]
                lanes = len(total) if components > FEW and len(total) <= room else components
                _sum_taps(planes, places, joint, taps, n, total, lanes)
                for one in range(components):
                    out[number, first + n, one] += gains[kernel, one] * total[one]
