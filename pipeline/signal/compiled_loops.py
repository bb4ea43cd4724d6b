"""Passes over blocks of lines in compiled loops; numpy would write and read a block of 44 MB for every step."""

from __future__ import annotations

import numpy as np
from numba import types
from numpy.typing import NDArray

from spectralzoom.pipeline.compiled import FLOATS, compiled, rows_of
from spectralzoom.pipeline.signal.components import BLOCK

Values = NDArray[np.float32]
_LINES, _FRAME, _BANDS = (rows_of(FLOATS, axes, read_only=True) for axes in (3, 2, 1))


@compiled(rows_of(types.uint16, 3, read_only=True), _FRAME, _FRAME, _BANDS, rows_of(FLOATS, 3))
def calibrate_lines(raw: NDArray[np.uint16], dark: Values, gain: Values, line_gain: Values, values: Values) -> None:
    """Write values (line, sample, band): raw numbers less dark ones, times gains (sample, band) and (line,)."""
    for line in range(len(raw)):
        for sample in range(len(dark)):
            for band in range(dark.shape[1]):
                light = np.float32(raw[line, sample, band]) - dark[sample, band]
                values[line, sample, band] = light * gain[sample, band] * line_gain[line]


@compiled(_LINES, _BANDS, rows_of(FLOATS, 1), rows_of(FLOATS, 3))
def sum_blocks(values: Values, origin: Values, largest: Values, sums: Values) -> bool:
    """Write sums (row, column, band) over 4 x 4 values (line, sample, band) from the origin; return if all are finite.

    ``largest`` (band,) becomes the greatest distance from the origin. Values beyond whole blocks have no sum.
    """
    lines, samples, bands = values.shape
    broken, across = np.zeros(bands, np.float32), np.zeros(bands, np.float32)
    for first in range(0, lines, BLOCK):
        for sample in range(samples):
            across[:] = 0
            for line in range(first, min(first + BLOCK, lines)):
                for band in range(bands):
                    value = values[line, sample, band] - origin[band]
                    across[band] += value
                    broken[band] += value - value  # 0, or NaN where it is not finite
                    largest[band] = max(largest[band], abs(value))
            row, column = first // BLOCK, sample // BLOCK
            if row < sums.shape[0] and column < sums.shape[1]:
                for band in range(bands):
                    sums[row, column, band] += across[band]
    return not broken.any()
