"""Whether a second look pays: a fast scan of a field, then its doubtful lines once more, beside plain scans.

All have the same seconds of the camera; set-up and reload of the second look are among them. Lines of the second look
are chosen by the truth (what each seat gains: nobody can choose much better), or by the doubts of the first scan's map,
which say exposure and step as well. Where both looks have lines equally far apart their readings are weighed as sure as
they are, else the second stands. Beside that stands what surveys do today: a second visit, `--look part`, which the
memory's reader weighs against the first.

Dense fields are farms; sparse ones are of interest in a sixteenth (odd seeds) or an eighth: a block of a farm, and one
field around it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from measure import Row
from numpy.typing import NDArray
from sparse_lands import sparse_land

from flows.tasks.stages.accuracy import columns_of_all_seats
from flows.tasks.survey_model import shipped_weights
from flows.training.look import chosen_effects
from models.evaluation.metrics import confusion, mean_iou
from models.network.memory_reader import MemoryReader
from models.reading.doubts import SeatDoubts
from models.reading.inference import DrawnMap, glance_of_columns, segment
from models.reading.remembered import COME_TRUE, Looked, Remembered, carried, first_belief, recall
from models.training.looks import REFERENCE_MS
from models.weights.files import Weights, load_reader, load_weights
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import CostModel, Sweep
from pipeline.planning.coverage import cheapest_full, plain_sweeps, seats_shown
from pipeline.planning.part_looks import LineRun, SeatRows, part_look, sweeps_of_runs
from pipeline.planning.plain_scans import MIOU, PlainScan, ScanLimits, ScanRecord, choose_scan, plain_scans, scan_words
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.farm.farm_scene import farm_scene
from pipeline.simulator.scenes.scene import RasterScene
from pipeline.simulator.simulated import SimulatedSource, sweep_starts

Scan = tuple[int, float]  # pixels from line to line, and exposure [ms]
Columns = NDArray[np.float32]  # (seat, p, p, column)
Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
FARM_SEEDS, LAND_SEEDS = (1, 2, 3), (21, 22, 23, 24, 25, 26)
FARM, LAND = (512, 640), (1024, 1280)
BLOCKS = {1: (256, 320), 0: (512, 320)}  # of a sparse land, by the last bit of its seed
FARM_FIRST = {6.0: (2, 3.0), 9.0: (2, 5.0), 15.0: (1, 8.0)}  # seconds, and the first scan of two
LAND_FIRST = {10.0: (2, 3.0)}  # with less the first scan would have every 4th line
FARM_AGAIN: tuple[Scan, ...] = ((1, 6.0), (1, 12.0), (1, 25.0))  # second looks on offer
LAND_AGAIN: tuple[Scan, ...] = ((2, 5.9), (2, 9.0), (1, 6.0))
EVEN_MS = 13.0  # exposure at which the readout's noise is as large as that of soil's own light
DENSE_GAIN, SPARSE_GAIN = 0.5, 1.5  # points that second looks had to gain in the mean to be worth planning
FAR_BELOW = 0.03  # of mIoU by the record: plain scans that are expected to score as much less are not tried
BANDS, MEMORY, AGAIN_NOISE = 270, 2**30, 100_000_000
CAMERA, COST = LineCamera(), CostModel()
WEIGHTS = shipped_weights()


def joint_exposure(first_ms: float, second_ms: float) -> float:
    """Exposure of one reading that is as sure as two together: less than their sum, as each is read for itself."""
    sure = _sureness(first_ms) + _sureness(second_ms)
    return float((sure + np.sqrt(sure * (sure + 4 * EVEN_MS))) / 2)


def _sureness(exposure_ms: float) -> float:
    """What a reading's noise variance is the inverse of, but for a factor: shot noise and the readout's."""
    return exposure_ms**2 / (exposure_ms + EVEN_MS)


@dataclass
class Field:
    """A field, and what was rendered of it."""

    name: str
    scene: RasterScene
    seed: int
    made: dict[tuple[Scan, int], Columns] = field(default_factory=dict)

    @property
    def labels(self) -> NDArray[np.uint8]:
        assert self.scene.labels is not None
        return self.scene.labels

    @property
    def grid(self) -> SceneGrid:
        config = _weights().config
        return SceneGrid(*self.scene.shape, config.patch, config.factor)

    def sweeps(self, scan: Scan) -> list[Sweep]:
        along, _, _ = cheapest_full(self.grid, CAMERA, COST)
        return plain_sweeps(self.grid, CAMERA, along, step=scan[0], exposure_ms=scan[1])

    def seconds(self, scan: Scan) -> float:
        return COST.seconds(self.sweeps(scan), CAMERA)

    def columns(self, scan: Scan, noise: int = 0) -> Columns:
        """What a scan of everything shows, each with noise of its own."""
        if (scan, noise) not in self.made:
            sweeps, rig = self.sweeps(scan), Rig(CAMERA)
            chosen = chosen_effects(self.scene, rig, sweeps)
            clock = sweep_starts(sweeps, CAMERA, COST)
            source = SimulatedSource(self.scene, rig, self.seed + noise * AGAIN_NOISE, chosen, clock=clock)
            found = columns_of_all_seats(source, sweeps, self.grid, _weights(), memory=MEMORY, kernel="catmull-rom")
            self.made[scan, noise] = found
        return self.made[scan, noise]

    def score(self, classes: NDArray[np.uint8]) -> float:
        return 100 * mean_iou(confusion(self.labels, classes, _weights().config.classes))


@dataclass(frozen=True)
class Read:
    """A map and the coarse look that it was drawn from."""

    drawn: DrawnMap
    coarse: Columns

    def looked(self, scan: Scan, seen: Mask | None = None) -> Looked:
        """As a memory has to know it; where ``seen`` (y, x) is given, of these pixels alone."""
        values = self.drawn.log_probability
        assert values is not None
        where, factor = np.ones(values.shape[:2], np.bool_) if seen is None else seen, _weights().config.factor
        coarse = np.where(where[::factor, ::factor, None], self.coarse, np.float32(np.nan))
        values = np.where(where[..., None], values, np.float32(np.nan))
        return Looked(values, where, coarse, scan[1] / REFERENCE_MS, scan[0])


def read(columns: Columns, grid: SceneGrid, *, every_class: bool = False) -> Read:
    """Draw the map of a field whose every seat was seen; its coarse look are the means of its own pixels."""
    (down, across), p, s = grid.seat_shape, grid.patch, grid.factor
    cells = columns.reshape(down, across, p // s, s, p // s, s, -1).mean(axis=(3, 5), dtype=np.float32)
    small = cells.swapaxes(1, 2).reshape(down * p // s, across * p // s, -1)
    seats, seen = grid.valid_seats(), glance_of_columns(_weights(), small, grid)
    return Read(segment(_weights(), seen, columns[seats], seats, every_class=every_class), seen.columns)


@dataclass(frozen=True)
class TwoLooks:
    """What plans of two looks score, best by truth, by the first map's doubts, and as two visits; gains expected."""

    seconds: float
    plain: float
    plain_words: str
    truth: float
    doubts: float
    visits: float
    words: str  # the second look by doubts
    expected: float  # points that it is expected to gain over the first scan
    expected_plain: float  # that the plain scan in the place of both would be

    @property
    def figure(self) -> str:
        looks = (
            f"{self.doubts:.1f} by doubts ({self.words}), {self.truth:.1f} by truth, {self.visits:.1f} as two visits"
        )
        gains = f"expected gain over the first scan {self.expected:.1f}, of the plain scan {self.expected_plain:.1f}"
        return f"{looks}; plain {self.plain:.1f} ({self.plain_words}); {gains}"


