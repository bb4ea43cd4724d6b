"""What a field's memory is worth: maps of later visits beside those of anybody who remembers nothing, or looks no more.

A first visit takes every line with 25 ms, later ones every second line with 5 ms: a fifth of the seconds. Beside what
the memory makes of them stand the field scanned anew, the old map kept, the quick look alone, and the rule that anybody
would use: the old class, unless the new look is surer than .97 of another. A season is 30 visits six days apart; who
scans in full every k-th visit and holds the map between has the same seconds in all. Changes are planted into the scene
and looked for three days later. Farms that no training saw, each with noise of its own.

`python tests/benchmarks/bench_memory.py season` draws the season alone, `days` the visits after a few days, `changes`
what was planted, `light` fields that did not change under another sun, `wrong` memories that are none of the field,
`parts` visits that look at a part: fields as wide as four strips of a narrower camera, `strips` a season of them.
`storage --size 128x96 --visits 3` says what so many visits to so small a farm store; alone it takes 640x512 px, ten.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import combinations, product
from pathlib import Path

import numpy as np
from beside.stored_season import stored_rows
from measure import Row
from numpy.typing import NDArray
from scipy.ndimage import rotate

from flows.publish.change_picture import CHANGED_SHARE
from flows.survey.drawing import REACH_PX, whole_pixels
from flows.survey.stages.maps import MOST_TURN_PX
from flows.tradeoff.plans import plain_look
from flows.training.look import chosen_effects
from models.evaluation.metrics import confusion, mean_iou
from models.reading.doubts import SeatDoubts
from models.reading.inference import segment
from models.reading.remembered import (
    COME_TRUE,
    Belief,
    Looked,
    Remembered,
    carried,
    changed_from,
    changed_shares,
    compare,
    first_belief,
    recall,
)
from models.training.looks import REFERENCE_MS
from models.weights.files import Weights, describe_weights, load_weights
from models.weights.memory_files import MemoryWeights, load_memory, memory_path
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import CostModel
from pipeline.planning.area_cover import seats_shown
from pipeline.planning.coverage import cheapest_full, plain_sweeps
from pipeline.planning.part_looks import SeatRows, part_look, sweeps_of_runs
from pipeline.planning.plain_scans import ScanRecord
from pipeline.rectify.registration.field_shift import field_shift
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.farm.farm_scene import farm_scene
from pipeline.simulator.scenes.scene import RasterScene, SceneRaster
from pipeline.simulator.simulated import SimulatedSource, sweep_starts

SHAPE, SEEDS, SIX = (512, 640), (1, 2, 3), (1, 2, 3, 4, 5, 6)
CAMERA, COST = LineCamera(), CostModel()
ANEW, QUICK, REFERENCE = (1, 25.0), (2, 5.0), (1, 12.0)  # step and exposure [ms]
FIRST_DAY, HOUR = 172, 11.0
BEHIND = {1: 0.2, 3: 0.5, 7: 1.0}  # points of mIoU that a later visit may lie behind one that scans anew, by days
SEASON = [(110 + 6 * number, (11.0, 9.5, 13.0, 15.0)[number % 4]) for number in range(30)]
HELD = (2, 3, 4)  # visits from one full scan to the next
WEIGHTS = Path(__file__).resolve().parents[2] / "models" / "shipped" / "farm.safetensors"
SURE = 0.97
PLANTED, PLANTED_SEEDS = 3, range(1, 10)  # changes of each kind on each land, and the lands
LOW_SUN, HIGH_SUN = 6.2, 12.0  # hours of June 21 at which the sun stands at 20 and 61 degrees
STRIPS = LineCamera(samples=160)  # of which a field is four strips wide
PART_DAYS, PART_SHARES = (3, 7), (0.35, 0.6)  # days without a look; seconds of a visit, of those of a whole quick look
SEASON_SHARES = (0.15, 0.25)  # seconds of a visit of a season, of those of a full scan
WRONG_SEEDS = (7, 8, 9)  # lands whose memories are of others, moved, turned or old: nothing was settled on them
VISITS = 10  # of which it is measured what they store
WORSE = 0.5  # points that a map may lose by a memory that is wrong
Classes = NDArray[np.uint8]


@dataclass(frozen=True)
class Seen:
    """A look at a farm: what it says, its true classes and the camera's seconds."""

    looked: Looked
    labels: Classes
    seconds: float

    def score(self, classes: Classes) -> float:
        """mIoU of a map of that day, in points."""
        return 100 * mean_iou(confusion(self.labels, classes, len(_weights().class_names)))

    @property
    def alone(self) -> Classes:
        """The map of this look alone."""
        return first_belief(self.looked).classes()[0]


