"""Compiled loops of the simulator: noise, neighbouring bands, components mixed to bands, changes at stored numbers.

What a sample gets does not depend on its place. A library's product of matrices is no faster here, and rounds rows
otherwise where they stand elsewhere in a block.
"""

from __future__ import annotations

import numpy as np
from numba import types
from numpy.typing import NDArray

from pipeline.compiled import DOUBLES, FLOATS, OFFSETS, compiled, rows_of

Radiance = NDArray[np.float32]
_AT_ONCE = 1024  # numbers that stay in the processor's first cache
_WORDS, _LIGHT, _RAW = rows_of(types.uint32, 1), rows_of(FLOATS, 1), rows_of(types.uint16, 1)
_ENDLESS = 0x7F800000  # bits of an infinite float32; of what is no number they are more


@compiled(_WORDS, OFFSETS, _LIGHT)
def draw_pairs(words: NDArray[np.uint32], piece: int, drawn: Radiance) -> None:
    """Write standard normal deviates, a piece after the other: of each, words for radii, then as many for turns.

    r = sqrt(-2 ln u) and a turn t give r cos t and r sin t. ln is that of 2^e m with m about 1: a polynomial of m - 1,
    right to 1e-7; so are sine and cosine within an eighth of a turn, and the quarter says which and with which sign.
    """
    radius, rest = np.empty(_AT_ONCE, np.float32), np.empty(_AT_ONCE, np.float32)
    bits = radius.view(np.int32)
    for first in range(0, len(drawn), piece):
        half = min(piece, len(drawn) - first) // 2
        for start in range(0, half, _AT_ONCE):
            some, at = min(_AT_ONCE, half - start), np.uint64(first + start)
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


@compiled(_LIGHT, _LIGHT, _LIGHT, DOUBLES, DOUBLES, DOUBLES, DOUBLES, _RAW)
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

    The electrons are mean + sqrt(V) z + (k3 / 6 V) (z^2 - 1): three cumulants are right (Cornish and Fisher, 1938,
    second order); what is left is bounded by `noise.divergence`. ``light`` below 0 counts as 0; ``added`` comes to it,
    one number or as many as light. All [e-]. Numbers are rounded half to even, within 0 and full scale.
    """
    read, per_dn, dark, most = (
        np.float32(read_noise_e * read_noise_e),
        np.float32(electrons_per_dn),
        np.float32(dark_dn),
        np.float32(full_scale_dn),
    )
    expected = np.empty(_AT_ONCE, np.float32)
    bits = expected.view(np.int32)
    every, worst = np.uint64(1 if len(added) > 1 else 0), np.int32(0)
    for first in range(0, len(light), _AT_ONCE):
        some, start = min(_AT_ONCE, len(light) - first), np.uint64(first)
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
            mean, z = expected[n], deviate[start + np.uint64(n)]
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
_LINES = rows_of(FLOATS, 3)


@compiled(rows_of(FLOATS, 3, read_only=True), rows_of(FLOATS, 3, read_only=True), OFFSETS, _LINES)
def mix_neighbours(light: Radiance, weights: Radiance, first: int, made: Radiance) -> None:
    """Write light (line, sample, band) times weights (tap, sample, band) of bands ``first``, ``first`` + 1, ... beside.

    Bands beyond the first and the last are left out. The tap of the band itself is among them.
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


Rows = NDArray[np.int64]
TERMS = 4  # of a sum between two looks at its total, and samples that fraction what is read for them
LANES = 16  # floats: rows of a mixing matrix are some times as long, and begin where a line of the cache does
_FLOATS_AT_ONCE = 2048  # floats of every kernel that stay in the processor's cache
_ROWS = rows_of(OFFSETS, 1)
_LIGHT1, _LIGHT2, _LIGHT3 = rows_of(FLOATS, 1), rows_of(FLOATS, 2), rows_of(FLOATS, 3)


@compiled(_LIGHT2, _LIGHT2, _LIGHT2)
def sum_nodes(parts: Radiance, fractions: Radiance, nodes: Radiance) -> None:
    """Write sums (node, value) over kernels of values (kernel, value), times shares (node, kernel)."""
    kernels, count = parts.shape
    for first in range(0, count, _FLOATS_AT_ONCE):
        start, some = np.uint64(first), min(_FLOATS_AT_ONCE, count - first)
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
def _take_terms(nodes: Radiance, start: int, lower: int, upper: int, taken: Radiance, rows: Rows) -> int:
    """Write what four samples have of components that any of them has, (sample, term), and their rows of the mixing.

    Gives how many that are; the last sample stands for those beyond it, nothing for terms beyond the last.
    """
    last, components, count = nodes.shape[1] - 1, nodes.shape[2], 0
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
    taken: Radiance, rows: Rows, count: int, mixing: Radiance, a: Radiance, b: Radiance, c: Radiance, d: Radiance
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
    Of many components a sample has few: terms are added one by one, and those of 0 may be left out.
    """
    count, wide = nodes.shape[1], mixing.shape[1]
    taken, rows = np.empty((TERMS, len(mixing)), np.float32), np.empty(len(mixing), np.int64)
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


_SHIFTS = rows_of(FLOATS, 3)


@compiled(_SHIFTS, _SHIFTS, _SHIFTS, OFFSETS, DOUBLES, rows_of(DOUBLES, 1))
def greatest_changes(
    light: Radiance, finest: Radiance, scale: Radiance, binning: int, rounding: float, greatest: NDArray[np.float64]
) -> None:
    """Write the greatest change of each stored number over its unit, (number,): of all shifts and bands.

    ``light`` and ``finest`` are (shift, number * binning, band), ``scale`` the unit (shift, number, band). Changes
    count with their signs within a number, and as 0 where they are no more than ``rounding`` times the light.
    """
    bands, least, fraction = light.shape[2], np.float32(rounding), np.float32(1 / binning)
    summed, most = np.empty(bands, np.float32), np.empty(bands, np.float32)
    for number in range(len(greatest)):
        for band in range(bands):
            most[band] = np.float32(0)
        for shift in range(len(light)):
            for band in range(bands):
                summed[band] = np.float32(0)
            for sample in range(number * binning, (number + 1) * binning):
                for band in range(bands):
                    at = finest[shift, sample, band]
                    change = light[shift, sample, band] - at
                    summed[band] += change if abs(change) > least * abs(at) else np.float32(0)
            for band in range(bands):
                changed = abs(summed[band]) * fraction / scale[shift, number, band]
                most[band] = changed if changed > most[band] else most[band]
        for band in range(bands):
            greatest[number] = max(greatest[number], most[band])
