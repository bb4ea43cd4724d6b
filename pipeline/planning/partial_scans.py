"""Choose runs of lines for a limited time: those of a partial scan, or of a second pass.

The patches of a field lie in rows along the lines of the sweeps that show them. A run takes the lines of some rows one
after the other. At a price of a second, each sweep has its best runs in closed form. Bisection finds the lowest price
at which all of them together end in time. Single runs then fill the remaining seconds: rows of equal gain cannot be
separated by a price.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.geometry.scan import CostModel, Floats, Sweep, exposing, scene_to_sweep
from spectralzoom.pipeline.planning.coverage import lines_showing, some_lines

LEAST_PRICE, MOST_PRICE = 1e-9, 1e6  # of a second, in fractions of the total gain: all runs pay, or none
HALVINGS = 24  # of the logarithm of the interval between them
LineRun = tuple[int, int, int]  # number of the sweep, its first line, and the one after its last


@dataclass(frozen=True)
class PartialScan:
    """Runs of lines of a scan, their capture time and expected gain."""

    runs: tuple[LineRun, ...]
    seconds: float
    expected_gain: float


@dataclass(frozen=True)
class PatchRows:
    """Rows of patches of a field in the sweeps of a scan, along the lines.

    ``row`` (patch,) is the number of each patch's row among all rows of all sweeps, -1 if no sweep shows its middle.
    ``first`` and ``stop`` (sweep, row) are the lines that show a row, 0 and 0 if none does.
    """

    sweeps: tuple[Sweep, ...]
    row: NDArray[np.intp]
    first: NDArray[np.intp]
    stop: NDArray[np.intp]

    @staticmethod
    def of(sweeps: Sequence[Sweep], grid: SceneGrid, camera: LineCamera) -> PatchRows:
        """Assign each patch of a field to the sweep whose lines have it nearest to their middle."""
        patch_index = grid.every_patch()
        down, across = np.divmod(patch_index, grid.patch_shape[1])
        rank, many = (down, grid.patch_shape[0]) if sweeps[0].along == "x" else (across, grid.patch_shape[1])
        nearest = _nearest_sweep(sweeps, grid, camera, patch_index)
        first, stop = np.zeros((2, len(sweeps), many), np.intp)
        for number, sweep in enumerate(sweeps):
            for place in np.unique(rank[nearest == number]).tolist():
                lines = lines_showing(sweep, grid, camera, patch_index[(nearest == number) & (rank == place)])
                first[number, place], stop[number, place] = lines or (0, 0)
        return PatchRows(tuple(sweeps), np.where(nearest >= 0, nearest * many + rank, -1), first, stop)

    @cached_property
    def there(self) -> NDArray[np.bool_]:
        """Return (sweep, row) whether lines show a row."""
        return np.asarray(self.stop > self.first)

    def within(self, runs: Sequence[LineRun]) -> NDArray[np.bool_]:
        """Return (sweep, row) whether runs have all lines of a row."""
        found = np.zeros(self.first.shape, np.bool_)
        for number, first, stop in runs:
            found[number] |= (self.first[number] >= first) & (self.stop[number] <= stop)
        return found & self.there

    def patches(self, runs: Sequence[LineRun]) -> NDArray[np.intp]:
        """Return the patches of the rows within runs, ascending."""
        return np.flatnonzero((self.row >= 0) & self.within(runs).ravel()[self.row])

    def sums(self, expected_gain: Floats) -> Floats:
        """Return the sum of the gains (patch,) of each row of patches, (sweep, row)."""
        shown = self.row >= 0
        found = np.bincount(self.row[shown], expected_gain[shown], self.first.size).reshape(self.first.shape)
        return np.where(self.there, found, 0.0)


def _nearest_sweep(
    sweeps: Sequence[Sweep], grid: SceneGrid, camera: LineCamera, patch_index: NDArray[np.intp]
) -> NDArray[np.intp]:
    """Return (patch,) the sweep whose lines have their middle nearest to that of a patch; -1 if none shows it."""
    size = np.array([grid.height, grid.width])
    origin = grid.patch_origin(patch_index)
    middle = (origin + np.minimum(origin + grid.patch, size)) / 2 - size / 2
    along, scan = (1, 0) if sweeps[0].along == "x" else (0, 1)
    beside = np.full((len(sweeps), len(patch_index)), np.inf)
    for number, sweep in enumerate(sweeps):
        at = scene_to_sweep(sweep, camera, middle[:, along], middle[:, scan])
        half = camera.samples / sweep.binning / 2
        off = np.abs(at[:, 1] - (half - 0.5)) / half
        beside[number] = np.where((off <= 1) & (at[:, 0] >= -0.5) & (at[:, 0] <= sweep.lines - 0.5), off, np.inf)
    return np.where(np.isfinite(beside.min(axis=0)), beside.argmin(axis=0), -1)


def sweeps_of_runs(sweeps: Sequence[Sweep], runs: Sequence[LineRun]) -> list[Sweep]:
    """Return the sweeps of runs of lines, in the order of the scan.

    Raises SettingsError: the scan does not have a run's sweep or lines, or a sweep has two runs.
    """
    taken: dict[int, Sweep] = {}
    for number, first, stop in runs:
        if not 0 <= number < len(sweeps):
            raise SettingsError(f"the extent names sweep {number}, the scan has sweeps 0 to {len(sweeps) - 1}")
        lines = sweeps[number].lines
        if not 0 <= first < stop <= lines:
            raise SettingsError(
                f"the extent names lines {first} to {stop} of sweep {number}, which has lines 0 to {lines}"
            )
        if number in taken:
            raise SettingsError(f"the extent names sweep {number} twice; give one run of its lines")
        taken[number] = some_lines(sweeps[number], first, stop)
    return [taken[number] for number in sorted(taken)]


@dataclass(frozen=True)
class RunTimes:
    """Time of runs of lines: that of a line and of a run, which add up nearly, and the exact one."""

    line_s: float
    run_s: float
    seconds: Callable[[Sequence[LineRun]], float]

    @staticmethod
    def of_scan(sweeps: Sequence[Sweep], camera: LineCamera, cost: CostModel, exposure_ms: float) -> RunTimes:
        """Return the times of runs of a scan's lines in an exposure."""
        exposed = [replace(sweep, exposure_ms=exposure_ms) for sweep in sweeps]
        shown = exposing(camera, exposed[0])
        return RunTimes(
            shown.frame_ms * 1e-3,
            cost.setup_seconds(shown),
            lambda runs: cost.seconds(sweeps_of_runs(exposed, runs), camera),
        )


