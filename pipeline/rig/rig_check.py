"""What `rig check` asks of both devices. Nothing moves and nothing is set, unless the square is asked for."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Literal

from pipeline.errors import PipelineError, RigError
from pipeline.rig.camera.camera_files import log_in
from pipeline.rig.camera.headwall_camera import HeadwallCamera
from pipeline.rig.device_settings import FileServer
from pipeline.rig.mirror.mirror_controller import MirrorController, check_model
from pipeline.rig.mirror.registers import Status

Verdict = Literal["ok", "warn", "fail"]
Device = Literal["mirror", "camera"]

SQUARE = ((0.03, 0.03), (0.03, -0.03), (-0.03, -0.03), (-0.03, 0.03))  # within 0.05 of the middle
NEAR, FAR = 0.002, 0.02  # of the disk's radius: a position read back is right within NEAR, and lost beyond FAR
SETTLE_S = 2.0
LOG_HZ, LOGGED = 1000.0, 8
MOST_NAMED = 5  # entries of a listing, warnings
CONNECT = "connect"
RESTLESS = "look for wind, a loose mount or a drive that hunts; a survey waits for rest in vain"
LOOK_AT_LINE = "look at cable, plugs and earth if this comes again"


@dataclass(frozen=True)
class CheckRow:
    """One thing that was asked, what came, and what to do where that is not right."""

    device: Device
    asked: str
    came: str
    verdict: Verdict = "ok"
    mend: str = ""

    def record(self) -> dict[str, str]:
        """As plain values."""
        return asdict(self)


def failed(device: Device, asked: str, error: PipelineError) -> CheckRow:
    """Give the row of an error: what is wrong, and behind its semicolon what to do."""
    came, _, mend = str(error).partition("; ")
    return CheckRow(device, asked, came, "fail", mend)


def works(rows: Sequence[CheckRow], device: Device) -> bool:
    """Whether a device was asked something and nothing failed."""
    verdicts = [row.verdict for row in rows if row.device == device]
    return bool(verdicts) and "fail" not in verdicts


def check_mirror(connect: Callable[[], MirrorController], *, move: bool = False) -> list[CheckRow]:
    """Ask a mirror controller who it is and how it is; with ``move`` send it round a small square.

    ``connect`` opens the port and greets the device there. It is closed again. Errors become rows.
    """
    rows: list[CheckRow] = []
    with _warnings(rows, "mirror"):
        try:
            mirror = connect()
        except RigError as error:
            rows.append(failed("mirror", CONNECT, error))
            return rows
        try:
            _ask_mirror(mirror, rows, move=move)
        finally:
            mirror.close()
    return rows


def check_camera(camera: HeadwallCamera, server: FileServer) -> list[CheckRow]:
    """Ask a camera whether it captures and what it holds, and log in to its files. Errors become rows."""
    rows: list[CheckRow] = []
    with _warnings(rows, "camera"):
        try:
            if camera.is_capturing():
                mend = "is another program at work? Else stop it"
                rows.append(CheckRow("camera", "whether it captures", "a capture runs", "warn", mend))
            else:
                rows.append(CheckRow("camera", "whether it captures", "no capture runs"))
            _row(rows, "camera", "list its files", lambda: _listing(camera))
        except RigError as error:
            rows.append(failed("camera", CONNECT, error))
        finally:
            camera.close()
        _row(rows, "camera", f"log in to its files, port {server.port}", lambda: log_in(server))
    return rows


def _ask_mirror(mirror: MirrorController, rows: list[CheckRow], *, move: bool) -> None:
    found = mirror.identity()
    try:
        check_model(found, mirror.wire.port, mirror.settings.expected_id)
        rows.append(CheckRow("mirror", "identity", found.words))
    except RigError as error:
        rows.append(failed("mirror", "identity", error))
    if mirror.found_in_pro:
        rows.append(CheckRow("mirror", "mode", "it was in pro mode, as drivers leave it"))
    try:
        playing = mirror.is_playing()
        rows.append(_status(mirror, playing=playing))
        if playing:
            mend = "is another program at work? Else halt it: a survey would"
            rows.append(CheckRow("mirror", "path", "a path plays", "warn", mend))
        else:
            rows.append(CheckRow("mirror", "path", "no path plays"))
            rows.append(CheckRow("mirror", "temperature", f"{mirror.temperature():.1f} deg C"))
    except RigError as error:
        rows.append(failed("mirror", "status", error))
    if move and (playing or any(row.verdict == "fail" for row in rows)):
        rows.append(CheckRow("mirror", "move", "nothing was moved", "warn", "mend what is told above first"))
    elif move:
        _move(mirror, rows)


def _status(mirror: MirrorController, *, playing: bool) -> CheckRow:
    """What a survey would meet: one waits as long for the mirror to come to rest."""
    status = mirror.status()
    until = mirror.wire.clock.now() + SETTLE_S
    while Status.NOT_STABLE in status and not playing and mirror.wire.clock.now() < until:
        mirror.wire.clock.sleep(SETTLE_S / 10)
        status = mirror.status()
    if Status.NOT_STABLE in status and not playing:
        return CheckRow("mirror", "status", status.sentence, "fail", f"it has been so for {SETTLE_S:g} s: {RESTLESS}")
    if status.stops_motion:
        return CheckRow("mirror", "status", status.sentence, "fail", "mend that first: motions are refused with it")
    if status:
        return CheckRow("mirror", "status", status.sentence, "warn", "have a look at the mirror before a survey")
    return CheckRow("mirror", "status", status.sentence)


def _move(mirror: MirrorController, rows: list[CheckRow]) -> None:
    """Send the mirror to the corners of a square and back to the middle; stops at the first error."""
    for x, y in (*SQUARE, (0.0, 0.0)):
        asked = f"go to {x:g}; {y:g}"
        try:
            mirror.goto(x, y)
            mirror.settle(SETTLE_S)
            mirror.start_log(LOG_HZ)
            mirror.wire.clock.sleep(2 * LOGGED / LOG_HZ)
            found = mirror.read_log(LOGGED).position.astype(float).mean(axis=0)
        except RigError as error:
            rows.append(failed("mirror", asked, error))
            return
        off = math.dist((x, y), found)
        words = f"read back {found[0]:.4f}; {found[1]:.4f}, {off:.1g} off"
        if not off <= FAR:
            mend = "it is not where it was sent: look at the mirror head and its cable before it moves again"
            rows.append(CheckRow("mirror", asked, words, "fail", mend))
        elif off > NEAR:
            mend = "further off than 0.15 deg would explain: is it in tune?"
            rows.append(CheckRow("mirror", asked, words, "warn", mend))
        else:
            rows.append(CheckRow("mirror", asked, words))


def _listing(camera: HeadwallCamera) -> str:
    names = [file.name for file in camera.list_files("/")]
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return f"{', '.join(names[:MOST_NAMED])}{more}" if names else "nothing there"


def _row(rows: list[CheckRow], device: Device, asked: str, ask: Callable[[], str]) -> None:
    try:
        rows.append(CheckRow(device, asked, ask()))
    except RigError as error:
        rows.append(failed(device, asked, error))


@contextmanager
def _warnings(rows: list[CheckRow], device: Device) -> Iterator[None]:
    """Make a row of what the drivers warned of: answers that were late, damaged, or not asked for."""
    logger, heard = logging.getLogger("pipeline.rig"), logging.Handler(logging.WARNING)
    words: list[str] = []
    heard.emit = lambda record: words.append(record.getMessage())  # type: ignore[method-assign]
    logger.addHandler(heard)
    try:
        yield
    finally:
        logger.removeHandler(heard)
        if words and rows and rows[0].asked != CONNECT:  # that row says it all
            more = f"; and {len(words) - MOST_NAMED} more" if len(words) > MOST_NAMED else ""
            came = "; ".join(one.partition("; ")[0] for one in words[:MOST_NAMED])
            rows.append(CheckRow(device, "bytes on the line", came + more, "warn", LOOK_AT_LINE))