@cache
def _weights() -> Weights:
    return load_weights(WEIGHTS)


@cache
def _memory() -> MemoryWeights:
    return load_memory(memory_path(WEIGHTS), describe_weights(WEIGHTS))


def look_at_farm(seed: int, day: int, hour: float, how: tuple[int, float], noise: int = 0) -> Seen:
    """Scan a farm as it is on a day, read by the shipped weights."""
    scene = farm_scene(seed, SHAPE, camera=CAMERA, day=day, hour=hour)
    return _seen(scene, seed + 1000 * day + 100_000_000 * noise, how)


def _seen(scene: RasterScene, seed: int, how: tuple[int, float]) -> Seen:
    weights, (step, exposure_ms), rig = _weights(), how, Rig(CAMERA)
    grid = SceneGrid(*SHAPE, weights.config.patch, weights.config.factor)
    along, _, _ = cheapest_full(grid, CAMERA, COST)
    sweeps = plain_sweeps(grid, CAMERA, along, step=step, exposure_ms=exposure_ms)
    clock = sweep_starts(sweeps, CAMERA, COST)
    source = SimulatedSource(scene, rig, seed, chosen_effects(scene, rig, sweeps), clock=clock)
    look = plain_look(weights, source, sweeps, grid, COST)
    drawn = segment(weights, look.seen, look.columns, look.seats, every_class=True)
    assert drawn.log_probability is not None
    seen = np.ones(SHAPE, np.bool_)
    looked = Looked(drawn.log_probability, seen, look.seen.columns, exposure_ms / REFERENCE_MS, step)
    return Seen(looked, np.asarray(scene.labels, np.uint8), look.seconds)


def _later(before: Seen, belief: Belief, now: Seen, days: float, *, reader: bool = True) -> Belief:
    """What is believed after a later look."""
    memory = Remembered(belief, before.looked.coarse, days)
    return recall(memory, now.looked, _memory().reader if reader else None)


def _unless_surer(before: Seen, now: Seen) -> Classes:
    """The old class, unless the new look is surer than .97 of another."""
    classes, sure = first_belief(now.looked).classes()
    return np.where(sure > SURE, classes, before.alone)


def rows() -> list[Row]:
    """All figures."""
    return [
        *after_days(),
        *season(),
        *planted_changes(),
        *other_light(),
        *wrong_memories(),
        *parts(),
        *season_of_parts(),
        *storage(),
    ]


def after_days() -> Iterator[Row]:
    """A quick look after some days, by the memory and by everybody else."""
    found: dict[int, dict[str, list[float]]] = {}
    for seed in SIX:
        before = look_at_farm(seed, FIRST_DAY, HOUR, ANEW)
        for days in BEHIND:
            now, anew = (look_at_farm(seed, FIRST_DAY + days, HOUR, how, 1) for how in (QUICK, ANEW))
            maps = {
                f"scanned anew, {anew.seconds:.1f} s": anew.alone,
                "old map kept": before.alone,
                f"quick look alone, {now.seconds:.1f} s": now.alone,
                "old class unless surer than .97": _unless_surer(before, now),
                "memory without a reader": _later(before, first_belief(before.looked), now, days, reader=False),
                "memory": _later(before, first_belief(before.looked), now, days),
            }
            scores = found.setdefault(days, {})
            for name, one in maps.items():
                classes = one.classes()[0] if isinstance(one, Belief) else one
                scores.setdefault(name, []).append(now.score(classes))
    for days, scores in found.items():
        anew = next(values for name, values in scores.items() if name.startswith("scanned anew"))
        for name, values in scores.items():
            least = max(np.mean(anew) - BEHIND[days], np.mean(scores["old map kept"]))
            goal = (f">= {least:.1f}", bool(np.mean(values) >= least)) if name == "memory" else ("", None)
            yield Row(f"{days} d later, {name}", _figure(values), *goal)


