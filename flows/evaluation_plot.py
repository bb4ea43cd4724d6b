"""An evaluation as a plot: mIoU over CPU seconds, one line a policy, none and all as lines across."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from flows.figures import format_percent
from flows.panels import INK, MUTED

_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#56B4E9", "#882255", "#332288", "#999933")
_PAPER, _GRID = "#fbfaf7", "#e3e1d8"


def draw_evaluation(path: Path, content: dict[str, Any]) -> None:
    """Draw mIoU over CPU seconds, and over bytes, into a PNG file."""
    figure = evaluation_figure(content)
    FigureCanvasAgg(figure)
    figure.savefig(path, format="png")


def evaluation_figure(content: dict[str, Any]) -> Figure:
    """Give the figure. Where no frame was timed the seconds are left out."""
    known = [row for row in content["rows"] if row["miou"] is not None]
    timed = any(row["cost"]["cpu_s"]["done"] is not None for row in known)
    wanted = [("cpu_s", "CPU seconds a frame, one thread", 1.0)] if timed else []
    wanted.append(("bytes", "MB a frame, estimated from samples", 1e6))
    figure = Figure(figsize=(7.0 * len(wanted), 5.4), dpi=110, layout="constrained", facecolor=_PAPER)
    for number, (panel, (what, label, unit)) in enumerate(
        zip(figure.subplots(1, len(wanted), squeeze=False).ravel(), wanted, strict=True)
    ):
        _draw_panel(panel, known, what, unit)
        panel.set_xlabel(label, color=INK)
        panel.set_ylabel("mIoU [%]", color=INK)
        if not number:
            panel.set_title(
                f"{content['dataset']}: {_counted(len(content['frames']))}", loc="left", color=INK, weight="bold"
            )
    figure.legend(
        *panel.get_legend_handles_labels(), loc="outside lower center", ncols=6, frameon=False, labelcolor=INK
    )
    return figure


def _draw_panel(axes: Axes, rows: list[dict[str, Any]], what: str, unit: float) -> None:
    ends = {row["policy"]: row for row in rows if row["policy"] in ("none", "all")}
    policies = list(dict.fromkeys(row["policy"] for row in rows if row["policy"] not in ends))
    for name, style in (("none", (0, (2, 2))), ("all", "-")):
        axes.axhline(100 * ends[name]["miou"], color=MUTED, linewidth=1.1, linestyle=style, label=name, zorder=1)
        axes.plot(ends[name]["cost"][what]["done"] / unit, 100 * ends[name]["miou"], "s", color=MUTED, zorder=2)
    for number, policy in enumerate(policies):
        own = sorted((row for row in rows if row["policy"] == policy), key=lambda row: row["share"])
        x = [row["cost"][what]["done"] / unit for row in own]
        y = [100 * row["miou"] for row in own]
        oracle = own[0]["uses_labels"]
        axes.plot(
            x, y, marker="o", markersize=5, linewidth=1.5, linestyle="--" if oracle else "-", zorder=3,
            color=INK if oracle else _COLOURS[number % len(_COLOURS)],
            label=f"{policy} (uses labels)" if oracle else policy,
        )  # fmt: skip
        _draw_band(axes, own, x, ends["all"]["miou"], _COLOURS[number % len(_COLOURS)])
    _name_shares(axes, [row for row in rows if row["policy"] not in ends], what, unit)
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=12))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_facecolor(_PAPER)
    axes.grid(visible=True, which="major", color=_GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _counted(frames: int) -> str:
    return "1 frame" if frames == 1 else f"{frames} frames"


def _name_shares(axes: Axes, rows: list[dict[str, Any]], what: str, unit: float) -> None:
    """Name each share below the lowest of its points."""
    for share in sorted({row["share"] for row in rows}):
        lowest = min((row for row in rows if row["share"] == share), key=lambda row: row["miou"])
        place = (lowest["cost"][what]["done"] / unit, 100 * lowest["miou"])
        axes.annotate(
            format_percent(share), place, (0, -14), textcoords="offset points", color=INK, size=9, ha="center"
        )  # fmt: skip


def _draw_band(axes: Axes, own: list[dict[str, Any]], x: list[float], every: float, colour: str) -> None:
    """The interval of the difference to `all`, around its line."""
    bounds = [row["against_all"] for row in own]
    if own[0]["uses_labels"] or any(one["low"] is None or one["high"] is None for one in bounds):
        return
    low, high = ([100 * (every + one[end]) for one in bounds] for end in ("low", "high"))
    axes.fill_between(x, low, high, color=colour, alpha=0.12, linewidth=0, zorder=0)
