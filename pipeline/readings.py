"""Check the range of values that a sensor, or a product of its lines, can have.

Fill values of common formats are out of range: 1e20, 9.97e36, 1e30, 3.4e38, and the ends of 32-bit integers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

SIGMA_OF_MEDIAN = 1.4826  # standard deviation of a normal law over its median absolute deviation

MOST_VALUE = 1e9  # in any unit of scenes; larger values need a larger unit
MOST_STEPS = 65535  # of a camera: raw lines hold 16 bits
MOST_EDGE = 0.1  # fraction of a picture's edge with one value; less occurs by chance


@dataclass(frozen=True)
class Beyond:
    """Count and first of the out-of-range values of a cube."""

    count: int
    place: tuple[int, ...]  # (y, x, band)
    value: np.number[Any]

    def words(self) -> str:
        """Format count, place and value."""
        y, x, band = self.place
        return f"{self.count} value{'s' * (self.count > 1)}, the first {self.value!s} at y {y}, x {x}, band {band}"


def beyond_range(values: NDArray[Any], most: float = MOST_VALUE) -> NDArray[np.bool_] | None:
    """Mark values larger than ``most`` by size, infinite ones too; None if there is none. NaN counts as no value."""
    kind = values.dtype
    if not values.size or kind.kind not in "fiu" or (kind.kind in "iu" and np.iinfo(kind).max <= most):
        return None
    low, high = values.min(), values.max()
    if -most <= low and high <= most:
        return None
    found: NDArray[np.bool_] = (values > most) | (values < -most)
    return found if found.any() else None


def find_beyond(values: NDArray[Any]) -> Beyond | None:
    """Count the finite out-of-range values of a (y, x, band) cube, and name the first; None if there is none.

    Infinite values are missing, as NaN.
    """
    found = beyond_range(values)
    if found is None or not (found := found & np.isfinite(values)).any():
        return None
    place = tuple(int(at) for at in np.unravel_index(int(found.argmax()), found.shape))
    return Beyond(int(np.count_nonzero(found)), place, values[place])


def readings_alone(values: NDArray[np.floating], most: float) -> NDArray[np.floating]:
    """Return values with NaN for out-of-range ones; the same array if there is none."""
    found = beyond_range(values, most)
    return values if found is None else np.where(found, values.dtype.type(np.nan), values)


def edge_fill(edge: NDArray[Any]) -> tuple[float, float] | None:
    """Return the value that may fill a picture's edge, and its fraction of the edge; None if nothing suggests one.

    ``edge`` is (pixel, band), NaN where unknown. The candidate is the most frequent value that all bands of a pixel
    share. It is returned if it is 0 or less, the largest of its integer type, or out of range.
    """
    alike = edge[(edge == edge[:, :1]).all(axis=1), 0]
    if not alike.size:
        return None
    values, counts = np.unique(alike, return_counts=True)
    value, fraction = values[counts.argmax()], float(counts.max()) / len(edge)
    ends = edge.dtype.kind in "iu" and value == np.iinfo(edge.dtype).max
    if fraction < MOST_EDGE or not (value <= 0 or ends or value > MOST_VALUE):
        return None
    return float(value), fraction
