"""What the vector memory holds of a sweep during one capture, and where its lines lie, at the precision of the wire."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.camera import LineCamera
from pipeline.errors import SettingsError
from pipeline.rig.capture.line_positions import PlayedPath
from pipeline.rig.mirror.steering import wire_positions
from pipeline.rig.survey_rig import Pulses
from pipeline.scan import Sweep, line_positions, sweep_positions
from pipeline.vector_memory import memory_loads

LEAD = 1  # cells before the first line's: a unit that waits for edges takes its first cell at the run command, assumed


@dataclass(frozen=True)
class CapturePath:
    """Lines ``first`` to ``stop`` of a sweep, and the positions that are held for them.

    Positions are those of the plan, rounded to float32 as they go over the wire.
    """

    sweep: Sweep
    first: int
    stop: int
    cells: NDArray[np.float32]  # (lead + held, 2)
    middle: NDArray[np.float32]  # (line, 2) at mid exposure
    rate_hz: float  # of cells, for a path that no edge drives
    triggered: bool  # by one edge a cell; then the first line's first position is held twice

    @property
    def lines(self) -> int:
        """Lines of the capture."""
        return self.stop - self.first

    @property
    def played(self) -> PlayedPath:
        """The path as it runs by its own clock, for lines that are tied to it by time."""
        return PlayedPath(self.cells.astype(np.float64), self.rate_hz)

    def frames_at(self, index: int) -> int | None:
        """Frames that edges were counted of, where the cell ``index`` was played last; None within a line."""
        frames, rest = divmod(index + 1 - LEAD, self.sweep.step)
        return None if rest else frames


def next_path(sweep: Sweep, first: int, camera: LineCamera, *, vector_pairs: int, triggered: bool) -> CapturePath:
    """Give the path of the sweep's lines from ``first`` on, as many as the vector memory takes.

    Raises
    ------
    SettingsError : the positions of one line do not fit the memory. PoseError : one is beyond the mirror's disk.
    """
    if vector_pairs <= LEAD:
        raise SettingsError(f"a vector memory of {vector_pairs} pairs holds no line; expected more than {LEAD}")
    rest = replace(sweep, lines=sweep.lines - first)
    stop = first + memory_loads([rest], vector_pairs - LEAD)[0].parts[0].lines[1]
    return path_of(sweep, (first, stop), camera, triggered=triggered)


def path_of(sweep: Sweep, lines: tuple[int, int], camera: LineCamera, *, triggered: bool) -> CapturePath:
    """Give the path of some of the sweep's lines.

    Raises
    ------
    PoseError : a position is beyond the mirror's disk.
    """
    held: NDArray[Any] = sweep_positions(sweep, camera)[slice(*lines)].reshape(-1, 2)
    lead = held[:LEAD] if triggered else held[:0]
    cells, middle = (
        wire_positions(some) for some in (np.concatenate([lead, held]), line_positions(sweep, camera)[slice(*lines)])
    )
    return CapturePath(sweep, *lines, cells, middle, sweep.step * 1000 / camera.frame_ms, triggered)


def planned_positions(sweep: Sweep, camera: LineCamera) -> NDArray[np.float32]:
    """(line, 2) mirror positions at mid exposure that lines tied by pulses come with: the plan's, as sent.

    Raises
    ------
    PoseError : a position is beyond the mirror's disk.
    """
    return wire_positions(line_positions(sweep, camera))


def can_trigger(pulses: Pulses, sweep: Sweep) -> bool:
    """Whether the pulses at the mirror's input step through this sweep: one a position is needed."""
    return pulses == "position" or (pulses == "frame" and sweep.step == 1)
