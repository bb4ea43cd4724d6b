"""The questions of `rig check` to both devices. Nothing moves and nothing is set, unless ``move`` is asked for.

Every driver has to connect; with ``move`` the mirror visits the corners of a small square and plays a path that stays
at 0; 0. The shipped drivers are asked for more: identity, status, frames with and without a CRC, files.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from pipeline.errors import PipelineError, RigError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep
from pipeline.rig.camera.camera_files import log_in
from pipeline.rig.camera.headwall_camera import HeadwallCamera
from pipeline.rig.capture.capture_paths import capture_prefix
from pipeline.rig.capture.capture_runner import POLL_S, SLACK_S
from pipeline.rig.device_settings import Pulses
from pipeline.rig.drivers import CameraDriver, MirrorDriver, RigDevices
from pipeline.rig.mirror.mirror_controller import MirrorController, check_model
from pipeline.rig.mirror.pro_mode import Status, Trigger
from pipeline.rig.transports import Clock

Verdict = Literal["ok", "warn", "fail"]
Device = Literal["mirror", "camera"]

SQUARE = ((0.03, 0.03), (0.03, -0.03), (-0.03, -0.03), (-0.03, 0.03))  # within 0.05 of the middle
NEAR, FAR = 0.002, 0.02  # of the disk's radius: errors of a position from which on it is odd, and wrong
SETTLE_S = 2.0
LOG_HZ, LOGGED = 1000.0, 8
CELLS, OWN_HZ, OWN_S = 40, 20.0, 0.5  # of a path that stays at 0; 0: cells, rate and duration
EDGES = Sweep("check", "coarse", "x", 0.0, 0.0, lines=4, step=8, binning=8)  # to count the edges of
TRIGGERS = "what steps a path"
MOST_NAMED = 5  # entries of a listing, warnings
CONNECT = "connect"
RESTLESS = "look for wind, a loose mount or an oscillating drive; a survey would wait in vain"
CHECK_CABLE = "look at cable, plugs and earth if this comes again"


@dataclass(frozen=True)
class CheckRow:
    """One question, the answer, and what to do where that is not right."""

    device: Device
    asked: str
    came: str
    verdict: Verdict = "ok"
    mend: str = ""


def failed(device: Device, asked: str, error: PipelineError) -> CheckRow:
    """Return the row of an error: what is wrong, and after its semicolon what to do."""
    came, _, mend = str(error).partition("; ")
    return CheckRow(device, asked, came, "fail", mend)


def works(rows: Sequence[CheckRow], device: Device) -> bool:
    """Return whether a device was asked and nothing failed."""
    verdicts = [row.verdict for row in rows if row.device == device]
    return bool(verdicts) and "fail" not in verdicts


def check_mirror(connect: Callable[[], MirrorDriver], clock: Clock, *, move: bool = False) -> list[CheckRow]:
    """Ask a mirror for its identity and state; with ``move`` send it around a small square.

    ``connect`` opens the device, which is closed again. Errors become rows.
    """
    rows: list[CheckRow] = []
    with _warnings(rows, "mirror") as heard:
        try:
            mirror = connect()
        except RigError as error:
            rows.append(failed("mirror", CONNECT, error))
            return rows
        try:
            if isinstance(mirror, MirrorController):
                playing = _ask_mirror(mirror, rows, heard)
            else:
                rows.append(CheckRow("mirror", CONNECT, f"{type(mirror).__name__} is there"))
                playing = False
            if move and (playing or any(row.verdict == "fail" for row in rows)):
                rows.append(CheckRow("mirror", "move", "nothing was moved", "warn", "mend what is named above first"))
            elif move:
                _move(mirror, clock, rows)
        finally:
            mirror.close()
    return rows


def check_camera(connect: Callable[[], CameraDriver]) -> list[CheckRow]:
    """Ask a camera whether it captures, and the shipped one for its files. Errors become rows."""
    rows: list[CheckRow] = []
    with _warnings(rows, "camera"):
        try:
            camera = connect()
        except RigError as error:
            rows.append(failed("camera", CONNECT, error))
            return rows
        try:
            if camera.is_capturing():
                mend = "is another program at work? Else stop it"
                rows.append(CheckRow("camera", "whether it captures", "a capture runs", "warn", mend))
            else:
                rows.append(CheckRow("camera", "whether it captures", "no capture runs"))
            if isinstance(camera, HeadwallCamera):
                _row(rows, "camera", "list its files", partial(_listing, camera))
        except RigError as error:
            rows.append(failed("camera", CONNECT, error))
        finally:
            camera.close()
        if isinstance(camera, HeadwallCamera):
            _row(rows, "camera", f"log in to its files, port {camera.server.port}", partial(log_in, camera.server))
    return rows


def check_triggers(
    connect: Callable[[], RigDevices], clock: Clock, pulses: Pulses, exposed: LineCamera
) -> list[CheckRow]:
    """Play a path by the mirror's own clock, and then by the edges of a capture of four frames.

    All positions of the path are 0; 0, so the mirror stays there. The edges are compared with the setting ``pulses``;
    the capture has the times of the camera ``exposed``. Errors become rows.
    """
    rows: list[CheckRow] = []
    with _warnings(rows, "mirror"):
        try:
            devices = connect()
        except RigError as error:
            rows.append(failed("mirror", TRIGGERS, error))
            return rows
        try:
            rows += _triggers(devices, clock, pulses, exposed)
        except PipelineError as error:
            rows.append(failed("mirror", TRIGGERS, error))
            for stop in (devices.camera.stop, devices.steering.halt):
                with suppress(RigError):
                    stop()
        finally:
            devices.close()
    return rows


def _triggers(devices: RigDevices, clock: Clock, pulses: Pulses, exposed: LineCamera) -> list[CheckRow]:
    """Return a row for the path by its own clock, and one for the path by edges."""
    mirror, camera = devices.steering, devices.camera
    mirror.goto(0.0, 0.0)
    mirror.settle(SETTLE_S)
    mirror.load_path(np.zeros((CELLS, 2)))
    mirror.run(0, CELLS, OWN_HZ)
    clock.sleep(OWN_S)
    stepped = mirror.index()
    mirror.halt()
    camera.configure(exposed.exposure_ms, exposed.frame_ms)
    mirror.run(0, CELLS, OWN_HZ, 1, Trigger.RISING_EDGE)
    capture = camera.capture(EDGES.lines, prefix=capture_prefix(EDGES))
    until = clock.now() + EDGES.lines * exposed.frame_ms / 1000 + SLACK_S
    while camera.is_capturing():
        if clock.now() >= until:
            raise RigError(f"the capture {capture.folder} of {EDGES.lines} frames does not end; look at the camera")
        clock.sleep(POLL_S)
    edges = mirror.index()
    mirror.halt()
    came = f"{stepped} cells in {OWN_S:g} s at {OWN_HZ:g} Hz"
    mend = "the path did not step: is it the mirror of the documents?"
    by_clock = CheckRow("mirror", "a path by its own clock", came, *(() if stepped else ("fail", mend)))
    return [by_clock, _edges_row(edges, capture.folder, pulses)]


def _edges_row(edges: int, folder: str, pulses: Pulses) -> CheckRow:
    """Return the pulses that the edges of a capture of four frames show, compared with the setting."""
    more = " or more" if edges >= CELLS - 1 else ""
    came = f"{edges}{more} edges in {EDGES.lines} frames ({folder} on the camera)"
    found: dict[int, Pulses] = {0: "none", EDGES.lines: "frame"}
    wired = found.get(edges, "position")
    asked = "a path by edges at the trigger input"
    if 0 < edges < EDGES.lines:
        return CheckRow("mirror", asked, came, "fail", "edges are lost: look at the cable from camera to mirror")
    if pulses == wired:
        return CheckRow("mirror", asked, f'{came}, as pulses = "{pulses}" says')
    if pulses == "none":
        return CheckRow("mirror", asked, f'{came}; pulses = "{wired}" would step the mirror by them')
    return CheckRow("mirror", asked, came, "fail", f'set pulses = "{wired}" in [rig]; it is "{pulses}"')


def _ask_mirror(mirror: MirrorController, rows: list[CheckRow], heard: list[str]) -> bool:
    """Add rows of the shipped mirror's identity and state; return whether a path plays."""
    found, playing = mirror.identity(), False
    try:
        check_model(found, mirror.wire.port, mirror.settings.expected_id)
        rows.append(CheckRow("mirror", "identity", found.summary))
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
            before = len(heard)
            _row(rows, "mirror", "frames with and without a CRC", partial(_answered_frames, mirror))
            del heard[before:]  # refusals of these frames are no fault of the line
    except RigError as error:
        rows.append(failed("mirror", "status", error))
    return playing


