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
class Figures:
    """Error of a setting, its cost where that is not processor time, and further figures by name."""

    error: float
    cost: float | None = None
    beside: Mapping[str, float] = field(default_factory=dict, hash=False)


@dataclass(frozen=True)
class Tradeoff:
    """Define the measurement of one stage. Only ``run`` is timed.

    Functions take the state that ``prepare`` returns for a seed, then a setting, then the result of ``run``. A state
    may have ``notes`` on its reference.
    """

    stage: str
    knob: str
    error: str  # with its unit
    reference: str  # that the error is measured against
    settings: tuple[Setting, ...]  # ratios are to the first one
    prepare: Callable[[int], Any]
    run: Callable[[Any, Setting], Any]
    judge: Callable[[Any, Setting, Any], Figures]
    cost: str = "processor time [s]"
    level: tuple[str, float] | None = None  # name and size of an error that other errors hide
    default: Setting | None = None  # setting of a survey by its defaults
    repeats: int = 5  # by default


@dataclass(frozen=True)
class Point:
    """Error and cost of one setting."""

    setting: Setting
    error: float
    cost: float  # by ``judge``, else the least processor time [s]
    time_s: float  # least processor time
    ratio: float  # of the cost to the first setting's; of processor time the median over the rounds
    pareto: bool = False
    beside: Mapping[str, float] = field(default_factory=dict, hash=False)


@dataclass(frozen=True)
class Result:
    """Points of all settings of one trade-off."""

    stage: str
    knob: str
    error: str
    cost: str
    reference: str
    repeats: int
    seed: int
    machine: Mapping[str, object]
    points: tuple[Point, ...]
    level: tuple[str, float] | None = None
    default: Setting | None = None


def measure_tradeoff(tradeoff: Tradeoff, *, repeats: int | None = None, seed: int = 0) -> Result:
    """Judge every setting by one run, then time ``repeats`` runs of each in turn, on one thread."""
    repeats = tradeoff.repeats if repeats is None else repeats
    state = tradeoff.prepare(seed)
    with one_thread():
        load_before = mean_load()
        figures = {one: tradeoff.judge(state, one, tradeoff.run(state, one)) for one in tradeoff.settings}
        clocks = time_in_turn({one: partial(tradeoff.run, state, one) for one in tradeoff.settings}, repeats)
        machine = describe_machine(threads=1) | {"load_before": load_before, "load_after": mean_load()}
    points: list[Point] = []
    for one, judged in figures.items():
        time_s = clocks[one].cpu_min_s
        cost = time_s if judged.cost is None else judged.cost
        relative = ratio(clocks, one, tradeoff.settings[0])
        if judged.cost is not None:
            first = points[0].cost if points else cost
            relative = cost / first if first else math.nan  # a cube of one value takes no bytes
        points.append(Point(one, judged.error, cost, time_s, relative, beside=judged.beside))
    return Result(
        tradeoff.stage,
        tradeoff.knob,
        tradeoff.error,
        tradeoff.cost,
        "; ".join((tradeoff.reference, *getattr(state, "notes", ()))),
        repeats,
        seed,
        machine,
        mark_pareto(points),
        tradeoff.level,
        tradeoff.default,
    )


def mark_pareto(points: Sequence[Point]) -> tuple[Point, ...]:
    """Mark the points of the Pareto front: no other is at least as good in error and cost and better in one."""
    pairs = [(point.error, point.cost) for point in points]
    beaten = [any(a <= error and b <= cost and (a, b) != (error, cost) for a, b in pairs) for error, cost in pairs]
    kept = [math.isfinite(error) and not worse for (error, _), worse in zip(pairs, beaten, strict=True)]
    return tuple(replace(point, pareto=one) for point, one in zip(points, kept, strict=True))