def _figure(values: Sequence[float]) -> str:
    return f"{np.mean(values):.1f} mIoU ({' '.join(f'{value:.1f}' for value in values)})"


def season() -> Iterator[Row]:
    """Thirty visits, the mean of their maps, beside full scans made as often as the same seconds allow."""
    found: dict[str, list[float]] = {}
    seconds: dict[str, float] = {}

    def note(name: str, scores: Sequence[float], spent: float) -> None:
        found.setdefault(name, []).append(float(np.mean(scores)))
        seconds[name] = spent

    for seed in SEEDS:
        full = [look_at_farm(seed, *moment, REFERENCE) for moment in SEASON]
        quick = [full[0], *(look_at_farm(seed, *moment, QUICK, 1) for moment in SEASON[1:])]
        every, fast = full[0].seconds, quick[1].seconds
        note("full scan at every visit", [one.score(one.alone) for one in full], every)
        note("quick look at every visit, nothing remembered", [one.score(one.alone) for one in quick], fast)
        note("quick looks and the memory", _remembered(quick), fast)
        note("quick looks, memory without a reader", _remembered(quick, reader=False), fast)
        for k in HELD:
            maps = [full[number - number % k].alone for number in range(len(full))]
            scores = [one.score(held) for one, held in zip(full, maps, strict=True)]
            note(f"full scan every {k} visits, held between", scores, every / k)
    best = np.mean(found["full scan at every visit"])
    for name, values in found.items():
        goal = (
            (f">= {best - 1:.1f}", bool(np.mean(values) >= best - 1))
            if name == "quick looks and the memory"
            else ("", None)
        )
        yield Row(f"season, {name}: {seconds[name]:.1f} s a visit", _figure(values), *goal)


def _remembered(looks: Sequence[Seen], *, reader: bool = True) -> list[float]:
    """Scores of a season's maps, each by the memory of all looks before it."""
    belief, scores = first_belief(looks[0].looked), [looks[0].score(looks[0].alone)]
    moments = [day + hour / 24 for day, hour in SEASON]
    for number in range(1, len(looks)):
        days = moments[number] - moments[number - 1]
        belief = _later(looks[number - 1], belief, looks[number], days, reader=reader)
        scores.append(looks[number].score(belief.classes()[0]))
    return scores


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
        grid = SceneGrid(*SHAPE, _weights().config.patch, _weights().config.factor)
        along, _, _ = cheapest_full(grid, STRIPS, COST)
        quick, full = (
            plain_sweeps(grid, STRIPS, along, step=step, exposure_ms=exposure_ms)
            for step, exposure_ms in (QUICK, REFERENCE)
        )
        return Strips(grid, SeatRows.of(quick, grid, STRIPS), COST.seconds(quick, STRIPS), COST.seconds(full, STRIPS))

    def chosen(self, before: Seen, belief: Belief, days: float, seconds: float) -> tuple[NDArray[np.bool_], float]:
        """(seat,) that the memory has looked at in so many seconds, and the share of the lines that show them."""
        unseen = carried(Remembered(belief, None, days), _memory().reader)
        names, scans = _weights().class_names, ScanRecord.read(_weights().record["scans"])
        iou = np.array([scans.expected(*QUICK)[name] for name in names])
        strips = [(unseen.log_probability, unseen.age_days)]
        worth = SeatDoubts.of(strips, self.grid, len(names), come_true=COME_TRUE).worth((1 - iou) / (1 + iou))
        look = part_look(self.rows, worth, STRIPS, COST, exposure_ms=QUICK[1], seconds=seconds)
        assert look is not None
        sweeps = self.rows.sweeps
        lines = sum(stop - start for _, start, stop in look.runs) / sum(sweep.lines for sweep in sweeps)
        return seats_shown(sweeps_of_runs(sweeps, look.runs), self.grid, STRIPS), lines

    @property
    def alone(self) -> list[NDArray[np.bool_]]:
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
        unseen = carried(Remembered(first, None, days), _memory().reader)
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
        yield Row(f"a part, {name}", _figure(values))


