"""The verb `rig check`: what it asks and shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flows.settings.load import load_settings
from flows.terminal.processes import DONE, FAILED, PARTLY
from flows.terminal.progress import on_stdout, print_json
from pipeline.errors import SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import CostModel
from pipeline.rig.device_settings import CameraLimits, SurveyRig
from pipeline.rig.devices import SYSTEM_CLOCK
from pipeline.rig.opening import open_camera_driver, open_devices, open_mirror_driver
from pipeline.rig.rig_check import TRIGGERS, CheckRow, Device, check_camera, check_mirror, check_triggers, works

_COLOURS = {"ok": "green", "warn": "yellow", "fail": "bold red"}


@dataclass(frozen=True)
class CheckRequest:
    """Which devices to check; None leaves one out."""

    rig: SurveyRig
    mirror: bool = True
    camera: bool = True
    move: bool = False
    vector_pairs: int = CostModel.vector_pairs
    exposed: LineCamera = field(default_factory=LineCamera)  # times of a capture whose edges are counted


def check_request(settings: Path | None, port: str | None, camera: str | None, *, move: bool = False) -> CheckRequest:
    """What to check: both devices of the settings, or those that are named (SettingsError: they cannot be used)."""
    wanted = load_settings(settings)
    rig = wanted.rig
    if port is not None:
        rig = replace(rig, port=port)
    if camera is not None:
        rig = _at(rig, camera)
    both = settings is not None or port is camera is None
    mirror_asked, camera_asked = both or port is not None, both or camera is not None
    return CheckRequest(rig, mirror_asked, camera_asked, move, wanted.cost.vector_pairs, wanted.camera)


def run_check(request: CheckRequest, console: Console, *, as_json: bool = False) -> int:
    """Check the devices, with a table on stdout; 0 where nothing failed, 3 where one of two works, 1 otherwise."""
    rig = replace(request.rig, park_at_close=False)  # the square ends at 0; 0 by itself
    limits = CameraLimits(most_rate_hz=request.exposed.max_rate_hz)
    asked: dict[Device, bool] = {"mirror": request.mirror, "camera": request.camera}
    rows: list[CheckRow] = []
    if request.mirror:
        with console.status(f"asking the mirror at {rig.port}"):
            open_mirror = partial(open_mirror_driver, rig, request.vector_pairs)
            rows += check_mirror(open_mirror, SYSTEM_CLOCK, move=request.move)
    if request.camera:
        with console.status(f"asking the camera at {rig.host}"):
            rows += check_camera(partial(open_camera_driver, rig, limits))
    why_not = _why_no_triggers(request, rows)
    if request.mirror and why_not:
        rows.append(CheckRow("mirror", TRIGGERS, f'not tried {why_not}; pulses = "{rig.pulses}" is taken on trust'))
    elif request.mirror:
        with console.status("asking what steps a path"):
            connect = partial(open_devices, rig, request.vector_pairs, limits)
            rows += check_triggers(connect, SYSTEM_CLOCK, rig.pulses, request.exposed)
    good = [works(rows, device) for device, is_asked in asked.items() if is_asked]
    code = DONE if all(good) else PARTLY if any(good) else FAILED
    if not as_json:
        _print(rows, on_stdout())
        return code
    print_json(
        {
            "port": rig.port if request.mirror else None,
            "camera": f"{rig.host}:{rig.control_port}" if request.camera else None,
            "move": request.move,
            "rows": [row.record() for row in rows],
            "failed": sum(row.verdict == "fail" for row in rows),
            "warned": sum(row.verdict == "warn" for row in rows),
            "exit_code": code,
        }
    )
    return code


def _why_no_triggers(request: CheckRequest, rows: Sequence[CheckRow]) -> str:
    """Return why no path is played; "" where one is."""
    if not request.move:
        return "without --move"
    if not request.camera:
        return "without a camera"
    return "" if all(row.verdict == "ok" for row in rows) else "as not all of the above is in order"


def _print(rows: Sequence[CheckRow], console: Console) -> None:
    table = Table("device", "asked", "came", "", box=SIMPLE_HEAD)
    for row in rows:
        verdict = f"[{_COLOURS[row.verdict]}]{row.verdict}[/]"
        table.add_row(row.device, escape(row.asked), escape(row.came), verdict)
    console.print(table)
    mend = [row for row in rows if row.mend]
    for row in mend:
        say = f"[{_COLOURS[row.verdict]}]{row.verdict}[/] {row.device}, {escape(row.asked)}: {escape(row.mend)}"
        console.print(say, soft_wrap=True)
    if not mend:
        console.print("nothing to mend")


def _at(rig: SurveyRig, camera: str) -> SurveyRig:
    """The rig with the camera at HOST, HOST:PORT or HOST:PORT:FILE_PORT."""
    host, *ports = camera.split(":")
    if not host or len(ports) > 2 or not all(port.isdecimal() and 0 < int(port) < 65536 for port in ports):
        raise SettingsError(f"--camera expects HOST, HOST:PORT or HOST:PORT:FILE_PORT, got {camera!r}")
    control, files = (*map(int, ports), *(rig.control_port, rig.file_port)[len(ports) :])
    return replace(rig, host=host, control_port=control, file_port=files)
