"""Passes over a recording: plans cut to the lines that it holds.

A pass is planned as for a rig first, and cut where its first or last lines were never captured. If lines are missing in
between, the recorded swaths replace the planned ones. Exposures are those of the recorded lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from spectralzoom.pipeline.capture.recorded import RecordedSource
from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.geometry.scan import Axis, Sweep, exposing
from spectralzoom.pipeline.planning.fine_pass import FIRST_STEP

MOST_CUT_LINES, MOST_CUT_PX = 3, 2.0  # largest excess of a plan over a recording, for the kernel and turned lines


@dataclass(frozen=True)
class RecordedPasses:
    """Plans the passes of a survey of a recording; reads no line."""

    source: RecordedSource

    @property
    def axes(self) -> tuple[Axis, ...]:
        """Return the axes of the scene along which recorded lines lie."""
        return tuple(dict.fromkeys(one.sweep.along for one in self.source.sweeps))

    @property
    def exposures_ms(self) -> list[float]:
        """Return the exposures of the recorded sweeps, each once."""
        return sorted({exposing(self.source.camera, one.sweep).exposure_ms for one in self.source.sweeps})

    @property
    def fine_ms(self) -> float | None:
        """Return the longest exposure of lines of a second pass, or as close as such [ms]; None: there are none."""
        close = [one.sweep for one in self.source.sweeps if one.sweep.kind == "fine" or one.sweep.step < FIRST_STEP]
        return max((exposing(self.source.camera, sweep).exposure_ms for sweep in close), default=None)

    def uniform_scan(self) -> list[Sweep]:
        """Return all recorded sweeps as a uniform scan; SceneError where they differ in axis, step or binning."""
        if len(self._kinds) > 1:
            kinds = "; ".join(f"along {along}, step {step}, binning {binning}" for along, step, binning in self._kinds)
            raise SceneError(
                f"the recording holds lines of {len(self._kinds)} kinds ({kinds}), which are not one uniform scan; "
                "give the --budget of a zoomed survey, or name sweeps of one kind"
            )
        return [one.sweep for one in self.source.sweeps]

    def served(self, sweeps: Sequence[Sweep]) -> list[Sweep] | None:
        """Return planned sweeps without uncaptured lines at their ends; None where more is missing."""
        found = []
        for sweep in sweeps:
            cut = self.source.cut_to_recorded(sweep)
            if cut is None or not self.source.serves(cut):
                return None
            before = round((cut.start_px - sweep.start_px) / sweep.step)
            if max(before, sweep.lines - before - cut.lines) > MOST_CUT_LINES + MOST_CUT_PX / sweep.step:
                return None
            found.append(replace(cut, exposure_ms=self._exposure_ms(cut)))
        return found

    def full_scan(self, planned: Sequence[Sweep]) -> list[Sweep]:
        """Return the full scan that savings are stated against: the recording's own, else the planned one.

        Its exposure is the camera's, as in every other survey.
        """
        own = [one.sweep for one in self.source.sweeps] if [kind[1:] for kind in self._kinds] == [(1, 1)] else []
        return [replace(one, exposure_ms=None) for one in self.served(planned) or own or planned]

    def first_pass(self, planned: Sequence[Sweep]) -> list[Sweep]:
        """Return the planned sweeps of a first pass or a uniform scan, cut to the recorded lines.

        Raises NotRecordedError: neither the planned swaths nor the recorded ones have the lines.
        """
        found = self.served(planned) or self.served(self._on_recorded_swaths(planned)) or []
        if not found:
            for sweep in planned:
                self.source.pick(sweep)  # names the first line that is missing
        return found

    def fine_pass(self, planned: Sequence[Sweep]) -> list[Sweep]:
        """Return the planned sweeps of a fine pass without uncaptured lines at their ends.

        Raises NotRecordedError: a line in between is missing.
        """
        found = []
        for sweep in planned:
            if (cut := self.source.cut_to_recorded(sweep)) is not None:
                found.append(replace(cut, exposure_ms=self._exposure_ms(cut)))
        return found

    def lines_served(self, sweeps: Sequence[Sweep]) -> int:
        """Return the number of valid recorded lines that serve sweeps, each counted once."""
        picked = map(self.source.pick, sweeps)
        served = {pair for one in picked for pair in zip(one.place.tolist(), one.line.tolist(), strict=True)}
        return sum(int(self.source.sweeps[place].valid_line[line]) for place, line in served)

    @property
    def _kinds(self) -> list[tuple[Axis, int, int]]:
        """Return axis, step and binning of the recorded sweeps, each once."""
        return sorted({(one.sweep.along, one.sweep.step, one.sweep.binning) for one in self.source.sweeps})

    def _on_recorded_swaths(self, planned: Sequence[Sweep]) -> list[Sweep]:
        """Return sweeps of the planned step and binning on every recorded swath, over its lines."""
        if not planned or len(self._kinds) > 1:  # runs of a fine pass are no scan of the field
            return []
        like = planned[0]
        found: list[Sweep] = []
        for one in (some for some in self.source.sweeps if some.valid_line.any()):
            scan_px = one.tangents[one.valid_line, 1] / self.source.camera.ifov_rad
            low, high = float(np.nanmin(scan_px)), float(np.nanmax(scan_px))
            name, lines = f"{like.name.rpartition('-')[0]}-{len(found)}", round((high - low) / like.step) + 1
            start_px = low - (like.positions - 1) / 2
            found.append(replace(like, name=name, swath_px=one.sweep.swath_px, start_px=start_px, lines=lines))
        return found

    def _exposure_ms(self, sweep: Sweep) -> float | None:
        """Return the exposure of the recorded sweep that serves the first line."""
        return self.source.sweeps[int(self.source.pick(sweep).place[0])].sweep.exposure_ms
