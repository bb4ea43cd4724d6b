"""Looks at a part of a field: which lines of a scan are worth their seconds, where a field is known already.

The patches of a field lie in rows along the lines of the sweeps that show them. A look takes one run of lines of a
sweep, or none of it. At a price of a second each sweep has a best run, in closed form (the largest sum of neighbours);
the lowest price at which all of them together end in time is searched for. What that leaves of the seconds one sweep
gets: where rows are worth about the same, no price divides them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import CostModel, Sweep, exposing, scene_to_sweep
from pipeline.planning.coverage import lines_showing, some_lines

LEAST_PRICE, MOST_PRICE = 1e-9, 1e6  # of a second, in fractions of all worth: at one all pays, at the other nothing
HALVINGS = 48  # of the logarithm of what lies between them
Floats = NDArray[np.float64]
LineRun = tuple[int, int, int]  # number of the sweep, its first line, and the one after its last


@dataclass(frozen=True)
class PartialScan:
    """Runs of lines of a scan, what they cost and what they are worth."""

    runs: tuple[LineRun, ...]
    seconds: float
    expected_gain: float


@dataclass(frozen=True)
class PatchRows:
    """Rows of patches of a field in the sweeps of a scan, along the lines.

    ``row`` (patch,) is the number of each patch's row among all rows of all sweeps, -1 where no sweep shows its middle;
    ``first`` and ``stop`` (sweep, row) are the lines that show a row, 0 and 0 where none does.
    """

    sweeps: tuple[Sweep, ...]
    row: NDArray[np.intp]
    first: NDArray[np.intp]
    stop: NDArray[np.intp]

    @staticmethod
    def of(sweeps: Sequence[Sweep], grid: SceneGrid, camera: LineCamera) -> PatchRows:
        """Assign each patch of a field to the sweep whose lines have it nearest to their middle."""
        patch_index = grid.valid_patches()
        along_x = sweeps[0].along == "x"
        down, across = np.divmod(patch_index, grid.patch_shape[1])
        rank, many = (down, grid.patch_shape[0]) if along_x else (across, grid.patch_shape[1])
        nearest = _nearest_sweep(sweeps, grid, camera, patch_index)
        row = np.full(int(np.prod(grid.patch_shape)), -1, np.intp)
        shown = nearest >= 0
        row[patch_index[shown]] = nearest[shown] * many + rank[shown]
        first, stop = np.zeros((2, len(sweeps), many), np.intp)
        for number, sweep in enumerate(sweeps):
            for place in np.unique(rank[nearest == number]).tolist():
                of_row = patch_index[(nearest == number) & (rank == place)]
                lines = lines_showing(sweep, grid, camera, of_row)
                first[number, place], stop[number, place] = (0, 0) if lines is None else lines
        return PatchRows(tuple(sweeps), row, first, stop)

    @cached_property
    def there(self) -> NDArray[np.bool_]:
        """(sweep, row) that lines show."""
        return np.asarray(self.stop > self.first)

    def sums(self, expected_gain: Floats) -> Floats:
        """Return the sum of the gains (patch,) of each row of patches, (sweep, row)."""
        shown = self.row >= 0
        found = np.bincount(self.row[shown], expected_gain[shown], self.first.size).reshape(self.first.shape)
        return np.where(self.there, found, 0.0)


def _nearest_sweep(
    sweeps: Sequence[Sweep], grid: SceneGrid, camera: LineCamera, patch_index: NDArray[np.intp]
) -> NDArray[np.intp]:
    """Return (patch,) the number of the sweep whose lines lie nearest to the middle of a patch; -1 where none does."""
    size = np.array([grid.height, grid.width])
    origin = grid.patch_origin(patch_index)
    middle = (origin + np.minimum(origin + grid.patch, size)) / 2 - size / 2
    along, scan = (1, 0) if sweeps[0].along == "x" else (0, 1)
    beside = np.full((len(sweeps), len(patch_index)), np.inf)
    for number, sweep in enumerate(sweeps):
        at = scene_to_sweep(sweep, camera, middle[:, along], middle[:, scan])
        half = camera.samples / sweep.binning / 2
        off = np.abs(at[:, 1] - (half - 0.5)) / half
        on_it = (off <= 1) & (at[:, 0] >= -0.5) & (at[:, 0] <= sweep.lines - 0.5)
        beside[number] = np.where(on_it, off, np.inf)
    return np.where(np.isfinite(beside.min(axis=0)), beside.argmin(axis=0), -1)


def sweeps_of_runs(sweeps: Sequence[Sweep], runs: Sequence[LineRun]) -> list[Sweep]:
    """Give the sweeps of runs of lines, in the order of the scan.

    Raises SettingsError: a run is of a sweep or of lines that the scan does not have, or a sweep has two.
    """
    taken: dict[int, Sweep] = {}
    for number, first, stop in runs:
        if not 0 <= number < len(sweeps):
            raise SettingsError(f"the look is at sweep {number}, the scan has sweeps 0 to {len(sweeps) - 1}")
        sweep = sweeps[number]
        if not 0 <= first < stop <= sweep.lines:
            raise SettingsError(
                f"the look is at lines {first} to {stop} of sweep {number}, which has lines 0 to {sweep.lines}"
            )
        if number in taken:
            raise SettingsError(f"the look names sweep {number} twice; one run of its lines is taken")
        taken[number] = some_lines(sweep, first, stop)
    return [taken[number] for number in sorted(taken)]


def partial_scan(
    rows: PatchRows, expected_gain: Floats, camera: LineCamera, cost: CostModel, *, exposure_ms: float, seconds: float
) -> PartialScan | None:
    """Choose the runs of lines that are worth most of those that end in time; None where no run pays or ends.

    ``expected_gain`` is that of a look at each patch, (patch,); none is below 0.
    """
    exposed = replace(rows, sweeps=tuple(replace(sweep, exposure_ms=exposure_ms) for sweep in rows.sweeps))
    values = rows.sums(expected_gain)
    total = float(values.sum())
    if not total > 0:
        return None
    dear, cheap = MOST_PRICE * total / exposing(camera, exposed.sweeps[0]).frame_ms, LEAST_PRICE * total
    everything = _scan_at_price(exposed, values, camera, cost, cheap)
    if everything.seconds <= seconds:
        return everything
    best = PartialScan((), 0.0, 0.0)
    for _ in range(HALVINGS):  # at a lower price no fewer lines are taken
        price = math.sqrt(dear * cheap)
        scan_pass = _scan_at_price(exposed, values, camera, cost, price)
        if scan_pass.seconds > seconds:
            cheap = price
        else:
            dear, best = price, scan_pass
    filled = _filled(exposed, values, camera, cost, seconds, best)
    return filled if filled.runs else None


def _filled(
    rows: PatchRows, values: Floats, camera: LineCamera, cost: CostModel, seconds: float, scan_pass: PartialScan
) -> PartialScan:
    """The look worth most of these: as given; one sweep's run beside the others' as long as time is; that run alone."""
    best = scan_pass
    for number, others in product(range(len(values)), {scan_pass.runs, ()}):
        beside = tuple(run for run in others if run[0] != number)
        first, stop = rows.first[number], rows.stop[number]
        low, high = 0, int(stop.max())
        while low < high:  # the most lines that end in time
            lines = (low + high + 1) // 2
            taken_s = cost.seconds(sweeps_of_runs(rows.sweeps, [*beside, (number, 0, lines)]), camera)
            low, high = (lines, high) if taken_s <= seconds else (low, lines - 1)
        run = _longest_run(values[number], first, stop, low)
        if run is None:
            continue
        runs = tuple(sorted([*beside, (number, *run)]))
        expected_gain = sum(
            float(values[one][(rows.first[one] >= a) & (rows.stop[one] <= b)].sum()) for one, a, b in runs
        )
        if expected_gain > best.expected_gain:
            best = PartialScan(runs, cost.seconds(sweeps_of_runs(rows.sweeps, runs), camera), expected_gain)
    return best


def _longest_run(values: Floats, first: NDArray[np.intp], stop: NDArray[np.intp], lines: int) -> tuple[int, int] | None:
    """The run of at most so many lines that is worth most, without rows worth nothing at its ends; None where none."""
    there = np.flatnonzero(stop > first)
    if not there.size:
        return None
    summed = np.concatenate([[0.0], np.cumsum(values[there])])
    end = np.searchsorted(stop[there], first[there] + lines, side="right")  # the row after its last
    expected_gain = np.where(end > np.arange(there.size), summed[end] - summed[:-1], 0.0)
    begin = int(expected_gain.argmax())
    some = np.flatnonzero(values[there[begin : end[begin]]] > 0)
    if not some.size:
        return None
    return int(first[there[begin + some[0]]]), int(stop[there[begin + some[-1]]])


def _scan_at_price(rows: PatchRows, values: Floats, camera: LineCamera, cost: CostModel, price: float) -> PartialScan:
    """The best run of each sweep, if it has one, where a second has a price in the unit of ``values`` (sweep, row)."""
    exposed = exposing(camera, rows.sweeps[0])
    line_price, setup_price = price * exposed.frame_ms * 1e-3, price * cost.setup_seconds(exposed)
    runs, expected_gain = [], 0.0
    for number, (row, first, stop) in enumerate(zip(values, rows.first, rows.stop, strict=True)):
        run = _best_run(row, first, stop, line_price, setup_price)
        if run is not None:
            runs.append((number, *run))
            expected_gain += float(row[(first >= run[0]) & (stop <= run[1])].sum())
    return PartialScan(tuple(runs), cost.seconds(sweeps_of_runs(rows.sweeps, runs), camera), expected_gain)


def _best_run(
    values: Floats, first: NDArray[np.intp], stop: NDArray[np.intp], line_price: float, setup_price: float
) -> tuple[int, int] | None:
    """The run of lines worth most beyond its price, first and the one after the last; None where none is."""
    there = np.flatnonzero(stop > first)
    if not there.size:
        return None
    summed = np.concatenate([[0.0], np.cumsum(values[there])])
    begins = summed[:-1] - line_price * first[there]
    ends = summed[1:] - line_price * stop[there]
    least = np.minimum.accumulate(begins)
    left = ends - least
    last = int(left.argmax())
    if left[last] <= setup_price:
        return None
    begin = int(np.flatnonzero(begins[: last + 1] == least[last])[0])
    return int(first[there[begin]]), int(stop[there[last]])


def cheapest_row_seconds(rows: PatchRows, camera: LineCamera, cost: CostModel, exposure_ms: float) -> float:
    """Give the seconds of the cheapest look at a single row of patches; inf where no line shows any."""
    prices = [
        cost.seconds([replace(sweep, lines=int(lines[there].min()), exposure_ms=exposure_ms)], camera)
        for sweep, lines, there in zip(rows.sweeps, rows.stop - rows.first, rows.there, strict=True)
        if there.any()
    ]
    return min(prices, default=math.inf)
