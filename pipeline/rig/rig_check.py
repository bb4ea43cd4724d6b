"""The questions of `rig check` to both devices. Nothing moves and nothing is set, unless ``move`` is asked for.

Every driver has to connect; with ``move`` the mirror visits the corners of a small square. The shipped drivers are
asked for more: identity, status, files.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

from pipeline.errors import PipelineError, RigError, list_some
from pipeline.rig.camera.camera_files import log_in
from pipeline.rig.camera.headwall_camera import HeadwallCamera
from pipeline.rig.capture_runner import SETTLE_S
from pipeline.rig.drivers import CameraDriver, MirrorDriver
from pipeline.rig.mirror_controller import MirrorController

Device = Literal["mirror", "camera"]

SQUARE = ((0.03, 0.03), (0.03, -0.03), (-0.03, -0.03), (-0.03, 0.03))  # within 0.05 of the middle
CONNECT = "connect"


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
    try:
        if isinstance(mirror, MirrorController):
            rows = [CheckRow("mirror", CONNECT, mirror.identity.summary)]
            _row(rows, "mirror", "status", lambda: _status(mirror))
        else:
            rows = [CheckRow("mirror", CONNECT, f"{type(mirror).__name__} is there")]
        if move and works(rows, "mirror"):
            _move(mirror, rows)
        elif move:
            rows.append(CheckRow("mirror", "move", "nothing was moved", "warn", "mend what is named above first"))
    finally:
        mirror.close()
    return rows


def check_camera(connect: Callable[[], CameraDriver]) -> list[CheckRow]:
    """Ask a camera whether it captures, and the shipped one for its files. Errors become rows."""
    rows: list[CheckRow] = []
    try:
        camera = connect()
    except RigError as error:
        return [failed("camera", CONNECT, error)]
    try:
        if camera.is_capturing():
            mend = "is another program at work? Else stop it"
            rows.append(CheckRow("camera", "whether it captures", "a capture runs", "warn", mend))
        else:
            rows.append(CheckRow("camera", "whether it captures", "no capture runs"))
        if isinstance(camera, HeadwallCamera):
            files = camera.list_files
            _row(rows, "camera", "list its files", lambda: list_some([one.name for one in files("/")]) or "none")
    except RigError as error:
        rows.append(failed("camera", CONNECT, error))
    finally:
        camera.close()
    if isinstance(camera, HeadwallCamera):
        _row(rows, "camera", f"log in to its files, port {camera.server.port}", partial(log_in, camera.server))
    return rows


def _status(mirror: MirrorController) -> str:
    """Return the status in words; a mirror that moves gets as long to come to rest as in a survey."""
    mirror.settle(SETTLE_S)
    status = mirror.status()
    if status.stops_motion:
        raise RigError(f"{status.sentence}; mend that first: motions are refused with it")
    return status.sentence


def _move(mirror: MirrorDriver, rows: list[CheckRow]) -> None:
    """Send the mirror to the corners of a square and back to the middle; stop at the first error."""
    for x, y in (*SQUARE, (0.0, 0.0)):
        asked = f"go to {x:g}; {y:g}"
        try:
            mirror.goto(x, y)
            mirror.settle(SETTLE_S)
        except RigError as error:
            rows.append(failed("mirror", asked, error))
            return
        rows.append(CheckRow("mirror", asked, "at rest"))


def _row(rows: list[CheckRow], device: Device, asked: str, ask: Callable[[], str]) -> None:
    try:
        rows.append(CheckRow(device, asked, ask()))
    except RigError as error:
        rows.append(failed(device, asked, error))
