"""A stage's measure of accuracy against time, and the runner that prices its settings; benchmarks time with it, too.

Processor time and least wall time are taken by interleaved repeats on one thread. A loaded machine then shifts all
settings alike, and ratios hold.
"""

from __future__ import annotations

import gc
import math
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

from pipeline.errors import SettingsError

Setting = str | float


@dataclass(frozen=True)
class Timing:
    """Seconds of one call over the rounds: processor and wall."""

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
    """Time calls round by round, every round beginning with another one. Nothing runs before the first round."""
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
    """Return the median over the rounds of one call's processor time over another's, which load leaves unchanged."""
    pairs = zip(clocks[of].cpu_s, clocks[to].cpu_s, strict=True)
    return statistics.median([own / other for own, other in pairs if other > 0] or [math.nan])


@contextmanager
def one_thread() -> Iterator[int]:
    """Hold torch, where a stage has loaded it, to one thread; gives the number of threads in use."""
    # Stages own torch; flows must neither import it nor pay for it where no stage needs it.
    torch = sys.modules.get("torch")
    if torch is None:
        yield 1
        return
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield torch.get_num_threads()
    finally:
        torch.set_num_threads(before)


def describe_machine(threads: int) -> dict[str, object]:
    """Return processor, cores, system, threads in use and versions of what computes."""
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
    """One knob of one stage. ``run`` alone is timed.

    A stage whose time is not spent on this machine (capture) gives it by ``modelled_s``; it then counts as the price.
    ``level`` is an error below which more exactness is lost in something else, and its name; ``beside`` are more
    figures, of which ``paid`` names the one that counts as the price in place of time. All functions take what
    ``prepare`` gave for a seed, then a setting, then what ``run`` gave. ``missing`` says why a setting cannot run here.
    ``settings_of`` gives the settings where they depend on what was prepared, ``default`` the one that surveys take
    where nobody chooses.
    """

    stage: str
    knob: str
    error: str  # with its unit
    unit: str  # that time is divided by, such as px*band
    reference: str  # that the error is measured against
    settings: tuple[Setting, ...]  # the first is the one that ratios are to
    prepare: Callable[[int], Any]
    run: Callable[[Any, Setting], Any]
    judge: Callable[[Any, Setting, Any], float]
    work: Callable[[Any], float]  # units that one run handles
    modelled_s: Callable[[Any, Setting, Any], float] | None = None
    level: Callable[[Any], tuple[str, float]] | None = None
    beside: Mapping[str, Callable[[Any, Setting, Any], float]] = field(default_factory=dict, hash=False)
    paid: str | None = None
    missing: Callable[[Setting], str | None] = lambda setting: None
    repeats: int = 5  # unless others are asked for
    settings_of: Callable[[Any], tuple[Setting, ...]] | None = None
    default: Callable[[Any], Setting | None] = lambda state: None


@dataclass(frozen=True)
class Point:
    """One setting: its error and what a run of it takes."""

    setting: Setting
    error: float
    price_s: float  # of the model where the stage has one, else the least processor time
    wall_min_s: float
    ns_per_unit: float
    ratio: float  # of what is paid to the first setting's; of processor time its median over the rounds
    pareto: bool = False
    beside: Mapping[str, float] = field(default_factory=dict, hash=False)
    paid: float | None = None  # in place of ``price_s``, of the result's unit

    @property
    def cost(self) -> float:
        """The figure that settings are compared by beside their error."""
        return self.price_s if self.paid is None else self.paid


@dataclass(frozen=True)
class Result:
    """All settings of one trade-off, measured in one go."""

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
    paid: str | None = None  # what is paid; None: time
    missing: Mapping[str, str] = field(default_factory=dict, hash=False)  # settings that did not run, and why
    default: Setting | None = None  # what surveys take where nobody chooses


def measure_tradeoff(tradeoff: Tradeoff, *, repeats: int | None = None, seed: int = 0) -> Result:
    """Judge every setting by one run, then time ``repeats`` of each in turn, on one thread."""
    repeats = tradeoff.repeats if repeats is None else repeats
    if repeats < 1:
        raise SettingsError(f"repeats must be at least 1, got {repeats}")
    state = tradeoff.prepare(seed)
    asked = tradeoff.settings if tradeoff.settings_of is None else tradeoff.settings_of(state)
    why = {setting: tradeoff.missing(setting) for setting in asked}
    settings = [setting for setting, reason in why.items() if reason is None]
    with one_thread() as threads:
        load_before = mean_load()
        made = [tradeoff.run(state, setting) for setting in settings]
        errors = [float(tradeoff.judge(state, *pair)) for pair in zip(settings, made, strict=True)]
        clocks = time_in_turn({one: partial(tradeoff.run, state, one) for one in settings}, repeats)
        machine = describe_machine(threads) | {"load_before": load_before, "load_after": mean_load()}
    points, first = list[Point](), settings[0]
    for setting, out, error in zip(settings, made, errors, strict=True):
        price_s = clocks[setting].cpu_min_s
        relative = ratio(clocks, setting, first)
        if tradeoff.modelled_s is not None:
            price_s = tradeoff.modelled_s(state, setting, out)
            relative = price_s / tradeoff.modelled_s(state, first, made[0])
        beside = {name: float(figure(state, setting, out)) for name, figure in tradeoff.beside.items()}
        paid = None if tradeoff.paid is None else beside[tradeoff.paid]
        if paid is not None:
            relative = paid / (paid if not points else points[0].cost)
        ns = 1e9 * price_s / tradeoff.work(state)
        wall = clocks[setting].wall_min_s
        points.append(Point(setting, error, price_s, wall, ns, relative, beside=beside, paid=paid))
    named = (tradeoff.stage, tradeoff.knob, tradeoff.error, tradeoff.unit, tradeoff.reference)
    level = None if tradeoff.level is None else tradeoff.level(state)
    return Result(
        *(*named, repeats, seed, machine, mark_pareto(points), tradeoff.modelled_s is not None, level, tradeoff.paid),
        missing={str(setting): reason for setting, reason in why.items() if reason is not None},
        default=tradeoff.default(state),
    )


def mark_pareto(points: Sequence[Point]) -> tuple[Point, ...]:
    """Mark the points that no other beats: none is at least as good in error and price and better in one."""
    return tuple(
        replace(
            point,
            pareto=math.isfinite(point.error)
            and not any(
                other.error <= point.error
                and other.cost <= point.cost
                and (other.error, other.cost) != (point.error, point.cost)
                for other in points
            ),
        )
        for point in points
    )