def _answered_frames(mirror: MirrorController) -> str:
    """Return which frames are answered; those of the settings are."""
    own = mirror.settings.with_crc
    why = mirror.why_unanswered(with_crc=not own)
    if not why:
        return f"both are answered; with_crc = {str(own).lower()} is set"
    words = {False: "without", True: "with"}
    return f"frames {words[own]} a CRC are answered, frames {words[not own]} one are not: {why}"


def _status(mirror: MirrorController, *, playing: bool) -> CheckRow:
    """Return the row of the status; a mirror that moves gets as long to come to rest as in a survey."""
    status = mirror.status()
    until = mirror.wire.clock.now() + SETTLE_S
    while Status.NOT_STABLE in status and not playing and mirror.wire.clock.now() < until:
        mirror.wire.clock.sleep(SETTLE_S / 10)
        status = mirror.status()
    if Status.NOT_STABLE in status and not playing:
        return CheckRow("mirror", "status", status.sentence, "fail", f"that lasts for {SETTLE_S:g} s: {RESTLESS}")
    if status.stops_motion:
        return CheckRow("mirror", "status", status.sentence, "fail", "mend that first: motions are refused with it")
    if status:
        return CheckRow("mirror", "status", status.sentence, "warn", "look at the mirror before a survey")
    return CheckRow("mirror", "status", status.sentence)


