"""Spectra mixed from each band and its neighbours, sample by sample, in one compiled loop."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.compiled import FLOATS, OFFSETS, compiled, rows_of

Light = NDArray[np.float32]
SAMPLES_AT_ONCE = 32  # whose weights stay in the processor's cache while lines pass
_LIGHT = rows_of(FLOATS, 3)


@compiled(rows_of(FLOATS, 3, read_only=True), rows_of(FLOATS, 3, read_only=True), OFFSETS, _LIGHT)
def mix_neighbours(light: Light, weights: Light, first: int, made: Light) -> None:
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
