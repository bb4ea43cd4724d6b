"""A measured trade-off for people: a table 'to be right to X you pay Y', and a plot of error against time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flows.figures import format_seconds
from flows.panels import INK, MUTED
from flows.tradeoff import Point, Result

_FRONT: Any = {"marker": "o", "color": "#0072B2", "markersize": 9, "linewidth": 1.4, "label": "no other beats it"}
_BEATEN: Any = {"marker": "o", "color": MUTED, "markersize": 9, "linewidth": 0, "fillstyle": "none", "label": "beaten"}
_PLAIN = FuncFormatter(lambda value, _: f"{value:g}")


def print_tradeoff(result: Result, console: Console) -> None:
    """Print the settings from the most to the least exact; those that no other beats are marked."""
    table = Table(
        title=f"{escape(result.stage)}: to be right to ... you pay ...", title_justify="left", title_style="bold",
        header_style="dim", box=SIMPLE_HEAD, caption=_caption(result), caption_justify="left",
    )  # fmt: skip
    headings = ("", result.knob, "error", f"per {result.unit}", "price", "x first", "wall, least", "wall, median")
    for number, heading in enumerate(headings):
        table.add_column(escape(heading), justify="left" if number < 2 else "right")
    for point in sorted(result.points, key=lambda point: point.error):
        table.add_row(*_row(point), style="" if point.pareto else "dim")
    console.print(table)


def _row(point: Point) -> list[str]:
    walls = (_short(seconds) for seconds in (point.wall_min_s, point.wall_median_s))
    times = [_short(point.ns_per_unit * 1e-9), _short(point.price_s), f"{point.ratio:.2f}", *walls]
    return ["●" if point.pareto else "○", escape(str(point.setting)), f"{point.error:.3g}", *times]


def _short(seconds: float) -> str:
    """A time with three figures in the unit that suits it."""
    for size, unit in ((1e-3, "ms"), (1e-6, "µs"), (1e-9, "ns")):
        if size <= seconds < 1:
            return f"{seconds / size:.3g} {unit}"
    return format_seconds(seconds) if seconds >= 1 else f"{seconds * 1e9:.3g} ns"


def _caption(result: Result) -> str:
    machine = result.machine
    priced = "the cost model" if any(point.modelled_s is not None for point in result.points) else "processor time"
    words = (
        f"error: {result.error}, against {result.reference}; price: {priced}; ● no other setting beats it\n"
        f"{result.repeats} repeats in turn, {machine['threads']} thread, load {machine['load_before']} to "
        f"{machine['load_after']}, {machine['processor']}"
    )
    return escape(words)


def draw_tradeoffs(path: str | Path, results: Sequence[Result]) -> None:
    """Draw one panel for each trade-off as a PNG: points that no other beats filled and joined, the others hollow."""
    figure = Figure(figsize=(7.2 * len(results), 5.4), dpi=120, layout="constrained", facecolor="#fbfaf7")
    for axes, result in zip(figure.subplots(1, len(results), squeeze=False)[0], results, strict=True):
        _draw_tradeoff(axes, result)
    FigureCanvasAgg(figure)
    figure.savefig(path, format="png")


def _draw_tradeoff(axes: Axes, result: Result) -> None:
    front = sorted((point for point in result.points if point.pareto), key=lambda point: point.price_s)
    beaten = [point for point in result.points if not point.pareto]
    modelled = any(point.modelled_s is not None for point in result.points)
    for points, style in ((front, _FRONT), (beaten, _BEATEN)):
        if points:
            axes.plot([_time(point, modelled) for point in points], [point.error for point in points], **style)
    for point in result.points:
        place = (_time(point, modelled), point.error)
        axes.annotate(str(point.setting), place, (9, 7), textcoords="offset points", color=INK, size=11)
    _scale(axes, [_time(point, modelled) for point in result.points], [point.error for point in result.points])
    axes.set_title(f"{result.stage}: {result.knob}", loc="left", weight="bold", color=INK)
    axes.set(xlabel="seconds by the cost model" if modelled else f"ns / {result.unit}", ylabel=result.error)
    axes.grid(visible=True, which="major", color="#e3e1d8", linewidth=0.8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(x=0.22, y=0.16)
    axes.legend(frameon=False)


def _time(point: Point, modelled: bool) -> float:
    return point.price_s if modelled else point.ns_per_unit


def _scale(axes: Axes, times: Sequence[float], errors: Sequence[float]) -> None:
    """Logarithmic axes with plain figures wherever all values are positive."""
    if min(times) > 0:
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter(_PLAIN)
        axes.xaxis.set_minor_formatter(_PLAIN)
    if min(errors) > 0:
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(_PLAIN)
        axes.yaxis.set_minor_formatter(_PLAIN)
