"""Print an evaluation as tables, and draw it: accuracy with intervals, costs, classes."""

from __future__ import annotations

from typing import Any

from matplotlib.figure import Figure
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flows.evaluate.judge import ENDS
from flows.publish.panels import GRID, INK, PAPER
from flows.terminal.figures import counted, format_count, format_percent, format_points
from flows.terminal.progress import table

SHOWN_FRACTION = 0.10  # of the patches: the nearest fraction judged is in the table of classes
CAPTION = (
    "K: fraction of the valid patches. mIoU: of the counts of all frames, mean over the classes of the labels. "
    "overall: fraction of right pixels. ±: standard deviation over seeds, else over random draws. [ ]: 95 % of "
    "{draws} draws, paired bootstrap over frames, and over seeds if there are several. * uses labels. captured: gain "
    "of the chosen patches over that of the oracle's. MACs: multiply-adds a frame."
)


def print_evaluation(content: dict[str, Any], console: Console) -> None:
    """Print frames and weights, accuracy with costs, the classes, and an explanation."""
    weights = content["weights"]
    named = f"{len(weights)} sets of weights" if len(weights) > 1 else weights[0]["file"]
    left = f"; left out (training frames): {len(content['left_out'])}" if content["left_out"] else ""
    lines = [f"{content['dataset']}: {counted(len(content['frames']), 'frame')}, {named}{left}"]
    if len(weights) > 1:
        lines += [f"  {one['file']}: {one['frames']} frames: {', '.join(one['covers']) or 'none'}" for one in weights]
        together = "; ".join(" + ".join(names) for names in content["seeds"])
        lines.append(f"  seeds of the training: {len(content['seeds'])} ({together})")
    for line in lines:
        console.print(escape(line), soft_wrap=True)
    console.print(_accuracy(content))
    console.print(_classes(content))
    console.print(escape(CAPTION.format(draws=content["settings"]["draws"])), soft_wrap=True, style="dim")


def _accuracy(content: dict[str, Any]) -> Table:
    shared = ("placement", "K", "mIoU", "overall", "average", "kappa")
    columns = (*shared, "to all", "to random", "captured", "MACs")
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
            format_percent(row["captured_gain"]),
            format_count(row["cost"]["multiply_adds"]["done"]),
        )
        rows.append([f"[dim]{cell}" if row["uses_labels"] else cell for cell in cells])
    return table(columns, rows, whole=columns)


def _miou(row: dict[str, Any]) -> str:
    spread = row["spread"] if row["spread"] is not None else row["draws_spread"]
    return format_points(row["miou"]) + ("" if spread is None else f" ±{100 * spread:.1f}")


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
            false = row["false_classes"].get(name)  # pixels of a class that the labels lack
            cells += [format_points(row["per_class_iou"][name]) if false is None else f"{format_count(false)} px false"]
        rows.append([escape(name), format_count(support), *cells])
    return table(columns, rows, title="IoU by class", whole=columns)


def format_difference(interval: dict[str, float | None] | None) -> str:
    """Format a difference in points of mIoU, with the bounds of its interval if there are any."""
    if interval is None or interval["difference"] is None:
        return ""
    text = f"{100 * interval['difference']:+.1f}"
    low, high = interval["low"], interval["high"]
    return text if low is None or high is None else f"{text} [{100 * low:+.1f}, {100 * high:+.1f}]"


def evaluation_figure(content: dict[str, Any]) -> Figure:
    """Plot mIoU over the multiply-adds a frame, a line for each policy."""
    figure = Figure(figsize=(8.0, 5.0), dpi=110, layout="constrained", facecolor=PAPER)
    axes = figure.subplots()
    ends = {row["policy"]: 100 * row["miou"] for row in content["rows"] if row["policy"] in ENDS}
    for name, style in (("none", ":"), ("all", "-")):
        axes.axhline(ends[name], color=INK, linewidth=1.0, linestyle=style, label=name)
    for policy in dict.fromkeys(row["policy"] for row in content["rows"] if row["policy"] not in ENDS):
        own = [row for row in content["rows"] if row["policy"] == policy]
        points = sorted((row["cost"]["multiply_adds"]["done"] / 1e9, 100 * row["miou"]) for row in own)
        axes.plot(*zip(*points, strict=True), marker="o", markersize=5, label=policy)
    axes.set(xlabel="multiply-adds a frame [10$^9$]", ylabel="mIoU [%]", facecolor=PAPER)
    axes.grid(color=GRID)
    axes.legend(frameon=False)
    figure.suptitle(f"{content['dataset']}: {counted(len(content['frames']), 'frame')}", x=0.01, ha="left", color=INK)
    return figure
