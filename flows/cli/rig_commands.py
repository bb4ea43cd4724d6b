"""The verb `rig check`, a table of questions and answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flows.settings.flags import AsJson, Switch
from flows.settings.load import load_settings
from flows.terminal.processes import DONE, FAILED, PARTLY
from flows.terminal.progress import on_stdout, print_json, stderr
from pipeline.rig.drivers import open_camera_driver, open_mirror_driver
from pipeline.rig.rig_check import CheckRow, Device, check_camera, check_mirror, works

_COLOURS = {"ok": "green", "warn": "yellow", "fail": "bold red"}


def check(
    settings: Path | None = None,
    *,
    port: str | None = None,
    camera: str | None = None,
    move: Switch = False,
    as_json: AsJson = False,
) -> int:
    """Connect to mirror and camera, read their state, and report problems with remedies.

    Exit code: 0 without problems, 3 if one of two devices works, 2 for a wrong setting or file, else 1.

    Parameters
    ----------
    settings
        Settings file (TOML) whose table [rig] has the addresses of both devices. Flags override it.
    port
        Port of the mirror controller: /dev/ttyACM0 or COM3. Without a settings file, only named devices are checked.
    camera
        Address of the camera: 10.0.65.50.
    move
        Also move the mirror along a small square, within 0.05 of the middle of its range. It stops at 0; 0.
    """
    wanted = load_settings(settings)
    rig = wanted.rig if port is None else replace(wanted.rig, port=port)
    rig = rig if camera is None else replace(rig, host=camera)
    both = settings is not None or port is camera is None
    mirror_asked, camera_asked = both or port is not None, both or camera is not None
    rows: list[CheckRow] = []
    if mirror_asked:
        with stderr.status(f"asking the mirror at {escape(rig.port)}"):
            rows += check_mirror(partial(open_mirror_driver, rig, wanted.cost.vector_pairs), move=move)
    if camera_asked:
        with stderr.status(f"asking the camera at {escape(rig.host)}"):
            rows += check_camera(partial(open_camera_driver, rig))
    asked: dict[Device, bool] = {"mirror": mirror_asked, "camera": camera_asked}
    good = [works(rows, device) for device, is_asked in asked.items() if is_asked]
    code = DONE if all(good) else PARTLY if any(good) else FAILED
    if not as_json:
        _print(rows, on_stdout())
        return code
    print_json(
        {
            "port": rig.port if mirror_asked else None,
            "camera": rig.host if camera_asked else None,
            "move": move,
            "rows": [asdict(row) for row in rows],
            "failed": sum(row.verdict == "fail" for row in rows),
            "warned": sum(row.verdict == "warn" for row in rows),
            "exit_code": code,
        }
    )
    return code


def _print(rows: Sequence[CheckRow], console: Console) -> None:
    table = Table("device", "asked", "came", "", box=SIMPLE_HEAD)
    for row in rows:
        table.add_row(row.device, escape(row.asked), escape(row.came), f"[{_COLOURS[row.verdict]}]{row.verdict}[/]")
    console.print(table)
    mend = [row for row in rows if row.mend]
    for row in mend:
        say = f"[{_COLOURS[row.verdict]}]{row.verdict}[/] {row.device}, {escape(row.asked)}: {escape(row.mend)}"
        console.print(say, soft_wrap=True)
    if not mend:
        console.print("nothing to mend")