def _move(mirror: MirrorDriver, clock: Clock, rows: list[CheckRow]) -> None:
    """Send the mirror to the corners of a square and back to the middle; stop at the first error."""
    for x, y in (*SQUARE, (0.0, 0.0)):
        asked = f"go to {x:g}; {y:g}"
        try:
            mirror.goto(x, y)
            mirror.settle(SETTLE_S)
            mirror.start_log(LOG_HZ)
            clock.sleep(2 * LOGGED / LOG_HZ)
            found = mirror.read_log().position[:LOGGED].astype(float).mean(axis=0)
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
def _warnings(rows: list[CheckRow], device: Device) -> Iterator[list[str]]:
    """Yield the drivers' warnings, and make a row of them: answers that were late, damaged, or not asked for."""
    logger, handler = logging.getLogger("pipeline.rig"), logging.Handler(logging.WARNING)
    warnings: list[str] = []
    handler.emit = lambda record: warnings.append(record.getMessage())  # type: ignore[method-assign]
    logger.addHandler(handler)
    try:
        yield warnings
    finally:
        logger.removeHandler(handler)
        if warnings and rows and rows[0].asked != CONNECT:
            more = f"; and {len(warnings) - MOST_NAMED} more" if len(warnings) > MOST_NAMED else ""
            came = "; ".join(one.partition("; ")[0] for one in warnings[:MOST_NAMED])
            rows.append(CheckRow(device, "bytes on the line", came + more, "warn", CHECK_CABLE))
