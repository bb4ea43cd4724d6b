"""Passes over one swath as one path: the lines of later sweeps between those of the first, in the order they lie."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep, exposing
from pipeline.rectify.placed import PixelGrid, Placed, place
from pipeline.rectify.sweep_paths import StoredLines, SweepPath
from pipeline.signal.components import Components
from pipeline.signal.lines import CondensedLines, Raw
from pipeline.source import References

LEAST_LINES = 2  # of a run, so that it has a direction


@dataclass(frozen=True, eq=False)
class InterlacedLines:
    """Lines of several condensed sweeps of one pass's components, read as the lines of one sweep."""

    sweep: Sweep  # that the lines together are
    parts: tuple[StoredLines, ...]
    part: NDArray[np.intp]  # (line,) which of the sweeps took a line
    number: NDArray[np.intp]  # (line,) which of its lines

    def _gathered(self, columns: Iterable[NDArray[np.generic]]) -> NDArray[np.generic]:
        every = list(columns)
        found = np.empty((len(self.part), *every[0].shape[1:]), every[0].dtype)
        for taker, column in enumerate(every):
            here = self.part == taker
            found[here] = column[self.number[here]]
        return found

    @cached_property
    def _condensed(self) -> tuple[CondensedLines, ...]:
        return tuple(one for one in self.parts if isinstance(one, CondensedLines))

    @property
    def source(self) -> str:
        """Return what the source of the first sweep calls itself."""
        return self.parts[0].source

    @property
    def references(self) -> References:
        """Return the frames of the first sweep; scores need none."""
        return self.parts[0].references

    @cached_property
    def position(self) -> NDArray[np.float64]:
        """Return the mirror's positions at mid exposure, (line, 2)."""
        return np.asarray(self._gathered(one.position for one in self.parts), np.float64)

    @cached_property
    def time_s(self) -> NDArray[np.float64]:
        """Return the lines' times since the start of their own sweeps, (line,) [s]."""
        return np.asarray(self._gathered(one.time_s for one in self.parts), np.float64)

    @cached_property
    def valid_line(self) -> NDArray[np.bool_]:
        """Return the lines that were captured, (line,)."""
        return np.asarray(self._gathered(one.valid_line for one in self.parts), np.bool_)

    @property
    def components(self) -> Components:
        """Return the law that gives spectra back; all sweeps share it."""
        return self._condensed[0].components

    @property
    def step(self) -> float:
        """Return the size of one step of a stored score; all sweeps share it."""
        return self._condensed[0].step

    @cached_property
    def usable(self) -> NDArray[np.bool_]:
        """Return the spectra that may be used, (line, sample)."""
        return np.asarray(self._gathered(one.usable for one in self._condensed), np.bool_)

    def read(self, start: int, stop: int) -> Raw:
        """Read the scores of the lines ``start`` to ``stop`` in steps, (line, sample, component)."""
        part, number = self.part[start:stop], self.number[start:stop]
        found: Raw | None = None
        for taker in np.unique(part).tolist():
            here = part == taker
            first = int(number[here].min())
            raw = self.parts[taker].read(first, int(number[here].max()) + 1)
            if found is None:
                found = np.empty((len(part), *raw.shape[1:]), raw.dtype)
            found[here] = raw[number[here] - first]
        assert found is not None
        return found


def interlaced_paths(paths: Sequence[SweepPath], camera: LineCamera, grid: PixelGrid | None = None) -> list[Placed]:
    """Find where sweeps of several passes lie: each as it was taken, and as one where lines lie between others.

    Sweeps of one swath whose lines fill the same even positions make runs of closer lines. The mosaic takes the
    closest lines that reach a pixel (`pipeline.rectify.mosaic`).
    """
    placed, swaths = list[Placed](), dict[tuple[str, float], list[SweepPath]]()
    for one in paths:
        if one.lines.sweep.kind == "coarse":
            placed.append(one.placed(camera, grid))
            if one.lines.sweep.held == 1:
                swaths[one.lines.sweep.along, one.lines.sweep.swath_px] = [one]
    for one in paths:
        if one.lines.sweep.kind != "coarse":
            same = swaths.get((one.lines.sweep.along, one.lines.sweep.swath_px))
            if same is None:  # a swath of its own
                placed.append(one.placed(camera, grid))
            else:
                same.append(one)
    for same in swaths.values():
        placed += _runs(same, camera, grid)
    return placed


def _runs(paths: Sequence[SweepPath], camera: LineCamera, grid: PixelGrid | None) -> list[Placed]:
    """Place the runs of lines of one swath that are closer to each other than those of the first pass."""
    px = np.concatenate([one.lines.sweep.line_px() for one in paths])
    part = np.repeat(np.arange(len(paths)), [one.lines.sweep.lines for one in paths])
    number = np.concatenate([np.arange(one.lines.sweep.lines) for one in paths])
    order = np.argsort(px, kind="stable")
    apart = np.rint(np.diff(px[order])).astype(np.intp)
    widest = max(one.lines.sweep.step for one in paths if one.lines.sweep.kind == "coarse")
    ends = np.flatnonzero(np.diff(apart, prepend=0, append=0))  # where the distance changes
    found = []
    for first, stop in pairwise(ends.tolist()):
        if apart[first] >= widest or stop - first + 1 < LEAST_LINES:
            continue
        run = order[first : stop + 1]
        used = np.unique(part[run])
        parts = [paths[taker] for taker in used.tolist()]
        usable = np.concatenate([one.usable for one in paths])[run]
        shift = np.concatenate([one.shift_px for one in paths])[run]
        sweep = replace(
            parts[0].lines.sweep,
            name=f"{parts[0].lines.sweep.name}-{first}",
            kind="fine",
            start_px=float(px[run[0]]),
            lines=len(run),
            step=int(apart[first]),
            exposure_ms=_mean_exposure_ms(paths, part[run], camera),
        )
        lines = InterlacedLines(sweep, tuple(one.lines for one in parts), np.searchsorted(used, part[run]), number[run])
        found.append(place(lines, camera, grid=grid, usable=usable, shift_px=shift, gain=parts[0].gain))
    return found


def _mean_exposure_ms(paths: Sequence[SweepPath], part: NDArray[np.intp], camera: LineCamera) -> float:
    """Return the exposure whose noise is the mean of the lines'."""
    of_sweeps = np.array([exposing(camera, one.lines.sweep).exposure_ms for one in paths])
    return float(1 / (1 / of_sweeps[part]).mean())


def capture_numbers(placed: Sequence[Placed], camera: LineCamera, grid: PixelGrid, cell: int = 4) -> NDArray[np.intp]:
    """Return which of some sweeps shows each pixel of a grid, (y, x): that of the closest lines; -1 where none does.

    It is looked up for the middle of every ``cell`` x ``cell`` px.
    """
    height, width = grid.shape
    rows, columns = (np.minimum(np.arange(0, size, cell) + cell // 2, size - 1) for size in (height, width))
    points = grid.points(slice(0, height), slice(0, width))[np.ix_(rows, columns)]
    found = np.full(points.shape[:2], -1, np.intp)
    for number in sorted(range(len(placed)), key=lambda one: -placed[one].lines.sweep.step):  # the closest last
        for scan_path, _ in placed[number].scan_paths:
            seen = np.isfinite(placed[number].locate_point(scan_path, camera, points)[..., 0])
            found[seen] = number
    return found.repeat(cell, axis=0).repeat(cell, axis=1)[:height, :width]
