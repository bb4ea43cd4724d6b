"""An evaluation as tables: accuracy with intervals and costs by row, then the classes."""

from __future__ import annotations

from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flows.figures import DASH, format_count, format_percent, format_points

SHOWN_SHARE = 0.10


def print_evaluation(content: dict[str, Any], console: Console) -> None:
    """Print accuracy, costs, placement and classes, and what the figures mean."""
    console.print(escape(_head(content)), highlight=False, soft_wrap=True)
    for table in (_accuracy(content), _costs(content), _placement(content), _classes(content)):
        console.print(table)
    console.print(escape(_caption(content)), highlight=False, soft_wrap=True, style="dim")


def _head(content: dict[str, Any]) -> str:
    frames, weights = content["frames"], content["weights"]
    gone = sorted({name for one in weights for name in one["left_out"]})
    seeds = f"{len(weights)} sets of weights" if len(weights) > 1 else weights[0]["file"]
    left = f"; left out as trained on: {len(gone)}" if gone else ""
    return f"{content['dataset']}: {len(frames)} frame{'s' if len(frames) != 1 else ''}, {seeds}{left}"


def _accuracy(content: dict[str, Any]) -> Table:
    table = Table(header_style="dim", box=SIMPLE_HEAD, collapse_padding=True)
    table.add_column("placement", no_wrap=True)
    for name in ("K", "mIoU", "per frame", "boundary", "in / out", "to all", "to random", "gap"):
        table.add_column(name, justify="right", no_wrap=True)
    for row in content["rows"]:
        table.add_row(*_accuracy_cells(row), style="dim" if row["uses_labels"] else "")
    return table


def _accuracy_cells(row: dict[str, Any]) -> list[str]:
    spread = row["spread"] if row["spread"] is not None else row["draws_spread"]
    gap = row["gap_closed"] if row["policy"] not in ("none", "all") else None
    return [
        row["policy"] + ("*" if row["uses_labels"] else ""),
        format_percent(row["share"]),
        format_points(row["miou"]) + ("" if spread is None else f" ±{100 * spread:.1f}"),
        format_points(row["miou_i"]),
        format_points(row["boundary_iou"]),
        f"{format_points(row['inside_miou'])} / {format_points(row['outside_miou'])}",
        _difference(row["against_all"]),
        _difference(row["against_random"]),
        format_percent(gap),
    ]


def _difference(interval: dict[str, float | None] | None) -> str:
    """Points of mIoU with the bounds of the interval, as far as there are any."""
    if interval is None or interval["difference"] is None:
        return ""
    text = f"{100 * interval['difference']:+.1f}"
    low, high = interval["low"], interval["high"]
    return text if low is None or high is None else f"{text} [{100 * low:+.1f}, {100 * high:+.1f}]"


def _costs(content: dict[str, Any]) -> Table:
    table = Table(header_style="dim", box=SIMPLE_HEAD, collapse_padding=True)
    table.add_column("placement", no_wrap=True)
    for name in ("K", "samples", "of all", "MB", "multiply-adds", "of all", "CPU s", "of all", "capture s", "of full"):
        table.add_column(name, justify="right", no_wrap=True)
    for row in content["rows"]:
        table.add_row(*_cost_cells(row), style="dim" if row["uses_labels"] else "")
    return table


def _cost_cells(row: dict[str, Any]) -> list[str]:
    cost = row["cost"]
    done = {name: cost[name]["done"] for name in cost if name != "fine_lines"}
    share = {name: format_percent(cost[name]["ratio"]) for name in done}
    return [
        row["policy"] + ("*" if row["uses_labels"] else ""),
        format_percent(row["share"]),
        format_count(done["samples"]),
        share["samples"],
        DASH if done["bytes"] is None else f"{done['bytes'] / 1e6:.3g}",
        format_count(done["multiply_adds"]),
        share["multiply_adds"],
        DASH if done["cpu_s"] is None else f"{done['cpu_s']:.3f}",
        share["cpu_s"],
        DASH if done["capture_s"] is None else f"{done['capture_s']:.0f}",
        share["capture_s"],
    ]


def _placement(content: dict[str, Any]) -> Table:
    """One line a policy: how its order of the seats agrees with the oracle's, and what the seats of each K gain."""
    rows: dict[str, list[dict[str, Any]]] = {}
    for row in content["rows"]:
        if row["policy"] not in ("none", "all"):
            rows.setdefault(row["policy"], []).append(row)
    table = Table(header_style="dim", box=SIMPLE_HEAD, collapse_padding=True)
    table.add_column("placement\n", no_wrap=True)
    for name in ("rank\n", "AP\ngain > 0"):
        table.add_column(name, justify="right", no_wrap=True)
    for share in content["settings"]["shares"]:
        table.add_column(f"{format_percent(share)}\ngain   AP", justify="right", no_wrap=True)
    for policy, own in rows.items():
        found = [f"{_ratio(row['captured_gain'])} {_ratio(row['ap_top'])}" for row in own]
        table.add_row(policy, _ratio(own[0]["spearman"]), _ratio(own[0]["ap_gain"]), *found)
    return table


def _ratio(value: float | None) -> str:
    return DASH if value is None else f"{value:.2f}"


def _classes(content: dict[str, Any]) -> Table:
    shown = [row for row in content["rows"] if row["policy"] in ("none", "all")]
    first = [row for row in content["rows"] if row["policy"] == content["rows"][1]["policy"]]
    shown.insert(1, min(first, key=lambda row: abs(row["share"] - SHOWN_SHARE)))
    shown = [row for number, row in enumerate(shown) if row not in shown[:number]]
    table = Table(header_style="dim", box=SIMPLE_HEAD, collapse_padding=True)
    table.add_column("class", no_wrap=True)
    table.add_column("labelled px", justify="right", no_wrap=True)
    for row in shown:
        for what in ("IoU", "boundary"):
            table.add_column(f"{row['policy']} {format_percent(row['share'])}\n{what}", justify="right", no_wrap=True)
    for name, support in content["support"].items():
        kinds = ("per_class_iou", "per_class_boundary_iou")
        cells = [format_points(row[kind][name]) for row in shown for kind in kinds]
        table.add_row(escape(name), format_count(support), *cells)
    return table


def _caption(content: dict[str, Any]) -> str:
    averaged = {row["classes_averaged"] for row in content["rows"]}
    classes = " to ".join(str(number) for number in sorted({min(averaged), max(averaged)}))
    timed = len({one["frame"] for records in content["timed"] for one in records})
    return (
        "K: share of the valid seats, free of each other (frame mode). mIoU over the counts of all frames, mean over "
        f"{classes} classes; ± the spread of seeds, else of random draws. [ ] 95 % of {content['settings']['draws']} "
        "paired draws of the frames. * uses labels.\n"
        "rank: Spearman of scores and gain; AP: average precision for seats with a gain, and for the oracle's own K; "
        "gain: the chosen seats' share of the gain that the oracle's seats have.\n"
        f"MB: {content['notes']['bytes']}. CPU: {content['notes']['cpu_s']} ({timed} timed).\n"
        f"capture ({len(content['captured'])} priced): {content['notes']['capture_s']}."
    )
