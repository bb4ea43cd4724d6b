"""What accuracy costs in time: stages register knobs, each with reference and error measure; one runner prices them.

Processor time and least wall time are taken by interleaved repeats on one thread, so that a loaded machine shifts all
settings alike and ratios hold. The results name machine, load, threads and versions.
"""

from __future__ import annotations

import math
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from importlib import metadata
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SettingsError

COPIED_BYTES = 1 << 26  # beyond any cache


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
    """Processor, cores, system, threads in use and versions of what computes."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:  # noqa: PTH123
            names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
            processor = next(names, "unknown")
    except OSError:
        processor = platform.processor() or "unknown"
    return {
        "processor": processor,
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "threads": threads,
        "versions": {name: metadata.version(name) for name in ("numpy", "scipy", "torch")},
    }


def mean_load() -> float | None:
    """Mean number of running processes over the last minute; None where the system does not say."""
    return round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None


Setting = str | float
Clocks = list[tuple[float, float]]  # processor and wall seconds by round
State = TypeVar("State")
Output = TypeVar("Output")


@dataclass(frozen=True)
class Level:
    """An error below which more exactness is lost in something else, such as a tenth of the noise."""

    name: str
    error: float


@dataclass(frozen=True)
class Tradeoff(Generic[State, Output]):
    """One knob of one stage. ``run`` alone is timed.

    A stage whose time is not spent on this machine (capture) gives it by ``modelled_s``; it then counts as the price.
    ``levels`` and ``moved_bytes`` say which floors apply: errors that drown in noise, and the bytes that one unit must
    at least read and write, priced by a copy of memory in the same rounds. ``beside`` are more figures.
    """

    stage: str
    knob: str
    error: str  # what the error is, with its unit
    unit: str  # what time is divided by, such as px*band
    reference: str  # what the error is measured against
    settings: tuple[Setting, ...]  # the first is the one that ratios are to
    prepare: Callable[[int], State]  # seed -> what every setting works on, reference included
    run: Callable[[State, Setting], Output]
    judge: Callable[[State, Setting, Output], float]  # -> error
    work: Callable[[State, Setting], float]  # -> count of units that one run handles
    modelled_s: Callable[[State, Setting, Output], float] | None = None
    levels: Callable[[State], tuple[Level, ...]] | None = None
    moved_bytes: float | None = None
    beside: Mapping[str, Callable[[State, Setting, Output], float]] = field(default_factory=dict, hash=False)
    families: bool = False  # settings are "FAMILY, MEMBER"; a family is drawn as one line


@dataclass(frozen=True)
class Point:
    """One setting: its error and what a run of it takes."""

    setting: Setting
    error: float
    work: float
    cpu_min_s: float = math.nan
    cpu_median_s: float = math.nan
    wall_min_s: float = math.nan
    wall_median_s: float = math.nan
    ratio: float = math.nan  # of the price to the first setting's; of processor time its median over the rounds
    modelled_s: float | None = None
    pareto: bool = False
    beside: Mapping[str, float] = field(default_factory=dict, hash=False)  # more figures, by name

    @property
    def price_s(self) -> float:
        """Seconds that count: those of the model where the stage has one, else the least processor time."""
        return self.cpu_min_s if self.modelled_s is None else self.modelled_s

    @property
    def ns_per_unit(self) -> float:
        return 1e9 * self.price_s / self.work


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
    levels: tuple[Level, ...] = ()
    families: bool = False
    memory_floor_ns: float | None = None  # for one unit: its bytes copied and nothing else

    def to_dict(self) -> dict[str, object]:
        """Plain values for JSON, which has no NaN and no infinity: they become None."""
        points = [
            _finite(asdict(point) | {"price_s": point.price_s, "ns_per_unit": point.ns_per_unit})
            for point in self.points
        ]
        return {**asdict(self), "machine": dict(self.machine), "points": points}


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(one) for key, one in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


_REGISTRY: dict[tuple[str, str], Tradeoff[Any, Any]] = {}


def register(tradeoff: Tradeoff[State, Output]) -> Tradeoff[State, Output]:
    """Add a trade-off under its stage and knob and give it back; the same stage and knob again replaces it."""
    _REGISTRY[tradeoff.stage, tradeoff.knob] = tradeoff
    return tradeoff


def register_all(*tradeoffs: Tradeoff[Any, Any]) -> None:
    """Add a module's trade-offs, in the order in which a stage shows them."""
    for one in tradeoffs:
        register(one)


def registered() -> dict[tuple[str, str], Tradeoff[Any, Any]]:
    """Give the trade-offs registered so far, by stage and knob."""
    return dict(_REGISTRY)


