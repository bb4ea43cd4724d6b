"""Choose the lines of partial scans, and lay the later passes between the lines of a first one.

The patches of a field lie in rows along the lines of the sweeps that show them. A partial scan takes at most one run
of lines of each sweep. At a price of a second each sweep has a best run in closed form (the largest sum of
neighbours). Bisection finds the lowest price at which all of them together end in time. One more sweep gets the
remaining seconds: rows of equal gain cannot be separated by a price.

Lines of a later pass never repeat a line of the first one. For them the mirror holds one position a line, and line
numbers count the positions of the full scan, 1 px apart.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import CostModel, Sweep, exposing, scene_to_sweep
from pipeline.planning.coverage import field_px, lines_showing, some_lines
from pipeline.planning.prices import prices_of

FIRST_STEP = 4  # positions of the full scan from line to line of the first pass
FIRST_STEPS = (4, 8)  # allowed values
LEAST_PRICE, MOST_PRICE = 1e-9, 1e6  # of a second, in fractions of the total gain: all runs pay, or none
HALVINGS = 48  # of the logarithm of the interval between them
Floats = NDArray[np.float64]
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
        patch_index = grid.valid_patches()
        down, across = np.divmod(patch_index, grid.patch_shape[1])
        rank, many = (down, grid.patch_shape[0]) if sweeps[0].along == "x" else (across, grid.patch_shape[1])
        nearest = _nearest_sweep(sweeps, grid, camera, patch_index)
        row = np.full(int(np.prod(grid.patch_shape)), -1, np.intp)
        shown = nearest >= 0
        row[patch_index[shown]] = nearest[shown] * many + rank[shown]
        first, stop = np.zeros((2, len(sweeps), many), np.intp)
        for number, sweep in enumerate(sweeps):
            for place in np.unique(rank[nearest == number]).tolist():
                lines = lines_showing(sweep, grid, camera, patch_index[(nearest == number) & (rank == place)])
                first[number, place], stop[number, place] = lines or (0, 0)
        return PatchRows(tuple(sweeps), row, first, stop)

    @cached_property
    def there(self) -> NDArray[np.bool_]:
        """Return (sweep, row) whether lines show a row."""
        return np.asarray(self.stop > self.first)

    def sums(self, expected_gain: Floats) -> Floats:
        """Return the sum of the gains (patch,) of each row of patches, (sweep, row)."""
        shown = self.row >= 0
        found = np.bincount(self.row[shown], expected_gain[shown], self.first.size).reshape(self.first.shape)
        return np.where(self.there, found, 0.0)


def _nearest_sweep(
    sweeps: Sequence[Sweep], grid: SceneGrid, camera: LineCamera, patch_index: NDArray[np.intp]
) -> NDArray[np.intp]:
    """Return (patch,) the sweep whose lines have their middle nearest to that of a patch; -1 if none shows it."""
    size, origin = np.array([grid.height, grid.width]), grid.patch_origin(patch_index)
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
    """Return the sweeps of runs of lines, in the order of the scan.

    Raises SettingsError: the scan does not have a run's sweep or lines, or a sweep has two runs.
    """
    taken: dict[int, Sweep] = {}
    for number, first, stop in runs:
        if not 0 <= number < len(sweeps):
            raise SettingsError(f"the extent names sweep {number}, the scan has sweeps 0 to {len(sweeps) - 1}")
        sweep = sweeps[number]
        if not 0 <= first < stop <= sweep.lines:
            raise SettingsError(
                f"the extent names lines {first} to {stop} of sweep {number}, which has lines 0 to {sweep.lines}"
            )
        if number in taken:
            raise SettingsError(f"the extent names sweep {number} twice; give one run of its lines")
        taken[number] = some_lines(sweep, first, stop)
    return [taken[number] for number in sorted(taken)]


def partial_scan(
    rows: PatchRows, expected_gain: Floats, camera: LineCamera, cost: CostModel, *, exposure_ms: float, seconds: float
) -> PartialScan | None:
    """Choose the runs of lines with the most gain that end in time; None if no run does.

    ``expected_gain`` (patch,) is that of capturing each patch; none is below 0.
    """
    exposed = replace(rows, sweeps=tuple(replace(sweep, exposure_ms=exposure_ms) for sweep in rows.sweeps))
    values = rows.sums(expected_gain)
    total = float(values.sum())
    if not total > 0:
        return None
    high, low = MOST_PRICE * total / exposing(camera, exposed.sweeps[0]).frame_ms, LEAST_PRICE * total
    everything = _scan_at_price(exposed, values, camera, cost, low)
    if everything.seconds <= seconds:
        return everything
    best = PartialScan((), 0.0, 0.0)
    for _ in range(HALVINGS):  # a lower price never takes fewer lines
        price = math.sqrt(high * low)
        scan = _scan_at_price(exposed, values, camera, cost, price)
        if scan.seconds > seconds:
            low = price
        else:
            high, best = price, scan
    filled = _filled(exposed, values, camera, cost, seconds, best)
    return filled if filled.runs else None


def _filled(
    rows: PatchRows, values: Floats, camera: LineCamera, cost: CostModel, seconds: float, scan: PartialScan
) -> PartialScan:
    """Return the best of: the scan; one sweep's run changed to fill the time beside the others; that run alone."""
    best = scan
    for number, others in product(range(len(values)), {scan.runs, ()}):
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
        gain = sum(float(values[one][(rows.first[one] >= a) & (rows.stop[one] <= b)].sum()) for one, a, b in runs)
        if gain > best.expected_gain:
            best = PartialScan(runs, cost.seconds(sweeps_of_runs(rows.sweeps, runs), camera), gain)
    return best


