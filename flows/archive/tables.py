"""How the terminal shows an archive: runs and stores as tables, lineage as a tree, what changed, what is broken."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import PurePath
from typing import Any, Literal

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.tree import Tree

from flows.publish.receipt import is_pending
from flows.terminal.figures import DASH, counted, format_bytes, format_points, format_seconds
from storage.archive.keys import in_text

SHORT_KEY = 12
WHOLE = ("when", "key", "seed", "budget", "mIoU", "size", "state", "age", "stage", "what")  # columns never folded
MOST_ROWS = 20  # stores of a stage, changes, removals
DAY_S = 86400.0


def show_contents(content: dict[str, Any], console: Console) -> None:
    """Print what `ls` found."""
    runs = _table("Runs", "run", "scene", "seed", "budget", "mIoU", "size", "age", "state", left=2)
    for run in content["runs"]:
        miou = run["miou"] if isinstance(run["miou"], int | float) else None
        scored = "not yet" if is_pending(run) else format_points(miou)
        runs.add_row(
            escape(run["id"]),
            escape(PurePath(str(run["scene"])).name) if run["scene"] else DASH,
            _plain(run["seed"]),
            _plain(run["budget"]),
            scored,
            format_bytes(run["bytes"]),
            _age(run["age_s"]),
            run["state"] if run["state"] == "there" else f"[bold red]{escape(run['state'])}[/]",
        )
    console.print(runs if content["runs"] else "no runs")
    stores = _table("Stores", "stage", "key", "version", "size", "age", "runs that name it")
    for stage, rows in content["stages"].items():
        for number, row in enumerate(rows[-MOST_ROWS:]):
            size = "cleared" if row["cleared"] else format_bytes(row["bytes"])
            size = "[bold red]damaged[/]" if row["problem"] else size
            stores.add_row(
                escape(stage) if number == 0 else "",
                escape(row["key"]),
                escape(row["version"]),
                size,
                _age(row["age_s"]),
                str(row["runs"] or "none"),
            )
        if len(rows) > MOST_ROWS:
            stores.add_row("", f"[dim]and {len(rows) - MOST_ROWS} older[/]", "", "", "", "")
    console.print(stores if content["stages"] else "no stores")
    for uri in content["lost"]:
        console.print(f"[bold red]{escape(uri)} has lost its manifest; run verify[/]", soft_wrap=True)
    count = sum(map(len, content["stages"].values()))
    _say(
        console, f"{counted(len(content['runs']), 'run')}, {counted(count, 'store')}, {format_bytes(content['bytes'])}"
    )


def show_clearance(content: dict[str, Any], console: Console) -> None:
    """Print what `gc` removed or would remove."""
    verb = "would go" if content["dry_run"] else "went"
    for removal in content["removals"][:MOST_ROWS]:
        _say(console, f"{removal['uri']}  {format_bytes(removal['size'])}  {removal['why']}")
    if len(content["removals"]) > MOST_ROWS:
        _say(console, f"and {len(content['removals']) - MOST_ROWS} more")
    for reason in dict.fromkeys(content["kept"].values()):
        count = sum(why == reason for why in content["kept"].values())
        _say(console, f"{counted(count, 'store')} that no run names {'stays' if count == 1 else 'stay'}: {reason}")
    if content["obstacle"] is not None:
        console.print(f"[bold yellow]{escape(content['obstacle'])}[/]", soft_wrap=True)
    _say(console, f"{len(content['removals'])} things {verb}, {format_bytes(content['bytes'])}")


def show_explanation(content: dict[str, Any], console: Console) -> None:
    """Print a product's lineage, and what changed since the version before."""
    run = content.get("run")
    if run is not None:
        where = f"{content['product']}: {run['scene']}, seed {run['seed']}, budget {run['budget']}, {run['state']}"
        _say(console, run["problem"] or where)
        if run["command"]:
            _say(console, run["command"])
    for node in content["lineage"]:
        console.print(_branch(node, None))
    if run is None:
        _say(console, f"named by {', '.join(content['runs']) or 'no run: gc will remove it'}")
        _show_changes(content, console)


