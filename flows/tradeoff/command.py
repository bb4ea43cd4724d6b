"""Run the verb `tradeoff`: a table for each stage, JSON, and plots of error against time."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter
from cyclopts.validators import Number
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from rich.console import Console
from rich.markup import escape

from flows.publish.panels import GRID, INK, PAPER, png
from flows.settings.flags import AsJson, OutFile
from flows.terminal.processes import writing
from flows.terminal.progress import on_stdout, print_json, stderr, table
from flows.tradeoff.entries import Point, Result, Setting, Tradeoff, measure_tradeoff
from flows.tradeoff.stages import SEGMENT, SURVEY, TRADEOFFS, segment_tradeoff, survey_tradeoff
from flows.tradeoff.store import STORE, store_tradeoff
from pipeline.errors import SettingsError
from storage.archive.whole_files import to_json

_LEVEL = "#D55E00"
OF_SCENES: Mapping[str, Callable[[str, Any], Tradeoff]] = {
    SEGMENT.stage: segment_tradeoff,
    SURVEY.stage: survey_tradeoff,
    STORE.stage: store_tradeoff,
}


def tradeoff(
    stage: str | None = None,
    *,
    scene: str | None = None,
    weights: Path | None = None,
    out: OutFile = Path("tradeoff"),
    repeats: Annotated[int | None, Parameter(validator=Number(gte=1))] = None,
    seed: Annotated[int, Parameter(validator=Number(gte=0))] = 0,
    as_json: AsJson = False,
) -> int:
    """Measure accuracy against time or bytes, for STAGE or for all stages with a choice.

    Parameters
    ----------
    stage
        rectify, segment, simulate, store or survey. Default: all.
    scene
        Labelled scene instead of a farm: a raster for segment, a scene of the simulated rig for survey, a cube of raw
        numbers for store. Without a stage: segment and survey.
    weights
        Weights for the classes of the scene; optional for store, which then draws no map.
    out
        Folder of tradeoff.json and tradeoff.png.
    repeats
        Rounds that time every setting once. Default: 5, for store 1.
    seed
        Random seed of the scenes.
    """
    wanted = choose_tradeoffs(stage, scene, weights)
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)  # fails before minutes are spent
    results = []
    for one in wanted:
        with stderr.status(f"measuring {one.stage}: {one.knob}"):
            results.append(measure_tradeoff(one, repeats=repeats, seed=seed))
        print_tradeoff(results[-1], stderr if as_json else on_stdout())
    content = {"tradeoffs": [asdict(result) for result in results]}
    with writing(out):
        (out / "tradeoff.json").write_text(to_json(content), encoding="utf-8")
        (out / "tradeoff.png").write_bytes(png(tradeoff_figure(results)))
    stderr.print(f"{out / 'tradeoff.json'}\n{out / 'tradeoff.png'}", markup=False, soft_wrap=True)
    if as_json:
        print_json(content)
    return 0


def choose_tradeoffs(stage: str | None, scene: str | None, weights: Path | None) -> list[Tradeoff]:
    """Return the trade-offs of a stage, or of all; with a scene those of `segment` and `survey`. SettingsError."""
    if scene is None and weights is None:
        if stage is not None and stage not in TRADEOFFS:
            raise SettingsError(f"no trade-off for stage {stage!r}; there are: {', '.join(TRADEOFFS)}")
        return [TRADEOFFS[stage]] if stage else list(TRADEOFFS.values())
    stages = (SEGMENT.stage, SURVEY.stage) if stage is None else (stage,)
    if scene is None or stages[0] not in OF_SCENES or (weights is None and stage != STORE.stage):
        raise SettingsError(
            f"--scene FILE and --weights FILE go together, with the stages {', '.join(OF_SCENES)} (the last also "
            f"without weights): spectralzoom tradeoff {SURVEY.stage} --scene FILE --weights FILE"
        )
    return [OF_SCENES[name](scene, weights) for name in stages]


def print_tradeoff(result: Result, console: Console) -> None:
    """Print the settings from the most to the least exact, with the Pareto front marked."""
    points = sorted(result.points, key=lambda point: point.error)
    priced = [] if result.cost == Tradeoff.cost else [result.cost]
    rows = []
    for point in points:
        further = [*point.beside.values(), *([point.cost] if priced else [])]
        figures = ["-" if math.isnan(one) else f"{one:.2g}" if abs(one) < 10 else f"{one:.1f}" for one in further]
        name = ["●" if point.pareto else "○", _named(point.setting, result.default), f"{point.error:.3g}"]
        cells = [*name, *figures, f"{point.time_s:.3g} s", f"{point.ratio:.2f}"]
        rows.append([f"{'' if point.pareto else '[dim]'}{escape(cell)}" for cell in cells])
    headings = [one.replace(" ", "\n") for one in ("error", *points[0].beside, *priced, "time", "x first")]
    title = f"{escape(result.stage)}, {escape(result.knob)}: error and cost"
    columns = ("", result.knob, *headings)
    console.print(table(columns, rows, left=2, title=title, whole=("", *headings)), _caption(result))


def _named(setting: Setting, default: Setting | None) -> str:
    return f"{setting} (default)" if setting == default else str(setting)


def _caption(result: Result) -> str:
    machine = result.machine
    rounds = f"{result.repeats} repeat{'s' if result.repeats > 1 else ''} in turn"
    return escape(
        f"error: {result.error}, against {result.reference}; cost: {result.cost}; ● Pareto front\n"
        f"{rounds}, {machine['threads']} thread, load {machine['load_before']} to {machine['load_after']}, "
        f"{machine['processor']}"
    )


def tradeoff_figure(results: Sequence[Result]) -> Figure:
    """Return a figure of one panel for each trade-off: points of the Pareto front are filled, others hollow."""
    figure = Figure(figsize=(7.0, 4.9 * len(results)), dpi=120, layout="constrained", facecolor=PAPER)
    for axes, result in zip(figure.subplots(len(results), squeeze=False).ravel(), results, strict=True):
        _draw_tradeoff(axes, result)
    return figure


def _draw_tradeoff(axes: Axes, result: Result) -> None:
    """Draw one line for each family of settings; "FAMILY, MEMBER" is a member's name, other names are one family."""
    families: dict[str, list[Point]] = {}
    for point in result.points:
        if math.isfinite(point.error):
            families.setdefault(str(point.setting).rpartition(", ")[0], []).append(point)
    for name, members in families.items():
        members.sort(key=lambda one: (one.cost, one.error))
        x, y = [one.cost for one in members], [one.error for one in members]
        (line,) = axes.plot(x, y, linewidth=1.4, label=name, zorder=2)
        colour = line.get_color()
        for point in members:
            fill = "full" if point.pareto else "none"
            axes.plot(point.cost, point.error, marker="o", color=colour, markersize=8, fillstyle=fill, zorder=3)
            axes.annotate(
                _named(point.setting, result.default).rpartition(", ")[2],
                (point.cost, point.error),
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
    axes.set(xscale="log", yscale="linear" if exact else "log", facecolor=PAPER, axisbelow=True)
    if exact:
        axes.set_yscale("symlog", linthresh=min((one.error for one in result.points if one.error > 0), default=1.0))
    axes.set_title(f"{result.stage}: {result.knob}", loc="left", weight="bold", color=INK, size=13)
    axes.set_xlabel(result.cost, color=INK)
    axes.set_ylabel(result.error, color=INK)
    axes.grid(visible=True, which="major", color=GRID, linewidth=0.8)
    axes.spines[["top", "right"]].set_visible(False)