def _longest_run(values: Floats, first: NDArray[np.intp], stop: NDArray[np.intp], lines: int) -> tuple[int, int] | None:
    """Return the run of at most so many lines with the most gain, without rows of no gain at its ends; None if none."""
    there = np.flatnonzero(stop > first)
    if not there.size:
        return None
    summed = np.concatenate([[0.0], np.cumsum(values[there])])
    end = np.searchsorted(stop[there], first[there] + lines, side="right")  # the row after its last
    gain = np.where(end > np.arange(there.size), summed[end] - summed[:-1], 0.0)
    begin = int(gain.argmax())
    some = np.flatnonzero(values[there[begin : end[begin]]] > 0)
    if not some.size:
        return None
    return int(first[there[begin + some[0]]]), int(stop[there[begin + some[-1]]])


def _scan_at_price(rows: PatchRows, values: Floats, camera: LineCamera, cost: CostModel, price: float) -> PartialScan:
    """Return the best run of each sweep, if it has one, at a price of a second in the unit of ``values``."""
    exposed = exposing(camera, rows.sweeps[0])
    line_price, setup_price = price * exposed.frame_ms * 1e-3, price * cost.setup_seconds(exposed)
    runs, gain = [], 0.0
    for number, (row, first, stop) in enumerate(zip(values, rows.first, rows.stop, strict=True)):
        run = _best_run(row, first, stop, line_price, setup_price)
        if run is not None:
            runs.append((number, *run))
            gain += float(row[(first >= run[0]) & (stop <= run[1])].sum())
    return PartialScan(tuple(runs), cost.seconds(sweeps_of_runs(rows.sweeps, runs), camera), gain)


def _best_run(
    values: Floats, first: NDArray[np.intp], stop: NDArray[np.intp], line_price: float, setup_price: float
) -> tuple[int, int] | None:
    """Return the run with the most gain less price: first line and the one after the last; None if none pays."""
    there = np.flatnonzero(stop > first)
    if not there.size:
        return None
    summed = np.concatenate([[0.0], np.cumsum(values[there])])
    begins = summed[:-1] - line_price * first[there]
    ends = summed[1:] - line_price * stop[there]
    least = np.minimum.accumulate(begins)
    last = int((ends - least).argmax())
    if ends[last] - least[last] <= setup_price:
        return None
    begin = int(np.flatnonzero(begins[: last + 1] == least[last])[0])
    return int(first[there[begin]]), int(stop[there[last]])


