"""What accuracy costs in time: stages register knobs, each with reference and error measure; one runner prices them.

Processor time and least wall time are taken by interleaved repeats on one thread, so that a loaded machine shifts all
settings alike and ratios hold. The results name machine, load, threads and versions.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Generic, TypeVar

from flows.tradeoff.machine import Copying, describe_machine, mean_load, one_thread
from pipeline.errors import SettingsError

Setting = str | float
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
    ratio: float  # of the price to the first setting's; of processor time its median over the rounds
    modelled_s: float | None
    pareto: bool = False
    beside: Mapping[str, float] = field(default_factory=dict, hash=False)  # more figures, by name

    @property
    def price_s(self) -> float:
        """Seconds that count: those of the model where the stage has one, else the least processor time."""
        return self.cpu_min_s if self.modelled_s is None else self.modelled_s

    @property
    def ns_per_unit(self) -> float:
        """The price for one unit of work [ns]."""
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
    memory_floor_ns: float | None = None  # for one unit: its bytes copied and nothing else

    def to_dict(self) -> dict[str, object]:
        """Plain values for JSON, which has no NaN and no infinity: they become None."""
        points = [
            _finite({**asdict(point), "price_s": point.price_s, "ns_per_unit": point.ns_per_unit})
            for point in self.points
        ]
        return {**asdict(self), "machine": dict(self.machine), "points": points}


def _finite(values: Mapping[str, object]) -> dict[str, object]:
    return {key: _finite(v) if isinstance(v, Mapping) else _known(v) for key, v in values.items()}


def _known(value: object) -> object:
    return None if isinstance(value, float) and not math.isfinite(value) else value


_REGISTRY: dict[tuple[str, str], Tradeoff[Any, Any]] = {}


def register(tradeoff: Tradeoff[State, Output]) -> Tradeoff[State, Output]:
    """Add a trade-off under its stage and knob and give it back; the same stage and knob again replaces it."""
    _REGISTRY[tradeoff.stage, tradeoff.knob] = tradeoff
    return tradeoff


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
    """Run every setting ``repeats`` times in turn, on one thread, after one run of each that warms up and is judged.

    Raises
    ------
    SettingsError : ``repeats`` is below 1.
    """
    if repeats < 1:
        raise SettingsError(f"repeats must be at least 1, got {repeats}")
    state = tradeoff.prepare(seed)
    copying = None if tradeoff.moved_bytes is None else Copying()
    with one_thread() as threads:
        load_before = mean_load()
        judged = [_judge(tradeoff, state, setting) for setting in tradeoff.settings]
        clocks = _time_in_turn(tradeoff, state, repeats, copying)
        machine = describe_machine(threads) | {"load_before": load_before, "load_after": mean_load()}
    points = [_point(tradeoff, state, number, judged, clocks) for number in range(len(tradeoff.settings))]
    named = (tradeoff.stage, tradeoff.knob, tradeoff.error, tradeoff.unit, tradeoff.reference)
    levels = () if tradeoff.levels is None else tradeoff.levels(state)
    floor = None if copying is None else copying.ns_per_byte * (tradeoff.moved_bytes or 0)
    return Result(*named, repeats, seed, machine, mark_pareto(points), levels, floor)


def _judge(
    tradeoff: Tradeoff[State, Output], state: State, setting: Setting
) -> tuple[float, float | None, dict[str, float]]:
    """Error, modelled seconds and further figures of one setting."""
    output = tradeoff.run(state, setting)
    modelled = None if tradeoff.modelled_s is None else tradeoff.modelled_s(state, setting, output)
    beside = {name: float(tell(state, setting, output)) for name, tell in tradeoff.beside.items()}
    return float(tradeoff.judge(state, setting, output)), modelled, beside


def _time_in_turn(
    tradeoff: Tradeoff[State, Output], state: State, repeats: int, copying: Copying | None
) -> list[list[tuple[float, float]]]:
    """(processor, wall) seconds by setting and round; every round starts at another setting."""
    count = len(tradeoff.settings)
    clocks: list[list[tuple[float, float]]] = [[] for _ in range(count)]
    for turn in range(repeats):
        if copying is not None:
            copying.run()
        for offset in range(count):
            number = (turn + offset) % count
            wall, cpu = time.perf_counter(), time.process_time()
            tradeoff.run(state, tradeoff.settings[number])
            clocks[number].append((time.process_time() - cpu, time.perf_counter() - wall))
    return clocks


def _point(
    tradeoff: Tradeoff[State, Output],
    state: State,
    number: int,
    judged: Sequence[tuple[float, float | None, dict[str, float]]],
    clocks: Sequence[Sequence[tuple[float, float]]],
) -> Point:
    cpu, wall = zip(*clocks[number], strict=True)
    (error, modelled, beside), first_modelled = judged[number], judged[0][1]
    prices = zip(cpu, (first for first, _ in clocks[0]), strict=True)
    if modelled is not None and first_modelled is not None:
        prices = zip((modelled,), (first_modelled,), strict=True)
    ratios = [own / first for own, first in prices if first > 0]
    return Point(
        setting=tradeoff.settings[number],
        error=error,
        work=tradeoff.work(state, tradeoff.settings[number]),
        cpu_min_s=min(cpu),
        cpu_median_s=statistics.median(cpu),
        wall_min_s=min(wall),
        wall_median_s=statistics.median(wall),
        ratio=statistics.median(ratios) if ratios else math.nan,
        modelled_s=modelled,
        beside=beside,
    )


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
