"""A recording as a source of lines: recorded sweeps serve every later request for lines of that field.

A request for a recorded sweep returns that sweep. A request for any other sweep returns the nearest recorded line for
each planned line, of the same binning. A line keeps its recorded position, time and exposure. The rectification uses
these, so an offset of half a pixel from the plan costs nothing.

A line of every n-th position holds n mirror positions during one exposure. A recorded full scan has n single lines
there, and one of them replaces it. So detail between the lines is not averaged.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from spectralzoom.pipeline.errors import NotRecordedError, SceneError
from spectralzoom.pipeline.geometry.camera import LARGEST_SUM_DN, LineCamera
from spectralzoom.pipeline.geometry.mirror import direction_to_scene, position_to_direction
from spectralzoom.pipeline.geometry.scan import Axis, Floats, Sweep, exposing
from spectralzoom.pipeline.source import Line, References

Numbers = NDArray[np.intp]

BLOCK_LINES = 64  # read at a time
SWATH_PX = 1.0  # largest distance of a planned swath from the recorded one
REACH_STEPS = 0.75  # largest distance of a planned line from a recorded one, in recorded line spacings, or
PLANNED_REACH = 0.8  # in planned ones, where that is more: the last recorded line serves a plan that ends there
FINE_ENOUGH = 1.5  # largest ratio of recorded to planned line spacing
SAME_PX = 1e-4  # distances that differ by less are equal, as positions are float32; the first line is chosen then


@dataclass(frozen=True)
class RecordedSweep:
    """One sweep of a recording: its lines in the order of capture, and a function that reads single lines.

    ``sweep`` is the planned one where the recording holds it, else one that
    `pipeline.capture.straight_scans.fit_sweep` derived from the positions.
    """

    sweep: Sweep
    references: References
    position: Floats  # (line, 2) mirror X and Y at mid exposure
    time_s: Floats  # (line,) of mid exposure, since the start of the sweep
    exposure_ms: Floats  # (line,)
    valid_line: NDArray[np.bool_]  # (line,)
    read_lines: Callable[[Numbers], NDArray[np.uint16]]  # numbers of lines, ascending -> (line, sample, band) uint16

    @cached_property
    def tangents(self) -> Floats:
        """Return the line centres (line, 2) along the line and the scan, as scene tangents; NaN where unknown."""
        known = np.isfinite(self.position).all(axis=1)
        found = np.full(self.position.shape, np.nan)
        found[known] = direction_to_scene(position_to_direction(self.position[known]))
        return found

    @cached_property
    def line_distance(self) -> float:
        """Return the median distance of consecutive lines along the scan, as a scene tangent."""
        valid = np.flatnonzero(self.valid_line & np.isfinite(self.tangents[:, 1]))
        if len(valid) < 2:
            return 0.0
        return float(np.median(np.abs(np.diff(self.tangents[valid, 1])) / np.diff(valid)))


@dataclass(frozen=True)
class PickedLines:
    """The recorded lines that serve a planned sweep, in the order of the recording.

    If the recording went the other way, this reverses the plan; times still rise.
    """

    place: Numbers  # (line,) number of the recorded sweep
    line: Numbers  # (line,) number of the line there
    again: NDArray[np.bool_]  # (line,) the same recorded line serves the planned line before


@dataclass(frozen=True, eq=False)
class Recording:
    """A :class:`pipeline.source.Source` over recorded sweeps; no line is read before it is asked for.

    ``camera`` has the bits, exposure and period of the recording, and the samples of a line that is not binned. A scan
    without a mirror has a long focal length, so that lines are parallel.

    Raises SceneError: there is no sweep, or a sweep's lines have other samples or bands than the camera and the
    wavelengths.
    """

    sweeps: Sequence[RecordedSweep]  # in the order of capture
    camera: LineCamera
    wavelength_nm: Floats  # (band,)
    fwhm_nm: Floats | None = None  # (band,)
    notes: tuple[str, ...] = ()  # assumptions
    light: tuple[str, ...] = ()  # identity of the numbers: hashes of manifests, or of files
    acquired: str | None = None  # when the first lines were captured, a day or a moment in UTC, ISO 8601
    pixel_m: float | None = None  # side of a pixel on the ground
    geobox: GeoBox | None = None  # place of the field
    name = "recorded"
    effects = ()

    def __post_init__(self) -> None:
        if not self.sweeps:
            raise SceneError("the recording holds no sweep; name a folder or file with raw cubes in it")
        for one in self.sweeps:
            wanted = (self.camera.samples // one.sweep.binning, len(self.wavelength_nm))
            if one.references.dark.shape != wanted:
                raise SceneError(
                    f"sweep {one.sweep.name} has lines of {one.references.dark.shape} (sample, band), and a camera of "
                    f"{self.camera.samples} samples and {len(self.wavelength_nm)} wavelengths gives {wanted} with "
                    f"binning {one.sweep.binning}; set camera.samples and the wavelengths to what was recorded"
                )

    @property
    def key(self) -> dict[str, Any]:
        """Return the light, bits, references and facts of lines, without the name of any file."""
        facts = [
            (one.sweep, one.references, one.position, one.time_s, one.exposure_ms, one.valid_line)
            for one in self.sweeps
        ]
        return {"light": self.light, "bits": self.camera.bits, "sweeps": facts}

    def opened(self, kept: Path) -> AbstractContextManager[Recording]:
        """Return the recording itself, which has no device."""
        return nullcontext(self)

    @property
    def axes(self) -> tuple[Axis, ...]:
        """Return the axes of the scene along which recorded lines lie."""
        return tuple(dict.fromkeys(one.sweep.along for one in self.sweeps))

    @property
    def exposures_ms(self) -> list[float]:
        """Return the exposures of the recorded sweeps, each once."""
        return sorted({exposing(self.camera, one.sweep).exposure_ms for one in self.sweeps})

    def lines(self, sweep: Sweep, first: int = 0) -> Iterator[Line]:
        """Yield the lines that serve a sweep, from line ``first`` on, in the order of `PickedLines`.

        A recorded line that serves two planned lines is valid once; one that holds nothing but 65535 never is. Raises
        NotRecordedError: a planned line was never captured.
        """
        picked = self.pick(sweep)
        for start in range(first, sweep.lines, BLOCK_LINES):
            yield from self._lines_of(picked, np.arange(start, min(start + BLOCK_LINES, sweep.lines)))

    def references(self, sweep: Sweep) -> References:
        """Return dark and white frames of the lines that serve a sweep; raises as `lines`."""
        return self.sweeps[int(self.pick(sweep).place[0])].references

    def cut_to_recorded(self, sweep: Sweep) -> Sweep | None:
        """Return a sweep without the lines at either end that were never captured; None where none was.

        Plans begin and end a few lines beyond the field, where a recording may have none. A missing line in between
        stays, and `lines` names it. A recorded line that serves the last two lines of an end counts as one of them.
        """
        place, line = self._served(sweep)
        taken = np.flatnonzero(place >= 0)
        if not len(taken):
            return None
        again = (np.diff(place) == 0) & (np.diff(line) == 0)  # a line and the next
        first, last = int(taken[0]), int(taken[-1])
        first += int(first < last and again[first])
        last -= int(first < last and again[last - 1])
        return replace(sweep, start_px=sweep.start_px + first * sweep.step, lines=last + 1 - first)

    def serves(self, sweep: Sweep) -> bool:
        """Return whether every line of a sweep was captured, so that `pick` finds it."""
        return bool((self._served(sweep)[0] >= 0).all())

    def pick(self, sweep: Sweep) -> PickedLines:
        """Choose the recorded lines that serve a sweep; nothing is read.

        All of them have the same references. Among sweeps with equal references the nearest lines are chosen.

        Raises NotRecordedError: a planned line was never captured.
        """
        place, line = self._served(sweep)
        if (place < 0).any():
            self._refuse(sweep, place)
        order = np.lexsort((line, place))
        place, line = place[order], line[order]
        again = (np.diff(place, prepend=-1) == 0) & (np.diff(line, prepend=-1) == 0)
        return PickedLines(place, line, again)

    def _served(self, sweep: Sweep) -> tuple[Numbers, Numbers]:
        """Return recorded sweep and line for each planned line, of the group that serves the most; -1 where none."""
        if (own := self._own(sweep)) is not None:
            return np.full(sweep.lines, own), np.arange(sweep.lines)
        found = [self._nearest(sweep, group) for group in self._groups]
        place, line, _ = min(found, key=lambda one: (np.sum(one[0] < 0), np.round(one[2].mean() / SAME_PX)))
        return place, line

    def _own(self, sweep: Sweep) -> int | None:
        """Return the number of the recorded sweep with the same lines; its exposure decides among several."""
        lines = (sweep.along, sweep.lines, sweep.step, sweep.binning)
        alike = [
            number
            for number, one in enumerate(one.sweep for one in self.sweeps)
            if (one.along, one.lines, one.step, one.binning) == lines
            and max(abs(one.swath_px - sweep.swath_px), abs(one.start_px - sweep.start_px)) <= SAME_PX
        ]
        exposed = [number for number in alike if self.sweeps[number].sweep.exposure_ms == sweep.exposure_ms]
        return next(iter(exposed or alike), None)

    @cached_property
    def _groups(self) -> list[list[int]]:
        """Return groups of sweeps that may serve one request together: of one axis, binning and references."""
        groups: list[list[int]] = []
        for number, one in enumerate(self.sweeps):
            for group in groups:
                other = self.sweeps[group[0]]
                alike = (one.sweep.along, one.sweep.binning) == (other.sweep.along, other.sweep.binning)
                if alike and one.references.same_as(other.references):
                    group.append(number)
                    break
            else:
                groups.append([number])
        return groups

    def _nearest(self, sweep: Sweep, group: Sequence[int]) -> tuple[Numbers, Numbers, Floats]:
        """Return recorded sweep, line and distance [px] for each planned line; -1 where none is near enough.

        An invalid line serves only where no valid one does.
        """
        place, line = np.full((2, sweep.lines), -1)
        best = np.full(sweep.lines, np.inf)
        able = [number for number in group if self._is_able(self.sweeps[number], sweep)]
        for usable in (True, False):
            open_lines = place < 0
            for number in able:
                one = self.sweeps[number]
                candidates = np.flatnonzero((one.valid_line == usable) & np.isfinite(one.tangents[:, 1]))
                if not len(candidates):
                    continue
                apart = one.line_distance / self.camera.ifov_rad
                reach = max(REACH_STEPS * apart, PLANNED_REACH * sweep.step)
                near, distance = nearest_line(one.tangents[candidates, 1] / self.camera.ifov_rad, sweep.line_px())
                better = open_lines & (distance <= reach) & (distance < best - SAME_PX)
                place[better], line[better], best[better] = number, candidates[near[better]], distance[better]
        return place, line, best

    def _is_able(self, one: RecordedSweep, sweep: Sweep) -> bool:
        """Return whether a recorded sweep lies on the planned swath, with its binning and fine enough lines."""
        return (
            (one.sweep.along, one.sweep.binning) == (sweep.along, sweep.binning)
            and abs(one.sweep.swath_px - sweep.swath_px) <= SWATH_PX
            and one.line_distance / self.camera.ifov_rad <= FINE_ENOUGH * sweep.step
        )

    def _refuse(self, sweep: Sweep, place: Numbers) -> NoReturn:
        """Raise NotRecordedError for the first planned line without a recorded one; ``place`` is -1 there."""
        alike = [one for one in self.sweeps if one.sweep.along == sweep.along and np.isfinite(one.tangents).any()]
        if not alike:
            axes = ", ".join(sorted({one.sweep.along for one in self.sweeps}))
            raise NotRecordedError(
                f"the lines of sweep {sweep.name} lie along {sweep.along}, those of the recording along {axes}; plan "
                f"sweeps along {axes}"
            )
        missing = int(np.argmax(place < 0))
        near = min((one.sweep for one in alike), key=lambda one: abs(one.swath_px - sweep.swath_px))
        raise NotRecordedError(
            f"line {missing} of sweep {sweep.name} was never captured: it lies at {sweep.line_px()[missing]:g} px of "
            f"the scan on the swath at {sweep.swath_px:g} px (binning {sweep.binning}, step {sweep.step}), and sweep "
            f"{near.name} from {near.line_px()[0]:g} to {near.line_px()[-1]:g} px on {near.swath_px:.6g} px (binning "
            f"{near.binning}, step {near.step}). Ask for lines on the recording's swaths, no finer than recorded"
        )

    def _lines_of(self, picked: PickedLines, numbers: Numbers) -> Iterator[Line]:
        """Read some of the picked lines, once for each recorded sweep, and yield them in order."""
        data: dict[int, NDArray[np.uint16]] = {}
        for place in np.unique(picked.place[numbers]):
            here = numbers[picked.place[numbers] == place]
            wanted, back = np.unique(picked.line[here], return_inverse=True)
            block = self.sweeps[place].read_lines(wanted)
            data |= {int(number): block[at] for number, at in zip(here, back, strict=True)}
        for number in numbers.tolist():
            place, line = int(picked.place[number]), int(picked.line[number])
            one = self.sweeps[place]
            yield Line(
                number=number,
                data=data[number],
                mirror_x=float(one.position[line, 0]),
                mirror_y=float(one.position[line, 1]),
                time_s=float(one.time_s[line]) + (self._begins_s[place] - self._begins_s[int(picked.place[0])]),
                exposure_ms=float(one.exposure_ms[line]),
                valid=bool(one.valid_line[line] and not picked.again[number] and data[number].min() < LARGEST_SUM_DN),
            )

    @cached_property
    def _begins_s(self) -> list[float]:
        """Return the start of each sweep, as if all were captured without a break [s]."""
        known = (one.time_s[np.isfinite(one.time_s)] for one in self.sweeps)
        spans_s = [(float(one[-1]) if len(one) else 0.0) + self.camera.frame_ms * 1e-3 for one in known]
        return list(accumulate(spans_s[:-1], initial=0.0))


def line_runs(numbers: Numbers) -> list[tuple[int, int]]:
    """Return (start, stop) of the runs of consecutive line numbers."""
    edges = np.flatnonzero(np.diff(numbers, prepend=-2, append=-2) != 1)
    return [(int(numbers[first]), int(numbers[stop - 1]) + 1) for first, stop in pairwise(edges)]


def nearest_line(scan_px: Floats, wanted_px: Floats) -> tuple[Numbers, Floats]:
    """Return the number of the line nearest to each wanted place, and its distance [px].

    ``scan_px`` (line,) are the lines in any order, at least one. If two are equally far, up to SAME_PX, the one at the
    smaller coordinate is chosen.
    """
    order = np.argsort(scan_px, kind="stable")
    places = scan_px[order]
    after = np.clip(np.searchsorted(places, wanted_px), 0, len(places) - 1)
    before = np.maximum(after - 1, 0)
    below, above = np.abs(wanted_px - places[before]), np.abs(places[after] - wanted_px)
    chosen = np.where(above < below - SAME_PX, after, before)
    return order[chosen], np.abs(places[chosen] - wanted_px)
