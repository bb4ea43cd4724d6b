"""Which runs of lines to take: the best worth of whole seats for a price, over strips that share one budget.

Lagrangian duality makes it exact where it can be: for a price of worth per second the best runs of a strip are one
dynamic programme, and the plans so found are the corners of the budget's upper convex hull (Everett, 1963). Between
two corners the plan grows step by step. Every candidate is made without regard to the budget and then either fits or
does not; hence a bigger budget never buys less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Run = tuple[int, int]  # first line and the one after the last
SAME = 1e-9  # of the total worth: Lagrangian values closer than this are one
LEAST_RATE = 1e-10  # of the total worth over the whole price, to stand for "whatever it costs"
MOST_STEPS = 64
NEW_RUN_STARTS = 32


@dataclass(frozen=True)
class Wanted:
    """What one strip could show: seat i needs lines ``first[i]`` to ``stop[i]`` and is worth ``worth[i]`` > 0."""

    first: NDArray[np.intp]
    stop: NDArray[np.intp]
    worth: NDArray[np.float64]


@dataclass(frozen=True)
class Prices:
    """Seconds of a line, of opening a run, and of a reload that is due once every ``lines_per_reload`` lines."""

    line_s: float
    run_s: float
    reload_s: float
    lines_per_reload: int

    @property
    def even_line_s(self) -> float:
        """A line with its share of a reload: with this the price is additive, and below the true one by < a reload."""
        return self.line_s + self.reload_s / self.lines_per_reload

    def seconds(self, lines: int, runs: int) -> float:
        """True price of so many lines in so many runs [s]."""
        return lines * self.line_s + runs * self.run_s + -(-lines // self.lines_per_reload) * self.reload_s

    def even_seconds(self, lines: int, runs: int) -> float:
        """Additive price [s]."""
        return lines * self.even_line_s + runs * self.run_s


@dataclass(frozen=True)
class Plan:
    """Runs per strip, ascending and apart, with their worth, lines and additive price."""

    runs: tuple[tuple[Run, ...], ...]
    worth: float
    even_s: float

    @property
    def lines(self) -> int:
        """Lines of all runs."""
        return sum(stop - first for strip in self.runs for first, stop in strip)

    def seconds(self, prices: Prices) -> float:
        """True price [s]."""
        return prices.seconds(self.lines, sum(map(len, self.runs)))


@dataclass(frozen=True)
class _Step:
    strip: int
    run: Run
    gain: float
    even_s: float


def best_runs(wanted: Wanted, line_price: float, run_price: float) -> tuple[Run, ...]:
    """Find the runs of one strip with the greatest worth less price, exactly.

    best(e) = max(best(e'), max over c of best(c) + V(c, e) - (e - c) line_price - run_price), V(c, e) the worth of the
    seats whose lines lie in c..e. Only seats' first lines can open a run and only their stops can close one; V grows
    with e by an update of all c at once. Prices are in units of worth.
    """
    if not len(wanted.first):
        return ()
    starts = np.unique(wanted.first)
    opened = np.searchsorted(starts, wanted.first) + 1
    order = np.argsort(wanted.stop, kind="stable")
    stops, heads = np.unique(wanted.stop[order], return_index=True)
    ready = np.searchsorted(starts, stops, side="left")
    value = np.full(len(starts), -np.inf)
    best, closed, back = 0.0, 0, np.zeros(len(starts), np.intp)
    chain: list[tuple[Run, int]] = []  # a run and the chain entry before it; entry 0 is no run at all
    top, worths, reach = 0, wanted.worth[order].tolist(), opened[order].tolist()
    tails = np.append(heads[1:], len(order)).tolist()
    for stop, head, tail, known in zip(stops.tolist(), heads.tolist(), tails, ready.tolist(), strict=True):
        value[closed:known] = best + line_price * starts[closed:known] - run_price
        back[closed:known] = top
        closed = known
        for seat in range(head, tail):
            value[: reach[seat]] += worths[seat]
        pick = int(value[:known].argmax())
        net = float(value[pick]) - line_price * stop
        if net > best:
            chain.append(((int(starts[pick]), stop), int(back[pick])))
            best, top = net, len(chain)
    runs: list[Run] = []
    while top:
        run, top = chain[top - 1]
        runs.append(run)
    return tuple(reversed(runs))


def plan_runs(wanted: Sequence[Wanted], prices: Prices, budget_s: float) -> Plan:
    """Choose the runs of all strips with the most worth found whose true price is within ``budget_s``.

    Exact at the corners of the hull; between two the shortfall is less than the worth between them.
    """
    nothing = Plan(tuple(() for _ in wanted), 0.0, 0.0)
    total = float(sum(strip.worth.sum() for strip in wanted))
    if total <= 0:
        return nothing
    span = sum(int(strip.stop.max()) for strip in wanted if len(strip.stop))
    everything = _solve(wanted, prices, LEAST_RATE * total / prices.even_seconds(span, len(wanted)))
    if everything.seconds(prices) <= budget_s:
        return everything
    best = nothing
    for low, high in _corners(wanted, prices, (nothing, everything), budget_s, total):
        for plan in (high, *_grow(wanted, prices, low, high, budget_s)):
            if plan.worth > best.worth and plan.seconds(prices) <= budget_s:
                best = plan
    return best


def _solve(wanted: Sequence[Wanted], prices: Prices, rate: float) -> Plan:
    """Best plan when a second costs ``rate`` of worth."""
    return _priced(wanted, prices, [best_runs(s, rate * prices.even_line_s, rate * prices.run_s) for s in wanted])


def _priced(wanted: Sequence[Wanted], prices: Prices, runs: Sequence[tuple[Run, ...]]) -> Plan:
    worth = sum(float(s.worth[_covered(s, r)].sum()) for s, r in zip(wanted, runs, strict=True))
    lines = sum(stop - first for strip in runs for first, stop in strip)
    return Plan(tuple(runs), worth, prices.even_seconds(lines, sum(map(len, runs))))


def _covered(wanted: Wanted, runs: Sequence[Run]) -> NDArray[np.bool_]:
    """Which seats lie in one of the runs, (seat,)."""
    if not runs:
        return np.zeros(len(wanted.first), bool)
    firsts, stops = np.array(runs).T
    last = np.searchsorted(firsts, wanted.first, side="right") - 1
    inside: NDArray[np.bool_] = (last >= 0) & (wanted.stop <= stops[last])
    return inside


def _corners(
    wanted: Sequence[Wanted], prices: Prices, ends: tuple[Plan, Plan], budget_s: float, total: float
) -> list[tuple[Plan, Plan]]:
    """Neighbouring corners of the hull whose edge could hold the best plan within the budget."""
    found: list[tuple[Plan, Plan]] = []
    open_edges = [ends]
    while open_edges:
        low, high = open_edges.pop()
        if low.even_s > budget_s or high.even_s <= budget_s - prices.reload_s or high.even_s <= low.even_s:
            continue
        rate = (high.worth - low.worth) / (high.even_s - low.even_s)
        between = _solve(wanted, prices, rate)
        above = (between.worth - low.worth) - rate * (between.even_s - low.even_s)
        if above <= SAME * total or not low.even_s < between.even_s < high.even_s:
            found.append((low, high))
        else:
            open_edges += [(low, between), (between, high)]
    return found


def _grow(wanted: Sequence[Wanted], prices: Prices, low: Plan, high: Plan, budget_s: float) -> list[Plan]:
    """Grow a corner towards the next by the steps that give most per second, and end each with the last that fits.

    The chain of steps does not know the budget, and no plan costs more than the next corner: both are needed for the
    law that a bigger budget never buys less.
    """
    plan, plans = low, [low]
    for _ in range(MOST_STEPS):
        steps = [step for strip in range(len(wanted)) for step in _steps(wanted[strip], prices, plan, strip)]
        steps = [step for step in steps if plan.even_s + step.even_s <= high.even_s]
        fitting = [step for step in steps if _fits(plan, step, prices, budget_s)]
        if fitting:
            plans.append(_taken(wanted, prices, plan, max(fitting, key=lambda step: (step.gain, -step.even_s))))
        if not steps:
            break
        plan = _taken(wanted, prices, plan, max(steps, key=lambda step: step.gain / max(step.even_s, prices.line_s)))
        if plan.even_s > budget_s:
            break
        plans.append(plan)
    return plans


def _fits(plan: Plan, step: _Step, prices: Prices, budget_s: float) -> bool:
    runs = _joined(plan.runs[step.strip], step.run)
    count = sum(map(len, plan.runs)) - len(plan.runs[step.strip]) + len(runs)
    lines = plan.lines + sum(b - a for a, b in runs) - sum(b - a for a, b in plan.runs[step.strip])
    return prices.seconds(lines, count) <= budget_s


def _taken(wanted: Sequence[Wanted], prices: Prices, plan: Plan, step: _Step) -> Plan:
    runs = list(plan.runs)
    runs[step.strip] = _joined(runs[step.strip], step.run)
    return _priced(wanted, prices, runs)


def _joined(runs: Sequence[Run], more: Run) -> tuple[Run, ...]:
    """Runs with one more, merged with those that it meets."""
    first, stop = more
    meets = [run for run in runs if run[0] <= stop and run[1] >= first]
    apart = [run for run in runs if run not in meets]
    whole = (min([first, *(run[0] for run in meets)]), max([stop, *(run[1] for run in meets)]))
    return tuple(sorted([*apart, whole]))


def _steps(wanted: Wanted, prices: Prices, plan: Plan, strip: int) -> list[_Step]:
    """Ways to go on in one strip: carry a run on, begin it earlier, join it to the next, or open a new one."""
    if not len(wanted.first):
        return []
    runs = plan.runs[strip]
    left = np.where(_covered(wanted, runs), 0.0, wanted.worth)
    end = int(wanted.stop.max())
    walls = [0, *(stop for _, stop in runs)], [*(first for first, _ in runs), end]
    grown: list[tuple[Run, float, float]] = []
    for place, (after, before) in enumerate(zip(*walls, strict=True)):
        opens, closes = place < len(runs), place > 0
        if closes:
            grown += _later(wanted, left, runs[place - 1][0], (after, before), prices.even_line_s)
        if opens:
            grown += _earlier(wanted, left, runs[place][1], (after, before), prices.even_line_s)
        if opens and closes:
            run = runs[place - 1][0], runs[place][1]
            inside = (wanted.first >= run[0]) & (wanted.stop <= run[1])
            price = (before - after) * prices.even_line_s - prices.run_s
            grown.append((run, float(left[inside].sum()), price))
        gap = np.flatnonzero((left > 0) & (wanted.first >= after) & (wanted.stop <= before))
        richest = gap[np.argsort(-left[gap], kind="stable")[:NEW_RUN_STARTS]]
        for first in np.unique(wanted.first[richest]).tolist():
            fresh = _later(wanted, left, first, (first, before), prices.even_line_s)
            grown += [(run, gain, price + prices.run_s) for run, gain, price in fresh]
    return [_Step(strip, run, gain, price) for run, gain, price in grown if gain > 0]


def _later(
    wanted: Wanted, left: NDArray[np.float64], first: int, gap: Run, line_s: float
) -> list[tuple[Run, float, float]]:
    """Every later end of the run from ``first`` inside ``gap``: run, worth gained, seconds more."""
    seats = np.flatnonzero((left > 0) & (wanted.first >= first) & (wanted.stop > gap[0]) & (wanted.stop <= gap[1]))
    seats = seats[np.argsort(wanted.stop[seats], kind="stable")]
    stops, gains = wanted.stop[seats], np.cumsum(left[seats])
    last = np.flatnonzero(np.append(np.diff(stops) > 0, True))[: len(stops)]
    ends = zip(stops[last].tolist(), gains[last].tolist(), strict=True)
    return [((first, stop), gain, (stop - gap[0]) * line_s) for stop, gain in ends]


def _earlier(
    wanted: Wanted, left: NDArray[np.float64], stop: int, gap: Run, line_s: float
) -> list[tuple[Run, float, float]]:
    """Every earlier start of the run to ``stop`` inside ``gap``: run, worth gained, seconds more."""
    mirrored = Wanted(-wanted.stop, -wanted.first, wanted.worth)
    found = _later(mirrored, left, -stop, (-gap[1], -gap[0]), line_s)
    return [((-b, -a), gain, seconds) for (a, b), gain, seconds in found]