def season_of_parts() -> Iterator[Row]:
    """Thirty visits to a field four strips wide, each at a part of it, in a share of a full scan's seconds."""
    found: dict[str, list[float]] = {}
    field, moments = Strips.of_field(), [day + hour / 24 for day, hour in SEASON]
    for seed in SEEDS:
        first = look_at_farm(seed, *SEASON[0], REFERENCE)
        quick = [first, *(look_at_farm(seed, *moment, QUICK, 1) for moment in SEASON[1:])]
        for share in (*SEASON_SHARES, None):
            belief, before, scores = first_belief(first.looked), first, [first.score(first.alone)]
            for number in range(1, len(quick)):
                now, days = quick[number], moments[number] - moments[number - 1]
                if share is not None:
                    shown, _ = field.chosen(before, belief, days, share * field.full_s)
                    now = replace(now, looked=_only(now.looked, seat_image(shown, field.grid), field.grid.factor))
                belief = _later(before, belief, now, days)
                scores.append(now.score(belief.classes()[0]))
                before = now
            seconds = field.whole_s if share is None else share * field.full_s
            name = f"{seconds:.1f} s a visit, {seconds / field.full_s:.0%} of a full scan's"
            found.setdefault(name, []).append(float(np.mean(scores)))
    for name, values in found.items():
        yield Row(f"season of parts, {name}", _figure(values))


def _part_score(
    before: Seen, now: Seen, first: Belief, days: float, grid: SceneGrid, shown: NDArray[np.bool_]
) -> float:
    """mIoU of the map after a look at some (seat,) seats."""
    looked = _only(now.looked, seat_image(shown, grid), grid.factor)
    return now.score(_later(before, first, replace(now, looked=looked), days).classes()[0])


def seat_image(shown: NDArray[np.bool_], grid: SceneGrid) -> NDArray[np.bool_]:
    """(y, x) pixels of (seat,) seats."""
    seats = shown.reshape(grid.seat_shape)
    return np.repeat(np.repeat(seats, grid.patch, axis=0), grid.patch, axis=1)[: grid.height, : grid.width]


def _only(looked: Looked, where: NDArray[np.bool_], factor: int) -> Looked:
    """A look that shows some pixels alone."""
    values = np.where(where[..., None], looked.log_probability, np.float32(np.nan))
    coarse = np.where(where[::factor, ::factor, None], looked.coarse, np.float32(np.nan))
    return replace(looked, log_probability=values, seen=looked.seen & where, coarse=coarse)


def planted_changes() -> Iterator[Row]:
    """Weed nests, tracks, stubble strips and flooded corners that are there three days later, and false alarms."""
    names, patch = _weights().class_names, _weights().config.patch
    hits: dict[str, list[bool]] = {}
    false, unchanged = 0, 0
    for seed in PLANTED_SEEDS:
        before = look_at_farm(seed, FIRST_DAY, HOUR, ANEW)
        scene = farm_scene(seed, SHAPE, camera=CAMERA, day=FIRST_DAY + 3, hour=14.0)
        changed, places = plant(scene, np.random.default_rng(seed), names)
        now = _seen(changed, seed, QUICK)
        first = first_belief(before.looked)
        after = _later(before, first, now, 3.0)
        told = changed_shares(changed_from(Remembered(first, None, 3.0), after), patch) >= CHANGED_SHARE
        for kind, place in places:
            covered = _shares(place, patch) >= 0.5
            hits.setdefault(kind, []).append(bool((told & covered).any()))
        same = _shares(before.labels != now.labels, patch) == 0
        false, unchanged = false + int((told & same).sum()), unchanged + int(same.sum())
    for kind, found in hits.items():
        share = float(np.mean(found))
        yield Row(f"planted: {kind}", f"{sum(found)} of {len(found)} found", ">= 95 %", share >= 0.95)
    share = false / unchanged
    yield Row("places said to have changed that did not", f"{share:.2%} of {unchanged}", "<= 2 %", share <= 0.02)


