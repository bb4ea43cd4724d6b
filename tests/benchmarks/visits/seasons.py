"""Whole fields looked at quickly, by the memory and by everybody else: after some days, and for a season."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from measure import Row
from numpy.typing import NDArray
from visits.farm_visits import (
    ANEW,
    FIRST_DAY,
    HOUR,
    QUICK,
    REFERENCE,
    SEASON,
    SEEDS,
    Classes,
    Seen,
    later,
    mean_figure,
    shipped,
    view_farm,
)

from models.evaluation.metrics import confusion
from models.reading.prior_map import ClassProbabilities, first_probabilities

SIX = (1, 2, 3, 4, 5, 6)
BEHIND = {1: 0.2, 3: 0.5, 7: 1.0}  # points of mIoU that a later visit may lie behind one that scans anew, by days
HELD = (2, 3, 4)  # visits from one full scan to the next
SURE = 0.97
REVISITED, REVISITED_DAYS = range(71, 79), (110, 172, 255)  # farms; days of April, June and September


def after_days() -> Iterator[Row]:
    """A quick look after some days, by the memory and by everybody else."""
    found: dict[int, dict[str, list[float]]] = {}
    for seed in SIX:
        before = view_farm(seed, FIRST_DAY, HOUR, ANEW)
        for days in BEHIND:
            now, anew = (view_farm(seed, FIRST_DAY + days, HOUR, how, 1) for how in (QUICK, ANEW))
            maps = {
                f"scanned anew, {anew.seconds:.1f} s": anew.alone,
                "old map kept": before.alone,
                f"quick look alone, {now.seconds:.1f} s": now.alone,
                "old class unless surer than .97": _unless_surer(before, now),
                "memory without a reader": later(
                    before, first_probabilities(before.observation), now, days, reader=False
                ),
                "memory left by weights of other coarse pixels": later(
                    before, first_probabilities(before.observation), now, days, comparable=False
                ),
                "memory": later(before, first_probabilities(before.observation), now, days),
            }
            scores = found.setdefault(days, {})
            for name, one in maps.items():
                classes = one.classes()[0] if isinstance(one, ClassProbabilities) else one
                scores.setdefault(name, []).append(now.score(classes))
    for days, scores in found.items():
        anew = next(values for name, values in scores.items() if name.startswith("scanned anew"))
        for name, values in scores.items():
            least = max(np.mean(anew) - BEHIND[days], np.mean(scores["old map kept"]))
            goal = (f">= {least:.1f}", bool(np.mean(values) >= least)) if name == "memory" else ("", None)
            yield Row(f"{days} d later, {name}", mean_figure(values), *goal)


def revisits() -> Iterator[Row]:
    """Yield the fraction of the gap between a quick scan and a full one that the prior map closes after a week."""
    closed, worst = list[float](), list[float]()
    for day in REVISITED_DAYS:
        scores: dict[str, list[float]] = {"old": [], "quick": [], "fused": [], "full": []}
        for seed in REVISITED:
            before, now, full = (
                view_farm(seed, when, HOUR, how, noise)
                for when, how, noise in ((day, ANEW, 0), (day + 7, QUICK, 1), (day + 7, ANEW, 1))
            )
            fused = later(before, first_probabilities(before.observation), now, 7).classes()[0]
            for name, one in zip(scores, (before.alone, now.alone, fused, full.alone), strict=True):
                scores[name].append(now.score(one))
            quick, both, best = (scores[name][-1] for name in ("quick", "fused", "full"))
            closed.append(100 * (both - quick) / (best - quick))
            worst.append(float(np.nanmin(_class_ious(now, fused) - _class_ious(now, now.alone))))
        figures = ", ".join(f"{name} {np.mean(each):.1f}" for name, each in scores.items())
        mine = closed[-len(REVISITED) :]
        yield Row(f"a week after day {day}, mIoU", figures, "", None)
        yield Row(f"a week after day {day}, gap closed [%]", f"{np.mean(mine):.0f}, least {min(mine):.0f}", "", None)
    met = float(np.mean(closed)) >= 65 and min(closed) >= 45
    yield Row("gap closed, all [%]", f"{np.mean(closed):.0f}, least {min(closed):.0f}", "65, least 45", met)
    yield Row("worst class against the quick scan alone", f"{min(worst):+.1f} points", ">= -1", min(worst) >= -1)


def _class_ious(now: Seen, classes: Classes) -> NDArray[np.float64]:
    """Return the IoU of each class [points]; NaN for a class that the labels lack."""
    counts = confusion(now.labels, classes, len(shipped().class_names)).astype(np.float64)
    right = np.diag(counts)
    union = counts.sum(axis=0) + counts.sum(axis=1) - right
    return np.where(counts.sum(axis=1) > 0, 100 * right / np.maximum(union, 1), np.nan)


def _unless_surer(before: Seen, now: Seen) -> Classes:
    """The old class, unless the new look is surer than .97 of another."""
    classes, sure = first_probabilities(now.observation).classes()
    return np.where(sure > SURE, classes, before.alone)


def season() -> Iterator[Row]:
    """Thirty visits, the mean of their maps, beside full scans made as often as the same seconds allow."""
    found: dict[str, list[float]] = {}
    seconds: dict[str, float] = {}

    def note(name: str, scores: Sequence[float], spent: float) -> None:
        found.setdefault(name, []).append(float(np.mean(scores)))
        seconds[name] = spent

    for seed in SEEDS:
        full = [view_farm(seed, *moment, REFERENCE) for moment in SEASON]
        quick = [full[0], *(view_farm(seed, *moment, QUICK, 1) for moment in SEASON[1:])]
        every, fast = full[0].seconds, quick[1].seconds
        note("full scan at every visit", [one.score(one.alone) for one in full], every)
        note("quick look at every visit, nothing remembered", [one.score(one.alone) for one in quick], fast)
        note("quick looks and the memory", _prior_map(quick), fast)
        note("quick looks, memory without a reader", _prior_map(quick, reader=False), fast)
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
        yield Row(f"season, {name}: {seconds[name]:.1f} s a visit", mean_figure(values), *goal)


def _prior_map(scan_passes: Sequence[Seen], *, reader: bool = True) -> list[float]:
    """Scores of a season's maps, each by the memory of all looks before it."""
    probabilities, scores = (
        first_probabilities(scan_passes[0].observation),
        [scan_passes[0].score(scan_passes[0].alone)],
    )
    moments = [day + hour / 24 for day, hour in SEASON]
    for number in range(1, len(scan_passes)):
        days = moments[number] - moments[number - 1]
        probabilities = later(scan_passes[number - 1], probabilities, scan_passes[number], days, reader=reader)
        scores.append(scan_passes[number].score(probabilities.classes()[0]))
    return scores
