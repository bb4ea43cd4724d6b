"""Find the scan paths of captured sweeps: trusted lines, their corrected places, and passes that share a swath."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import Sweep, exposing, merged_ms
from spectralzoom.pipeline.rectify.placed import PixelGrid, PlacedSweep, place
from spectralzoom.pipeline.rectify.registration.alignment import SweepShift
from spectralzoom.pipeline.rectify.scan_paths import JudgedStamps, judge_stamps
from spectralzoom.pipeline.signal.components import Components
from spectralzoom.pipeline.signal.lines import CondensedLines, Raw
from spectralzoom.pipeline.source import References

LEAST_LINES = 2  # of a run, so that it has a direction
CELL_PX = 4  # of the map of captures


@dataclass(frozen=True)
class SweepPath:
    """A captured sweep, its trusted lines, and its corrections."""

    lines: CondensedLines
    stamps: JudgedStamps
    shift: SweepShift
    gain: NDArray[np.float32] | None

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Return (line,) valid lines with a time stamp and a position of their own."""
        return np.asarray(self.lines.valid_line & self.stamps.usable & np.isfinite(self.lines.position.sum(axis=1)))

    @property
    def shift_px(self) -> NDArray[np.float64]:
        """Return (line, 2) pointing corrections along the line and the scan [px]."""
        return self.shift.of_lines(len(self.lines.time_s))

    def placed(self, camera: LineCamera, grid: PixelGrid | None = None) -> PlacedSweep:
        """Find where its lines lie, with tie tables of ``grid`` if one is given."""
        return place(self.lines, camera, grid=grid, usable=self.usable, shift_px=self.shift_px, gain=self.gain)

    def facts(self) -> dict[str, int]:
        """Count lines that were lost, sent twice or out of order; a rig's lost lines are rows that are not valid."""
        counts = {name: getattr(self.stamps, name) for name in ("lost", "repeated", "backward")}
        counts["lost"] *= self.lines.source != "rig"  # which pauses while it loads positions
        return counts | {"invalid": int(np.count_nonzero(~self.lines.valid_line))}


def sweep_paths(
    sweeps: Sequence[CondensedLines], camera: LineCamera, found: Mapping[str, Any] | None = None
) -> list[SweepPath]:
    """Judge the lines of sweeps; ``found`` are a registration's corrections, by the sweeps' names."""
    paths = []
    for lines in sweeps:
        name = lines.sweep.name
        period_s = exposing(camera, lines.sweep).frame_ms * 1e-3
        if lines.source == "recorded":  # lines may be selected from a recording
            apart = np.diff(lines.time_s[np.isfinite(lines.time_s)])
            period_s = float(np.median(apart[apart > 0])) if (apart > 0).any() else period_s
        one = (found or {}).get(name, {"offset_px": (0.0, 0.0), "drift_px_per_line": (0.0, 0.0), "gain": None})
        shift = SweepShift(name, np.array(one["offset_px"]), np.array(one["drift_px_per_line"]))
        gain = None if one["gain"] is None else np.array(one["gain"], np.float32)
        paths.append(SweepPath(lines, judge_stamps(lines.time_s, period_s), shift, gain))
    return paths


@dataclass(frozen=True, eq=False)
class InterlacedLines:
    """Lines of several condensed sweeps with the same components, read as the lines of one sweep."""

    sweep: Sweep  # of all lines together
    parts: tuple[CondensedLines, ...]
    part: NDArray[np.intp]  # (line,) number of the sweep of a line
    number: NDArray[np.intp]  # (line,) its line number there
    position: NDArray[np.float64]  # (line, 2) mirror at mid exposure
    time_s: NDArray[np.float64]  # (line,) since the start of their own sweeps
    exposure_ms: NDArray[np.float64]  # (line,)
    valid_line: NDArray[np.bool_]  # (line,)
    usable: NDArray[np.bool_]  # (line, sample)
    source: str  # of the first sweep
    references: References  # of the first sweep; scores need none
    components: Components  # of all sweeps
    step: float  # of a stored score, in all sweeps

    @classmethod
    def of(
        cls, sweep: Sweep, parts: Sequence[CondensedLines], part: NDArray[np.intp], number: NDArray[np.intp]
    ) -> InterlacedLines:
        """Gather the columns of the sweeps' lines."""

        def gathered(name: str) -> NDArray[Any]:
            every = [getattr(one, name) for one in parts]
            found = np.empty((len(part), *every[0].shape[1:]), every[0].dtype)
            for taker, column in enumerate(every):
                found[part == taker] = column[number[part == taker]]
            return found

        names = ("position", "time_s", "exposure_ms", "valid_line", "usable")
        columns: dict[str, Any] = {name: gathered(name) for name in names}
        shared = {name: getattr(parts[0], name) for name in ("source", "references", "components", "step")}
        return cls(sweep, tuple(parts), part, number, **columns, **shared)

    def read(self, start: int, stop: int, samples: slice = slice(None)) -> Raw:
        """Return scores of the lines ``start`` to ``stop`` in steps, (line, sample, component)."""
        part, number = self.part[start:stop], self.number[start:stop]
        found: Raw | None = None
        for taker in np.unique(part).tolist():
            here = part == taker
            first = int(number[here].min())
            raw = self.parts[taker].read(first, int(number[here].max()) + 1, samples)
            found = np.empty((len(part), *raw.shape[1:]), raw.dtype) if found is None else found
            found[here] = raw[number[here] - first]
        assert found is not None
        return found


