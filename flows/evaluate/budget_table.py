"""An evaluation over budgets as tables: one threshold for all frames, plans of the rig, the exposure of equal time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from flows.terminal.figures import DASH, format_percent, format_points


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


def _table(title: str, caption: str, first: str, *columns: str) -> Table:
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
    table = _table(
        "pooled: one threshold for the scores of all frames, and the seats that a frame then has",
        content["notes"]["pooled"],
        "placement",
        *names,
    )
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
    table = _table("rig mode: mIoU at equal capture seconds", _left_out(rig["left_out"]), "plan", *names)
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
    """Which budgets were left out, on how many frames, and why on the first of them."""
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
    table = _table(
        "equal time: as many capture seconds as all takes", content["notes"]["equal_time"], "placement", *names
    )
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


def _whole(value: float | None) -> str:
    return DASH if value is None else f"{value:.0f}"


def _part(done: float | None, full: float | None) -> str:
    return DASH if done is None or not full else format_percent(done / full)