def other_light() -> Iterator[Row]:
    """Places said to have changed in half a day between a low sun and a high one, when nothing did."""
    patch = _weights().config.patch
    for early, late in ((LOW_SUN, HIGH_SUN), (HIGH_SUN, LOW_SUN)):
        false, all_seats = 0, 0
        for seed in SEEDS:
            before, now = look_at_farm(seed, FIRST_DAY, early, ANEW), look_at_farm(seed, FIRST_DAY, late, QUICK, 1)
            first = first_belief(before.looked)
            after = _later(before, first, now, abs(late - early) / 24)
            told = changed_shares(changed_from(Remembered(first, None, 0.3), after), patch) >= CHANGED_SHARE
            same = _shares(before.labels != now.labels, patch) == 0
            false, all_seats = false + int((told & same).sum()), all_seats + int(same.sum())
        share = false / all_seats
        what = f"places said to have changed, nothing did, sun at {early:g} h then {late:g} h"
        yield Row(what, f"{share:.2%} of {all_seats}", "<= 2 %", share <= 0.02)


def wrong_memories() -> Iterator[Row]:
    """Maps that go on from a memory of another land, moved, turned, or old; and a quick look in part under a cloud."""
    found: dict[str, list[tuple[float, float]]] = {}
    for seed in WRONG_SEEDS:
        before, other = (look_at_farm(one, FIRST_DAY, HOUR, ANEW) for one in (seed, seed + 10))
        old = look_at_farm(seed, FIRST_DAY - 75, HOUR, ANEW)
        now = look_at_farm(seed, FIRST_DAY + 3, HOUR, QUICK, 1)
        scene = farm_scene(seed, SHAPE, camera=CAMERA, day=FIRST_DAY + 3, hour=HOUR)
        dim = scene.planes.copy()
        dim[:, : SHAPE[1] // 2] *= 0.4
        clouded = replace(scene, key=f"{scene.key}/cloud", raster=SceneRaster.of(dim, scene.labels))
        shaded = _seen(clouded, seed, QUICK)
        cases = {
            "of another land": (other.looked, now, 3.0),
            "moved by 20 px": (_moved(before.looked), now, 3.0),
            "turned by 5 degrees": (_turned(before.looked), now, 3.0),
            "75 days old": (old.looked, now, 78.0),
            "right, under a cloud over half of the field": (before.looked, shaded, 3.0),
        }
        for name, (looked, today, days) in cases.items():
            classes = _with_any_memory(looked, today, days)
            found.setdefault(name, []).append((today.score(classes), today.score(today.alone)))
    for name, scores in found.items():
        least = float(np.min([score - alone for score, alone in scores]))
        figure = " ".join(f"{score:.1f} for {alone:.1f}" for score, alone in scores)
        yield Row(f"memory {name}: with it for without", figure, f">= -{WORSE} each", least >= -WORSE)


def _with_any_memory(looked: Looked, today: Seen, days: float) -> Classes:
    """The map of a look after one that may be of anything: laid onto today's as surveys do it, or put aside."""
    factor = SHAPE[0] // looked.coarse.shape[0]
    lies = field_shift(_broad(today.looked), _broad(looked), reach_px=REACH_PX / factor)
    if factor * lies.edge_px(looked.coarse.shape) > MOST_TURN_PX:
        return today.alone
    shift = whole_pixels(replace(lies, shift=(factor * lies.shift[0], factor * lies.shift[1])))
    there = _moved(looked, shift)
    memory = Remembered(first_belief(there), there.coarse, days)
    after = recall(memory, today.looked, _memory().reader)
    other = compare(memory, today.looked, after, np.s_[:, :]).is_of_another_field
    return today.alone if other else after.classes()[0]


def _broad(looked: Looked) -> NDArray[np.floating]:
    """The mean of a coarse look's columns in scene values."""
    known = _weights().normalisation
    values: NDArray[np.floating] = looked.coarse @ np.linalg.inv(known.whitening) * known.spread + known.centre
    return values.mean(axis=-1)


def _moved(looked: Looked, by: tuple[int, int] = (20, 20)) -> Looked:
    """A look as it lies beside by so many px down and to the right."""
    cells = tuple(round(one * looked.coarse.shape[0] / SHAPE[0]) for one in by)
    images = ((looked.log_probability, by), (looked.coarse, cells))
    values, coarse = (np.roll(image, far, axis=(0, 1)) for image, far in images)
    return replace(looked, log_probability=values, coarse=coarse)


def _turned(looked: Looked) -> Looked:
    """A look as it lies turned."""
    values, coarse = (
        rotate(image, 5.0, reshape=False, order=0, mode="nearest") for image in (looked.log_probability, looked.coarse)
    )
    return replace(looked, log_probability=values, coarse=coarse)


def _shares(where: NDArray[np.bool_], patch: int) -> NDArray[np.float64]:
    y, x = where.shape
    shares: NDArray[np.float64] = where.reshape(y // patch, patch, x // patch, patch).mean(axis=(1, 3))
    return shares


def plant(
    scene: RasterScene, rng: np.random.Generator, names: Sequence[str]
) -> tuple[RasterScene, list[tuple[str, NDArray[np.bool_]]]]:
    """A scene with changes in places that do not touch, made of pixels that the scene has elsewhere, and the places."""
    assert scene.labels is not None
    planes, labels = scene.planes.copy(), scene.labels.copy()
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    shapes: dict[str, tuple[str, Callable[[float, float], NDArray[np.bool_]]]] = {
        "weed nest, 40 px across": ("weed", lambda cy, cx: (y - cy) ** 2 + (x - cx) ** 2 <= 20**2),
        "track, 16 x 120 px": ("track", lambda cy, cx: (abs(y - cy) <= 8) & (abs(x - cx) <= 60)),
        "bare strip, 24 x 120 px": ("soil", lambda cy, cx: (abs(y - cy) <= 12) & (abs(x - cx) <= 60)),
        "flooded corner, 60 px": ("water", lambda cy, cx: (y >= cy) & (x >= cx) & (y - cy + x - cx <= 60)),
    }
    taken, places = np.zeros(SHAPE, np.bool_), []
    for kind, (name, at) in shapes.items():
        donors = np.argwhere(scene.labels == names.index(name))
        count = 0
        while count < PLANTED:
            place = at(rng.uniform(30, SHAPE[0] - 70), rng.uniform(70, SHAPE[1] - 70))
            own = scene.labels[place] == names.index(name)
            if (taken & place).any() or own.mean() > 0.05:
                continue
            chosen = donors[rng.integers(len(donors), size=int(place.sum()))]
            planes[place], labels[place] = scene.planes[chosen[:, 0], chosen[:, 1]], names.index(name)
            taken |= place
            places.append((kind, place))
            count += 1
    return replace(scene, key=f"{scene.key}/planted", raster=SceneRaster.of(planes, labels)), places


def storage(size_px: tuple[int, int] = SHAPE, visits: int = VISITS) -> Iterator[Row]:
    """What the first visits of a season store, beside as many full scans."""
    return stored_rows(size_px, SEASON[:visits], QUICK, REFERENCE)


PARTS: dict[str, Callable[[], Iterator[Row]]] = {
    "days": after_days,
    "season": season,
    "changes": planted_changes,
    "light": other_light,
    "wrong": wrong_memories,
    "parts": parts,
    "strips": season_of_parts,
    "storage": storage,
}


def main(arguments: Sequence[str]) -> int:
    """Print the rows of some parts."""
    parser = argparse.ArgumentParser(description="What a field's memory is worth, and what it stores.")
    parser.add_argument("parts", nargs="*", metavar="part", help=f"some of {', '.join(PARTS)}; all where none is given")
    parser.add_argument("--size", default=f"{SHAPE[1]}x{SHAPE[0]}", help="of the farm of the part storage [px]")
    parser.add_argument("--visits", type=int, default=VISITS, help="of the part storage")
    asked = parser.parse_args(arguments)
    if unknown := set(asked.parts) - set(PARTS):
        parser.error(f"no part {', '.join(sorted(unknown))}; there are {', '.join(PARTS)}")
    columns, rows = map(int, asked.size.split("x"))
    parts = PARTS | {"storage": partial(storage, (rows, columns), asked.visits)}
    for name in asked.parts or parts:
        for row in parts[name]():
            goal = "" if row.met is None else f", goal {row.goal}: {'met' if row.met else 'MISSED'}"
            print(f"{row.what}: {row.figure}{goal}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
