"""Plans of the rig as a plot: mIoU over capture seconds, one line a plan, none and all as lines across."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from flows.evaluate.plot import GRID, PAPER, counted
from flows.publish.panels import INK, MUTED

_STYLES = {
    "gain": ("#0072B2", "-", "o"),
    "entropy": ("#E69F00", "-", "o"),
    "uniform lines": (INK, "--", "s"),
    "random lines": ("#CC79A7", "--", "^"),
}


def draw_rig(path: Path, content: dict[str, Any]) -> None:
    """Draw mIoU over capture seconds into a PNG file."""
    figure = rig_figure(content)
    FigureCanvasAgg(figure)
    figure.savefig(path, format="png")


def rig_figure(content: dict[str, Any]) -> Figure:
    """Give the figure; the band around our plan is the interval of its difference to uniform lines."""
    rows = [row for row in content["rig"]["rows"] if row["miou"] is not None]
    figure = Figure(figsize=(7.4, 5.2), dpi=110, layout="constrained", facecolor=PAPER)
    axes = figure.subplots()
    ends = {row["policy"]: row for row in content["rows"] if row["policy"] in ("none", "all")}
    for name, style in (("none", (0, (2, 2))), ("all", "-")):
        label = f"{name}: {'coarse pass alone' if name == 'none' else 'every seat'}"
        axes.axhline(100 * ends[name]["miou"], color=MUTED, linewidth=1.1, linestyle=style, label=label, zorder=1)
    even = {row["budget"]: row["miou"] for row in rows if row["policy"] == "uniform lines"}
    for plan in dict.fromkeys(row["policy"] for row in rows):
        own = sorted((row for row in rows if row["policy"] == plan), key=lambda row: row["budget"])
        colour, line, marker = _STYLES[plan]
        seconds = [row["seconds"] for row in own]
        axes.plot(
            seconds,
            [100 * row["miou"] for row in own],
            color=colour,
            linestyle=line,
            marker=marker,
            markersize=5,
            linewidth=1.6,
            label=plan,
            zorder=3,
        )
        bounds = [row["against_uniform"] for row in own]
        if all(one is not None and one["low"] is not None for one in bounds):
            low, high = (
                [100 * (even[row["budget"]] + one[end]) for row, one in zip(own, bounds, strict=True)]
                for end in ("low", "high")
            )
            axes.fill_between(seconds, low, high, color=colour, alpha=0.12, linewidth=0, zorder=0)
    axes.set_xlabel("capture seconds a frame, coarse pass included", color=INK)
    axes.set_ylabel("mIoU [%]", color=INK)
    axes.set_title(
        f"{content['dataset']}, rig mode: {counted(len(content['frames']))}", loc="left", color=INK, weight="bold"
    )
    axes.set_facecolor(PAPER)
    axes.grid(visible=True, color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=3, frameon=False, labelcolor=INK)
    return figure
