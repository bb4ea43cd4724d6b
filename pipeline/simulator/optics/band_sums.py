"""Components through kernels mixed to bands, in compiled loops: what a sample gets does not depend on its place.

A library's product of matrices is no faster here, and rounds rows otherwise where they stand elsewhere in a block.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.compiled import FLOATS, OFFSETS, compiled, rows_of

Light = NDArray[np.float32]
Rows = NDArray[np.int64]
TERMS = 4  # of a sum between two looks at its total, and samples that share what is read for them
LANES = 16  # floats: rows of a mixing matrix are some times as long, and begin where a line of the cache does
_AT_ONCE = 2048  # floats of every kernel that stay in the processor's cache
_ROWS = rows_of(OFFSETS, 1)
_LIGHT1, _LIGHT2, _LIGHT3 = rows_of(FLOATS, 1), rows_of(FLOATS, 2), rows_of(FLOATS, 3)


@compiled(_LIGHT2, _LIGHT2, _LIGHT2)
def sum_nodes(parts: Light, shares: Light, nodes: Light) -> None:
    """Write sums (node, value) over kernels of values (kernel, value), times shares (node, kernel)."""
    kernels, count = parts.shape
    for first in range(0, count, _AT_ONCE):
        start, some = np.uint64(first), min(_AT_ONCE, count - first)
        for node in range(len(nodes)):
            for number in range(some):
                nodes[node, start + np.uint64(number)] = np.float32(0)
            for kernel in range(0, kernels, TERMS):
                k1, k2, k3 = min(kernel + 1, kernels - 1), min(kernel + 2, kernels - 1), min(kernel + 3, kernels - 1)
                s0 = shares[node, kernel]
                s1 = shares[node, k1] if k1 == kernel + 1 else np.float32(0)
                s2 = shares[node, k2] if k2 == kernel + 2 else np.float32(0)
                s3 = shares[node, k3] if k3 == kernel + 3 else np.float32(0)
                for number in range(some):
                    at = start + np.uint64(number)
                    nodes[node, at] += (
                        s0 * parts[kernel, at] + s1 * parts[k1, at] + s2 * parts[k2, at] + s3 * parts[k3, at]
                    )


@compiled(_LIGHT3, OFFSETS, OFFSETS, OFFSETS, _LIGHT2, _ROWS)
def _take_terms(nodes: Light, start: int, lower: int, upper: int, taken: Light, rows: Rows) -> int:
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
def _mix_four(taken: Light, rows: Rows, count: int, mixing: Light, a: Light, b: Light, c: Light, d: Light) -> None:
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
def mix_bands(nodes: Light, lower: int, upper: int, mixing: Light, first: int, bands: int, light: Light) -> None:
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


def mixing_rows(mixing: Light) -> Light:
    """Lay out a matrix (node * component, band) for `mix_bands`: more rows and columns of 0, and rows in line."""
    terms, bands = mixing.shape
    rows, columns = -(-terms // TERMS) * TERMS, -(-bands // LANES) * LANES
    room = np.zeros(rows * columns + LANES, np.float32)
    first = -room.ctypes.data % (LANES * room.itemsize) // room.itemsize
    found = room[first : first + rows * columns].reshape(rows, columns)
    found[:terms, :bands] = mixing
    return found
