"""What `spectralzoom tradeoff` shows: tables (to be right to X you pay Y), JSON, plots of error against time."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter, NullLocator
from matplotlib.transforms import Bbox, blended_transform_factory
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

import flows.tradeoff.farm
import flows.tradeoff.plans
import flows.tradeoff.rectify
import flows.tradeoff.simulate
import flows.tradeoff.simulate_light  # noqa: F401 - each registers its entries
from flows.publish.panels import GRID, INK, MUTED, PAPER, save_png
from flows.terminal.figures import format_seconds
from flows.terminal.processes import writing
from flows.tradeoff.entries import Point, Result, cheapest_within, find_tradeoffs, measure_tradeoff, registered
from pipeline.errors import SettingsError


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
    wanted = find_tradeoffs(stage) if stage else sorted(registered().values(), key=lambda one: one.stage)
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)  # before minutes are spent on what cannot be kept
    results = []
    for tradeoff in wanted:
        with console.status(f"measuring {tradeoff.stage}: {tradeoff.knob}"):
            result = measure_tradeoff(tradeoff, repeats=repeats, seed=seed)
        print_tradeoff(result, console)
        results.append(result)
    content = {"tradeoffs": [result.to_dict() for result in results]}
    with writing(out):
        (out / "tradeoff.json").write_text(json.dumps(content, indent=2, allow_nan=False) + "\n")
        draw_tradeoffs(out / "tradeoff.png", results)
    console.print(f"{out / 'tradeoff.json'}\n{out / 'tradeoff.png'}", soft_wrap=True)
    return content


_FRONT: Any = {"marker": "o", "color": "#0072B2", "markersize": 9, "label": "no other setting beats it"}
_BEATEN: Any = {"marker": "o", "color": MUTED, "markersize": 9, "fillstyle": "none", "label": "beaten"}
_LEVELS = ("#D55E00", "#A23B72")
_FAMILIES = ("#0072B2", "#007A5A", "#8a6d00", "#D55E00", "#A23B72")
_FLOOR = "#007A5A"
_ACROSS = 3  # panels in a row
_UNITS = ((1e6, "ms"), (1e3, "µs"), (1.0, "ns"))
_SIDES = tuple(((x, y), "left" if x > 0 else "right", "bottom" if y > 0 else "top") for x in (6, -6) for y in (5, -5))
_DOT = 11.0  # pixels across a mark
_SAME = 8  # pixels of the figure apart: a mark lies on another
_ROOM, _RIGHT_ROOM = 0.18, 0.28  # of the range of the logarithms, beyond points and floors


def draw_tradeoffs(path: str | Path, results: Sequence[Result]) -> None:
    """Draw one panel for each trade-off into a PNG file."""
    save_png(tradeoff_figure(results), path)


def tradeoff_figure(results: Sequence[Result]) -> Figure:
    """Give a figure of one panel for each trade-off: points that no other beats filled and joined, others hollow."""
    across = min(_ACROSS, len(results))
    down = -(-len(results) // across)
    figure = Figure(figsize=(6.0 * across, 4.9 * down + 0.5), dpi=120, layout="constrained", facecolor=PAPER)
    figure.get_layout_engine().set(w_pad=0.12, h_pad=0.12)  # type: ignore[union-attr, call-arg]
    panels = figure.subplots(down, across, squeeze=False).ravel()
    for axes, result in zip(panels, results, strict=False):
        _draw_tradeoff(axes, result)
    for axes in panels[len(results) :]:
        axes.set_axis_off()
    keys = [Line2D([], [], linewidth=1.4, **_FRONT), Line2D([], [], linewidth=0, **_BEATEN)]
    figure.legend(handles=keys, loc="outside lower center", ncols=2, frameon=False, labelcolor=INK)
    return figure


def _draw_tradeoff(axes: Axes, result: Result) -> None:
    points = [point for point in result.points if math.isfinite(point.error)]
    modelled = any(point.modelled_s is not None for point in result.points)
    least = min(point.ns_per_unit for point in result.points)
    fits = (one for one in _UNITS if least >= one[0])
    size, unit = (1.0, "s") if modelled else next(fits, _UNITS[-1])
    floor = None if result.memory_floor_ns is None else result.memory_floor_ns / size
    place = {id(one): ((one.price_s if modelled else one.ns_per_unit) / size, one.error) for one in points}
    exact = _logarithmic(axes, result, list(place.values()), floor or 0)
    place = {key: (x, y if y > 0 else exact) for key, (x, y) in place.items()}
    _draw_levels(axes, result, list(place.values()), floor)
    if floor is not None:
        _draw_memory_floor(axes, floor)
    if result.families:
        return _draw_families(axes, result, [(place[id(point)], point) for point in points])
    front = sorted((point for point in points if point.pareto), key=lambda point: point.price_s)
    for group, style, line in ((front, _FRONT, 1.4), ([p for p in points if not p.pareto], _BEATEN, 0)):
        x, y = ([place[id(point)][axis] for point in group] for axis in (0, 1))
        axes.plot(x, y, linewidth=line, zorder=3, **style)
    for at, together in _by_place(axes, [(place[id(point)], point) for point in points]):
        beside = (7, 7) if any(point.pareto for point in together) else (9, -4)
        axes.annotate(
            ", ".join(str(point.setting) for point in together),
            at,
            beside,
            textcoords="offset points",
            color=INK,
            size=10.5,
            zorder=4,
            path_effects=[withStroke(linewidth=3, foreground=PAPER)],
        )
    return _finish(axes, result, "seconds by the cost model" if modelled else f"{unit} / {result.unit}")


def _draw_families(axes: Axes, result: Result, placed: Sequence[tuple[tuple[float, float], Point]]) -> None:
    """One line a family, with its name in a legend and its members' at their points."""
    families: dict[str, list[tuple[tuple[float, float], Point]]] = {}
    named: list[tuple[tuple[float, float], str, str]] = []
    for place, point in placed:
        families.setdefault(str(point.setting).rpartition(", ")[0], []).append((place, point))
    for (name, members), colour in zip(families.items(), cycle(_FAMILIES), strict=False):
        members.sort(key=lambda one: one[0])
        axes.plot(*zip(*(at for at, _ in members), strict=True), color=colour, linewidth=1.4, label=name, zorder=2)
        for (x, y), point in members:
            fill = "full" if point.pareto else "none"
            axes.plot(x, y, marker="o", color=colour, markersize=8, fillstyle=fill, zorder=3)
            named.append(((x, y), str(point.setting).rpartition(", ")[2], colour))
    _name_points(axes, named)
    axes.legend(frameon=False, labelcolor="linecolor", fontsize=10)
    return _finish(axes, result, "seconds by the cost model")


