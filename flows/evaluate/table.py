"""An evaluation as tables: accuracy with intervals, costs, placement, budgets and classes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flows.evaluate.rows import ENDS
from flows.tasks.scores import SHOWN, SHOWN_WORDS, definitions_differ
from flows.terminal.figures import DASH, format_count, format_percent, format_points

SHOWN_SHARE = 0.10  # of the seats, or the nearest one tried: what is shown where one share has to do


def print_evaluation(content: dict[str, Any], console: Console) -> None:
    """Print what was judged, accuracy, costs, placement, budgets and classes, and what the figures mean."""
    for line in _head(content):
        console.print(escape(line), soft_wrap=True)
    tables = (_accuracy(content), *_both_definitions(content), _costs(content), _compute(content), _placement(content))
    for table in (*tables, *budget_tables(content), _classes(content)):
        console.print(table)
    console.print(escape(_caption(content)), soft_wrap=True, style="dim")


def _head(content: dict[str, Any]) -> list[str]:
    frames, weights = content["frames"], content["weights"]
    seeds = f"{len(weights)} sets of weights" if len(weights) > 1 else weights[0]["file"]
    left = f"; left out as seen in training: {len(content['left_out'])}" if content["left_out"] else ""
    lines = [f"{content['dataset']}: {len(frames)} frame{'s' if len(frames) != 1 else ''}, {seeds}{left}"]
    several = [*(weights if len(weights) > 1 else []), *content["controls"]]
    for one in several:
        kind = f"control {one['design']}, " if "design" in one else ""
        lines.append(f"  {kind}{one['file']}: {one['frames']} frames: {', '.join(one['covers']) or 'none'}")
    if len(weights) > 1:
        together = "; ".join(" + ".join(names) for names in content["seeds"])
        lines.append(f"  seeds of the training: {len(content['seeds'])} ({together})")
    base = content["baseline"]
    lines.append(f"baseline: {base['policy']} ({base['why']})")
    return lines


def _name(row: dict[str, Any]) -> str:
    return f"{row['policy']}{'*' if row['uses_labels'] else ''}"


def _named(row: dict[str, Any]) -> tuple[str, str]:
    return _name(row), format_percent(row["share"])


def _style(row: dict[str, Any]) -> str:
    return "dim" if row["uses_labels"] or row["control"] else ""


def _accuracy(content: dict[str, Any]) -> Table:
    """Of one frame alone, more accuracies over its pixels take the place of the mean over frames."""
    alone = len(content["frames"]) == 1
    of_frames = ("average", "kappa") if alone else ("per\nframe",)
    names = ("K", "mIoU", "overall", *of_frames, "bound-\nary", "in / out", "to baseline", "to random", "gap")
    table = _table("placement", *names)
    for row in content["rows"]:
        spread = row["spread"] if row["spread"] is not None else row["draws_spread"]
        own = (
            [format_points(row["average_accuracy"]), _ratio(row["kappa"])] if alone else [format_points(row["miou_i"])]
        )
        table.add_row(
            *_named(row),
            format_points(row["miou"]) + ("" if spread is None else f" ±{100 * spread:.1f}"),
            format_points(row["pixel_accuracy"]),
            *own,
            format_points(row["boundary_iou"]),
            f"{format_points(row['inside_miou'])} / {format_points(row['outside_miou'])}",
            format_difference(row["against_baseline"]),
            format_difference(row["against_random"]),
            format_percent(row["gap_closed"] if row["policy"] not in ENDS and not row["control"] else None),
            style=_style(row),
        )
    return table


def _both_definitions(content: dict[str, Any]) -> Iterator[Table]:
    """The mean over the classes that a map shows, where that is another: the figure of before."""
    if definitions_differ(content["rows"]):
        table = _table("placement", "K", "mIoU", SHOWN)
        for row in content["rows"]:
            means = (format_points(row[name]) for name in ("miou", "miou_of_shown_classes"))
            table.add_row(*_named(row), *means, style=_style(row))
        yield table


def _costs(content: dict[str, Any]) -> Table:
    of = "of base"
    table = _table(
        "placement", "K", "samples", of, "MB", "madds", of, "CPU s", of, "frame s", "of full", "rig s", "of full"
    )
    for row in content["rows"]:
        done = {name: entry["done"] for name, entry in row["cost"].items() if name != "fine_lines"}
        share = {name: format_percent(row["cost"][name]["ratio"]) for name in done}
        table.add_row(
            *_named(row),
            format_count(done["samples"]),
            share["samples"],
            DASH if done["bytes"] is None else f"{done['bytes'] / 1e6:.3g}",
            format_count(done["multiply_adds"]),
            share["multiply_adds"],
            DASH if done["cpu_s"] is None else f"{done['cpu_s']:.3f}",
            share["cpu_s"],
            _whole(done["frame_s"]),
            share["frame_s"],
            _whole(done["rig_s"]),
            share["rig_s"],
            style=_style(row),
        )
    return table


def _whole(seconds: float | None) -> str:
    return DASH if seconds is None else f"{seconds:.0f}"


def _compute(content: dict[str, Any]) -> Table:
    parts = ("glance", "score", "encode", "decode")
    table = _table("multiply-adds", "K", *parts)
    for row in content["rows"]:
        adds = row["cost"]["multiply_adds"]
        cells = (format_count(adds[part]) for part in parts)
        table.add_row(*_named(row), *cells, style=_style(row))
    return table


def _placement(content: dict[str, Any]) -> Table:
    """One line a policy: how its order of the seats agrees with the oracle's, and what the seats of each K gain."""
    rows: dict[str, list[dict[str, Any]]] = {}
    for row in content["rows"]:
        if row["policy"] not in ENDS and not row["control"]:
            rows.setdefault(row["policy"], []).append(row)
    shares = [f"{format_percent(share)}\ncaptured AP" for share in content["settings"]["shares"]]
    table = _table(
        "placement\n", "rank\n", "AP\ngain > 0", *shares, "area\nof gap", "hyper-\nvolume", "to 95 %\nof all"
    )
    curves = {one["policy"]: one for one in content["curves"]}
    for policy, own in rows.items():
        found = [f"{_ratio(row['captured_gain'])} {_ratio(row['ap_top'])}" for row in own]
        curve = curves.get(policy, {})
        volume, enough = curve.get("hypervolume"), curve.get("cost_to_enough")
        summed = [
            _ratio(curve.get("auc_gap")),
            DASH if volume is None else f"{100 * volume:.2f}",
            format_percent(enough),
        ]
        table.add_row(_name(own[0]), _ratio(own[0]["spearman"]), _ratio(own[0]["ap_gain"]), *found, *summed)
    return table


