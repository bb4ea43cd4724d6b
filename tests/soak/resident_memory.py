"""Memory of a process over time: whether it grows."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

MOST_GROWTH = 0.05
MB = 1e6


def resident_bytes(pid: int | None = None) -> int:
    """Resident memory of a process, this one by default [bytes]."""
    pages = int(Path(f"/proc/{pid or os.getpid()}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True)
class Growth:
    """Means of the second and the last quarter of samples [bytes], and the slope over the last three quarters."""

    second: float
    last: float
    each: float  # [bytes a sample]
    samples: int

    @classmethod
    def of(cls, samples: Sequence[int]) -> Growth:
        """Take the first quarter as warming up."""
        values, quarter = np.array(samples, np.float64), len(samples) // 4
        assert quarter, "four samples at least"
        rest = values[quarter:]
        slope = float(np.polyfit(np.arange(len(rest)), rest, 1)[0])
        return cls(float(values[quarter : 2 * quarter].mean()), float(values[-quarter:].mean()), slope, len(values))

    @property
    def fraction(self) -> float:
        """By how much the last quarter is above the second, as a fraction of that."""
        return self.last / self.second - 1

    @property
    def is_flat(self) -> bool:
        """Whether it is within the figure."""
        return abs(self.fraction) <= MOST_GROWTH

    def words(self) -> str:
        """In one line."""
        return (
            f"second quarter {self.second / MB:.1f} MB, last {self.last / MB:.1f} MB: {100 * self.fraction:+.2f} %; "
            f"{self.each / MB:+.3f} MB from one to the next over the last three quarters of {self.samples}"
        )