@cache
def _weights() -> Weights:
    return load_weights(WEIGHTS)


@cache
def _memory() -> MemoryReader:
    return load_reader(WEIGHTS)


def fields(seeds: Sequence[int]) -> Iterator[tuple[Field, Mapping[float, Scan], Sequence[Scan]]]:
    """Farms and sparse lands, the first scans that begin two looks by the seconds of both, and second looks."""
    for seed in seeds:
        if seed in LAND_SEEDS:
            scene, _ = sparse_land(seed, LAND, BLOCKS[seed % 2], CAMERA)
            yield Field(f"land {seed}", scene, seed), LAND_FIRST, LAND_AGAIN
        else:
            yield Field(f"farm {seed}", farm_scene(seed, FARM, camera=CAMERA), seed), FARM_FIRST, FARM_AGAIN


def rows() -> list[Row]:
    """All fields."""
    return list(look_rows((*FARM_SEEDS, *LAND_SEEDS)))


def look_rows(seeds: Sequence[int]) -> Iterator[Row]:
    """Some fields by their seconds; then what second looks gain over plain scans, dense fields and sparse."""
    gains: dict[bool, list[tuple[float, float, float]]] = {True: [], False: []}
    for ground, firsts, again in fields(seeds):
        for seconds, first in firsts.items():
            found = two_looks(ground, seconds, first, again)
            over = found.truth - found.plain, found.doubts - found.plain, found.visits - found.plain
            gains[ground.seed in LAND_SEEDS].append(over)
            yield Row(f"{ground.name}, {seconds:g} s, first {scan_words(*first)}", found.figure)
    for sparse, name, least in ((False, "dense", DENSE_GAIN), (True, "sparse", SPARSE_GAIN)):
        for number, how in enumerate(("by truth", "by doubts", "as two visits")):
            if each := [one[number] for one in gains[sparse]]:
                yield Row(f"{name}: two looks {how}, over plain scans", _points(each))
        if each := [max(one[0], 0.0) for one in gains[sparse]]:
            met = bool(np.mean(each) >= least)
            yield Row(f"{name}: two looks by truth where they are better", _points(each), f">= +{least}", met)


