"""Run the verb `tradeoff`: a table for each stage, JSON, and plots of error against time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from itertools import cycle
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from rich.console import Console
from rich.markup import escape

from flows.publish.panels import GRID, INK, PAPER, save_png
from flows.terminal.figures import format_seconds
from flows.terminal.processes import writing
from flows.terminal.progress import table
from flows.tradeoff.entries import Point, Result, Setting, Tradeoff, measure_tradeoff
from flows.tradeoff.stages import SEGMENT, SURVEY, TRADEOFFS, segment_tradeoff, survey_tradeoff
from flows.tradeoff.store import STORE, store_tradeoff
from pipeline.errors import SettingsError
from storage.archive.whole_files import to_json

_COLOURS = ("#0072B2", "#007A5A", "#8a6d00", "#D55E00", "#A23B72", "#333333", "#5B3FA0", "#00798C", "#9B2226")
_LEVEL = "#D55E00"
_ACROSS = 3  # panels in a row
_UNITS = ((1e6, "ms"), (1e3, "µs"), (1.0, "ns"))


def run_tradeoff(
    stage: str | None,
    out: Path,
    repeats: int | None,
    seed: int,
    console: Console,
    *,
    scene: str | None = None,
    weights: Path | None = None,
) -> dict[str, Any]:
    """Measure the trade-off of one stage, or all; write tradeoff.json and .png into ``out`` and print the tables.

    ``scene`` replaces the farm of `segment`, `store` and `survey`; ``weights`` read it. Raises SettingsError: an
    unknown stage, one that takes no scene, a scene or weights alone; else as the stages.
    """
    if repeats is not None and repeats < 1:
        raise SettingsError(f"--repeats must be at least 1, got {repeats}")
    if seed < 0:
        raise SettingsError(f"--seed must be 0 or more, got {seed}")
    wanted = choose_tradeoffs(stage, scene, weights)
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)  # fails before minutes are spent
    results = []
    for tradeoff in wanted:
        with console.status(f"measuring {tradeoff.stage}: {tradeoff.knob}"):
            results.append(measure_tradeoff(tradeoff, repeats=repeats, seed=seed))
        print_tradeoff(results[-1], console)
    content = {"tradeoffs": [asdict(result) for result in results]}
    with writing(out):
        (out / "tradeoff.json").write_text(to_json(content), encoding="utf-8")
        save_png(tradeoff_figure(results), out / "tradeoff.png")
    console.print(f"{out / 'tradeoff.json'}\n{out / 'tradeoff.png'}", soft_wrap=True)
    return content


def choose_tradeoffs(stage: str | None, scene: str | None, weights: Path | None) -> list[Tradeoff]:
    """Return the trade-offs of a stage, or of all; with a scene those of `segment` and `survey`. SettingsError."""
    if scene is None and weights is None:
        if stage is not None and stage not in TRADEOFFS:
            raise SettingsError(f"no trade-off for stage {stage!r}; there are: {', '.join(TRADEOFFS)}")
        return [TRADEOFFS[stage]] if stage else list(TRADEOFFS.values())
    if stage == STORE.stage and scene:
        return [store_tradeoff(scene, weights)]
    own = {SEGMENT.stage: segment_tradeoff, SURVEY.stage: survey_tradeoff}
    if (stage is not None and stage not in own) or scene is None or weights is None:
        raise SettingsError(
            f"--scene FILE and --weights FILE go together, with the stages {', '.join(own)} and {STORE.stage} (this "
            f"also without weights): spectralzoom tradeoff {SURVEY.stage} --scene FILE --weights FILE"
        )
    return [make(scene, weights) for name, make in own.items() if stage in (None, name)]


def print_tradeoff(result: Result, console: Console) -> None:
    """Print the settings from the most to the least exact, with the Pareto front marked."""
    points = sorted(result.points, key=lambda point: point.error)
    rows, figures = [_row(point, result) for point in points], ("error", *result.points[0].beside)
    times = ("time",) if result.paid else ("price", "x first")
    times = times if result.paid or result.modelled else (f"per {result.unit}", *times)
    headings = [name.replace(" ", "\n") for name in (*figures, *times)]
    pairs = zip(rows, points, strict=True)
    shown = [[f"{'' if point.pareto else '[dim]'}{escape(cell)}" for cell in row] for row, point in pairs]
    title = f"{escape(result.stage)}, {escape(result.knob)}: error and cost"
    columns = ("", result.knob, *headings)
    console.print(table(columns, shown, left=2, title=title, whole=columns), _caption(result))


def _row(point: Point, result: Result) -> list[str]:
    times = [_short(point.ns_per_unit * 1e-9), _short(point.price_s), f"{point.ratio:.2f}"]
    if point.paid is not None:  # the cost is one of the other figures
        times = times[1:2]
    elif result.modelled:
        times = times[1:]
    further = [f"{one:.2g}" if abs(one) < 10 else f"{one:.1f}" for one in point.beside.values()]
    name = _named(point.setting, result.default)
    return ["●" if point.pareto else "○", name, f"{point.error:.3g}", *further, *times]


def _named(setting: Setting, default: Setting | None) -> str:
    return f"{setting} (default)" if setting == default else str(setting)


def _short(seconds: float) -> str:
    for size, unit in ((1e-3, "ms"), (1e-6, "µs"), (1e-9, "ns")):
        if size <= seconds < 1:
            return f"{seconds / size:.3g} {unit}"
    return format_seconds(seconds) if seconds >= 1 else f"{seconds * 1e9:.3g} ns"


def _caption(result: Result) -> str:
    machine, within = result.machine, ""
    if result.level is not None:
        name, error = result.level
        good = [point for point in result.points if point.error <= error]
        best = min(good, key=lambda point: point.cost, default=None)
        found = "no setting" if best is None else f"{best.setting}, {_short(best.ns_per_unit * 1e-9)}"
        within = f"within {name} ({error:.2g}): {found}\n"
    priced = result.paid or ("the cost model" if result.modelled else "processor time")
    rounds = f"{result.repeats} repeat{'s' if result.repeats > 1 else ''} in turn"
    return escape(
        f"error: {result.error}, against {result.reference}; price: {priced}; ● Pareto front\n"
        f"{within}"
        f"{rounds}, {machine['threads']} thread, load {machine['load_before']} to {machine['load_after']}, "
        f"{machine['processor']}"
    )


def tradeoff_figure(results: Sequence[Result]) -> Figure:
    """Return a figure of one panel for each trade-off: points of the Pareto front are filled, others hollow."""
    across = min(_ACROSS, len(results))
    down = -(-len(results) // across)
    figure = Figure(figsize=(6.0 * across, 4.9 * down + 0.5), dpi=120, layout="constrained", facecolor=PAPER)
    panels = figure.subplots(down, across, squeeze=False).ravel()
    for axes, result in zip(panels, results, strict=False):
        _draw_tradeoff(axes, result)
    for axes in panels[len(results) :]:
        axes.set_axis_off()
    return figure


def _draw_tradeoff(axes: Axes, result: Result) -> None:
    """Draw one line for each family of settings; "FAMILY, MEMBER" is a member's name, other names are one family."""
    least = min(point.ns_per_unit for point in result.points)
    size, unit = next((one for one in _UNITS if least >= one[0]), _UNITS[-1])
    families: dict[str, list[tuple[float, float, Point]]] = {}
    for point in result.points:
        if math.isfinite(point.error):
            x = point.cost if result.modelled or result.paid else point.ns_per_unit / size
            families.setdefault(str(point.setting).rpartition(", ")[0], []).append((x, point.error, point))
    for (name, members), colour in zip(families.items(), cycle(_COLOURS), strict=False):
        members.sort(key=lambda one: one[:2])
        axes.plot(*zip(*(one[:2] for one in members), strict=True), color=colour, linewidth=1.4, label=name, zorder=2)
        for x, y, point in members:
            fill = "full" if point.pareto else "none"
            axes.plot(x, y, marker="o", color=colour, markersize=8, fillstyle=fill, zorder=3)
            axes.annotate(
                _named(point.setting, result.default).rpartition(", ")[2],
                (x, y),
                (6, 5),
                textcoords="offset points",
                color=colour,
                size=8.5,
                zorder=4,
                path_effects=[withStroke(linewidth=2.5, foreground=PAPER)],
            )
    if len(families) > 1:
        axes.legend(frameon=False, labelcolor="linecolor", fontsize=10)
    if result.level is not None:
        axes.axhline(result.level[1], color=_LEVEL, linewidth=1.1, linestyle=(0, (5, 3)), zorder=1)
        place: Any = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points"}
        axes.annotate(result.level[0], (1, result.level[1]), (-2, 3), **place, ha="right", color=_LEVEL, size=9)
    exact = any(point.error == 0 for point in result.points)  # 0 has no logarithm
    axes.set(xscale="log", yscale="linear" if exact else "log")
    if exact:
        smallest = min((point.error for point in result.points if point.error > 0), default=1.0)
        axes.set_yscale("symlog", linthresh=smallest)
    axes.set_title(f"{result.stage}: {result.knob}", loc="left", weight="bold", color=INK, size=13)
    time = "seconds by the cost model" if result.modelled else f"{unit} / {result.unit}"
    axes.set_xlabel(result.paid or time, color=INK)
    axes.set_ylabel(result.error, color=INK)
    axes.set_facecolor(PAPER)
    axes.grid(visible=True, which="major", color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
