"""What `pack` does: storage packs old raw sweeps, this shows how far it is and what it saved."""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flows.publish.receipt import to_json
from flows.terminal.figures import DASH, format_bytes
from flows.terminal.progress import StageProgress
from flows.terminal.shown_text import on_stdout
from storage.archive.archive import Archive
from storage.remote.opening import open_archive
from storage.repacking import Packed, Packing, pack, plan_packing

DONE, PARTLY = 0, 3
STAGE = "pack"


def run_pack(
    archive: str | Path, console: Console, *, older_than: float = 30.0, dry_run: bool = False, as_json: bool = False
) -> int:
    """Pack raw stores older than so many days; progress on ``console``, what was packed (or would be) on stdout.

    Returns
    -------
    Exit code: 3 where the archive is in use, or a store is damaged.
    """
    opened = open_archive(archive, create=False, write=not dry_run)
    done = (
        _pack(opened, console, older_than)
        if not dry_run
        else Packed(tuple(plan_packing(opened, older_than=older_than)))
    )
    content: dict[str, Any] = {
        "archive": str(opened.root),
        "dry_run": dry_run,
        "stores": [_row(one) for one in done.stores],
        "bytes_saved": done.saved,
        "obstacle": done.obstacle,
    }
    if as_json:
        sys.stdout.write(to_json(content))
    else:
        _show(done, on_stdout(), dry_run=dry_run)
    partly = done.obstacle is not None or any(one.state == "failed" for one in done.stores)
    return PARTLY if partly else DONE


def _pack(archive: Archive, console: Console, older_than: float) -> Packed:
    with StageProgress(console, {STAGE: "packing raw sweeps"}) as bars:
        done = pack(archive, older_than=older_than, progress=lambda uri, share: bars.show(STAGE, share, uri))
        bars.show(STAGE, 1.0, f"{format_bytes(done.saved)} saved", ended=True)
    return done


def _row(one: Packing) -> dict[str, Any]:
    return {**asdict(one), "ratio": None if one.after is None else one.before / one.after}


def _show(done: Packed, console: Console, *, dry_run: bool) -> None:
    """A table of what was packed, the reasons why others were not, and the sum."""
    named = [one for one in done.stores if one.state in ("packed", "to pack")]
    if named:
        console.print(_table(named, "Would be packed" if dry_run else "Packed"))
    reasons = Counter(one.why for one in done.stores if one.state == "skipped")
    for reason, count in reasons.items():
        _say(console, f"{count} left as stored: {reason}")
    for one in done.stores:
        if one.state == "failed":
            console.print(f"[bold red]{escape(one.uri)}[/]: {escape(one.why)}", highlight=False, soft_wrap=True)
    if done.obstacle is not None:
        console.print(f"[bold yellow]{escape(done.obstacle)}[/]", highlight=False, soft_wrap=True)
    if dry_run:
        size = sum(one.before for one in named)
        return _say(console, f"{len(named)} of {len(done.stores)} raw stores would be packed, {format_bytes(size)}")
    count = sum(one.state == "packed" for one in named)
    return _say(console, f"{count} of {len(done.stores)} raw stores packed, {format_bytes(done.saved)} saved")


def _table(rows: list[Packing], title: str) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold", header_style="dim", box=SIMPLE_HEAD)
    table.add_column("store", overflow="fold")
    for column in ("before", "after", "ratio"):
        table.add_column(column, justify="right", no_wrap=True)
    for one in rows:
        ratio = DASH if one.after is None else f"{one.before / one.after:.2f}"
        table.add_row(escape(one.uri), format_bytes(one.before), format_bytes(one.after), ratio)
    return table


def _say(console: Console, text: str) -> None:
    console.print(escape(text), highlight=False, soft_wrap=True)