def _points(over: Sequence[float]) -> str:
    return f"{np.mean(over):+.1f} points ({' '.join(f'{one:+.1f}' for one in over)})"


def two_looks(ground: Field, seconds: float, first: Scan, again: Sequence[Scan]) -> TwoLooks:
    """Compare plans of two looks with plain scans of the same seconds."""
    grid, record = ground.grid, ScanRecord.read(_weights().record["scans"])
    plain, scan = _best_plain(ground, record, seconds)
    before, left = read(ground.columns(first), grid, every_class=True), seconds - ground.seconds(first)
    first_score = ground.score(before.drawn.classes)
    doubts = _doubts(before.drawn.log_probability, grid)
    belief = first_belief(before.looked(first))
    unseen = carried(Remembered(belief, before.coarse, 0.0), _memory())
    remembered = _doubts(unseen.log_probability, grid, come_true=COME_TRUE)
    by_truth, by_doubts, by_memory = [first_score], [(0.0, first_score, "none")], [(0.0, first_score)]
    for second in again:
        rows = SeatRows.of(ground.sweeps(second), grid, CAMERA)
        joint = _joint(ground, first, second)
        light = joint_exposure(first[1], second[1]) if first[0] == second[0] else second[1]
        everywhere = read(joint, grid).drawn.classes
        gains = {
            "truth": _true_gains(ground, before.drawn.classes, everywhere),
            "doubts": doubts.worth(_wrong_after(record, (second[0], light))),
            "memory": remembered.worth(_wrong_after(record, second)),
        }
        shown, _ = _seats_of(grid, rows, _best_runs(rows, gains["truth"], second[1], left))
        by_truth.append(_score_of(ground, first, joint, shown))
        shown, words = _seats_of(grid, rows, _runs_by_price(rows, gains["doubts"], second[1], left))
        worth = 100 * float(gains["doubts"][shown].sum())
        by_doubts.append((worth, _score_of(ground, first, joint, shown), words))
        shown, _ = _seats_of(grid, rows, _runs_by_price(rows, gains["memory"], second[1], left))
        own = read(ground.columns(second, 1), grid, every_class=True).looked(second, _pixels(shown, grid))
        after = recall(Remembered(belief, before.coarse, 0.0), own, _memory())
        by_memory.append((float(gains["memory"][shown].sum()), ground.score(after.classes()[0])))
    expected, score, words = max(by_doubts)
    instead = 100 * float(doubts.worth(_wrong_after(record, (scan.step, scan.exposure_ms))).sum())
    visits = max(by_memory)[1]
    truth = max(*by_truth, *(found for _, found, _ in by_doubts))
    return TwoLooks(seconds, plain, scan.words, truth, score, visits, words, expected, instead)


def _best_plain(ground: Field, record: ScanRecord, seconds: float) -> tuple[float, PlainScan]:
    """What the best plain scan in so many seconds scores, each step's with its longest exposure; the record's own."""
    sweeps = {step: ground.sweeps((step, CAMERA.exposure_ms)) for step in record.steps}
    scans = plain_scans(record, sweeps, CAMERA, COST, BANDS, seconds=seconds)
    paid = [scan for scan in scans if scan.seconds <= seconds]
    chosen = choose_scan(scans, ScanLimits(seconds))
    longest = [max((s for s in paid if s.step == step), key=lambda s: s.exposure_ms) for step in {s.step for s in paid}]
    tried = [scan for scan in longest if scan.expected[MIOU] >= chosen.expected[MIOU] - FAR_BELOW]
    scores = {
        (scan.step, scan.exposure_ms): ground.score(
            read(ground.columns((scan.step, scan.exposure_ms)), ground.grid).drawn.classes
        )
        for scan in [*tried, chosen]
    }
    return max(scores.values()), chosen


def _joint(ground: Field, first: Scan, second: Scan) -> Columns:
    """Both looks as one where their lines are equally far apart, else the second."""
    own = ground.columns(second, 1)
    if first[0] != second[0]:
        return own
    old, new = _sureness(first[1]), _sureness(second[1])
    return np.asarray((old * ground.columns(first) + new * own) / np.float32(old + new), np.float32)


