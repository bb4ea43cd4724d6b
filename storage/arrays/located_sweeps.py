"""Sweeps of a capture with what registration found of them: which lines may be believed, and where they lie."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.rectify.line_numbers import LineNumbers, number_lines
from pipeline.rectify.placed import PixelGrid, Placed, place
from pipeline.rectify.registration.alignment import SweepShift, no_shifts
from storage.archive.stored_tables import read_table
from storage.arrays.cubes import RawCube


@dataclass(frozen=True)
class Sighted:
    """One captured sweep, which of its lines may be believed, and its corrections."""

    cube: RawCube
    numbers: LineNumbers
    shift: SweepShift
    gain: NDArray[np.float32] | None

    @property
    def usable(self) -> NDArray[np.bool_]:
        """(line,) valid lines with a time stamp and a position of their own."""
        known = np.isfinite(self.cube.position.sum(axis=1))
        usable: NDArray[np.bool_] = self.cube.valid_line & self.numbers.usable & known
        return usable

    @property
    def shift_px(self) -> NDArray[np.float64]:
        """(line, 2) pointing corrections along the line and the scan [px]."""
        return self.shift.of_lines(len(self.cube.time_s))

    def placed(self, camera: LineCamera, grid: PixelGrid | None = None) -> Placed:
        """Find where its lines lie."""
        return place(self.cube, camera, grid=grid, usable=self.usable, shift_px=self.shift_px, gain=self.gain)

    def facts(self) -> dict[str, int]:
        """Lines that were lost, sent twice, out of order or late."""
        found = self.numbers
        counts = {"lost": found.lost, "repeated": found.repeated, "backward": found.backward, "late": found.late}
        return counts | {"invalid": int(np.count_nonzero(~self.cube.valid_line))}


def sight_sweeps(cubes: Sequence[RawCube], registration: Path | None, camera: LineCamera) -> list[Sighted]:
    """Judge the lines of opened sweeps, with their corrections from a registration's record, if there is one."""
    shifts = {shift.name: shift for shift in no_shifts([cube.sweep.name for cube in cubes])}
    gains: dict[str, NDArray[np.float32]] = {}
    if registration is not None:
        for name, one in read_table(registration)["sweeps"].items():
            shifts[name] = SweepShift(name, np.array(one["offset_px"]), np.array(one["drift_px_per_line"]))
            if one["gain"] is not None:
                gains[name] = np.array(one["gain"], np.float32)
    frame_s = camera.frame_ms * 1e-3
    return [
        Sighted(cube, number_lines(cube.time_s, frame_s), shifts[cube.sweep.name], gains.get(cube.sweep.name))
        for cube in cubes
    ]
