"""Looks at a part of a field as wide as four strips of a narrower camera: after some days, and for a season."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, product

import numpy as np
from measure import Row
from visits.farm_visits import (
    ANEW,
    CAMERA,
    COST,
    FIRST_DAY,
    HOUR,
    QUICK,
    REFERENCE,
    SEASON,
    SEEDS,
    SHAPE,
    Mask,
    Seen,
    later,
    look_at_farm,
    mean_figure,
    shipped,
    shipped_memory,
)

from models.reading.doubts import SeatDoubts
from models.reading.remembered import COME_TRUE, Belief, Looked, Remembered, carried, first_belief
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import UNLABELLED, SceneGrid
from pipeline.planning.coverage import cheapest_full, plain_sweeps, seats_shown
from pipeline.planning.part_looks import SeatRows, part_look, sweeps_of_runs
from pipeline.planning.plain_scans import ScanRecord
from pipeline.simulator.scenes.farm.farm_scene import farm_scene

STRIPS = LineCamera(samples=160)  # of which a field is four strips wide
PART_DAYS, PART_SHARES = (3, 7), (0.35, 0.6)  # days without a look; seconds of a visit, of those of a whole quick look
SEASON_SHARES = (0.15, 0.25)  # seconds of a visit of a season, of those of a full scan
SOON_H = 0.5  # hours from a visit to the next of a day that is watched
UNWATCHED = (1, 2, 3, 5)  # visits of the season, none of which is made
ROUNDS = (1, 2)  # visits from one quick look at everything to the next


@dataclass(frozen=True)
class Strips:
    """A field as wide as four strips of a camera, and what its quick looks at parts cost and show."""

    grid: SceneGrid
    rows: SeatRows
    whole_s: float  # of a quick look at all of it
    full_s: float  # of a full scan

    @staticmethod
    def of_field() -> Strips:
        """Those of the farms that everything here looks at."""
        grid = SceneGrid(*SHAPE, shipped().config.patch, shipped().config.factor)
        along, _, _ = cheapest_full(grid, STRIPS, COST)
        quick, full = (
            plain_sweeps(grid, STRIPS, along, step=step, exposure_ms=exposure_ms)
            for step, exposure_ms in (QUICK, REFERENCE)
        )
        return Strips(grid, SeatRows.of(quick, grid, STRIPS), COST.seconds(quick, STRIPS), COST.seconds(full, STRIPS))

    def chosen(self, before: Seen, belief: Belief, days: float, seconds: float) -> tuple[Mask, float]:
        """(seat,) that the memory has looked at in so many seconds, and the share of the lines that show them."""
        unseen = carried(Remembered(belief, None, days), shipped_memory())
        names, scans = shipped().class_names, ScanRecord.read(shipped().record["scans"])
        iou = np.array([scans.expected(*QUICK)[name] for name in names])
        strips = [(unseen.log_probability, unseen.age_days)]
        worth = SeatDoubts.of(strips, self.grid, len(names), come_true=COME_TRUE).worth((1 - iou) / (1 + iou))
        look = part_look(self.rows, worth, STRIPS, COST, exposure_ms=QUICK[1], seconds=seconds)
        assert look is not None
        sweeps = self.rows.sweeps
        lines = sum(stop - start for _, start, stop in look.runs) / sum(sweep.lines for sweep in sweeps)
        return seats_shown(sweeps_of_runs(sweeps, look.runs), self.grid, STRIPS), lines

    @property
    def alone(self) -> list[Mask]:
        """(seat,) that each strip shows."""
        return [seats_shown([sweep], self.grid, STRIPS) for sweep in self.rows.sweeps]


def parts() -> Iterator[Row]:
    """A part of a field looked at in some of a quick look's seconds: where the memory promises most, or anywhere."""
    found: dict[str, list[float]] = {}
    field = Strips.of_field()
    for seed, days in product(SEEDS, PART_DAYS):
        before = look_at_farm(seed, FIRST_DAY, HOUR, ANEW)
        now = look_at_farm(seed, FIRST_DAY + days, HOUR, QUICK, 1)
        first = first_belief(before.looked)
        score = partial(_part_score, before, now, first, days, field.grid)
        unseen = carried(Remembered(first, None, days), shipped_memory())
        found.setdefault(f"{days} d, nothing looked at, 0 s", []).append(now.score(unseen.classes()[0]))
        for share in PART_SHARES:
            seconds = share * field.whole_s
            chosen, lines = field.chosen(before, first, days, seconds)
            found.setdefault(f"{days} d, {seconds:.1f} s where the memory promises most", []).append(score(chosen))
            count = max(round(lines * len(field.alone)), 1)
            others = [np.any(some, axis=0) for some in combinations(field.alone, count)]
            name = f"{days} d, {count} of {len(field.alone)} strips, any"
            found.setdefault(name, []).append(float(np.mean([score(some) for some in others])))
        name = f"{days} d, the whole field, {field.whole_s:.1f} s"
        found.setdefault(name, []).append(score(np.any(field.alone, axis=0)))
    for name, values in found.items():
        yield Row(f"a part, {name}", mean_figure(values))