def _name_points(axes: Axes, named: Sequence[tuple[tuple[float, float], str, str]]) -> None:
    """Write names of points, in their colours, on the first side of each where none of another point lies."""
    middles = [axes.transData.transform(at) for at, _, _ in named]
    dots = [Bbox([middle - _DOT / 2, middle + _DOT / 2]) for middle in middles]
    written: list[Bbox] = []
    for number, (at, name, colour) in enumerate(named):
        taken = [*written, *dots[:number], *dots[number + 1 :]]
        for beside, ha, va in _SIDES:
            text = axes.annotate(
                name,
                at,
                beside,
                textcoords="offset points",
                ha=ha,
                va=va,
                color=colour,
                size=8.5,
                zorder=4,
                path_effects=[withStroke(linewidth=2.5, foreground=PAPER)],
            )
            box = text.get_window_extent()
            if beside == _SIDES[-1][0] or not any(box.overlaps(other) for other in taken):
                written.append(box)
                break
            text.remove()


def _finish(axes: Axes, result: Result, across: str) -> None:
    """Title, names of the axes, and a quiet background."""
    axes.set_title(f"{result.stage}: {result.knob}", loc="left", weight="bold", color=INK, size=13)
    axes.set_xlabel(across, color=INK)
    axes.set_ylabel(result.error, color=INK)
    axes.set_facecolor(PAPER)
    axes.grid(visible=True, which="major", color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _by_place(
    axes: Axes, placed: Sequence[tuple[tuple[float, float], Point]]
) -> list[tuple[tuple[float, float], list[Point]]]:
    """Points that hide each other come together, at the place of the first."""
    found: list[tuple[tuple[float, float], list[Point]]] = []
    for place, point in placed:
        here = axes.transData.transform(place)
        near = (together for at, together in found if abs(axes.transData.transform(at) - here).max() < _SAME)
        together = next(near, None)
        if together is None:
            found.append((place, [point]))
        else:
            together.append(point)
    return found


def _draw_levels(axes: Axes, result: Result, places: Sequence[tuple[float, float]], floor: float | None) -> None:
    """Lines across, each with its name at the end where no point is near, right of the memory's floor."""
    across, (_, bottom) = axes.transData, axes.transData.transform((1, axes.get_ylim()[0]))
    height = across.transform((1, axes.get_ylim()[1]))[1] - bottom
    span = math.log(axes.get_xlim()[1] / axes.get_xlim()[0])
    start = axes.get_xlim()[0] if floor is None else floor
    for level, colour in zip(result.levels, cycle(_LEVELS), strict=False):
        here = across.transform((1, level.error))[1]
        near = [x for x, y in places if abs(across.transform((x, y))[1] - here) < 0.07 * height]
        left = any(math.log(x / axes.get_xlim()[0]) > 0.6 * span for x in near)
        above = [across.transform((1, other.error))[1] - here for other in result.levels if other.error > level.error]
        below = min(above, default=height) < 0.06 * height  # there is no room between two lines
        axes.axhline(level.error, color=colour, linewidth=1.1, linestyle=(0, (5, 3)), zorder=1)
        axes.annotate(
            level.name,
            (start if left else axes.get_xlim()[1], level.error),
            (3 if left else -2, -3 if below else 3),
            textcoords="offset points",
            ha="left" if left else "right",
            va="top" if below else "baseline",
            color=colour,
            size=9,
        )


def _draw_memory_floor(axes: Axes, floor: float) -> None:
    axes.axvspan(axes.get_xlim()[0], floor, color=_FLOOR, alpha=0.07, linewidth=0, zorder=0)
    axes.axvline(floor, color=_FLOOR, linewidth=1.1, zorder=1)
    axes.annotate(
        "bytes copied alone",
        (floor, 0.98),
        (-3, 0),
        textcoords="offset points",
        rotation=90,
        ha="right",
        va="top",
        xycoords=blended_transform_factory(axes.transData, axes.transAxes),
        color=_FLOOR,
        size=9,
        path_effects=[withStroke(linewidth=3, foreground=PAPER, alpha=0.8)],
    )


def _logarithmic(axes: Axes, result: Result, places: Sequence[tuple[float, float]], floor: float) -> float:
    """Make both axes logarithmic with room around points and floors; gives where an error of 0 is drawn."""
    times = [x for x, _ in places if x > 0] + [floor] * (floor > 0)
    errors = [y for _, y in places if y > 0] + [level.error for level in result.levels if level.error > 0]
    low, high = _range(errors or [1.0])
    exact = low / (high / low) ** _ROOM
    axes.set(xscale="log", yscale="log", xlim=_widened(*_range(times or [1.0]), _RIGHT_ROOM))
    has_zero = any(y == 0 for _, y in places)
    axes.set_ylim(_widened(exact if has_zero else low, high))
    for axis in (axes.xaxis, axes.yaxis):
        low_tick, high_tick = axis.get_view_interval()
        decades = math.log10(high_tick / low_tick)
        parts = (1.0,) if decades > 4 else (1.0, 3.0) if decades > 1.6 else (1.0, 2.0, 5.0)
        axis.set_major_locator(LogLocator(subs=parts, numticks=12))
        axis.set_major_formatter(FuncFormatter(lambda value, _: _plain(value)))
        axis.set_minor_formatter(NullFormatter())
    if has_zero:
        ticks = [tick for tick in axes.get_yticks() if low * 0.999 <= tick <= axes.get_ylim()[1]]
        axes.yaxis.set_major_locator(FixedLocator([exact, *ticks]))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: "0, exact" if value == exact else _plain(value)))
    return float(exact)


def _range(values: Sequence[float]) -> tuple[float, float]:
    low, high = min(values), max(values)
    return (low, high) if high >= 2 * low else (low / 2**0.5, high * 2**0.5)


def _widened(low: float, high: float, above: float = _ROOM) -> tuple[float, float]:
    return low / (high / low) ** _ROOM, high * (high / low) ** above


def _plain(value: float) -> str:
    return f"{value:g}".replace("e-0", "e-").replace("e+0", "e")
