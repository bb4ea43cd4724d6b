"""How the terminal shows two runs side by side."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flows.terminal.figures import DASH, format_count, format_percent, format_points, format_seconds

SAVINGS = {"lines": format_count, "capture_s": format_seconds, "tokens": format_count}
LABELS = {"lines": "lines", "capture_s": "time of capture", "tokens": "tokens"}


def panel_words(side: Mapping[str, Any]) -> str:
    """A run and how good it is, in words."""
    scores = (("mIoU", side["miou"]), ("overall", side["overall_accuracy"]))
    return ", ".join([str(side["run"]), *(f"{name} {format_points(one)}" for name, one in scores if one is not None)])


def change_words(differing: Mapping[str, Any]) -> str:
    """How much differs, in words."""
    return f"{format_count(differing['pixels'])} px, {format_percent(differing['share'])}"


def show_comparison(content: dict[str, Any], console: Console) -> None:
    """Print what `compare` found."""

    def say(text: str) -> None:
        console.print(escape(text), highlight=False, soft_wrap=True)

    say(f"A: {panel_words(content['a'])}\nB: {panel_words(content['b'])}")
    console.print(_class_table(content["classes"]))
    say(f"{change_words(content['differing'])} differ")
    if content["largest"]:
        table = _table("Largest changes", "A", "B", "pixels", "share", left=2)
        for row in content["largest"]:
            figures = (format_count(row["pixels"]), format_percent(row["share"]))
            table.add_row(escape(row["from"]), escape(row["to"]), *figures)
        console.print(table)
    sure = content["confidence"]
    if sure["a"] is not None:
        rose = format_percent(sure["rose"])
        say(
            f"confidence {sure['a']:.3f} in A, {sure['b']:.3f} in B ({sure['change']:+.3f}), higher at {rose} of pixels"
        )
    table = _table("Spent", "cost", "A", "B", left=1)
    for name, show in SAVINGS.items():
        table.add_row(LABELS[name], *(show(value) for value in content["savings"][name]))
    console.print(table)
    _show_changes(content, console)
    say(f"  {content['picture']}")


def _class_table(rows: list[dict[str, Any]]) -> Table:
    ground = any("ha" in row for row in rows)
    hectares = ("ha in A", "ha in B") if ground else ()
    table = _table("Classes", "class", "px in A", "px in B", "in A", "in B", *hectares, "IoU of A and B", left=1)
    for row in rows:
        figures = [*map(format_count, row["pixels"]), *map(format_percent, row["share"])]
        figures += [f"{area:.4g}" for area in row["ha"]] if "ha" in row else [DASH] * len(hectares)
        table.add_row(escape(row["name"].replace("_", " ")), *figures, format_points(row["iou"]))
    return table


def _show_changes(content: dict[str, Any], console: Console) -> None:
    if not content["settings"] and not content["versions"]:
        console.print("settings and versions are the same")
        return
    table = _table("What was not the same", "what", "name", "A", "B", left=4)
    for kind in ("settings", "versions"):
        for row in content[kind]:
            table.add_row(kind.removesuffix("s"), *(escape(str(row[name])) for name in ("name", "old", "new")))
    console.print(table)


def _table(title: str, *columns: str, left: int) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold", header_style="dim", box=SIMPLE_HEAD)
    for number, column in enumerate(columns):
        table.add_column(column, justify="left" if number < left else "right", overflow="fold")
    return table