def _ratio(value: float | None) -> str:
    return DASH if value is None else f"{value:.2f}"


def _classes(content: dict[str, Any]) -> Table:
    shown = [row for row in content["rows"] if row["policy"] in ENDS]
    first = [row for row in content["rows"] if row["policy"] == content["rows"][1]["policy"]]
    shown.insert(1, min(first, key=lambda row: abs(row["share"] - SHOWN_SHARE)))
    shown += [row for row in content["rows"] if row["control"] and row["share"] in (0, 1)]
    shown = [row for number, row in enumerate(shown) if row not in shown[:number]]
    heads = [f"{row['policy']} {format_percent(row['share'])}\n{what}" for row in shown for what in ("IoU", "boundary")]
    table = _table("class", "labelled px", *heads)
    for name, support in content["support"].items():
        cells = []
        for row in shown:
            false = row["false_classes"].get(name)  # how often the map shows a class that the labels lack
            iou = format_points(row["per_class_iou"][name])
            cells += [iou if false is None else f"{format_count(false)} px false"]
            cells += [format_points(row["per_class_boundary_iou"][name])]
        table.add_row(escape(name), format_count(support), *cells)
    return table


def _caption(content: dict[str, Any]) -> str:
    averaged = {row["classes_averaged"] for row in content["rows"]}
    classes = " to ".join(str(number) for number in sorted({min(averaged), max(averaged)}))
    timed, notes = len(content["timed"]), content["notes"]
    before = f"{SHOWN_WORDS} " if definitions_differ(content["rows"]) else ""
    return (
        "K: share of the valid seats, free of each other (frame mode). mIoU over the counts of all frames, mean over "
        f"the {classes} classes of the labels (per frame, in / out: those they have there); overall: share of pixels "
        f"that are right. {before}± the spread of seeds, else of random draws. [ ] 95 % of "
        f"{content['settings']['draws']} draws: {notes['intervals']}. * uses labels.\n"
        "rank: Spearman of scores and gain; AP: average precision for seats with a gain, and for the oracle's own K; "
        "captured: the chosen seats' share of the gain that the oracle's seats have.\n"
        f"area of gap, hypervolume (points), least cost to reach 95 % of the mIoU of all: {notes['curves']}.\n"
        f"MB: {notes['bytes']}. madds: multiply-adds. CPU: {notes['cpu_s']} ({timed} timed).\n"
        f"capture ({len(content['captured'])} priced): {notes['capture_s']}."
    )


