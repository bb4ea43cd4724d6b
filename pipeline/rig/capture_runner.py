"""Captures on a rig, one after the other, and the journal of what the rig has acknowledged.

The journal has one record per line, a CRC-32 and a JSON object, beside the files fetched from the camera. Each line
begins with a line end of its own, so that a damaged line takes no other with it. After a killed process the next one
reads there which folder on the camera holds which lines, and does not capture those again. A torn or changed line
counts as not written.
"""

from __future__ import annotations

import json
import logging
import math
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from typing import Any

from spectralzoom.pipeline.errors import RigError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import Sweep, exposing
from spectralzoom.pipeline.rig.camera.camera_files import Kept
from spectralzoom.pipeline.rig.capture_paths import CapturePath, CaptureRecord, LinePositions, capture_prefix
from spectralzoom.pipeline.rig.device_settings import SurveyRig
from spectralzoom.pipeline.rig.drivers import RigDevices
from spectralzoom.pipeline.source import AT_REST

LOG = logging.getLogger(__name__)
JOURNAL = "captures.jsonl"  # beside the files fetched from the camera
SLACK_S = 5.0  # by which a capture may take longer than its frames
WRITING_S = 120.0  # that a camera may keep writing what it has after a stop
POLL_S = 0.05
SETTLE_S = 2.0  # for the mirror to come to rest

Say = Callable[[str], None]  # takes the present step in a few words


class CaptureJournal:
    """Records in ``kept``, read once and appended to; ``damage`` names the damaged lines of the journal."""

    def __init__(self, kept: Kept) -> None:
        self._kept = kept
        self._taken: dict[str, CaptureRecord] = {}  # by folder; of a capture the latest record counts
        self._origins: dict[str, int] = {}  # stamp of line 0 [us], by the sweep's name
        self.references: dict[float | None, str] = {}  # folders of dark and white frames, by a sweep's own exposure
        self.damage: list[str] = []
        lines = filter(None, kept.read(JOURNAL, 0, kept.size(JOURNAL)).split(b"\n"))
        for number, line in enumerate(lines, 1):
            check, _, text = line.partition(b" ")
            if check == _crc32(text):
                self._follow(json.loads(text))
            else:
                self.damage.append(f"record {number} of {JOURNAL} is ignored: it is torn or has changed")
        if self.damage:
            LOG.warning("%s", "; ".join(self.damage))

    def holding(self, sweep: Sweep, line: int) -> CaptureRecord | None:
        """Return the latest capture that has a line of the sweep and is not spent."""
        fits = [one for one in self._taken.values() if one.sweep == sweep and one.first <= line < one.stop]
        return next((one for one in reversed(fits) if not one.spent), None)

    @property
    def captures(self) -> list[dict[str, Any]]:
        """Return every capture in order: sweep, lines, folder on the camera, error of positions, why it is spent."""
        return [
            {"folder": one.folder, "sweep": one.sweep.name, "first": one.first, "stop": one.stop}
            | ({} if one.residual_px is None else {"residual_px": one.residual_px, "notes": list(one.notes)})
            | ({"spent": one.spent} if one.spent else {})
            for one in self._taken.values()
        ]

    def record_capture(self, taken: CaptureRecord) -> None:
        """Record a capture that the camera acknowledged."""
        self._write({"what": "capture", **asdict(taken)})

    def record_spent(self, taken: CaptureRecord, why: str) -> None:
        """Record that a capture gives no further line."""
        self.record_capture(replace(self._taken[taken.folder], spent=why))

    def record_positions(self, taken: CaptureRecord, how: LinePositions, notes: Sequence[str]) -> None:
        """Record once how a capture's lines got their positions."""
        known = self._taken[taken.folder]
        if known.residual_px is None:
            self.record_capture(replace(known, residual_px=how.residual_px, notes=(*notes, *how.notes)))

    def record_references(self, folder: str, exposure_ms: float | None = None) -> None:
        """Record the folder of the dark and white frames of an exposure; None is the camera's own."""
        self._write({"what": "references", "folder": folder, "exposure_ms": exposure_ms})

    def origin_us(self, sweep: Sweep, stamp_us: int | None = None) -> int | None:
        """Return the stamp of the sweep's line 0; one that is given is recorded."""
        if stamp_us is not None and self._origins.get(sweep.name) != stamp_us:
            self._write({"what": "origin", "sweep": sweep.name, "stamp_us": stamp_us})
        return self._origins.get(sweep.name)

    def _write(self, record: dict[str, Any]) -> None:
        text = json.dumps(record).encode()
        self._kept.append(JOURNAL, b"\n%s %s\n" % (_crc32(text), text))
        self._follow(json.loads(text))

    def _follow(self, record: dict[str, Any]) -> None:
        match record.pop("what"):
            case "capture":
                spans = {name: tuple(record.get(name, ())) for name in ("run_s", "capture_s", "notes")}
                taken = CaptureRecord(**record | spans | {"sweep": Sweep(**record["sweep"])})
                known = self._taken.get(taken.folder)
                if known is not None and known.capture_s != taken.capture_s:
                    del self._taken[taken.folder]  # an emptied camera uses the names of its folders again
                self._taken[taken.folder] = taken
            case "references":
                self.references[record["exposure_ms"]] = record["folder"]
            case "origin":
                self._origins[record["sweep"]] = record["stamp_us"]


