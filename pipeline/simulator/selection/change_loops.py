"""How much light changes at stored numbers, in a compiled loop."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.compiled import DOUBLES, FLOATS, OFFSETS, compiled, rows_of

Light = NDArray[np.float32]
_LIGHT = rows_of(FLOATS, 3)


@compiled(_LIGHT, _LIGHT, _LIGHT, OFFSETS, DOUBLES, rows_of(DOUBLES, 1))
def greatest_changes(
    light: Light, finest: Light, scale: Light, binning: int, rounding: float, greatest: NDArray[np.float64]
) -> None:
    """Write the greatest change of each stored number over its unit, (number,): of all shifts and bands.

    ``light`` and ``finest`` are (shift, number * binning, band), ``scale`` the unit (shift, number, band). Changes
    count with their signs within a number, and as 0 where they are no more than ``rounding`` times the light.
    """
    bands, least, share = light.shape[2], np.float32(rounding), np.float32(1 / binning)
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
                changed = abs(summed[band]) * share / scale[shift, number, band]
                most[band] = changed if changed > most[band] else most[band]
        for band in range(bands):
            greatest[number] = max(greatest[number], most[band])