def interlaced_paths(
    paths: Sequence[SweepPath], camera: LineCamera, grid: PixelGrid | None = None
) -> list[PlacedSweep]:
    """Find where sweeps of several passes lie: each by itself, and together where lines lie between others.

    Sweeps of one swath whose lines fill the same even positions make runs of closer lines. A sweep that repeats lines
    of the first pass lies by itself. The mosaic takes the closest lines that reach a pixel (`pipeline.rectify.mosaic`).
    """
    placed: list[PlacedSweep] = []
    swaths: dict[tuple[str, float], list[SweepPath]] = {}
    for one in sorted(paths, key=lambda path: path.lines.sweep.kind != "coarse"):
        sweep = one.lines.sweep
        same = swaths.get((sweep.along, sweep.swath_px))
        if sweep.kind != "coarse" and same is not None:
            first_px, px = (path.lines.sweep.line_px().round(3) for path in (same[0], one))
            if not np.isin(px, first_px).any():
                same.append(one)
                continue
        placed.append(one.placed(camera, grid))
        if sweep.kind == "coarse" and sweep.held == 1:
            swaths[sweep.along, sweep.swath_px] = [one]
    for same in swaths.values():
        placed += _runs(same, camera, grid)
    return placed


def _runs(paths: Sequence[SweepPath], camera: LineCamera, grid: PixelGrid | None) -> list[PlacedSweep]:
    """Place the runs of lines of one swath that are closer to each other than those of the first pass."""
    px = np.concatenate([one.lines.sweep.line_px() for one in paths])
    part = np.repeat(np.arange(len(paths)), [one.lines.sweep.lines for one in paths])
    number = np.concatenate([np.arange(one.lines.sweep.lines) for one in paths])
    exposure_ms = np.array([exposing(camera, one.lines.sweep).exposure_ms for one in paths])
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
        sweep = replace(
            parts[0].lines.sweep,
            name=f"{parts[0].lines.sweep.name}-{first}",
            kind="fine",
            start_px=float(px[run[0]]),
            lines=len(run),
            step=int(apart[first]),
            exposure_ms=merged_ms(exposure_ms[part[run]]),
        )
        lines = InterlacedLines.of(sweep, [one.lines for one in parts], np.searchsorted(used, part[run]), number[run])
        usable, shift = (np.concatenate([getattr(one, name) for one in paths])[run] for name in ("usable", "shift_px"))
        found.append(place(lines, camera, grid=grid, usable=usable, shift_px=shift, gain=parts[0].gain))
    return found


def capture_numbers(placed: Sequence[PlacedSweep], camera: LineCamera, grid: PixelGrid) -> NDArray[np.int16]:
    """Return the number of the sweep with the closest lines at each pixel of a grid, (y, x); -1 if none shows it.

    It is computed for the middle of every 4 x 4 px.
    """
    places = (np.minimum(np.arange(0, size, CELL_PX) + CELL_PX // 2, size - 1) for size in grid.shape)
    centres = (first + grid.spacing_px * place for first, place in zip(grid.origin_px, places, strict=True))
    points = np.stack(np.meshgrid(*centres, indexing="ij"), axis=-1)
    found = np.full(points.shape[:2], -1, np.int16)
    for number in sorted(range(len(placed)), key=lambda one: -placed[one].lines.sweep.step):  # the closest last
        for scan_path, _ in placed[number].scan_paths:
            found[np.isfinite(placed[number].locate_point(scan_path, camera, points)[..., 0])] = number
    return found.repeat(CELL_PX, axis=0).repeat(CELL_PX, axis=1)[: grid.shape[0], : grid.shape[1]]
