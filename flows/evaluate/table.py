"""An evaluation as tables and as a plot: accuracy with intervals, costs, classes."""

from __future__ import annotations

from typing import Any

from matplotlib.figure import Figure
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flows.evaluate.judge import ENDS
from flows.publish.panels import GRID, INK, PAPER
from flows.terminal.figures import (
    DASH,
    counted,
    format_bytes,
    format_count,
    format_percent,
    format_points,
    format_seconds,
)
from flows.terminal.progress import table

SHOWN_FRACTION = 0.10  # of the patches, or the nearest one tried: what is shown where one share has to do
CAPTION = (
    "K: fraction of the valid patches, each free of the others. mIoU over the counts of all frames, mean over the "
    "classes "
    "of the labels; overall: fraction of pixels that are right; ± the spread of seeds, else of random draws. [ ] 95 "
    "% of "
    "{draws} draws: paired bootstrap over frames, and over seeds where there are several. * uses labels. captured: the "
    "chosen patches' fraction of the gain of the oracle's. Data before compression; multiply-adds in closed form; "
    "seconds by the cost model, coarse pass included, by runs of lines or the full scan where that is cheaper."
)


def print_evaluation(content: dict[str, Any], console: Console) -> None:
    """Print what was judged, accuracy with costs and classes, and what the figures mean."""
    weights = content["weights"]
    named = f"{len(weights)} sets of weights" if len(weights) > 1 else weights[0]["file"]
    left = f"; left out as seen in training: {len(content['left_out'])}" if content["left_out"] else ""
    lines = [f"{content['dataset']}: {counted(len(content['frames']), 'frame')}, {named}{left}"]
    if len(weights) > 1:
        lines += [f"  {one['file']}: {one['frames']} frames: {', '.join(one['covers']) or 'none'}" for one in weights]
        together = "; ".join(" + ".join(names) for names in content["seeds"])
        lines.append(f"  seeds of the training: {len(content['seeds'])} ({together})")
    for line in lines:
        console.print(escape(line), soft_wrap=True)
    console.print(_accuracy(content))
    console.print(_costs(content))
    console.print(_classes(content))
    console.print(escape(CAPTION.format(draws=content["settings"]["draws"])), soft_wrap=True, style="dim")


def _accuracy(content: dict[str, Any]) -> Table:
    columns = ("placement", "K", "mIoU", "overall", "average", "kappa", "to all", "to random", "gap", "captured")
    rows = []
    for row in content["rows"]:
        cells = (
            f"{row['policy']}{'*' if row['uses_labels'] else ''}",
            format_percent(row["fraction"]),
            _miou(row),
            format_points(row["pixel_accuracy"]),
            format_points(row["average_accuracy"]),
            f"{row['kappa']:.2f}",
            format_difference(row["against_all"]),
            format_difference(row["against_random"]),
            format_percent(row["gap_closed"]),
            format_percent(row["captured_gain"]),
        )
        rows.append([f"[dim]{cell}" if row["uses_labels"] else cell for cell in cells])
    return table(columns, rows, whole=columns)


def _costs(content: dict[str, Any]) -> Table:
    columns = ("placement", "K", "data", "of all", "multiply-adds", "of all", "seconds", "of full scan")
    rows = [
        [
            row["policy"],
            format_percent(row["fraction"]),
            format_bytes(row["cost"]["bytes"]["done"]),
            format_percent(row["cost"]["bytes"]["ratio"]),
            format_count(row["cost"]["multiply_adds"]["done"]),
            format_percent(row["cost"]["multiply_adds"]["ratio"]),
            *_seconds(row["cost"]),
        ]
        for row in content["rows"]
    ]
    return table(columns, rows, whole=columns)


def _miou(row: dict[str, Any]) -> str:
    spread = row["spread"] if row["spread"] is not None else row["draws_spread"]
    return format_points(row["miou"]) + ("" if spread is None else f" ±{100 * spread:.1f}")


def _seconds(cost: dict[str, Any]) -> tuple[str, str]:
    """Seconds of capture and their fraction of the full scan's; unknown beyond the mirror's range."""
    if "capture_s" not in cost:
        return DASH, DASH
    done, full = cost["capture_s"]["done"], cost["full_s"]["done"]
    return format_seconds(done), format_percent(done / full)


def _classes(content: dict[str, Any]) -> Table:
    shown = [row for row in content["rows"] if row["policy"] in ENDS]
    first = [row for row in content["rows"] if row["policy"] == content["rows"][1]["policy"]]
    nearest = min(first, key=lambda row: abs(row["fraction"] - SHOWN_FRACTION))
    shown = [shown[0], *([] if nearest in shown else [nearest]), *shown[1:]]
    columns = ("class", "labelled px", *(f"{row['policy']} {format_percent(row['fraction'])}" for row in shown))
    rows = []
    for name, support in content["support"].items():
        cells = []
        for row in shown:
            false = row["false_classes"].get(name)  # how often the map shows a class that the labels lack
            cells += [format_points(row["per_class_iou"][name]) if false is None else f"{format_count(false)} px false"]
        rows.append([escape(name), format_count(support), *cells])
    return table(columns, rows, title="IoU by class", whole=columns)


def format_difference(interval: dict[str, float | None] | None) -> str:
    """Points of mIoU with the bounds of the interval, as far as there are any."""
    if interval is None or interval["difference"] is None:
        return ""
    text = f"{100 * interval['difference']:+.1f}"
    low, high = interval["low"], interval["high"]
    return text if low is None or high is None else f"{text} [{100 * low:+.1f}, {100 * high:+.1f}]"


def evaluation_figure(content: dict[str, Any]) -> Figure:
    """Draw mIoU over the bytes of the captures and over their seconds, where these are known: a line a policy."""
    panels = [("bytes", "MB a frame, before compression", 1e6)]
    if "capture_s" in content["rows"][0]["cost"]:
        panels.append(("capture_s", "capture seconds a frame, coarse pass included", 1.0))
    figure = Figure(figsize=(7.0 * len(panels), 5.0), dpi=110, layout="constrained", facecolor=PAPER)
    ends = {row["policy"]: 100 * row["miou"] for row in content["rows"] if row["policy"] in ENDS}
    for axes, (cost, label, unit) in zip(figure.subplots(1, len(panels), squeeze=False).flat, panels, strict=True):
        for name, style in (("none", ":"), ("all", "-")):
            axes.axhline(ends[name], color=INK, linewidth=1.0, linestyle=style, label=name)
        for policy in dict.fromkeys(row["policy"] for row in content["rows"] if row["policy"] not in ENDS):
            own = [row for row in content["rows"] if row["policy"] == policy]
            points = sorted((row["cost"][cost]["done"] / unit, 100 * row["miou"]) for row in own)
            axes.plot(*zip(*points, strict=True), marker="o", markersize=5, label=policy)
        axes.set(xlabel=label, ylabel="mIoU [%]", facecolor=PAPER)
        axes.grid(color=GRID)
        axes.legend(frameon=False)
    figure.suptitle(f"{content['dataset']}: {counted(len(content['frames']), 'frame')}", x=0.01, ha="left", color=INK)
    return figure
