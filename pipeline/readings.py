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


@dataclass(frozen=True)
class Beyond:
    """Count and first of the out-of-range values of a cube."""

    count: int
    place: tuple[int, ...]  # (y, x, band)
    value: np.number[Any]

    def text(self) -> str:
        """Format count, place and value."""
        y, x, band = self.place
        return f"{self.count} value{'s' * (self.count > 1)}, the first {self.value!s} at y {y}, x {x}, band {band}"


def beyond_range(values: NDArray[Any], most: float = MOST_VALUE) -> NDArray[np.bool_] | None:
    """Mark values larger than ``most`` by size, infinite ones too; None if there is none. NaN counts as no value."""
    kind = values.dtype
    if not values.size or kind.kind not in "fiu" or (kind.kind in "iu" and np.iinfo(kind).max <= most):
        return None
    most = min(most, float(np.finfo(kind).max)) if kind.kind == "f" else most
    if -most <= values.min() and values.max() <= most:
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