def _doubts(log_probability: NDArray[np.float32] | None, grid: SceneGrid, come_true: float = 1.0) -> SeatDoubts:
    assert log_probability is not None
    ages = np.zeros(log_probability.shape[:2], np.float32)
    return SeatDoubts.of([(log_probability, ages)], grid, log_probability.shape[-1], come_true=come_true)


def _wrong_after(record: ScanRecord, scan: Scan) -> Floats:
    """(class,) share of pixels that a scan calls otherwise, by the record."""
    expected = record.expected(*scan)
    iou = np.array([expected.get(name, expected[MIOU]) for name in _weights().class_names])
    wrong: Floats = (1 - iou) / (1 + iou)
    return wrong


def _true_gains(ground: Field, before: NDArray[np.uint8], after: NDArray[np.uint8]) -> Floats:
    """(seat,) what the second look gains in right pixels, each class as much as any other; no seat loses."""
    count = np.bincount(ground.labels.ravel(), minlength=_weights().config.classes)
    weight = np.divide(1.0, count, out=np.zeros(len(count)), where=count > 0) / np.count_nonzero(count)
    gained = weight[ground.labels] * ((after == ground.labels).astype(np.float64) - (before == ground.labels))
    (down, across), p = ground.grid.seat_shape, ground.grid.patch  # these fields are of whole seats
    gains: Floats = np.maximum(gained.reshape(down, p, across, p).sum(axis=(1, 3)).ravel(), 0.0)
    return gains


def _runs_by_price(rows: SeatRows, worth: Floats, exposure_ms: float, seconds: float) -> Sequence[LineRun]:
    """Runs of lines as surveys choose them."""
    look = part_look(rows, worth, CAMERA, COST, exposure_ms=exposure_ms, seconds=seconds)
    return () if look is None else look.runs


def _best_runs(rows: SeatRows, worth: Floats, exposure_ms: float, seconds: float) -> Sequence[LineRun]:
    """Of all runs of lines, one of each of up to two sweeps or none, those worth most that end in time."""
    camera = replace(CAMERA, exposure_ms=exposure_ms)
    runs: list[list[LineRun | None]] = []
    lines, sums = [], []
    for number, (values, first, stop) in enumerate(zip(rows.sums(worth), rows.first, rows.stop, strict=True)):
        there = np.flatnonzero(stop > first)
        begin, end = np.triu_indices(len(there))
        summed = np.concatenate([[0.0], np.cumsum(values[there])])
        length, total = stop[there][end] - first[there][begin], summed[end + 1] - summed[begin]
        order = np.lexsort((-total, length))
        kept = order[np.diff(np.maximum.accumulate(total[order]), prepend=0.0) > 0]  # none as short is worth as much
        own = [(number, int(first[there[begin[one]]]), int(stop[there[end[one]]])) for one in kept]
        runs.append([None, *own])
        lines.append(np.concatenate([[0], length[kept]]))
        sums.append(np.concatenate([[0.0], total[kept]]))
    if len(runs) == 1:
        runs, lines, sums = [*runs, [None]], [*lines, np.zeros(1)], [*sums, np.zeros(1)]
    taken, value = np.add.outer(*lines), np.add.outer(*sums)
    loads = np.ceil(taken * rows.sweeps[0].step / COST.vector_pairs)
    count = np.add.outer(*(one > 0 for one in lines), dtype=np.intp)
    spent = taken * camera.frame_ms * 1e-3 + loads * COST.reload_s + count * COST.setup_seconds(camera)
    best = np.unravel_index(np.where(spent <= seconds, value, -1.0).argmax(), value.shape)
    return [run for own, place in zip(runs, best, strict=True) if (run := own[place]) is not None]


def _seats_of(grid: SceneGrid, rows: SeatRows, runs: Sequence[LineRun]) -> tuple[Mask, str]:
    """(seat,) that runs of lines show, and these in words."""
    if not runs:
        return np.zeros(int(np.prod(grid.seat_shape)), np.bool_), "none"
    taken = sweeps_of_runs(rows.sweeps, runs)
    scan = taken[0].step, taken[0].exposure_ms or CAMERA.exposure_ms
    return seats_shown(taken, grid, CAMERA), f"{sum(sweep.lines for sweep in taken)} lines of {scan_words(*scan)}"


def _pixels(shown: Mask, grid: SceneGrid) -> Mask:
    """(y, x) pixels of (seat,) seats."""
    image = shown.reshape(grid.seat_shape).repeat(grid.patch, axis=0).repeat(grid.patch, axis=1)
    return image[: grid.height, : grid.width]


def _score_of(ground: Field, first: Scan, joint: Columns, shown: Mask) -> float:
    """mIoU of the map of a first scan with a second look at some seats."""
    columns = np.where(shown[:, None, None, None], joint, ground.columns(first))
    return ground.score(read(columns, ground.grid).drawn.classes)