def choose_runs(
    rows: PatchRows, expected_gain: Floats, times: RunTimes, *, seconds: float, several: bool = False
) -> PartialScan | None:
    """Choose the runs of lines with the most gain that end in time; None if no run does.

    ``expected_gain`` (patch,) is that of capturing each patch; none is below 0. A sweep has one run, or ``several``.
    """
    values = rows.sums(expected_gain)
    total = float(values.sum())
    if not total > 0:
        return None
    high, low = MOST_PRICE * total / times.line_s, LEAST_PRICE * total
    everything = _runs_at_price(rows, values, times, low, several=several)
    if everything.seconds <= seconds:
        return everything
    best = PartialScan((), 0.0, 0.0)
    for _ in range(HALVINGS):  # a lower price never takes fewer lines
        price = math.sqrt(high * low)
        scan = _runs_at_price(rows, values, times, price, several=several)
        if scan.seconds > seconds:
            low = price
        else:
            high = price
            best = scan
    while (filled := _filled(rows, values, times, seconds, best)).expected_gain > best.expected_gain:
        best = filled
    return best if best.runs else None


def _filled(rows: PatchRows, values: Floats, times: RunTimes, seconds: float, scan: PartialScan) -> PartialScan:
    """Return the best of: the scan; one sweep's run changed to fill the time beside the others; that run alone."""
    best = scan
    for number, others in product(range(len(values)), {scan.runs, ()}):
        beside = tuple(run for run in others if run[0] != number)
        first, stop = rows.first[number], rows.stop[number]
        low, high = 0, int(stop.max())
        while low < high:  # the most lines that end in time
            lines = (low + high + 1) // 2
            low, high = (lines, high) if times.seconds([*beside, (number, 0, lines)]) <= seconds else (low, lines - 1)
        run = _longest_run(values[number], first, stop, low)
        if run is None:
            continue
        runs = tuple(sorted([*beside, (number, *run)]))
        gain = float(values[rows.within(runs)].sum())
        taken_s = times.seconds(runs)
        if gain > best.expected_gain and taken_s <= seconds:
            best = PartialScan(runs, taken_s, gain)
    return best


