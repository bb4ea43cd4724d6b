"""The verb `rig check`, a table of questions to both devices and of answers.

Every driver has to connect. With ``move`` the mirror visits the corners of a small square, and with ``capture`` the
camera takes a few lines; else nothing moves and nothing is set. The shipped drivers are asked for more: identity,
status, files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from spectralzoom.flows.settings.flags import AsJson, Switch
from spectralzoom.flows.settings.settings import Settings, load_settings
from spectralzoom.flows.terminal.processes import DONE, FAILED, PARTLY
from spectralzoom.flows.terminal.progress import put_out, stderr
from spectralzoom.pipeline.errors import PipelineError, RigError, SettingsError
from spectralzoom.pipeline.rig.camera.camera_files import log_in
from spectralzoom.pipeline.rig.camera.headwall_camera import HeadwallCamera
from spectralzoom.pipeline.rig.capture_runner import SETTLE_S
from spectralzoom.pipeline.rig.drivers import (
    CameraDriver,
    MirrorDriver,
    RigDevices,
    open_camera_driver,
    open_mirror_driver,
)
from spectralzoom.pipeline.rig.fakes import FakeMirror
from spectralzoom.pipeline.rig.mirror_controller import MirrorController
from spectralzoom.pipeline.rig.rig_source import RigSource
from spectralzoom.pipeline.rig.transports import SYSTEM_CLOCK, Clock
from spectralzoom.pipeline.source import AT_REST

Device = Literal["mirror", "camera"]

SQUARE = ((0.03, 0.03), (0.03, -0.03), (-0.03, -0.03), (-0.03, 0.03))  # within 0.05 of the middle
CONNECT = "connect"
TRIED_LINES = 20
_COLOURS = {"ok": "green", "warn": "yellow", "fail": "bold red"}


@dataclass(frozen=True)
class CheckRow:
    """One question, the answer, and what to do where that is not right."""

    device: Device
    asked: str
    came: str
    verdict: Literal["ok", "warn", "fail"] = "ok"
    mend: str = ""


def failed(device: Device, asked: str, error: PipelineError) -> CheckRow:
    """Return the row of an error: what is wrong, and after its semicolon what to do."""
    came, _, mend = str(error).partition("; ")
    return CheckRow(device, asked, came, "fail", mend)


def works(rows: Sequence[CheckRow], device: Device) -> bool:
    """Return whether a device was asked and nothing failed."""
    verdicts = [row.verdict for row in rows if row.device == device]
    return bool(verdicts) and "fail" not in verdicts


def check_mirror(connect: Callable[[], MirrorDriver], *, move: bool = False) -> list[CheckRow]:
    """Ask a mirror for its identity and status; with ``move`` send it around a small square.

    ``connect`` opens the device, which is closed again. Errors become rows.
    """
    try:
        mirror = connect()
    except RigError as error:
        return [failed("mirror", CONNECT, error)]
    with closing(mirror):
        if isinstance(mirror, MirrorController):
            rows = [CheckRow("mirror", CONNECT, mirror.identity), _ask("mirror", "status", partial(_status, mirror))]
        else:
            rows = [CheckRow("mirror", CONNECT, f"{getattr(mirror, 'name', type(mirror).__name__)} is there")]
        if move and works(rows, "mirror"):
            rows += _move(mirror)
        elif move:
            rows.append(CheckRow("mirror", "move", "nothing was moved", "warn", "mend what is named above first"))
    return rows


def check_camera(connect: Callable[[], CameraDriver]) -> list[CheckRow]:
    """Ask a camera whether it captures, and the shipped one for its files. Errors become rows."""
    row = CheckRow("camera", "whether it captures", "no capture runs")
    try:
        camera = connect()
    except RigError as error:
        return [failed("camera", CONNECT, error)]
    with closing(camera):
        try:
            if camera.is_capturing():
                mend = "is another program at work? Else stop it"
                row = replace(row, came="a capture runs", verdict="warn", mend=mend)
        except RigError as error:
            row = failed("camera", CONNECT, error)
    if not isinstance(camera, HeadwallCamera):
        return [row]
    return [row, _ask("camera", f"log in to its files, port {camera.server.port}", partial(log_in, camera.server))]


def try_capture(connect: Callable[[], CameraDriver], wanted: Settings, clock: Clock = SYSTEM_CLOCK) -> CheckRow:
    """Take references and a few lines, as a survey does, with the mirror left alone. Errors become a row."""
    if wanted.wavelengths is None:
        raise SettingsError("--capture needs a settings file with wavelengths and the table [camera] of a survey")
    notes: list[str] = []

    def devices(_: object) -> RigDevices:
        return RigDevices(FakeMirror(clock), connect(), clock)

    source = RigSource(wanted.camera, np.array(wanted.wavelengths), devices, rig=wanted.rig, note=notes.append)
    try:
        with source.session():
            source.references(AT_REST)
            lines = list(source.lines(replace(AT_REST, name="check", lines=TRIED_LINES)))
    except RigError as error:
        return failed("camera", "capture", error)
    came = f"{sum(line.valid for line in lines)} of {TRIED_LINES} lines, dark and white frames"
    return CheckRow("camera", "capture", came, "warn" if notes else "ok", "; ".join(notes))


def _status(mirror: MirrorController) -> str:
    """Return the status in words; a mirror that moves gets as long to come to rest as in a survey."""
    mirror.settle(SETTLE_S)
    status = mirror.status()
    if status.stops_motion:
        raise RigError(f"{status.sentence}; mend that first: motions are refused with it")
    return status.sentence


def _move(mirror: MirrorDriver) -> Iterator[CheckRow]:
    """Send the mirror to the corners of a square and back to the middle; stop at the first error."""

    def go(x: float, y: float) -> str:
        mirror.goto(x, y)
        mirror.settle(SETTLE_S)
        return "at rest"

    for x, y in (*SQUARE, (0.0, 0.0)):
        yield (row := _ask("mirror", f"go to {x:g}; {y:g}", partial(go, x, y)))
        if row.verdict == "fail":
            return


def _ask(device: Device, asked: str, question: Callable[[], str]) -> CheckRow:
    """Return the row of a question to a device."""
    try:
        return CheckRow(device, asked, question())
    except RigError as error:
        return failed(device, asked, error)


def check(
    settings: Path | None = None,
    *,
    port: str | None = None,
    camera: str | None = None,
    move: Switch = False,
    capture: Switch = False,
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
    capture
        Also take dark and white frames and 20 lines with the camera, and compare them with the settings file.
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
            if capture and works(rows, "camera"):
                rows.append(try_capture(partial(open_camera_driver, rig), wanted))
    good = [works(rows, device) for device in dict.fromkeys(row.device for row in rows)]
    code = DONE if all(good) else PARTLY if any(good) else FAILED
    verdicts = [row.verdict for row in rows]
    content = {
        "port": rig.port if mirror_asked else None,
        "camera": rig.host if camera_asked else None,
        "move": move,
        "capture": capture,
        "rows": [asdict(row) for row in rows],
        "failed": verdicts.count("fail"),
        "warned": verdicts.count("warn"),
        "exit_code": code,
    }
    put_out(content, lambda _, console: _print(rows, console), as_json=as_json)
    return code


def _print(rows: Sequence[CheckRow], console: Console) -> None:
    table = Table("device", "asked", "came", "", box=SIMPLE_HEAD)
    shown = {verdict: f"[{colour}]{verdict}[/]" for verdict, colour in _COLOURS.items()}
    for row in rows:
        table.add_row(row.device, escape(row.asked), escape(row.came), shown[row.verdict])
    console.print(table)
    mend = [row for row in rows if row.mend]
    for row in mend:
        console.print(f"{shown[row.verdict]} {row.device}, {escape(row.asked)}: {escape(row.mend)}", soft_wrap=True)
    if not mend:
        console.print("nothing to mend")
