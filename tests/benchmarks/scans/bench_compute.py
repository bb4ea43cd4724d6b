"""Multiply-adds and bytes as budgets of a plain scan: what the map loses where a part of it alone is read in detail.

The scan is that of `survey --seconds 25`, on farms that training never saw. Beside the seats that the policies choose
within a budget stand as many at random and those that an oracle would take, which knows the labels and what the network
makes of every seat. Anybody's rule is to keep and read all of the field less finely, which stands below.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from bench_frontier import BANDS, CAMERA, COST, SEEDS, SHAPE, chosen_scan
from measure import Row
from numpy.typing import NDArray

from flows.settings.load import CHEAP_POLICY
from flows.tasks.reading_costs import ReadingCosts
from flows.tasks.seat_budget import SeatBudget
from flows.tasks.survey_model import shipped_weights
from flows.tradeoff.stages import plain_look
from flows.training.look import chosen_effects
from models.evaluation.metrics import confusion, mean_iou
from models.evaluation.placement import oracle_gain
from models.policies.policies import score_seats
from models.reading.inference import Glance, glance_of_columns, segment
from models.weights.files import Weights, load_weights
from pipeline.geometry.grid import SceneGrid
from pipeline.planning.coverage import cheapest_full, plain_sweeps
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.farm.farm_scene import farm_scene
from pipeline.simulator.simulated import SimulatedSource, sweep_starts

SECONDS = 25.0
GOALS = {("25%", "40%"): 1.0, ("15%", "35%"): 2.0}  # points of mIoU that may be lost
BUDGETS = (*GOALS, ("35%", "50%"), ("50%", "60%"))
POLICIES = ("gain", "entropy", "sobel", "random")
LEAST_GAINS = (0.05, 0.02, 0.01)
Columns = NDArray[np.float32]


@dataclass(frozen=True)
class ReadField:
    """A farm as a plain scan shows it, read whole, and what each seat would have lost the map."""

    seen: Glance
    columns: Columns  # (seat, p, p, column) of the padded grid
    labels: NDArray[np.uint8]
    costs: ReadingCosts
    every: float  # mIoU of everything read
    oracle: NDArray[np.float64]  # (seat,)

    def miou(self, weights: Weights, seats: NDArray[np.integer]) -> float:
        """mIoU of the map with these seats read in detail, in percent."""
        ascending = np.sort(seats)
        drawn = segment(weights, self.seen, self.columns[ascending], ascending)
        return judged(self.labels, drawn.classes, weights)


def judged(labels: NDArray[np.uint8], classes: NDArray[np.uint8], weights: Weights) -> float:
    """mIoU of a map in percent."""
    return 100 * mean_iou(confusion(labels, classes, weights.config.classes))


def field_of(weights: Weights, seed: int) -> ReadField:
    """Read all of a farm's scan by some weights."""
    scan = chosen_scan(SHAPE, SECONDS)
    scene, rig = farm_scene(seed, SHAPE, camera=CAMERA), Rig(CAMERA)
    grid = SceneGrid(*SHAPE, weights.config.patch, weights.config.factor)
    along, _, _ = cheapest_full(grid, CAMERA, COST)
    sweeps = plain_sweeps(grid, CAMERA, along, step=scan.step, exposure_ms=scan.exposure_ms)
    clock = sweep_starts(sweeps, CAMERA, COST)
    source = SimulatedSource(scene, rig, seed, chosen_effects(scene, rig, sweeps), clock=clock)
    look = plain_look(weights, source, sweeps, grid, COST)  # the grid holds whole cells: every seat is valid
    assert scene.labels is not None
    drawn = segment(weights, look.seen, look.columns, look.seats)
    oracle = oracle_gain(weights, look.seen, look.columns, scene.labels)
    every, costs = judged(scene.labels, drawn.classes, weights), ReadingCosts(weights.config, grid, BANDS)
    return ReadField(look.seen, look.columns, scene.labels, costs, every, oracle)


def picture(columns: Columns, grid: SceneGrid) -> Columns:
    """Put seats of a field of whole cells together, (y, x, column)."""
    (down, across), p = grid.seat_shape, grid.patch
    return columns.reshape(down, across, p, p, -1).swapaxes(1, 2).reshape(down * p, across * p, -1)