def _show_changes(content: dict[str, Any], console: Console) -> None:
    if content["before"] is None:
        _say(console, "there is no earlier version of it in this archive")
        return
    table = _table(f"Changed since {content['before']}", "stage", "what", "name", "before", "now", left=5)
    for change in content["changes"][:MOST_ROWS]:
        values = [_short(change[name]) for name in ("old", "new")]
        table.add_row(*map(escape, (change["where"], change["kind"], change["name"], *values)))
    if len(content["changes"]) > MOST_ROWS:
        table.add_row("", "", f"[dim]and {len(content['changes']) - MOST_ROWS} more; --json has all[/]", "", "")
    console.print(table)


def _branch(node: Mapping[str, Any], parent: Tree | None) -> Tree:
    words = _node_words(node)
    tree = Tree(words) if parent is None else parent.add(words)
    for given in node["inputs"]:
        _branch(given, tree)
    return tree


def _node_words(node: Mapping[str, Any]) -> str:
    if "stage" not in node:
        return f"[bold red]{escape(node['uri'])} {escape(node['problem'])}[/]"
    name = f"[bold]{escape(node['stage'])}[/] {escape(node['key'][:SHORT_KEY])}"
    called = [word for word in node["called"] if word != node["stage"]]
    name += f" [dim]({escape(', '.join(called))})[/]" if called else ""
    if node["problem"] is not None:
        return f"{name} [bold red]damaged: {escape(node['problem'])}[/]"
    if "see" in node:
        return f"{name} [dim]{node['see']}[/]"
    took = "" if node["wall_s"] is None else f", took {format_seconds(node['wall_s'])}"
    when = escape(node["created"][:16].replace("T", " ")) or DASH
    size = "cleared away, made again when it is asked for" if node["cleared"] else format_bytes(node["bytes"])
    return f"{name} version {escape(node['version'])}, {when}, {size}{took}"


def show_verdict(content: dict[str, Any], console: Console) -> None:
    """Print what `verify` found, and what would remake it."""
    for finding in content["problems"]:
        console.print(f"[bold red]{escape(finding['uri'])}[/]: {escape(finding['problem'])}", soft_wrap=True)
    for uri, why in content.get("hopeless", {}).items():
        _say(console, f"{uri} cannot be remade: {why}")
    if content.get("to_remake") or content.get("surveys"):
        count = len(content["to_remake"])
        _say(console, f"verify --repair makes {count} broken stores anew by:")
        for survey in content["surveys"]:
            _say(console, f"  {survey['run']}: {survey['command']}")
    _say(console, f"{content['whole']} of {content['checked']} stores and runs are as published")


def show_repair(content: dict[str, Any], console: Console) -> None:
    """Print what a repair did."""
    done = content["repair"]
    for title, part in (("failed", done["failed"]), ("left as it is", done["hopeless"])):
        for uri, why in part.items():
            console.print(f"[bold yellow]{title}[/] {escape(uri)}: {escape(why)}", soft_wrap=True)
    left = "nothing broken is left" if done["complete"] else "some could not be made anew"
    _say(console, f"{len(done['remade'])} remade, {len(done['dropped'])} that no run named removed; {left}")


def _table(title: str, *columns: str, left: int = 3) -> Table:
    table = Table(
        pad_edge=False,
        title=escape(title),
        title_justify="left",
        title_style="bold",
        header_style="dim",
        box=SIMPLE_HEAD,
        collapse_padding=True,
    )
    for number, column in enumerate(columns):
        justify: Literal["left", "right"] = "left" if number < left else "right"
        table.add_column(column, justify=justify, overflow="fold", no_wrap=column in WHOLE)
    return table


def _say(console: Console, text: str) -> None:
    console.print(escape(text), soft_wrap=True)


def _age(seconds: float | None) -> str:
    if seconds is None:
        return DASH
    for unit, word in ((DAY_S, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 2 * unit:
            return f"{seconds // unit:.0f} {word}"
    return format_seconds(max(seconds, 0))


def _plain(value: object) -> str:
    return DASH if value is None else escape(str(value))


def _short(value: object) -> str:
    text = str(value)
    if in_text(text) == text:
        _, stage, key = text.split("/")
        return f"{stage} {key[:SHORT_KEY]}"
    return text if len(text) <= 60 else f"{text[:57]}..."