def cheapest_row_seconds(rows: PatchRows, camera: LineCamera, cost: CostModel, exposure_ms: float) -> float:
    """Return the seconds of the fastest capture of a single row of patches; inf if no line shows any."""
    prices = [
        cost.seconds([replace(sweep, lines=int(lines[there].min()), exposure_ms=exposure_ms)], camera)
        for sweep, lines, there in zip(rows.sweeps, rows.stop - rows.first, rows.there, strict=True)
        if there.any()
    ]
    return min(prices, default=math.inf)


def merged_ms(first_ms: float, later_ms: float, first_fraction: float) -> float:
    """Return the exposure [ms] whose noise is the mean of that of lines of two exposures."""
    return 1 / (first_fraction / first_ms + (1 - first_fraction) / later_ms)


def every_nth(full: Sequence[Sweep], step: int = FIRST_STEP, exposure_ms: float | None = None) -> list[Sweep]:
    """Return the first pass: every ``step``-th line of the sweeps of a full scan, to its last line or just beyond."""
    found = []
    for number, sweep in enumerate(full):
        name, lines = f"coarse-{number}", -(-(sweep.lines - 1) // step) + 1
        found.append(replace(sweep, name=name, kind="coarse", step=step, held=1, lines=lines, exposure_ms=exposure_ms))
    return found


def lines_between(
    runs: Sequence[Sweep], first_pass: Sequence[Sweep], *, step: int = 1, exposure_ms: float | None = None
) -> list[Sweep]:
    """Return the sweeps that complete runs of a full scan's lines to a distance of ``step``.

    A run on the swath of a sweep of the first pass begins and ends at lines of that sweep, and takes the lines between.
    After a first pass of every fourth line these are the lines halfway, then the odd ones. Any other run takes all of
    its own lines.
    """
    taken = {(sweep.along, sweep.swath_px): sweep for sweep in first_pass}
    found: list[Sweep] = []
    for run in runs:
        coarse = taken.get((run.along, run.swath_px))
        if coarse is None:
            held = None if step == 1 else 1
            found.append(replace(run, lines=-(-run.lines // step), step=step, held=held, exposure_ms=exposure_ms))
        else:
            found += _filling(run, coarse, step, exposure_ms)
    return found


def _filling(run: Sweep, coarse: Sweep, step: int, exposure_ms: float | None) -> Iterator[Sweep]:
    """Yield the sweeps that halve the distance of a pass's lines along a run until it is ``step``."""
    low = round(run.start_px - coarse.start_px)
    first = max(low // coarse.step, 0)
    stop = min(-(-(low + run.lines - 1) // coarse.step), coarse.lines - 1)  # the coarse line that the run ends at
    apart, spaces = coarse.step, stop - first
    while apart > step and spaces > 0:
        start = coarse.start_px + first * coarse.step + apart / 2
        name = f"{run.name}-{apart // 2}"
        yield replace(run, name=name, start_px=start, lines=spaces, step=apart, held=1, exposure_ms=exposure_ms)
        apart, spaces = apart // 2, 2 * spaces


def most_within(
    seconds: float,
    values: NDArray[np.floating],
    grid: SceneGrid,
    first_pass: Sequence[Sweep],
    camera: LineCamera,
    cost: CostModel,
    *,
    step: int,
    exposure_ms: float,
    interlaced: bool = True,
) -> float:
    """Return an upper bound of the (patch,) values that lines ``step`` px apart show in so many ``seconds``.

    Rows of patches along the lines are taken freely, without the set-ups of runs.
    """
    along, apart = first_pass[0].along, first_pass[0].step
    lines = grid.patch * (1 / step - (1 / apart if interlaced else 0.0))
    price = lines * prices_of(replace(camera, exposure_ms=exposure_ms), cost).even_line_s
    row, column = np.divmod(np.arange(len(values)), grid.patch_shape[1])
    across, down = (column, row) if along == "x" else (row, column)
    middle = (across + 0.5) * grid.patch - field_px(grid, along)[0] / 2
    centres = np.array(sorted({sweep.swath_px for sweep in first_pass}))
    swath = np.abs(middle[:, None] - centres).argmin(axis=1)
    rows = np.bincount(swath * (int(down.max()) + 1) + down, np.maximum(values, 0.0))
    return float(np.sort(rows)[::-1][: int(seconds / price)].sum())
