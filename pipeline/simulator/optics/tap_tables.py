"""Weights of pixels around a position: box, held positions and Gaussians in closed form, tabulated for every kernel."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Weights = NDArray[np.float32]
PER_PX = 128  # rows of a table; between them weights are linear, right to 8e-6 of a kernel's curvature
SCALE_STEP = 1 / 4096  # from one tabulated scale to the next; the nearest is taken
_WORKED_OUT = 16  # every so many of them are worked out, those between are linear: right to 2e-6
TAIL = (
    5e-6  # fraction of a kernel's weight that may lie beyond its taps; what is left is scaled to sum 1. No tap beyond
)
# has more than that either: weights jump by so much where a tap comes in.
BETWEEN_ROWS = 1 / (4 * PER_PX**2)  # variance that a kernel gains between two rows at most: half of either [px^2]
_SDS = 6.5  # of a Gaussian: nothing beyond


def box_weight(distance: Floats, width: float, held: int = 1) -> Floats:
    """Give the linear kernel averaged over a box and over ``held`` positions 1 px apart, at distances [px]."""
    places = np.arange(held) - (held - 1) / 2
    total = np.zeros(np.shape(distance))
    for place in places:
        beside = distance - place
        if width > 1e-6:
            total += (_integral(beside + width / 2) - _integral(beside - width / 2)) / width
        else:
            total += np.maximum(1 - np.abs(beside), 0.0)
    return np.maximum(total / held, 0.0)  # differences of integrals round


def blurred_weight(width: float, variance: Floats, held: int = 1, per_px: int = PER_PX) -> tuple[Floats, Floats]:
    """Give distances (place,) from -reach to reach and weights (kernel, place) with Gaussians of variance (kernel,)."""
    reach = math.ceil(1 + width / 2 + (held - 1) / 2 + _SDS * math.sqrt(variance.max(initial=0.0))) + 1
    distance = np.arange(-reach * per_px, reach * per_px + 1) / per_px
    sharp = box_weight(distance, width, held)
    if not variance.any():
        return distance, np.repeat(sharp[None], len(variance), axis=0)
    length = 2 * len(distance)
    wave = np.fft.rfftfreq(length, 1 / per_px)
    passed = np.exp(-2 * np.pi**2 * variance[:, None] * wave**2)
    blurred = np.fft.irfft(np.fft.rfft(sharp, length) * passed, length)[:, : len(distance)]
    return distance, np.where(variance[:, None] > 0, np.maximum(blurred, 0.0), sharp)


class TapTable(NamedTuple):
    """Weights (row, tap) of the taps around a position, row after row, for every kernel and in it for every scale.

    A position is told by its distance ``place`` from the first tap, which lies ``left`` px before the centre's pixel.
    """

    weight: Weights
    left: int
    first: float  # place of the first row of each scale
    least_scale: float
    scales: int
    rows: int  # of one scale
    per_px: int = PER_PX
    per_scale: float = 1 / SCALE_STEP

    @property
    def taps(self) -> int:
        """How many pixels along the axis a position reads."""
        return int(self.weight.shape[1])

    @staticmethod
    def of(
        width: float, variance: Floats, held: int, scales: tuple[float, float], beside: float, tail: float = TAIL
    ) -> TapTable:
        """Tabulate kernels of a width and variances (kernel,), between two scales, up to ``beside`` px off centre."""
        least = (math.floor(scales[0] / SCALE_STEP) - 1) * SCALE_STEP
        count = math.ceil((scales[1] - least) / SCALE_STEP) + 2
        worked_out = range(0, count + _WORKED_OUT, _WORKED_OUT)
        sizes = [max(least + SCALE_STEP * number, 1e-3) for number in worked_out]
        found = [blurred_weight(width * size, variance * size**2, held) for size in sizes]
        reach = max(_reach(*one, tail) for one in found)
        off = 0.5 + beside
        left = math.floor(reach + off)
        taps = math.ceil(left + off + reach)
        place = left + np.arange(math.floor(-off * PER_PX), math.ceil(off * PER_PX) + 2) / PER_PX
        rows = [_rows(place, taps, reach, one).astype(np.float32) for one in found]
        joined = np.empty((len(variance), count, len(place), taps), np.float32)
        for number in range(count):
            low, fraction = divmod(number, _WORKED_OUT)
            between = rows[low] + (rows[low + 1] - rows[low]) * np.float32(fraction / _WORKED_OUT)
            joined[:, number] = between.swapaxes(1, 2)
        return TapTable(joined.reshape(-1, taps), left, float(place[0]), least, count, len(place))


def _rows(place: Floats, taps: int, reach: float, kernels: tuple[Floats, Floats]) -> Floats:
    """Weights (kernel, tap, place), scaled to sum 1 at every place."""
    distance, weight = kernels
    apart = place[None, :] - np.arange(taps)[:, None]
    rows: Floats = np.stack([np.interp(apart, distance, one, left=0.0, right=0.0) for one in weight])
    rows *= np.abs(apart) < reach + 1 / PER_PX
    rows /= rows.sum(axis=1, keepdims=True)
    return rows


def _reach(distance: Floats, weight: Floats, tail: float) -> float:
    half = len(distance) // 2
    size = weight.max(axis=0)
    both = size[half:] + size[half::-1]
    beyond = both[::-1].cumsum()[::-1] * (distance[1] - distance[0])
    counts = (beyond > tail) | (both > 2 * tail)
    return float(distance[half:][counts][-1]) if counts.any() else 0.0


def _integral(t: Floats) -> Floats:
    """Integral of the kernel of linear interpolation from 0 to t."""
    a = np.minimum(np.abs(t), 1.0)
    return np.sign(t) * a * (1 - a / 2)