def season_of_parts() -> Iterator[Row]:
    """Thirty visits to a field four strips wide: parts of it at each, or all of it at some, at equal seconds."""
    found: dict[str, list[float]] = {}
    field = Strips.of_field()
    for seed in SEEDS:
        first = look_at_farm(seed, *SEASON[0], REFERENCE)
        quick = [first, *(look_at_farm(seed, *moment, QUICK, 1) for moment in SEASON[1:])]
        for share in SEASON_SHARES:
            name = f"a part at each visit, in {share:.0%} of a full scan's seconds"
            found.setdefault(name, []).append(_season_score(field, quick, share, 1))
        for every in ROUNDS:
            share = field.whole_s / field.full_s / every
            name = f"all of it at every {every}. visit, by memory between, {share:.0%}"
            found.setdefault(name, []).append(_season_score(field, quick, None, every))
    for name, values in found.items():
        yield Row(f"season of parts, {name}", mean_figure(values))


def unwatched() -> Iterator[Row]:
    """A memory that nobody looks after: half an hour later, and how much it expects to be wrong as weeks go by."""
    field, names, reader = Strips.of_field(), shipped().class_names, shipped_memory()
    soon: list[tuple[float, float]] = []
    for seed in SEEDS:
        before, anew = (look_at_farm(seed, FIRST_DAY, HOUR + later_h, ANEW) for later_h in (0.0, SOON_H))
        held = carried(Remembered(first_belief(before.looked), None, SOON_H / 24), reader)
        soon.append((anew.score(held.classes()[0]), anew.score(anew.alone)))
    yield Row("half an hour later, nothing looked at", mean_figure([held for held, _ in soon]))
    yield Row("the same, scanned anew", mean_figure([anew for _, anew in soon]))
    found: dict[int, list[tuple[float, float]]] = {}
    for seed in SEEDS:
        first = first_belief(look_at_farm(seed, *SEASON[0], REFERENCE).looked)
        for number in UNWATCHED:
            (day, hour), days = SEASON[number], SEASON[number][0] - SEASON[0][0]
            unseen = carried(Remembered(first, None, days), reader)
            doubts = SeatDoubts.of(
                [(unseen.log_probability, unseen.age_days)], field.grid, len(names), come_true=COME_TRUE
            )
            labels = np.asarray(farm_scene(seed, SHAPE, camera=CAMERA, day=day, hour=hour).labels)
            wrong = float((unseen.classes()[0] != labels)[labels != UNLABELLED].mean())
            found.setdefault(days, []).append((doubts.expected_wrong(), wrong))
    for days, pairs in found.items():
        expected, wrong = np.mean(pairs, axis=0)
        each = " ".join(f"{100 * one:.1f}" for _, one in pairs)
        what = f"{days} d without a look after April 20, pixels that are wrong, beside those that are expected"
        yield Row(what, f"{100 * wrong:.1f} % ({each}), expected {100 * expected:.1f} %")


def _season_score(field: Strips, quick: Sequence[Seen], share: float | None, every: int) -> float:
    """Mean mIoU over the visits; at some of them quick looks, at parts that cost a ``share`` of a full scan, or at all.

    At the others the map is the memory brought to that day.
    """
    moments, reader = [day + hour / 24 for day, hour in SEASON], shipped_memory()
    before, belief, scores, last = quick[0], first_belief(quick[0].looked), [quick[0].score(quick[0].alone)], moments[0]
    for number in range(1, len(quick)):
        now, days = quick[number], moments[number] - last
        if number % every:
            unseen = carried(Remembered(belief, None, days), reader)
            scores.append(now.score(unseen.classes()[0]))
            continue
        if share is not None:
            shown, _ = field.chosen(before, belief, days, share * field.full_s)
            now = replace(now, looked=_only(now.looked, seat_image(shown, field.grid), field.grid.factor))
        belief, last = later(before, belief, now, days), moments[number]
        scores.append(now.score(belief.classes()[0]))
        before = now
    return float(np.mean(scores))


def _part_score(before: Seen, now: Seen, first: Belief, days: float, grid: SceneGrid, shown: Mask) -> float:
    """mIoU of the map after a look at some (seat,) seats."""
    looked = _only(now.looked, seat_image(shown, grid), grid.factor)
    return now.score(later(before, first, replace(now, looked=looked), days).classes()[0])


def seat_image(shown: Mask, grid: SceneGrid) -> Mask:
    """(y, x) pixels of (seat,) seats."""
    seats = shown.reshape(grid.seat_shape)
    return np.repeat(np.repeat(seats, grid.patch, axis=0), grid.patch, axis=1)[: grid.height, : grid.width]


def _only(looked: Looked, where: Mask, factor: int) -> Looked:
    """A look that shows some pixels alone."""
    values = np.where(where[..., None], looked.log_probability, np.float32(np.nan))
    coarse = np.where(where[::factor, ::factor, None], looked.coarse, np.float32(np.nan))
    return replace(looked, log_probability=values, seen=looked.seen & where, coarse=coarse)
