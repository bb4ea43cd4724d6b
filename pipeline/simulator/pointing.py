"""Pointing errors of the simulated mirror: where it really looks while it reports the planned positions."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SettingsError

ACCURACY_PX = 50.0  # 0.15 deg mechanical, as quoted by the vendor: systematic, unknown before registration
REPEATABILITY_PX = 0.8  # 40 urad mechanical: anew for every line


class Pointing(Protocol):
    """How far a mirror looks beside the places that it reports."""

    def of_lines(self, sweep_name: str, lines: range) -> NDArray[np.float64]:
        """Give the error of some lines of a sweep, (line, 2) along the line and the scan [px]."""


@dataclass(frozen=True)
class PointingErrors:
    """How far the mirror looks beside the place that it reports, in px of the scene along the line and the scan.

    Every sweep has an offset drawn evenly from ``-offset_px`` to ``offset_px`` in either axis, and every line a
    normal deviate of ``jitter_px`` rms in either. Each is drawn from a stream of its own, keyed (seed, sweep name) and
    (seed, sweep name, line number): no line's error depends on which others were asked for.
    """

    offset_px: float = ACCURACY_PX
    jitter_px: float = REPEATABILITY_PX
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("offset_px", "jitter_px"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise SettingsError(f"{name} of the pointing errors must be finite and not negative, got {value}")

    def offset(self, sweep_name: str) -> NDArray[np.float64]:
        """Give the systematic error of a sweep, (2,) along the line and the scan [px]."""
        return self._stream(sweep_name).uniform(-self.offset_px, self.offset_px, 2)

    def of_lines(self, sweep_name: str, lines: range) -> NDArray[np.float64]:
        """Give the whole error of some lines of a sweep, (line, 2) along the line and the scan [px]."""
        jitter = np.array([self._stream(sweep_name, number).standard_normal(2) for number in lines]).reshape(-1, 2)
        return self.offset(sweep_name) + self.jitter_px * jitter

    def _stream(self, sweep_name: str, *line: int) -> np.random.Generator:
        key = np.random.SeedSequence(entropy=self.seed, spawn_key=(zlib.crc32(sweep_name.encode()), *line))
        return np.random.Generator(np.random.Philox(key))


@dataclass(frozen=True)
class CommonOffset:
    """A mirror that looks beside every reported place by the same (along, scan) px."""

    offset_px: tuple[float, float]

    def of_lines(self, sweep_name: str, lines: range) -> NDArray[np.float64]:
        """Give the error of some lines, (line, 2) along the line and the scan [px]."""
        return np.tile(np.array(self.offset_px, np.float64), (len(lines), 1))