def means(image: Columns, step: int) -> Columns:
    """Means of ``step`` x ``step`` pixels, (y, x, column)."""
    y, x, count = image.shape
    small: Columns = image.reshape(y // step, step, x // step, step, count).mean(axis=(1, 3), dtype=np.float32)
    return small


def rows() -> list[Row]:
    """What budgets lose by the weights of surveys in two passes, then by those that plain scans are read with."""
    found = []
    for plain in (False, True):
        path = shipped_weights(plain=plain)
        weights = load_weights(path)
        fields = [field_of(weights, seed) for seed in SEEDS]
        s = weights.config.factor
        none = [field.miou(weights, field.seen.grid.valid_seats()[:0]) - field.every for field in fields]
        found.append(Row(f"{path.stem}: everything kept and read", _figure([field.every for field in fields])))
        found.append(Row(f"means of {s} x {s} px alone", _figure(none)))
        found += [*_budget_rows(weights, fields, plain), *_price_rows(weights, fields)]
        found += [] if plain else _less_fine_rows(weights, fields)
    return found


def _budget_rows(weights: Weights, fields: Sequence[ReadField], plain: bool) -> Iterator[Row]:
    for compute, kept in BUDGETS:
        for policy in (*POLICIES, "oracle"):
            losses, shares = [], []
            for seed, field in zip(SEEDS, fields, strict=True):
                budget = SeatBudget(field.costs, field.costs.grid.valid_seats(), _counted(policy), compute, kept)
                bought = budget.choose(_scores(field, policy, seed))
                losses.append(field.miou(weights, bought) - field.every)
                shares.append(_shares(budget, bought))
            most = GOALS.get((compute, kept)) if plain and policy == CHEAP_POLICY else None
            goal = "" if most is None else f">= -{most:g}"
            met = None if most is None else float(np.mean(losses)) >= -most
            yield Row(f"--compute {compute} --bytes-kept {kept}, {policy}", _figure(losses), goal, met, shares[0])


def _price_rows(weights: Weights, fields: Sequence[ReadField]) -> Iterator[Row]:
    """One least gain for all farms: each buys as many seats as pay."""
    for least in LEAST_GAINS:
        losses, shares = [], []
        for seed, field in zip(SEEDS, fields, strict=True):
            budget = SeatBudget(field.costs, field.costs.grid.valid_seats(), "gain", least_gain=least)
            bought = budget.choose(_scores(field, "gain", seed))
            losses.append(field.miou(weights, bought) - field.every)
            shares.append(_shares(budget, bought))
        yield Row(f"--least-gain {least:g}", _figure(losses), peers="; ".join(shares))


def _less_fine_rows(weights: Weights, fields: Sequence[ReadField]) -> Iterator[Row]:
    """All of the field at half the resolution: brought up and read in full, and read as a field of half the size."""
    brought_up, halved = [], []
    for field in fields:
        grid, p = field.seen.grid, field.seen.grid.patch
        half = means(picture(field.columns, grid), 2)
        whole = np.repeat(np.repeat(half, 2, axis=0), 2, axis=1)
        seats = grid.valid_seats()
        drawn = segment(weights, field.seen, _patches(whole, p), seats)
        brought_up.append(judged(field.labels, drawn.classes, weights) - field.every)
        small = replace(grid, height=grid.height // 2, width=grid.width // 2)
        seen = glance_of_columns(weights, means(half, small.factor), small)
        map_of_half = segment(weights, seen, _patches(half, p), small.valid_seats()).classes
        up = np.repeat(np.repeat(map_of_half, 2, axis=0), 2, axis=1)
        halved.append(judged(field.labels, up, weights) - field.every)
    everything = fields[0].costs.of_map(fields[0].seen.grid.valid_seats()).total
    costs = ReadingCosts(weights.config, small, BANDS)
    share = costs.of_map(small.valid_seats()).total / everything
    yield Row("means of 2 x 2 px, brought up and read in full", _figure(brought_up), peers="100 %, 25 % of the bytes")
    yield Row("read as a field of half the size", _figure(halved), peers=f"{100 * share:.0f} %, 25 % of the bytes")


def _patches(image: Columns, p: int) -> Columns:
    y, x, count = image.shape
    return np.ascontiguousarray(image.reshape(y // p, p, x // p, p, count).swapaxes(1, 2).reshape(-1, p, p, count))


def _scores(field: ReadField, policy: str, seed: int) -> NDArray[np.float64]:
    return field.oracle if policy == "oracle" else score_seats(policy, field.seen, seed=seed).ravel()


def _counted(policy: str) -> str:
    """The oracle's scores are counted as those of the usual policy."""
    return CHEAP_POLICY if policy == "oracle" else policy


def _shares(budget: SeatBudget, seats: NDArray[np.integer]) -> str:
    told = budget.told(seats)
    read, kept = (100 * told[name]["done"] / told[name]["everything"] for name in ("multiply_adds", "bytes"))
    return f"{read:.0f} %, {kept:.0f} % of the bytes"


def _figure(values: Sequence[float]) -> str:
    return f"{np.mean(values):+.2f} ({' '.join(f'{value:+.2f}' for value in values)})"
