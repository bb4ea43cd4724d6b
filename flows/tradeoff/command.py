"""What `spectralzoom tradeoff` shows: for each stage a table (to be right to X you pay Y), JSON and a plot."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

import flows.tradeoff.farm
import flows.tradeoff.rectify
import flows.tradeoff.simulate
import flows.tradeoff.simulate_light
import flows.tradeoff.simulate_noise  # noqa: F401 - each registers its entries
from flows.terminal.figures import format_seconds
from flows.tradeoff.entries import Point, Result, cheapest_within, find_tradeoffs, measure_tradeoff, registered
from flows.tradeoff.plots import draw_tradeoffs
from pipeline.errors import ArchiveError, SettingsError


def print_tradeoff(result: Result, console: Console) -> None:
    """Print the settings from the most to the least exact; those that no other beats are marked."""
    points = sorted(result.points, key=lambda point: point.error)
    rows, figures = [_row(point) for point in points], ("error", *result.points[0].beside)
    narrow = len(figures) > 1
    table = Table(
        title=f"{escape(result.stage)}, {escape(result.knob)}: to be right to ... you pay ...",
        title_justify="left",
        title_style="bold",
        header_style="dim",
        box=SIMPLE_HEAD,
        caption=_caption(result),
        caption_justify="left",
        collapse_padding=narrow,
    )
    walls = () if narrow else ("wall, least", "wall, median")
    for number, name in enumerate(("", result.knob, *figures, f"per {result.unit}", "price", "x first", *walls)):
        left, whole = number < 2, 0 < number < 2 + len(figures)
        heading = name.replace(" ", "\n") if narrow and not left else name
        least = max(len(word) for word in (*heading.split(), *(row[number] for row in rows))) if whole else 1
        table.add_column(escape(heading), justify="left" if left else "right", min_width=least)
    for row, point in zip(rows, points, strict=True):
        table.add_row(*map(escape, row), style="" if point.pareto else "dim")
    console.print(table)


def _row(point: Point) -> list[str]:
    walls = [] if point.beside else [_short(seconds) for seconds in (point.wall_min_s, point.wall_median_s)]
    times = [_short(point.ns_per_unit * 1e-9), _short(point.price_s), f"{point.ratio:.2f}", *walls]
    further = [f"{one:.2g}" for one in point.beside.values()]
    return ["●" if point.pareto else "○", str(point.setting), f"{point.error:.3g}", *further, *times]


def _short(seconds: float) -> str:
    """A time with three figures in the unit that suits it."""
    for size, unit in ((1e-3, "ms"), (1e-6, "µs"), (1e-9, "ns")):
        if size <= seconds < 1:
            return f"{seconds / size:.3g} {unit}"
    return format_seconds(seconds) if seconds >= 1 else f"{seconds * 1e9:.3g} ns"


def _caption(result: Result) -> str:
    machine, floors = result.machine, ""
    priced = "the cost model" if any(point.modelled_s is not None for point in result.points) else "processor time"
    for level in result.levels:
        point = cheapest_within(result, level.error)
        found = "no setting" if point is None else f"{point.setting}, {_short(point.ns_per_unit * 1e-9)}"
        floors += f"within {level.name} ({level.error:.2g}): {found}\n"
    if result.memory_floor_ns is not None:
        floors += f"copying the bytes of a {result.unit} alone: {_short(result.memory_floor_ns * 1e-9)}\n"
    rounds = f"{result.repeats} repeat{'s' if result.repeats > 1 else ''} in turn"
    words = (
        f"error: {result.error}, against {result.reference}; price: {priced}; ● no other setting beats it\n{floors}"
        f"{rounds}, {machine['threads']} thread, load {machine['load_before']} to {machine['load_after']}, "
        f"{machine['processor']}"
    )
    return escape(words)


def run_tradeoff(stage: str | None, out: Path, repeats: int, seed: int, console: Console) -> dict[str, Any]:
    """Measure the trade-offs of one stage, or all; write tradeoff.json and .png into ``out`` and print the tables."""
    if repeats < 1:
        raise SettingsError(f"--repeats must be at least 1, got {repeats}")
    if seed < 0:
        raise SettingsError(f"--seed must be 0 or more, got {seed}")
    wanted = find_tradeoffs(stage) if stage else tuple(registered().values())
    with _writing(out):
        out.mkdir(parents=True, exist_ok=True)  # before minutes are spent on what cannot be kept
    results = []
    for tradeoff in wanted:
        with console.status(f"measuring {tradeoff.stage}: {tradeoff.knob}"):
            result = measure_tradeoff(tradeoff, repeats=repeats, seed=seed)
        print_tradeoff(result, console)
        results.append(result)
    content = {"tradeoffs": [result.to_dict() for result in results]}
    with _writing(out):
        (out / "tradeoff.json").write_text(json.dumps(content, indent=2, allow_nan=False) + "\n")
        draw_tradeoffs(out / "tradeoff.png", results)
    console.print(f"{out / 'tradeoff.json'}\n{out / 'tradeoff.png'}", highlight=False, soft_wrap=True)
    return content


@contextmanager
def _writing(out: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise ArchiveError(f"cannot write to {out}: {error.strerror}; choose another --out") from error
