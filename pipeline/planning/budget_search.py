"""Search for the cover of most expected gain within a budget of seconds, over falling prices of a second.

Covers are computed independently of the budget, from the highest price of a second down. A larger budget chooses
among more of them, so that it never has less gain.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from pipeline.planning.scan_runs import NEGLIGIBLE, Cover, Field, Floats, ScanRun, best_cover, joined

HALVINGS = 4
PEELS = 8
MOST_STEPS = 40
RATE_SLACK = 1e-9
STEP = 0.88  # from one price of a second to the next
WIDE_STEP = 0.7
LEAST_RATE = 1e-10  # of the total gain over the time of all lines: a price at which every line pays


def spend(field: Field, budget_s: float) -> Cover:
    """Choose the runs with the most expected gain whose exact time is at most ``budget_s``.

    The budget lies between two covers; bisection of the price of a second narrows them. The remaining time goes to one
    more run, or to one longer run. ``expected_gain`` counts at least the patches that the runs were chosen for.
    """
    low, low_rate = Cover(), np.inf
    best = low
    for high, rate in covers(field):
        if high.seconds(field.prices) > budget_s:
            return _better(best, _between(field, (low, high), (low_rate, rate), budget_s))
        low, low_rate, best = high, rate, _better(best, high)
    return best


def _better(one: Cover, other: Cover) -> Cover:
    return other if other.expected_gain > one.expected_gain else one


def _between(field: Field, covers: tuple[Cover, Cover], rates: tuple[float, float], budget_s: float) -> Cover:
    """Narrow the interval from a cover within the budget to one above it.

    No cover with more gain than the one above is taken: a larger budget would not find it.
    """
    (low, high), (low_rate, high_rate) = covers, rates
    best = low
    for _ in range(HALVINGS):
        rate = float(np.sqrt(low_rate * high_rate)) if np.isfinite(low_rate) else high_rate / STEP
        middle = best_cover(field, low.runs, rate)
        prices = [cover.seconds(field.prices) for cover in (low, middle, high)]
        if not (low.expected_gain < middle.expected_gain < high.expected_gain and prices[0] < prices[1] < prices[2]):
            break
        if prices[1] <= budget_s:
            low, low_rate, best = middle, rate, _better(best, middle)
        else:
            high, high_rate = middle, rate
    for cover in (low, *_peeled(field, high)):
        for found in (cover, _one_more(field, cover, budget_s)):
            if found.seconds(field.prices) <= budget_s:
                best = _better(best, replace(found, expected_gain=min(found.expected_gain, high.expected_gain)))
    return best


def _peeled(field: Field, cover: Cover) -> Iterator[Cover]:
    """Yield ever smaller covers: whole runs or their ends are removed, those with the least gain per second first."""
    for _ in range(PEELS):
        patch_index, times = np.unique(
            np.concatenate([field.shown_patches(run) for run in cover.runs]), return_counts=True
        )
        own = np.zeros(len(field.expected_gain))
        own[patch_index[times == 1]] = field.expected_gain[patch_index[times == 1]]
        cuts = [(cut, place) for place, run in enumerate(cover.runs) for cut in _cuts(field, run, own)]
        (_, rest), place = min(cuts, key=lambda cut: cut[0][0])
        cover = field.cover([*cover.runs[:place], *rest, *cover.runs[place + 1 :]])
        if not cover.runs:
            return
        yield cover


def _cuts(field: Field, run: ScanRun, own: Floats) -> list[tuple[float, list[ScanRun]]]:
    """Return ways to shorten a run from its start, from its end, and to drop it: gain lost per second, and the rest."""
    views, prices = field.shown(run), field.prices
    expected_gain = own[field.views.patch_number[views]]
    whole = prices.even_seconds(run.stop - run.first, 1)
    found: list[tuple[float, list[ScanRun]]] = [(float(expected_gain.sum()) / whole, [])]
    for from_start in (True, False):
        away = field.views.first[views] - run.first if from_start else run.stop - field.views.stop[views]
        order = np.argsort(away, kind="stable")
        saved, lost = away[order][1:], np.cumsum(expected_gain[order])[:-1]  # without the views before each one
        if not np.any(saved > 0):
            continue
        density = np.where(saved > 0, lost / np.maximum(saved * prices.even_line_s, prices.line_s), np.inf)
        best = int(density.argmin())
        cut = int(saved[best])
        rest = replace(run, first=run.first + cut) if from_start else replace(run, stop=run.stop - cut)
        found.append((float(density[best]), [rest]))
    return found


def covers(field: Field) -> Iterator[tuple[Cover, float]]:
    """Yield covers and the price of a second [gain/s] that they are best for, falling; the last shows all patches."""
    cover = Cover()
    if field.total <= 0:
        return
    step = STEP if len(field.windows) == 1 else WIDE_STEP
    rate, least, still = _first_rate(field), _least_rate(field), 0
    while rate > least and cover.expected_gain < field.total * (1 - NEGLIGIBLE):
        found = best_cover(field, cover.runs, rate)
        still = still + 1 if found.runs == cover.runs else 0
        cover = found
        if not still:
            yield cover, rate
        rate *= step ** (2**still)
    if cover.expected_gain < field.total * (1 - NEGLIGIBLE):
        yield field.cover(_completed(field, cover.runs)), rate


def _first_rate(field: Field) -> float:
    """Return the largest gain per second of a single run (Dinkelbach, 1967)."""
    tables, prices = field.tables(field.expected_gain), field.prices
    seconds = prices.even_line_s * tables.unit * np.arange(tables.closed.shape[1])
    rate = 0.0
    for _ in range(MOST_STEPS):
        toll = tables.begun - rate * seconds
        net = tables.closed - rate * seconds - np.minimum.accumulate(toll, axis=1)
        swath, stop = (int(at) for at in np.unravel_index(int(net.argmax()), net.shape))
        if net[swath, stop] <= 0:
            break
        first = int(toll[swath, : stop + 1].argmin())
        if first == stop:  # only rounding is left
            break
        expected_gain = float(tables.closed[swath, stop] - tables.begun[swath, first])
        density = expected_gain / float(seconds[stop] - seconds[first] + prices.run_s)
        if density <= rate * (1 + RATE_SLACK):
            break
        rate = density
    return rate


def _least_rate(field: Field) -> float:
    """Return a price of a second at which every patch pays."""
    every = field.prices.even_seconds(field.views.lines * len(field.side_by_side), len(field.side_by_side))
    lowest = float(field.expected_gain[field.expected_gain > 0].min(initial=field.total))
    return max(LEAST_RATE * field.total, lowest / 2) / max(every, field.prices.line_s)


def _one_more(field: Field, cover: Cover, budget_s: float) -> Cover:
    """Spend the remaining time on one more run or one longer run, whichever shows more."""
    prices, views, runs = field.prices, field.views, list(cover.runs)
    tables = field.tables(field.left(runs))
    options: list[tuple[float, list[ScanRun]]] = []
    cells = (prices.most_lines(budget_s, len(runs) + 1) - cover.lines) // tables.unit
    if cells > 0:
        cells = min(cells, tables.closed.shape[1] - 1)
        gain = tables.closed[:, cells:] - tables.begun[:, : tables.begun.shape[1] - cells]
        swath, at = (int(place) for place in np.unravel_index(int(gain.argmax()), gain.shape))
        new = ScanRun(swath, at * tables.unit, (at + cells) * tables.unit)
        options.append((float(gain[swath, at]), [*runs, new]))
    lines = prices.most_lines(budget_s, len(runs)) - cover.lines
    for place, run in enumerate(runs if lines > 0 else []):
        for grown in (ScanRun(run.swath, run.first, run.stop + lines), ScanRun(run.swath, run.first - lines, run.stop)):
            first, stop = max(grown.first, 0), min(grown.stop, views.lines)
            at, end = -(-first // tables.unit), stop // tables.unit
            gained = float(tables.closed[run.swath, end] - tables.begun[run.swath, at])
            options.append((gained, [*runs[:place], ScanRun(run.swath, first, stop), *runs[place + 1 :]]))
    if not options:
        return cover
    gained, chosen = max(options, key=lambda option: option[0])
    if gained <= NEGLIGIBLE * field.total:
        return cover
    chosen = field.trimmed(joined(chosen, 0), field.expected_gain)
    found = field.cover(chosen)
    return Cover(found.runs, cover.expected_gain + gained, found.even_s)


def _completed(field: Field, runs: Sequence[ScanRun]) -> list[ScanRun]:
    """Add, for each patch that no run shows, the shortest run that does."""
    views, found = field.views, list(runs)
    lengths = views.stop - views.first
    order = np.lexsort((np.arange(len(lengths)), lengths, views.patch_number))
    shortest = order[np.unique(views.patch_number[order], return_index=True)[1]]
    left = field.left(found)
    for view in shortest[left[views.patch_number[shortest]] > 0].tolist():
        swath = int(np.searchsorted(views.edges, view, side="right")) - 1
        found.append(ScanRun(swath, int(views.first[view]), int(views.stop[view])))
    return joined(found, field.gap)
