"""Passes over a recording: plans cut to the lines that it holds.

A pass is planned as for a rig first, and cut where its first or last lines were never captured. If lines are missing in
between, the recorded swaths replace the planned ones. Exposures are those of the recorded lines. No line is read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from spectralzoom.pipeline.capture.recorded import Recording
from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.geometry.scan import Axis, Sweep, exposing
from spectralzoom.pipeline.planning.fine_pass import FIRST_STEP

MOST_CUT_LINES, MOST_CUT_PX = 3, 2.0  # largest excess of a plan over a recording, for the kernel and turned lines


def sweeps_as_taken(recording: Recording) -> list[Sweep]:
    """Return all recorded sweeps as a uniform scan; SceneError where they differ in axis, step or binning."""
    kinds = _kinds(recording)
    if len(kinds) > 1:
        listed = "; ".join(f"along {along}, step {step}, binning {binning}" for along, step, binning in kinds)
        raise SceneError(
            f"the recording holds lines of {len(kinds)} kinds ({listed}), which are not one uniform scan; "
            "give the --budget of a zoomed survey, or name sweeps of one kind"
        )
    return [one.sweep for one in recording.sweeps]


def recorded_full_scan(recording: Recording, planned: Sequence[Sweep]) -> list[Sweep]:
    """Return the full scan that savings are stated against: the recording's own, else the planned one.

    Its exposure is the camera's, as in every other survey.
    """
    own = [one.sweep for one in recording.sweeps] if [kind[1:] for kind in _kinds(recording)] == [(1, 1)] else []
    return [replace(one, exposure_ms=None) for one in _served(recording, planned) or own or planned]


def recorded_first_pass(recording: Recording, planned: Sequence[Sweep]) -> list[Sweep]:
    """Return the planned sweeps of a first pass or a uniform scan, cut to the recorded lines.

    Raises NotRecordedError: neither the planned swaths nor the recorded ones have the lines.
    """
    found = _served(recording, planned) or _served(recording, _on_recorded_swaths(recording, planned)) or []
    if not found:
        for sweep in planned:
            recording.pick(sweep)  # names the first line that is missing
    return found


def recorded_fine_pass(recording: Recording, planned: Sequence[Sweep]) -> list[Sweep]:
    """Return the planned sweeps of a fine pass without uncaptured lines at their ends.

    Raises NotRecordedError: a line in between is missing.
    """
    cut = [recording.cut_to_recorded(sweep) for sweep in planned]
    return [_as_exposed(recording, sweep) for sweep in cut if sweep is not None]


def recorded_fine_ms(recording: Recording) -> float | None:
    """Return the longest exposure of lines of a second pass, or as close as such [ms]; None: there are none."""
    close = [one.sweep for one in recording.sweeps if one.sweep.kind == "fine" or one.sweep.step < FIRST_STEP]
    return max((exposing(recording.camera, sweep).exposure_ms for sweep in close), default=None)


def lines_served(recording: Recording, sweeps: Sequence[Sweep]) -> int:
    """Return the number of valid recorded lines that serve sweeps, each counted once."""
    picked = map(recording.pick, sweeps)
    served = {pair for one in picked for pair in zip(one.place.tolist(), one.line.tolist(), strict=True)}
    return sum(int(recording.sweeps[place].valid_line[line]) for place, line in served)


def _served(recording: Recording, sweeps: Sequence[Sweep]) -> list[Sweep] | None:
    """Return planned sweeps without uncaptured lines at their ends; None where more is missing."""
    found = []
    for sweep in sweeps:
        cut = recording.cut_to_recorded(sweep)
        if cut is None or not recording.serves(cut):
            return None
        before = round((cut.start_px - sweep.start_px) / sweep.step)
        if max(before, sweep.lines - before - cut.lines) > MOST_CUT_LINES + MOST_CUT_PX / sweep.step:
            return None
        found.append(_as_exposed(recording, cut))
    return found


def _kinds(recording: Recording) -> list[tuple[Axis, int, int]]:
    """Return axis, step and binning of the recorded sweeps, each once."""
    return sorted({(one.sweep.along, one.sweep.step, one.sweep.binning) for one in recording.sweeps})


def _on_recorded_swaths(recording: Recording, planned: Sequence[Sweep]) -> list[Sweep]:
    """Return sweeps of the planned step and binning on every recorded swath, over its lines."""
    if not planned or len(_kinds(recording)) > 1:  # runs of a fine pass are no scan of the field
        return []
    like = planned[0]
    found: list[Sweep] = []
    for one in (some for some in recording.sweeps if some.valid_line.any()):
        scan_px = one.tangents[one.valid_line, 1] / recording.camera.ifov_rad
        low, high = float(np.nanmin(scan_px)), float(np.nanmax(scan_px))
        name, lines = f"{like.name.rpartition('-')[0]}-{len(found)}", round((high - low) / like.step) + 1
        start_px = low - (like.positions - 1) / 2
        found.append(replace(like, name=name, swath_px=one.sweep.swath_px, start_px=start_px, lines=lines))
    return found


def _as_exposed(recording: Recording, sweep: Sweep) -> Sweep:
    """Return a sweep with the exposure of the recorded sweep that serves its first line."""
    return replace(sweep, exposure_ms=recording.sweeps[int(recording.pick(sweep).place[0])].sweep.exposure_ms)