def _longest_run(values: Floats, first: NDArray[np.intp], stop: NDArray[np.intp], lines: int) -> tuple[int, int] | None:
    """Return the run of at most so many lines with the most gain, without rows of no gain at its ends; None if none."""
    there = np.flatnonzero(stop > first)
    if not there.size:
        return None
    summed = np.concatenate([[0.0], np.cumsum(values[there])])
    end = np.searchsorted(stop[there], first[there] + lines, side="right")  # the row after its last
    begin = int(np.where(end > np.arange(there.size), summed[end] - summed[:-1], 0.0).argmax())
    some = np.flatnonzero(values[there[begin : end[begin]]] > 0)
    if not some.size:
        return None
    return int(first[there[begin + some[0]]]), int(stop[there[begin + some[-1]]])


def _runs_at_price(rows: PatchRows, values: Floats, times: RunTimes, price: float, *, several: bool) -> PartialScan:
    """Return the best runs of each sweep at a price of a second in the unit of ``values``."""
    prices = (price * times.line_s, price * times.run_s)
    runs: list[LineRun] = []
    for number, (row, first, stop, there) in enumerate(zip(values, rows.first, rows.stop, rows.there, strict=True)):
        spans = zip(row[there].tolist(), first[there].tolist(), stop[there].tolist(), strict=True)
        runs += [(number, *run) for run in _best_runs(spans, *prices, several=several)]
    return PartialScan(tuple(runs), times.seconds(runs), float(values[rows.within(runs)].sum()))


def _best_runs(
    spans: Iterable[tuple[float, int, int]], line_price: float, run_price: float, *, several: bool
) -> tuple[tuple[int, int], ...]:
    """Return the runs of one sweep with the most gain less price, as first line and the one after the last.

    ``spans`` are gain, first line and line after the last of each row, ascending. Two candidates are kept from row to
    row: the best runs so far, and the best of those that end with this row.
    """
    nothing: tuple[tuple[int, int], ...] = ()
    best, ending = (0.0, nothing), (-math.inf, nothing)
    for gain, first, stop in spans:
        net, runs = best if several else (0.0, nothing)
        begun = net + gain - line_price * (stop - first) - run_price, (*runs, (first, stop))
        net, runs = ending
        if runs:
            ending = net + gain - line_price * (stop - runs[-1][1]), (*runs[:-1], (runs[-1][0], stop))
        ending = ending if ending[0] >= begun[0] else begun
        best = ending if ending[0] > best[0] else best
    return best[1]


def cheapest_row_seconds(
    rows: PatchRows, expected_gain: Floats, camera: LineCamera, cost: CostModel, exposure_ms: float
) -> float:
    """Return the seconds of the fastest capture of a single row of patches with a gain; inf if no line shows any."""
    prices = [
        cost.seconds([replace(sweep, lines=int(lines[there].min()), exposure_ms=exposure_ms)], camera)
        for sweep, lines, there in zip(rows.sweeps, rows.stop - rows.first, rows.sums(expected_gain) > 0, strict=True)
        if there.any()
    ]
    return min(prices, default=math.inf)
