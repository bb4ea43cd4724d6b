"""Find lines that cannot be: without an exposure, beyond the mirror, or darker than the dark frame.

They are left out one by one, as saturated samples are. More than a tenth of them mean that the capture is wrong.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.exposures import WILD_RATIO
from spectralzoom.pipeline.geometry.mirror import RIM_SLACK
from spectralzoom.pipeline.source import Line, References

MOST_LEFT_OUT = 0.1  # of the lines
DARKER, LEAST_DARKER_DN = 0.25, 8.0  # of the dark level, which noise and a drift of the level do not reach in ...
MOST_DARKER = 0.5  # ... this fraction of the elements
NO_EXPOSURE, BEYOND = "without a possible exposure", "beyond the mirror or without a position"
DARK_LINE, CURE = "darker than the dark frame", "look at the capture and its frames, and take what is wrong again"
LEAST_LEVEL_DN, MOST_ZEROS = 8.0, 0.25  # a dark level whose noise gives no 0, and elements at 0 in spite of it

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]


def wild_exposures(exposure_ms: Floats, valid: Bools) -> Bools:
    """Return (line,) whether an exposure is not above 0, or a hundred times another than the median of valid lines."""
    known = np.isfinite(exposure_ms) & (exposure_ms > 0)
    usual = np.median(exposure_ms[known & valid]) if (known & valid).any() else 1.0
    ratio = np.where(known, exposure_ms, usual) / usual
    return np.asarray(~known | (ratio >= WILD_RATIO) | (ratio <= 1 / WILD_RATIO))


def beyond_mirror(position: NDArray[np.floating]) -> Bools:
    """Return (line,) whether a mirror position (line, 2) is beyond the unit disk or unknown."""
    return np.asarray(~(np.hypot(position[..., 0], position[..., 1]) <= 1 + RIM_SLACK["float32"]))


class DarkLevel:
    """The numbers (sample, band) of a dark frame, below which noise does not reach in most elements.

    A line is darker than that if half of its elements are a quarter of the dark level below it, or if a quarter of them
    are 0. A line with nothing but 0 is such a line beside any dark frame.
    """

    def __init__(self, dark: NDArray[np.float32]) -> None:
        level = np.nan_to_num(np.asarray(dark, np.float32), nan=0, posinf=0, neginf=0)
        self._floor = level - np.maximum(DARKER * level, LEAST_DARKER_DN)
        self._without_zeros = level >= LEAST_LEVEL_DN
        self._most = max(int(level.max(initial=0)), 0)

    def is_above(self, line: NDArray[np.number]) -> bool:
        """Return whether a raw line (sample, band) is darker than the dark frame by more than noise."""
        if np.count_nonzero(line <= self._most) <= MOST_ZEROS * line.size:
            return False
        zero = line == 0
        unlit = np.mean(line < self._floor) > MOST_DARKER or np.mean(zero & self._without_zeros) > MOST_ZEROS
        return bool(unlit or zero.all())


def leave_out(where: str, valid: Bools, faults: Mapping[str, Bools], cure: str) -> tuple[Bools, list[str]]:
    """Return (line,) lines that are still valid, and a note on those that a fault leaves out.

    ``faults`` are (line,) by their texts. Raises SceneError: more than a tenth of the lines have one.
    """
    found = {what: valid & wrong for what, wrong in faults.items() if (valid & wrong).any()}
    left = valid & ~np.any([np.zeros(len(valid), np.bool_), *found.values()], axis=0)
    count, texts = int(np.count_nonzero(valid & ~left)), "; ".join(found)
    if count > MOST_LEFT_OUT * len(valid):
        raise SceneError(f"{where}: {count} of {len(valid)} lines cannot be used, more than a tenth: {texts}; {cure}")
    return left, [f"{where}: {count} of {len(valid)} lines are left out: {texts}"] if count else []


def counted(faults: Iterable[tuple[str, Bools]]) -> dict[str, Bools]:
    """Return (line,) faults by a text with their number and the first line."""
    return {
        f"{wrong.sum()} {what} (the first is line {wrong.argmax()})": wrong for what, wrong in faults if wrong.any()
    }


@dataclass
class LineJudge:
    """Find the faults of the lines of a sweep as they arrive."""

    references: References
    exposure_ms: float  # of the sweep
    faults: dict[str, list[int]] = field(default_factory=dict)

    @cached_property
    def _dark(self) -> DarkLevel:
        return DarkLevel(self.references.dark)

    def judged(self, line: Line) -> Line:
        """Return a line, not valid if it cannot be; then its exposure is that of the sweep, its position unknown."""
        if not line.valid:
            return line
        if not 0 < line.exposure_ms < np.inf:
            self.faults.setdefault(NO_EXPOSURE, []).append(line.number)
            return replace(line, valid=False, exposure_ms=self.exposure_ms)
        if beyond_mirror(np.array([line.mirror_x, line.mirror_y])):
            self.faults.setdefault(BEYOND, []).append(line.number)
            return replace(line, valid=False, mirror_x=np.nan, mirror_y=np.nan)
        if self._dark.is_above(line.data):
            self.faults.setdefault(DARK_LINE, []).append(line.number)
            return replace(line, valid=False)
        return line

    def notes(self, where: str, lines: int) -> list[str]:
        """Return a note on the lines that were left out of ``lines`` (SceneError: they are more than a tenth)."""
        wrong = ((what, np.isin(np.arange(lines), numbers)) for what, numbers in self.faults.items())
        return leave_out(where, np.ones(lines, np.bool_), counted(wrong), CURE)[1]
