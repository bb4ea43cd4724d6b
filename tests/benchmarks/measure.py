"""Measurements of the benchmarks: processor time of calls in turn on one thread, memory, and the rows of a table."""

from __future__ import annotations

import gc
import math
import os
import statistics
import textwrap
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Row:
    """One row of the table. ``met`` is None if there is no goal."""

    what: str
    figure: str
    goal: str = ""
    met: bool | None = None
    peers: str = ""


@dataclass(frozen=True)
class Timing:
    """Seconds of one call in each round, by the processor's clock and by the wall clock."""

    cpu_s: tuple[float, ...]
    wall_s: tuple[float, ...]

    @property
    def cpu_min_s(self) -> float:
        """Least processor time [s]."""
        return min(self.cpu_s)


def data_folder(name: str) -> Path:
    """Return the folder of a real data set, which may be absent: $SPECTRALZOOM_DATA, or shared/data by the checkout."""
    return Path(os.environ.get("SPECTRALZOOM_DATA", ROOT.parent / "shared" / "data")) / name


def not_run(what: str, folder: Path) -> Row:
    """Return a row for a benchmark whose data are missing."""
    return Row(what, f"not run: no {folder}, set SPECTRALZOOM_DATA")


def time_in_turn(calls: Mapping[str, Callable[[], object]], rounds: int = 5) -> dict[str, Timing]:
    """Time calls round by round, after one untimed run of each; every round begins with another call."""
    for call in calls.values():
        call()
    names = list(calls)
    spent: dict[str, list[tuple[float, float]]] = {name: [] for name in names}
    for turn in range(rounds):
        first = turn % len(names)
        for name in names[first:] + names[:first]:
            gc.collect()
            wall, cpu = time.perf_counter(), time.process_time()
            calls[name]()
            spent[name].append((time.process_time() - cpu, time.perf_counter() - wall))
    return {name: Timing(*map(tuple, zip(*pairs, strict=True))) for name, pairs in spent.items()}


def ratio(clocks: Mapping[str, Timing], of: str, to: str) -> float:
    """Return the median over the rounds of one call's processor time over another's. Load hardly changes it."""
    pairs = zip(clocks[of].cpu_s, clocks[to].cpu_s, strict=True)
    return statistics.median([own / other for own, other in pairs if other > 0] or [math.nan])


def ns_of(clock: Timing, values: float) -> float:
    """Return the least processor time per value. [ns]"""
    return clock.cpu_min_s / values * 1e9


def aligned(cells: Sequence[Sequence[str]], most: Sequence[int]) -> str:
    """Return rows of texts, the first of them headings, in aligned columns; longer texts are wrapped."""
    widths = [min(width, max(len(line[column]) for line in cells)) for column, width in enumerate(most)]
    lines = []
    for cell in cells:
        columns = [textwrap.wrap(text, width) or [""] for text, width in zip(cell, widths, strict=True)]
        lines += [
            "  ".join(f"{text:{width}}" for text, width in zip(line, widths, strict=True))
            for line in zip_longest(*columns, fillvalue="")
        ]
    lines.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join(line.rstrip() for line in lines)


def print_rows(rows: Sequence[Row]) -> None:
    """Print one row a line."""
    for row in rows:
        met = {True: "met", False: "NOT met", None: ""}[row.met]
        print("  ".join(text for text in (row.what, row.figure, row.goal, met, row.peers) if text))


def markdown_lines(cells: Sequence[Sequence[str]]) -> list[str]:
    """Return the rows as lines of a Markdown table."""
    lines = [f"| {' | '.join(text.replace('|', chr(92) + '|') for text in row)} |" for row in cells]
    return [lines[0], "|" + "---|" * len(cells[0]), *lines[1:]]