def budget_tables(content: dict[str, Any]) -> Iterator[Table]:
    """Give tables of one threshold for all frames, of the rig's plans and of equal time, as far as they were judged."""
    if any(row["thresholds"] for row in content["rows"]):
        yield _pooled(content)
    if content["rig"]["rows"] or content["rig"]["left_out"]:
        yield _rig(content)
    if content["equal_time"]:
        yield _equal_time(content)


def format_difference(interval: dict[str, float | None] | None, digits: int = 1) -> str:
    """Points of mIoU with the bounds of the interval, as far as there are any."""
    if interval is None or interval["difference"] is None:
        return ""
    text = f"{100 * interval['difference']:+.{digits}f}"
    low, high = interval["low"], interval["high"]
    return text if low is None or high is None else f"{text} [{100 * low:+.{digits}f}, {100 * high:+.{digits}f}]"


def _table(first: str, *columns: str, title: str | None = None, caption: str = "") -> Table:
    table = Table(
        title=title,
        title_justify="left",
        title_style="",
        caption=caption or None,
        caption_justify="left",
        header_style="dim",
        box=SIMPLE_HEAD,
        collapse_padding=True,
    )
    table.add_column(first, no_wrap=True)
    for name in columns:
        table.add_column(name, justify="right", no_wrap=True)
    return table


def _pooled(content: dict[str, Any]) -> Table:
    names = ("K", "least", "most", "threshold", "mIoU", "to K on every frame")
    title = "pooled: one threshold for the scores of all frames, and the seats that a frame then has"
    table = _table("placement", *names, title=title, caption=content["notes"]["pooled"])
    for row in content["rows"]:
        if row["thresholds"]:
            seats = row["seats_per_frame"]
            table.add_row(
                row["policy"],
                format_percent(row["share"]),
                str(seats["least"]),
                str(seats["most"]),
                ", ".join(DASH if one is None else f"{one:.3g}" for one in row["thresholds"]),
                format_points(row["miou"]),
                format_difference(row["against_share_per_frame"], 2),
            )
    return table


def _rig(content: dict[str, Any]) -> Table:
    rig = content["rig"]
    names = ("budget", "seconds", "of full", "lines", "of full", "seats", "mIoU", "overall", "to uniform", "to random")
    table = _table("plan", *names, title="rig mode: mIoU at equal capture seconds", caption=_left_out(rig["left_out"]))
    for row in sorted(rig["rows"], key=lambda row: row["budget"]):
        table.add_row(
            row["policy"],
            format_percent(row["budget"]),
            _whole(row["seconds"]),
            _part(row["seconds"], row["full_s"]),
            _whole(row["lines"]),
            _part(row["lines"], row["full_lines"]),
            _whole(row["seats"]),
            format_points(row["miou"]),
            format_points(row["pixel_accuracy"]),
            format_difference(row["against_uniform"]),
            format_difference(row["against_random"]),
        )
    return table


def _left_out(missing: list[dict[str, Any]]) -> str:
    budgets: dict[float | None, list[str]] = {}
    for one in missing:
        budgets.setdefault(one["budget"], []).append(one["why"])
    return "\n".join(
        f"left out on {len(why)} frame{'s' if len(why) > 1 else ''}, "
        f"{'all budgets' if budget is None else format_percent(budget)}: {why[0]}"
        for budget, why in budgets.items()
    )


def _equal_time(content: dict[str, Any]) -> Table:
    names = ("K", "exposure", "seconds", "of full", "mIoU", "overall", "to all", "equal exposure", "to equal exposure")
    title = "equal time: as many capture seconds as all takes"
    table = _table("placement", *names, title=title, caption=content["notes"]["equal_time"])
    for row in content["equal_time"]:
        table.add_row(
            row["policy"],
            format_percent(row["share"]),
            f"x {row['exposure']:.2f}",
            _whole(row["seconds"]),
            _part(row["seconds"], row["full_s"]),
            format_points(row["miou"]),
            format_points(row["pixel_accuracy"]),
            format_difference(row["against_all"]),
            format_points(row["equal_exposure_miou"]),
            format_difference(row["against_equal_exposure"]),
        )
    return table


def _part(done: float | None, full: float | None) -> str:
    return DASH if done is None or not full else format_percent(done / full)
