"""Measure accuracy against processor time for the settings of one stage. The benchmarks share the timer.

Settings run in turn on one thread. A loaded machine then slows all of them alike, and their ratios hold.
"""

from __future__ import annotations

import gc
import math
import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

from models.network.machine import one_thread
from pipeline.errors import SettingsError

Setting = str | float


@dataclass(frozen=True)
class Timing:
    """Seconds of one call in each round, by the processor's clock and by the wall clock."""

    cpu_s: tuple[float, ...]
    wall_s: tuple[float, ...]

    @property
    def cpu_min_s(self) -> float:
        """Least processor time [s]."""
        return min(self.cpu_s)

    @property
    def wall_min_s(self) -> float:
        """Least wall time [s]."""
        return min(self.wall_s)


def time_in_turn(calls: Mapping[Any, Callable[[], object]], rounds: int = 5) -> dict[Any, Timing]:
    """Time all calls in each round. Every round begins with another call; there is no warm-up."""
    names = list(calls)
    spent: dict[Any, list[tuple[float, float]]] = {name: [] for name in names}
    for turn in range(rounds):
        first = turn % len(names)
        for name in names[first:] + names[:first]:
            gc.collect()
            wall, cpu = time.perf_counter(), time.process_time()
            calls[name]()
            spent[name].append((time.process_time() - cpu, time.perf_counter() - wall))
    return {name: Timing(*map(tuple, zip(*pairs, strict=True))) for name, pairs in spent.items()}


def ratio(clocks: Mapping[Any, Timing], of: Any, to: Any) -> float:
    """Return the median over the rounds of one call's processor time over another's. Load hardly changes it."""
    pairs = zip(clocks[of].cpu_s, clocks[to].cpu_s, strict=True)
    return statistics.median([own / other for own, other in pairs if other > 0] or [math.nan])


def describe_machine(threads: int) -> dict[str, object]:
    """Return processor, cores, system, threads in use and versions of the numerical packages."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return {
        "processor": next(names, platform.processor() or "unknown"),
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "threads": threads,
        "versions": {name: metadata.version(name) for name in ("numpy", "scipy", "torch")},
    }


def mean_load() -> float:
    """Return the mean number of running processes over the last minute."""
    return round(os.getloadavg()[0], 2)


@dataclass(frozen=True)
class Tradeoff:
    """Define the measurement of one stage. Only ``run`` is timed.

    Functions take the state that ``prepare`` returns for a seed, then a setting, then the result of ``run``.
    """

    stage: str
    knob: str
    error: str  # with its unit
    unit: str  # of work, such as px*band: times are given per unit
    reference: str  # that the error is measured against
    settings: tuple[Setting, ...]  # ratios are to the first one
    prepare: Callable[[int], Any]
    run: Callable[[Any, Setting], Any]
    judge: Callable[[Any, Setting, Any], float]
    work: Callable[[Any], float]  # units of one run
    modelled_s: Callable[[Any, Setting, Any], float] | None = None  # price, where this machine does not spend the time
    level: Callable[[Any], tuple[str, float]] | None = None  # name and size of an error that other errors hide
    beside: Mapping[str, Callable[[Any, Setting, Any], float]] = field(default_factory=dict, hash=False)
    paid: str | None = None  # figure of ``beside`` that is the price in place of time
    repeats: int = 5  # by default
    settings_of: Callable[[Any], tuple[Setting, ...]] | None = None  # settings that depend on the state
    default: Callable[[Any], Setting | None] = lambda state: None  # setting of a survey by its defaults


@dataclass(frozen=True)
class Point:
    """Error and cost of one setting."""

    setting: Setting
    error: float
    price_s: float  # by the model where the stage has one, else the least processor time
    wall_min_s: float
    ns_per_unit: float
    ratio: float  # of the cost to the first setting's; of processor time the median over the rounds
    pareto: bool = False
    beside: Mapping[str, float] = field(default_factory=dict, hash=False)
    paid: float | None = None  # replaces ``price_s``

    @property
    def cost(self) -> float:
        """Return the figure that settings are compared by, beside their error."""
        return self.price_s if self.paid is None else self.paid


@dataclass(frozen=True)
class Result:
    """Points of all settings of one trade-off."""

    stage: str
    knob: str
    error: str
    unit: str
    reference: str
    repeats: int
    seed: int
    machine: Mapping[str, object]
    points: tuple[Point, ...]
    modelled: bool
    level: tuple[str, float] | None = None
    paid: str | None = None  # None: time
    default: Setting | None = None


def measure_tradeoff(tradeoff: Tradeoff, *, repeats: int | None = None, seed: int = 0) -> Result:
    """Judge every setting by one run, then time ``repeats`` runs of each in turn, on one thread."""
    repeats = tradeoff.repeats if repeats is None else repeats
    if repeats < 1:
        raise SettingsError(f"repeats must be at least 1, got {repeats}")
    state = tradeoff.prepare(seed)
    settings = tradeoff.settings if tradeoff.settings_of is None else tradeoff.settings_of(state)
    with one_thread():
        load_before = mean_load()
        made = {one: tradeoff.run(state, one) for one in settings}
        errors = {one: float(tradeoff.judge(state, one, out)) for one, out in made.items()}
        clocks = time_in_turn({one: partial(tradeoff.run, state, one) for one in settings}, repeats)
        machine = describe_machine(threads=1) | {"load_before": load_before, "load_after": mean_load()}
    points = list[Point]()
    for one, out in made.items():
        price_s, relative = clocks[one].cpu_min_s, ratio(clocks, one, settings[0])
        beside = {name: float(figure(state, one, out)) for name, figure in tradeoff.beside.items()}
        paid = None if tradeoff.paid is None else beside[tradeoff.paid]
        if tradeoff.modelled_s is not None:
            price_s = tradeoff.modelled_s(state, one, out)
        if paid is not None or tradeoff.modelled_s is not None:
            cost = price_s if paid is None else paid
            relative = cost / (points[0].cost if points else cost)
        ns = 1e9 * price_s / tradeoff.work(state)
        points.append(Point(one, errors[one], price_s, clocks[one].wall_min_s, ns, relative, beside=beside, paid=paid))
    return Result(
        *(tradeoff.stage, tradeoff.knob, tradeoff.error, tradeoff.unit, tradeoff.reference, repeats, seed, machine),
        points=mark_pareto(points),
        modelled=tradeoff.modelled_s is not None,
        level=None if tradeoff.level is None else tradeoff.level(state),
        paid=tradeoff.paid,
        default=tradeoff.default(state),
    )


def mark_pareto(points: Sequence[Point]) -> tuple[Point, ...]:
    """Mark the points of the Pareto front: no other is at least as good in error and cost and better in one."""

    def beaten(point: Point) -> bool:
        own = (point.error, point.cost)
        pairs = [(other.error, other.cost) for other in points]
        return any(pair[0] <= own[0] and pair[1] <= own[1] and pair != own for pair in pairs)

    return tuple(replace(point, pareto=math.isfinite(point.error) and not beaten(point)) for point in points)