def find_tradeoffs(stage: str) -> tuple[Tradeoff[Any, Any], ...]:
    """Give all trade-offs of one stage, in the order registered; SettingsError naming the stages there are."""
    found = tuple(tradeoff for (its, _), tradeoff in _REGISTRY.items() if its == stage)
    if not found:
        stages = ", ".join(sorted({its for its, _ in _REGISTRY})) or "none"
        raise SettingsError(f"no trade-off for stage {stage!r}; there are: {stages}")
    return found


def measure_tradeoff(tradeoff: Tradeoff[State, Output], *, repeats: int = 5, seed: int = 0) -> Result:
    """Judge every setting by one run, then time ``repeats`` (1 or more: SettingsError) of each in turn, one thread."""
    if repeats < 1:
        raise SettingsError(f"repeats must be at least 1, got {repeats}")
    state = tradeoff.prepare(seed)
    with one_thread() as threads:
        load_before = mean_load()
        judged = [_judge(tradeoff, state, setting) for setting in tradeoff.settings]
        clocks, floor = _time_in_turn(tradeoff, state, repeats)
        machine = describe_machine(threads) | {"load_before": load_before, "load_after": mean_load()}
    points = [_timed(point, own, judged[0], clocks[0]) for point, own in zip(judged, clocks, strict=True)]
    named = (tradeoff.stage, tradeoff.knob, tradeoff.error, tradeoff.unit, tradeoff.reference)
    levels = () if tradeoff.levels is None else tradeoff.levels(state)
    return Result(*named, repeats, seed, machine, mark_pareto(points), levels, tradeoff.families, floor)


def _judge(tradeoff: Tradeoff[State, Output], state: State, setting: Setting) -> Point:
    output = tradeoff.run(state, setting)
    return Point(
        setting,
        error=float(tradeoff.judge(state, setting, output)),
        work=tradeoff.work(state, setting),
        modelled_s=None if tradeoff.modelled_s is None else tradeoff.modelled_s(state, setting, output),
        beside={name: float(tell(state, setting, output)) for name, tell in tradeoff.beside.items()},
    )


def _time_in_turn(tradeoff: Tradeoff[State, Output], state: State, repeats: int) -> tuple[list[Clocks], float | None]:
    """Seconds by setting and round, each round from another setting on; least time of copying a unit's bytes [ns]."""
    count, moved = len(tradeoff.settings), tradeoff.moved_bytes
    source: NDArray[np.uint8] = np.ones(0 if moved is None else COPIED_BYTES, np.uint8)
    target, copies = np.zeros_like(source), []
    clocks: list[Clocks] = [[] for _ in range(count)]
    for turn in range(repeats):
        if moved is not None:
            start = time.process_time()
            np.copyto(target, source)
            copies.append(time.process_time() - start)
        for offset in range(count):
            number = (turn + offset) % count
            wall, cpu = time.perf_counter(), time.process_time()
            tradeoff.run(state, tradeoff.settings[number])
            clocks[number].append((time.process_time() - cpu, time.perf_counter() - wall))
    return clocks, None if moved is None else 1e9 * min(copies) / (2 * COPIED_BYTES) * moved  # read and written


def _timed(point: Point, clocks: Clocks, first: Point, first_clocks: Clocks) -> Point:
    cpu, wall = zip(*clocks, strict=True)
    prices = zip(cpu, (cpu_s for cpu_s, _ in first_clocks), strict=True)
    if point.modelled_s is not None and first.modelled_s is not None:
        prices = zip((point.modelled_s,), (first.modelled_s,), strict=True)
    ratios = [own / other for own, other in prices if other > 0]
    return replace(
        point,
        cpu_min_s=min(cpu),
        cpu_median_s=statistics.median(cpu),
        wall_min_s=min(wall),
        wall_median_s=statistics.median(wall),
        ratio=statistics.median(ratios) if ratios else math.nan,
    )


def mark_pareto(points: Sequence[Point]) -> tuple[Point, ...]:
    """Mark the points that no other beats: none is at least as good in error and price and better in one."""

    def beaten(point: Point) -> bool:
        return not math.isfinite(point.error) or any(
            other.error <= point.error
            and other.price_s <= point.price_s
            and (other.error < point.error or other.price_s < point.price_s)
            for other in points
        )

    return tuple(replace(point, pareto=not beaten(point)) for point in points)


def cheapest_within(result: Result, error: float) -> Point | None:
    """Give the point of least price whose error is at most ``error``; None where no setting is that good."""
    good = [point for point in result.points if point.error <= error]
    return min(good, key=lambda point: point.price_s, default=None)