def _crc32(text: bytes) -> bytes:
    return b"%08x" % zlib.crc32(text)


@dataclass(eq=False)
class CaptureRunner:
    """Runs captures on connected devices, and records what they acknowledge."""

    devices: RigDevices
    journal: CaptureJournal
    camera: LineCamera
    rig: SurveyRig
    say: Say

    def take(self, path: CapturePath) -> CaptureRecord:
        """Take the lines of a path, and wait until they are on the camera.

        Motions and the capture are sent once. If anything fails after the mirror or the camera has begun, both are
        stopped. A mirror that does not answer at the end may have restarted on the way: the lines do not count.
        """
        steering, clock = self.devices.steering, self.devices.clock
        exposed = exposing(self.camera, path.sweep)
        self.devices.camera.configure(exposed.exposure_ms, exposed.frame_ms)
        self.say(f"path: {len(path.cells)} positions")
        steering.load_path(path.cells)
        steering.goto(*(float(place) for place in path.cells[0]))
        steering.settle(SETTLE_S)
        with self._stopped_on_error():
            capture = self.devices.camera.capture(path.lines, prefix=capture_prefix(path.sweep, path.first))
            sent_s = clock.now()
            steering.run(path.rate_hz)
            times_s = (sent_s, clock.now()), (capture.sent_s, capture.acknowledged_s)
            taken = CaptureRecord(path.sweep, path.first, path.stop, capture.folder, *times_s)
            self.journal.record_capture(taken)
            self.wait(taken)
        try:
            steering.halt()
        except RigError as error:
            self.journal.record_spent(taken, f"the mirror did not answer at its end: {error}")
            raise
        return taken

    def wait(self, taken: CaptureRecord) -> None:
        """Wait until a capture is over; one that takes too long is stopped, and its frames count.

        Raises RigError: it does not end after the stop.
        """
        camera, clock = self.devices.camera, self.devices.clock
        began = clock.now()
        wanted = exposing(self.camera, taken.sweep).scan_seconds(taken.stop - taken.first)
        until = began + wanted + SLACK_S
        stopped = False
        while camera.is_capturing():
            self.say(f"capturing: {clock.now() - began:.0f} of {math.ceil(wanted)} s")
            if clock.now() >= until:
                if stopped:
                    raise RigError(
                        f"the camera still captures {taken.folder}, {WRITING_S:g} s after it was stopped; look at the "
                        "camera, then run again, which fetches what it has"
                    )
                LOG.warning("the capture %s takes too long and is stopped", taken.folder)
                camera.stop()
                until = clock.now() + WRITING_S
                stopped = True
            clock.sleep(min(max(began + wanted - clock.now(), POLL_S), 1.0))

    def capture_at_rest(self, prefix: str, exposure_ms: float | None = None) -> str:
        """Take one frame with the mirror at 0; 0 (if ``white_at_rest``), and return its folder.

        ``exposure_ms`` is the camera's own where it is None.
        """
        at_rest = replace(AT_REST, exposure_ms=exposure_ms)
        exposed = exposing(self.camera, at_rest)
        self.devices.camera.configure(exposed.exposure_ms, exposed.frame_ms)
        if self.rig.white_at_rest:
            self.devices.steering.goto(0.0, 0.0)
            self.devices.steering.settle(SETTLE_S)
        with self._stopped_on_error():
            capture = self.devices.camera.capture(1, prefix=prefix)
            at = (capture.sent_s, capture.acknowledged_s)
            self.wait(CaptureRecord(at_rest, 0, 1, capture.folder, at, at))
        return capture.folder

    @contextmanager
    def _stopped_on_error(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            for stop in (self.devices.camera.stop, self.devices.steering.halt):
                with suppress(RigError):
                    stop()
            raise
