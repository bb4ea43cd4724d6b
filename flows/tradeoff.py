"""What accuracy costs in time: stages register knob, reference and error measure; one runner prices the settings.

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
from dataclasses import asdict, dataclass
from importlib import metadata
from typing import Any, Generic, TypeVar

from pipeline.errors import SettingsError

Setting = str | float
State = TypeVar("State")
Output = TypeVar("Output")


@dataclass(frozen=True)
class Tradeoff(Generic[State, Output]):
    """One knob of one stage. ``run`` alone is timed.

    A stage whose time is not spent on this machine (capture) gives it by ``modelled_s``; it then counts as the price.
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


@dataclass(frozen=True)
class Point:
    """One setting: its error and what a run of it takes."""

    setting: Setting
    error: float
    work: float
    cpu_min_s: float
    cpu_median_s: float
    wall_min_s: float
    wall_median_s: float
    ratio: float  # of processor time to the first setting's, median over the rounds
    modelled_s: float | None
    pareto: bool = False

    @property
    def price_s(self) -> float:
        """Seconds that count: those of the model where the stage has one, else the least processor time."""
        return self.cpu_min_s if self.modelled_s is None else self.modelled_s

    @property
    def ns_per_unit(self) -> float:
        """The price for one unit of work [ns]."""
        return 1e9 * self.price_s / self.work if self.work else math.nan


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

    def to_dict(self) -> dict[str, object]:
        """Plain values for JSON."""
        points = [
            {**asdict(point), "price_s": point.price_s, "ns_per_unit": point.ns_per_unit} for point in self.points
        ]
        return {**asdict(self), "machine": dict(self.machine), "points": points}


_REGISTRY: dict[str, Tradeoff[Any, Any]] = {}


def register(tradeoff: Tradeoff[State, Output]) -> Tradeoff[State, Output]:
    """Add a trade-off under its stage's name and give it back; the same stage again replaces it."""
    _REGISTRY[tradeoff.stage] = tradeoff
    return tradeoff


def registered() -> dict[str, Tradeoff[Any, Any]]:
    """Give the trade-offs registered so far, by stage."""
    return dict(_REGISTRY)


def find_tradeoff(stage: str) -> Tradeoff[Any, Any]:
    """Give the trade-off of one stage; SettingsError naming those there are."""
    if stage not in _REGISTRY:
        raise SettingsError(f"no trade-off for stage {stage!r}; there are: {', '.join(sorted(_REGISTRY)) or 'none'}")
    return _REGISTRY[stage]


def measure_tradeoff(tradeoff: Tradeoff[State, Output], *, repeats: int = 5, seed: int = 0) -> Result:
    """Run every setting ``repeats`` times in turn, on one thread, after one run of each that warms up and is judged.

    Raises
    ------
    SettingsError : ``repeats`` is below 1.
    """
    if repeats < 1:
        raise SettingsError(f"repeats must be at least 1, got {repeats}")
    state = tradeoff.prepare(seed)
    with one_thread() as threads:
        load_before = _load()
        judged = [_judge(tradeoff, state, setting) for setting in tradeoff.settings]
        clocks = _time_in_turn(tradeoff, state, repeats)
        machine = describe_machine(threads) | {"load_before": load_before, "load_after": _load()}
    points = [_point(tradeoff, state, number, judged[number], clocks) for number in range(len(tradeoff.settings))]
    named = (tradeoff.stage, tradeoff.knob, tradeoff.error, tradeoff.unit, tradeoff.reference)
    return Result(*named, repeats, seed, machine, mark_pareto(points))


def _judge(tradeoff: Tradeoff[State, Output], state: State, setting: Setting) -> tuple[float, float | None]:
    """Error and modelled seconds of one setting."""
    output = tradeoff.run(state, setting)
    modelled = None if tradeoff.modelled_s is None else tradeoff.modelled_s(state, setting, output)
    return float(tradeoff.judge(state, setting, output)), modelled


def _time_in_turn(tradeoff: Tradeoff[State, Output], state: State, repeats: int) -> list[list[tuple[float, float]]]:
    """(processor, wall) seconds by setting and round; every round starts at another setting."""
    count = len(tradeoff.settings)
    clocks: list[list[tuple[float, float]]] = [[] for _ in range(count)]
    for turn in range(repeats):
        for offset in range(count):
            number = (turn + offset) % count
            wall, cpu = time.perf_counter(), time.process_time()
            tradeoff.run(state, tradeoff.settings[number])
            clocks[number].append((time.process_time() - cpu, time.perf_counter() - wall))
    return clocks


def _point(
    tradeoff: Tradeoff[State, Output], state: State, number: int, judged: tuple[float, float | None],
    clocks: Sequence[Sequence[tuple[float, float]]],
) -> Point:  # fmt: skip
    cpu, wall = zip(*clocks[number], strict=True)
    ratios = [own[0] / first[0] for own, first in zip(clocks[number], clocks[0], strict=True) if first[0] > 0]
    return Point(
        setting=tradeoff.settings[number], error=judged[0], work=tradeoff.work(state, tradeoff.settings[number]),
        cpu_min_s=min(cpu), cpu_median_s=statistics.median(cpu),
        wall_min_s=min(wall), wall_median_s=statistics.median(wall),
        ratio=statistics.median(ratios) if ratios else math.nan, modelled_s=judged[1],
    )  # fmt: skip


def mark_pareto(points: Sequence[Point]) -> tuple[Point, ...]:
    """Mark the points that no other beats: none is at least as good in error and price and better in one."""
    return tuple(Point(**{**asdict(point), "pareto": not _beaten(point, points)}) for point in points)


def _beaten(point: Point, points: Sequence[Point]) -> bool:
    if not math.isfinite(point.error):
        return True
    return any(
        other.error <= point.error
        and other.price_s <= point.price_s
        and (other.error < point.error or other.price_s < point.price_s)
        for other in points
    )


def cheapest_within(result: Result, error: float) -> Point | None:
    """Give the point of least price whose error is at most ``error``; None where no setting is that good."""
    good = [point for point in result.points if point.error <= error]
    return min(good, key=lambda point: point.price_s, default=None)


def best_within(result: Result, seconds: float) -> Point | None:
    """Give the point of least error whose price is at most ``seconds``; None where no setting is that cheap."""
    cheap = [point for point in result.points if point.price_s <= seconds and math.isfinite(point.error)]
    return min(cheap, key=lambda point: point.error, default=None)


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
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "threads": threads,
        "versions": {name: metadata.version(name) for name in ("numpy", "scipy", "torch")},
    }


def _processor() -> str:
    """The processor's name as the system knows it."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:  # noqa: PTH123
            return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "unknown")
    except OSError:
        return platform.processor() or "unknown"


def _load() -> float | None:
    """Mean number of running processes over the last minute; None where the system does not say."""
    return round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None
