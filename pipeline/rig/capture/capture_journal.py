"""What the rig has acknowledged of a stage's captures, one JSON object a line beside the files fetched from the camera.

A process that is killed leaves it behind; the next one reads which folder on the camera holds which lines, so that
nothing the rig acknowledged is captured twice. Each line has a checksum. A torn line counts as not written, and so does
one that has changed since; but then a capture of which no end is told is not gone on with: what the mirror stands at
now need not be what it stood at after that.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from pipeline.checked_lines import read_checked, with_check
from pipeline.geometry.scan import Sweep
from pipeline.rig.camera.camera_files import Kept
from pipeline.rig.capture.line_positions import LinePositions

JOURNAL = "captures.jsonl"
LOG = logging.getLogger(__name__)
_TIES = ("method", "residual_us", "residual_px", "offset_s", "drift_ppm")


@dataclass(frozen=True)
class CaptureRecord:
    """Lines ``first`` to ``stop`` of a sweep, in a folder of the camera."""

    sweep: Sweep
    first: int
    stop: int
    folder: str
    triggered: bool
    run_s: tuple[float, float]  # sent and acknowledged, by the drivers' clock
    capture_s: tuple[float, float]
    index_at_end: int | None = None  # cell of the path that was played last
    log: LoggedPath | None = None
    spent: str = ""  # why no line is to be had from it any more


@dataclass(frozen=True)
class LoggedPath:
    """A log of measured positions that is kept beside the files: (sample, 2) big-endian float32.

    ``index_name`` is where the cells that were played are, (sample,) big-endian int32; empty where nobody asked.
    """

    name: str
    rate_hz: float
    started_s: float
    start_error_s: float
    index_name: str = ""
    crc32: int | None = None  # of both files, one after the other; None by an earlier version


class CaptureJournal:
    """Records in ``kept``, read once and added to.

    Attributes
    ----------
    references
        Folder that holds dark and white frames.
    damage
        What cannot be believed of the journal, in words.
    """

    def __init__(self, kept: Kept) -> None:
        self._kept = kept
        self._taken: dict[str, CaptureRecord] = {}
        self._origins: dict[str, int] = {}  # stamp of line 0 [us], by the sweep's name
        self._ties: dict[str, dict[str, Any]] = {}
        self._ended: set[str] = set()  # folders
        self.references = ""
        self.damage: list[str] = []
        self._read()

    def holding(self, sweep: Sweep, line: int) -> CaptureRecord | None:
        """The latest capture that has a line of the sweep and is not spent."""
        fits = [one for one in self._taken.values() if one.sweep == sweep and one.first <= line < one.stop]
        return next((one for one in reversed(fits) if not one.spent), None)

    def began(self, taken: CaptureRecord) -> None:
        """Take down a capture that the camera acknowledged."""
        self._write({"what": "capture", **asdict(taken)})

    def ended(self, taken: CaptureRecord) -> CaptureRecord:
        """Take down what was read of the mirror after the capture."""
        ended = {"folder": taken.folder, "index_at_end": taken.index_at_end}
        self._write({"what": "end", **ended, "log": None if taken.log is None else asdict(taken.log)})
        return self._taken[taken.folder]

    def spend(self, taken: CaptureRecord, why: str) -> None:
        """Expect no further line of a capture."""
        self._write({"what": "spent", "folder": taken.folder, "why": why})

    def tied(self, taken: CaptureRecord, how: LinePositions, notes: Sequence[str]) -> None:
        """Take down how a capture's lines were tied to the mirror, once."""
        if taken.folder not in self._ties:
            said = {name: getattr(how, name) for name in _TIES}
            self._write({"what": "tied", "folder": taken.folder, **said, "notes": [*notes, *how.notes]})

    @property
    def captures(self) -> list[dict[str, Any]]:
        """Every capture in order: lines of which sweep, where on the camera, how they were tied, why none is left."""
        return [
            {"folder": one.folder, "sweep": one.sweep.name, "first": one.first, "stop": one.stop}
            | self._ties.get(one.folder, {})
            | ({"spent": one.spent} if one.spent else {})
            for one in self._taken.values()
        ]

    def refer(self, folder: str) -> None:
        """Take down where the dark and white frames are."""
        self._write({"what": "references", "folder": folder})

    def origin_us(self, sweep: Sweep, stamp_us: int | None = None) -> int | None:
        """Stamp of the sweep's line 0, taken down when it is first given."""
        if stamp_us is not None and sweep.name not in self._origins:
            self._write({"what": "origin", "sweep": sweep.name, "stamp_us": stamp_us})
        return self._origins.get(sweep.name)

    def _read(self) -> None:
        for line in read_checked(self._kept.read(JOURNAL, 0, self._kept.size(JOURNAL))):
            if line.state == "torn":
                continue
            why = "it has changed since it was written" if line.content is None else ""
            try:
                self._follow(line.content or {})
            except (LookupError, TypeError, ValueError):
                why = why or "what it adds to is not there"
            if why:
                self.damage.append(f"line {line.number} of {JOURNAL} counts for nothing: {why}")
        if self.damage:
            LOG.warning("%s", "; ".join(self.damage))
            for folder in self._taken.keys() - self._ended:
                self._taken[folder] = replace(self._taken[folder], spent="its end may be what the journal has lost")

    def _write(self, record: dict[str, Any]) -> None:
        text = json.dumps(record).encode()
        size = self._kept.size(JOURNAL)
        torn = size > 0 and self._kept.read(JOURNAL, size - 1, size) != b"\n"
        self._kept.append(JOURNAL, (b"\n" if torn else b"") + with_check(text))
        self._follow(json.loads(text))

    def _follow(self, record: dict[str, Any]) -> None:
        match record["what"]:
            case "capture":
                self._taken.pop(record["folder"], None)  # a camera that was emptied gives its folders' names again
                self._ties.pop(record["folder"], None)
                self._ended.discard(record["folder"])
                self._taken[record["folder"]] = CaptureRecord(
                    Sweep(**record["sweep"]),
                    record["first"],
                    record["stop"],
                    record["folder"],
                    record["triggered"],
                    tuple(record["run_s"]),
                    tuple(record["capture_s"]),
                )
            case "end":
                log = None if record["log"] is None else LoggedPath(**record["log"])
                found = self._taken[record["folder"]]
                self._taken[found.folder] = replace(found, index_at_end=record["index_at_end"], log=log)
                self._ended.add(found.folder)
            case "spent":
                self._taken[record["folder"]] = replace(self._taken[record["folder"]], spent=record["why"])
            case "tied":
                self._ties[record["folder"]] = {name: record[name] for name in (*_TIES, "notes")}
            case "references":
                self.references = record["folder"]
            case "origin":
                self._origins[record["sweep"]] = record["stamp_us"]
