"""Paths of captured sweeps: which lines are trusted, and where they lie once registration has corrected them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import exposing
from pipeline.rectify.placed import PixelGrid, Placed, place
from pipeline.rectify.registration.alignment import SweepShift, no_shifts
from pipeline.rectify.scan_paths import LineNumbers, number_lines
from pipeline.source import SweepLines


class StoredLines(SweepLines, Protocol):
    """The lines of one sweep, and who took them."""

    @property
    def source(self) -> str:
        """Return what their source calls itself."""


@dataclass(frozen=True)
class SweepPath:
    """A captured sweep, which of its lines are trusted, and its corrections."""

    lines: StoredLines
    numbers: LineNumbers
    shift: SweepShift
    gain: NDArray[np.float32] | None

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Return (line,) valid lines with a time stamp and a position of their own."""
        known = np.isfinite(self.lines.position.sum(axis=1))
        usable: NDArray[np.bool_] = self.lines.valid_line & self.numbers.usable & known
        return usable

    @property
    def shift_px(self) -> NDArray[np.float64]:
        """Return (line, 2) pointing corrections along the line and the scan [px]."""
        return self.shift.of_lines(len(self.lines.time_s))

    def placed(self, camera: LineCamera, grid: PixelGrid | None = None) -> Placed:
        """Find where its lines lie, with tie tables of ``grid`` where one is given."""
        return place(self.lines, camera, grid=grid, usable=self.usable, shift_px=self.shift_px, gain=self.gain)

    def facts(self) -> dict[str, int]:
        """Count lines that were lost, sent twice, out of order or late."""
        found = self.numbers
        counts = {"lost": found.lost, "repeated": found.repeated, "backward": found.backward, "late": found.late}
        return counts | {"invalid": int(np.count_nonzero(~self.lines.valid_line))}


def sweep_paths(
    sweeps: Sequence[StoredLines], camera: LineCamera, found: Mapping[str, Any] | None = None
) -> list[SweepPath]:
    """Judge the lines of sweeps; ``found`` are a registration's corrections, by the sweeps' names."""
    shifts = {shift.name: shift for shift in no_shifts([lines.sweep.name for lines in sweeps])}
    gains: dict[str, NDArray[np.float32]] = {}
    for name, one in (found or {}).items():
        shifts[name] = SweepShift(name, np.array(one["offset_px"]), np.array(one["drift_px_per_line"]))
        if one["gain"] is not None:
            gains[name] = np.array(one["gain"], np.float32)
    return [
        SweepPath(
            lines,
            number_lines(lines.time_s, _period_s(lines, camera)),
            shifts[lines.sweep.name],
            gains.get(lines.sweep.name),
        )
        for lines in sweeps
    ]


def _period_s(lines: StoredLines, camera: LineCamera) -> float:
    """Return the time from line to line; of lines that were picked out of a recording their own, not the camera's."""
    apart = np.diff(lines.time_s[np.isfinite(lines.time_s)]) if lines.source == "recorded" else np.zeros(0)
    rising = apart[apart > 0]
    return float(np.median(rising)) if len(rising) else exposing(camera, lines.sweep).frame_ms * 1e-3
