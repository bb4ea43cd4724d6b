"""The simulator in compiled loops: noise, bands, and sums over windows of pixels.

All are compiled, for arrays of one type each, and may be called by several threads at once. A sample's light depends on
nothing but its own view: it is summed tap after tap, in the same order wherever it stands. A library's product of
matrices is no faster here, and rounds rows otherwise where they stand elsewhere in a block.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from spectralzoom.pipeline.compiled import DOUBLES, FLOATS, OFFSETS, compiled, record_of, rows_of
from spectralzoom.pipeline.simulator.optics.kernel_fit import Floats, TapTable

Radiance = NDArray[np.float32]
_AT_ONCE = 1024  # numbers that stay in the processor's first cache
_LIGHT1, _LIGHT2, _LIGHT3 = rows_of(FLOATS, 1), rows_of(FLOATS, 2), rows_of(FLOATS, 3)
_WORDS = rows_of(types.uint32, 1)
_RAW = rows_of(types.uint16, 1)
_ENDLESS = 0x7F800000  # bits of an infinite float32; of what is no number they are more


@compiled(_WORDS, OFFSETS, _LIGHT1)
def draw_pairs(words: NDArray[np.uint32], piece: int, drawn: Radiance) -> None:
    """Write standard normal deviates, a piece after the other: of each, words for radii, then as many for turns.

    A radius r = sqrt(-2 ln u) and a turn t give r cos t and r sin t. The logarithm of 2^e m is a polynomial of m - 1,
    right to 1e-7. Sine and cosine are polynomials within an eighth of a turn; the quarter says which, with which sign.
    """
    radius, rest = np.empty(_AT_ONCE, np.float32), np.empty(_AT_ONCE, np.float32)
    bits = radius.view(np.int32)
    for first in range(0, len(drawn), piece):
        half = min(piece, len(drawn) - first) // 2
        for start in range(0, half, _AT_ONCE):
            some = min(_AT_ONCE, half - start)
            at = np.uint64(first + start)
            for n in range(some):
                radius[n] = np.float32(words[at + np.uint64(n)]) * np.float32(2**-32) + np.float32(2**-33)  # never 0
            for n in range(some):
                power = (bits[n] - np.int32(0x3F3504F3)) >> np.int32(23)  # m from sqrt(1/2) to sqrt(2)
                bits[n] -= power << np.int32(23)
                rest[n] = np.float32(power)
            for n in range(some):
                m = radius[n] - np.float32(1)
                p = np.float32(7.0376836292e-2) * m - np.float32(1.1514610310e-1)
                p = p * m + np.float32(1.1676998740e-1)
                p = p * m - np.float32(1.2420140846e-1)
                p = p * m + np.float32(1.4249322787e-1)
                p = p * m - np.float32(1.6668057665e-1)
                p = p * m + np.float32(2.0000714765e-1)
                p = p * m - np.float32(2.4999993993e-1)
                p = p * m + np.float32(3.3333331174e-1)
                log = m + (p * m - np.float32(0.5)) * (m * m) + rest[n] * np.float32(0.6931471805599453)
                radius[n] = np.sqrt(max(np.float32(-2) * log, np.float32(0)))
            for n in range(some):
                turn = np.int32(words[at + np.uint64(half + n)])
                quarter = (turn + np.int32(1 << 29)) >> np.int32(30)
                t = np.float32(turn - (quarter << np.int32(30))) * np.float32(np.pi * 2**-31)
                square = t * t
                s = np.float32(-1.9515295891e-4) * square + np.float32(8.3321608736e-3)
                s = (s * square - np.float32(1.6666654611e-1)) * square * t + t
                c = np.float32(2.443315711809948e-5) * square - np.float32(1.388731625493765e-3)
                c = (c * square + np.float32(4.166664568298827e-2)) * square * square
                c = c - np.float32(0.5) * square + np.float32(1)
                odd = quarter & np.int32(1)
                along, aside = (s, c) if odd else (c, s)
                along = -along if (quarter + odd) & np.int32(2) else along
                aside = -aside if quarter & np.int32(2) else aside
                drawn[at + np.uint64(n)] = along * radius[n]
                drawn[at + np.uint64(half + n)] = aside * radius[n]


@compiled(_LIGHT1, _LIGHT1, _LIGHT1, DOUBLES, DOUBLES, DOUBLES, DOUBLES, _RAW)
def read_merged(
    light: Radiance,
    added: Radiance,
    deviate: Radiance,
    read_noise_e: float,
    electrons_per_dn: float,
    dark_dn: float,
    full_scale_dn: float,
    raw: NDArray[np.uint16],
) -> bool:
    """Write the numbers of light with shot and read noise of one deviate z; whether all that is expected was finite.

    The electrons are mean + sqrt(V) z + (k3 / 6 V) (z^2 - 1). Three cumulants are right (Cornish and Fisher, 1938,
    second order). `divergence` in `effects.counting` bounds the rest. ``light`` below 0 counts as 0; ``added`` comes to
    it, one number or as many as light. All [e-]. Numbers are rounded half to even, within 0 and full scale.
    """
    read = np.float32(read_noise_e * read_noise_e)
    per_dn = np.float32(electrons_per_dn)
    dark = np.float32(dark_dn)
    most = np.float32(full_scale_dn)
    expected = np.empty(_AT_ONCE, np.float32)
    bits = expected.view(np.int32)
    every = np.uint64(1 if len(added) > 1 else 0)
    worst = np.int32(0)
    for first in range(0, len(light), _AT_ONCE):
        some = min(_AT_ONCE, len(light) - first)
        start = np.uint64(first)
        if every:
            for n in range(some):
                one = light[start + np.uint64(n)]
                expected[n] = (np.float32(0) if one < 0 else one) + added[start + np.uint64(n)]
        else:
            for n in range(some):
                one = light[start + np.uint64(n)]
                expected[n] = (np.float32(0) if one < 0 else one) + added[0]
        for n in range(some):
            worst = max(worst, bits[n] & np.int32(0x7FFFFFFF))
        for n in range(some):
            mean = expected[n]
            z = deviate[start + np.uint64(n)]
            variance = mean + read
            skew = mean / variance * np.float32(1 / 6)
            electrons = (np.sqrt(variance) + skew * z) * z - skew + mean
            dn = electrons / per_dn + dark
            dn = dn if dn > 0 else np.float32(0)
            dn = dn if dn < most else most
            dn = (dn + np.float32(1 << 23)) - np.float32(1 << 23)  # half to even
            raw[start + np.uint64(n)] = np.uint16(np.int32(dn))
    return bool(worst < _ENDLESS)


SAMPLES_AT_ONCE = 32  # whose weights stay in the processor's cache while lines pass


@compiled(rows_of(FLOATS, 3, read_only=True), rows_of(FLOATS, 3, read_only=True), OFFSETS, _LIGHT3)
def mix_neighbours(light: Radiance, weights: Radiance, first: int, made: Radiance) -> None:
    """Write light (line, sample, band) times weights (tap, sample, band) of bands ``first``, ``first`` + 1, ... beside.

    The tap of the band itself is among them; bands beyond the ends are left out.
    """
    lines, samples, bands = light.shape
    for start in range(0, samples, SAMPLES_AT_ONCE):
        for line in range(lines):
            for sample in range(start, min(start + SAMPLES_AT_ONCE, samples)):
                for band in range(bands):
                    made[line, sample, band] = light[line, sample, band] * weights[-first, sample, band]
                for tap in range(len(weights)):
                    beside = first + tap
                    if beside == 0:
                        continue
                    low = np.uint64(max(0, -beside))
                    near = np.uint64(max(0, beside))
                    for number in range(bands - abs(beside)):
                        here = np.uint64(number) + low
                        seen = light[line, sample, np.uint64(number) + near]
                        made[line, sample, here] += seen * weights[tap, sample, here]


Places = NDArray[np.int64]
TERMS = 4  # of a sum between two looks at its total, and samples that share what is read for them
LANES = 16  # floats: rows of a mixing matrix are some times as long, and begin where a line of the cache does
_FLOATS_AT_ONCE = 2048  # floats of every kernel that stay in the processor's cache
_ROWS = rows_of(OFFSETS, 1)


@compiled(_LIGHT2, _LIGHT2, _LIGHT2)
def sum_nodes(parts: Radiance, fractions: Radiance, nodes: Radiance) -> None:
    """Write sums (node, value) over kernels of values (kernel, value), times shares (node, kernel)."""
    kernels, count = parts.shape
    for first in range(0, count, _FLOATS_AT_ONCE):
        start = np.uint64(first)
        some = min(_FLOATS_AT_ONCE, count - first)
        for node in range(len(nodes)):
            for number in range(some):
                nodes[node, start + np.uint64(number)] = np.float32(0)
            for kernel in range(0, kernels, TERMS):
                k1, k2, k3 = min(kernel + 1, kernels - 1), min(kernel + 2, kernels - 1), min(kernel + 3, kernels - 1)
                s0 = fractions[node, kernel]
                s1 = fractions[node, k1] if k1 == kernel + 1 else np.float32(0)
                s2 = fractions[node, k2] if k2 == kernel + 2 else np.float32(0)
                s3 = fractions[node, k3] if k3 == kernel + 3 else np.float32(0)
                for number in range(some):
                    at = start + np.uint64(number)
                    nodes[node, at] += (
                        s0 * parts[kernel, at] + s1 * parts[k1, at] + s2 * parts[k2, at] + s3 * parts[k3, at]
                    )


@compiled(_LIGHT3, OFFSETS, OFFSETS, OFFSETS, _LIGHT2, _ROWS)
def _take_terms(nodes: Radiance, start: int, lower: int, upper: int, taken: Radiance, rows: Places) -> int:
    """Write four samples' components that any of them has, (sample, term), and their rows of the mixing; count them."""
    last = nodes.shape[1] - 1  # stands for the samples beyond it
    components = nodes.shape[2]
    count = 0
    n0, n1, n2, n3 = start, min(start + 1, last), min(start + 2, last), min(start + 3, last)
    for node in range(lower, upper):
        for one in range(components):
            a, b, c, d = nodes[node, n0, one], nodes[node, n1, one], nodes[node, n2, one], nodes[node, n3, one]
            if a != 0 or b != 0 or c != 0 or d != 0:
                taken[0, count], taken[1, count], taken[2, count], taken[3, count] = a, b, c, d
                rows[count] = (node - lower) * components + one
                count += 1
    for more in range(count, min(-(-count // TERMS) * TERMS, len(rows))):
        taken[0, more] = taken[1, more] = taken[2, more] = taken[3, more] = np.float32(0)
        rows[more] = 0
    return count


@compiled(_LIGHT2, _ROWS, OFFSETS, _LIGHT2, _LIGHT1, _LIGHT1, _LIGHT1, _LIGHT1)
def _mix_four(
    taken: Radiance, rows: Places, count: int, mixing: Radiance, a: Radiance, b: Radiance, c: Radiance, d: Radiance
) -> None:
    """Write totals (band,) of four samples: their terms (sample, term) times rows of the mixing."""
    wide = mixing.shape[1]
    for band in range(wide):
        a[band] = b[band] = c[band] = d[band] = np.float32(0)
    for t in range(0, count, TERMS):
        a0, a1, a2, a3 = taken[0, t], taken[0, t + 1], taken[0, t + 2], taken[0, t + 3]
        b0, b1, b2, b3 = taken[1, t], taken[1, t + 1], taken[1, t + 2], taken[1, t + 3]
        c0, c1, c2, c3 = taken[2, t], taken[2, t + 1], taken[2, t + 2], taken[2, t + 3]
        d0, d1, d2, d3 = taken[3, t], taken[3, t + 1], taken[3, t + 2], taken[3, t + 3]
        r0, r1, r2, r3 = np.uint64(rows[t]), np.uint64(rows[t + 1]), np.uint64(rows[t + 2]), np.uint64(rows[t + 3])
        for band in range(wide):
            m0, m1, m2, m3 = mixing[r0, band], mixing[r1, band], mixing[r2, band], mixing[r3, band]
            a[band] = a[band] + a0 * m0 + a1 * m1 + a2 * m2 + a3 * m3
            b[band] = b[band] + b0 * m0 + b1 * m1 + b2 * m2 + b3 * m3
            c[band] = c[band] + c0 * m0 + c1 * m1 + c2 * m2 + c3 * m3
            d[band] = d[band] + d0 * m0 + d1 * m1 + d2 * m2 + d3 * m3


@compiled(_LIGHT3, OFFSETS, OFFSETS, _LIGHT2, OFFSETS, OFFSETS, _LIGHT2)
def mix_bands(
    nodes: Radiance, lower: int, upper: int, mixing: Radiance, first: int, bands: int, light: Radiance
) -> None:
    """Write some bands of light (n, band), from the first on: components (node, n, component) times their mixing.

    Nodes from ``lower`` to before ``upper`` are taken; ``mixing`` (node * component, band) is as `mixing_rows` has it.
    A sample has few of many components. Terms are added one by one, and those of 0 may be left out.
    """
    count = nodes.shape[1]
    wide = mixing.shape[1]
    taken = np.empty((TERMS, len(mixing)), np.float32)
    rows = np.empty(len(mixing), np.int64)
    a, b = np.empty(wide, np.float32), np.empty(wide, np.float32)
    c, d = np.empty(wide, np.float32), np.empty(wide, np.float32)
    for start in range(0, count, TERMS):
        terms = _take_terms(nodes, start, lower, upper, taken, rows)
        _mix_four(taken, rows, terms, mixing, a, b, c, d)
        for one, total in enumerate((a, b, c, d)):
            if start + one < count:
                for band in range(bands):
                    light[start + one, np.uint64(first) + np.uint64(band)] = total[band]


def mixing_rows(mixing: Radiance) -> Radiance:
    """Lay out a matrix (node * component, band) for `mix_bands`: more rows and columns of 0, and rows in line."""
    terms, bands = mixing.shape
    rows, columns = -(-terms // TERMS) * TERMS, -(-bands // LANES) * LANES
    room = np.zeros(rows * columns + LANES, np.float32)
    first = -room.ctypes.data % (LANES * room.itemsize) // room.itemsize
    found = room[first : first + rows * columns].reshape(rows, columns)
    found[:terms, :bands] = mixing
    return found


AT_ONCE = 64  # samples whose weights are worked out together: they stay in the processor's first cache
TAPS_AT_ONCE = 8  # terms of a sum between two looks at its total
FEW = 4  # components that are summed one by one


class PartedKernels(NamedTuple):
    """Kernels and their parts: shifts (2, kernel) [px], variances (2, kernel) [px^2], places (2, part) [px]."""

    shift: Radiance
    variance: Floats
    between: float  # variance across of the parts' places
    place: Radiance


class PixelTable(NamedTuple):
    """Order of pixels in a table: counts along its inner and outer axis, and whether lines lie along the outer."""

    inner: int
    outer: int
    components: int
    along_outer: bool


_PIXELS = rows_of(FLOATS, 1, read_only=True)
_FLOATS2 = rows_of(DOUBLES, 2)
_TABLE = record_of(TapTable, _LIGHT2, OFFSETS, DOUBLES, DOUBLES, OFFSETS, OFFSETS, OFFSETS, DOUBLES)
_KERNELS = record_of(PartedKernels, _LIGHT2, _FLOATS2, DOUBLES, _LIGHT2)
_RASTER = record_of(PixelTable, OFFSETS, OFFSETS, OFFSETS, types.boolean)
_NUMBERS = rows_of(types.intp, 1)
_PLACES = rows_of(OFFSETS, 2)


@compiled(_FLOATS2, _LIGHT2, OFFSETS, _KERNELS, _FLOATS2, _LIGHT3)
def place_parts(
    views: Floats, beside: Radiance, kernel: int, kernels: PartedKernels, scale: Floats, off: Radiance
) -> None:
    """Write the scales (2, n) of a kernel and how far beside their pixel its parts lie, (2, part, n) [px].

    All along the line, then the scan. ``views`` (6, n) are `RayViews`, ``beside`` (2, n) how far from their pixel they
    look. The lean is the way of the parts along the line per px across. With scales and lean, all parts together have
    the second moments that rays give the footprint.
    """
    run, turn = kernels.variance[0, kernel], kernels.variance[1, kernel]
    runs, turns = kernels.shift[0, kernel], kernels.shift[1, kernel]
    between = kernels.between
    place = kernels.place
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
    """Write the weights (tap, n) of a kernel, linear between rows, at places ``off`` (axis, part, n) from the pixel."""
    taps = table.weight.shape[1]
    last_scale = table.scales - 1
    last_row = np.float32(table.rows - 2)
    ahead = np.float32(table.left - table.first)
    per_px = np.float32(table.per_px)
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
    count = joint.shape[1]
    wide = len(inner)
    for row in range(len(outer)):
        for column in range(wide):
            tap = row * wide + column
            if more:
                for n in range(count):
                    joint[tap, n] += outer[row, n] * inner[column, n]
            else:
                for n in range(count):
                    joint[tap, n] = outer[row, n] * inner[column, n]


@compiled(_FLOATS2, OFFSETS, _FLOATS2, _FLOATS2, _LIGHT2)
def _take_views(views: Floats, first: int, some: Floats, nearest: Floats, beside: Radiance) -> None:
    """Write some views (6, n) from the first one on, the last again where there are fewer, and their pixels."""
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
    count, high = rows.shape
    wide = columns.shape[1]
    for n in range(count):
        for row in range(high):
            for column in range(wide):
                places[n, row * wide + column] = rows[n, row] + columns[n, column]
        for tap in range(high * wide, places.shape[1]):
            places[n, tap] = rows[n, high - 1] + columns[n, wide - 1]


@compiled(_PIXELS, _PLACES, _LIGHT2, OFFSETS, OFFSETS, _LIGHT1, OFFSETS)
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


@compiled(_PIXELS, _RASTER, _FLOATS2, _KERNELS, _TABLE, _TABLE, _NUMBERS, _LIGHT2, _LIGHT3)
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
    high, wide = outer.weight.shape[1], inner.weight.shape[1]
    components = raster.components
    taps = high * wide
    parts = kernels.place.shape[1]
    padded = -(-taps // TAPS_AT_ONCE) * TAPS_AT_ONCE
    some = np.empty((6, AT_ONCE))
    nearest = np.empty((2, AT_ONCE))
    beside = np.empty((2, AT_ONCE), np.float32)
    scale = np.empty((2, AT_ONCE))
    off = np.empty((2, parts, AT_ONCE), np.float32)
    turn, run = np.empty((high, AT_ONCE), np.float32), np.empty((wide, AT_ONCE), np.float32)
    joint = np.zeros((padded, AT_ONCE), np.float32)
    places = np.empty((AT_ONCE, padded), np.int64)
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
