"""Bits that flip in files that only grow: ``python tests/faults growing_files``.

A spool, a rig's journal. Each is opened again as a capture or a rig would, and the capture continues. Demanded: no
other number, no defect, every other line kept.
"""

from __future__ import annotations

import random
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pipeline.errors import PipelineError
from pipeline.geometry.scan import Sweep
from pipeline.rig.camera.camera_files import KeptInMemory
from pipeline.rig.capture_paths import CaptureRecord
from pipeline.rig.capture_runner import JOURNAL, CaptureJournal
from storage.arrays.spool import Spool
from tests.faults.fault_table import Clock, Row, reported_wrong
from tests.faults.lost_lines import BANDS, HEADER, SAMPLES, fill, line, same
from tests.storage.small_archive import flip

LINES = 100
FLIPS = 2000
SWEEP = Sweep("fine-0", "fine", "x", 0.0, -7.5, 40)


@dataclass
class Rot:
    """What came of the flips of one kind of file. ``told`` counts those of which anything is said."""

    flips: int = 0
    told: int = 0
    wrong: list[str] = field(default_factory=list)

    def words(self) -> str:
        """The figures."""
        return f"{self.told} of {self.flips} told; {reported_wrong(self.wrong)}"


def flip_spool(flips: int, folder: Path, seed: int = 0) -> Rot:
    """Flip bits of a spool, and continue the capture: one line at most is lost, and none is another."""
    with Spool.open(folder / "whole", SAMPLES, BANDS, header=HEADER) as spool:
        fill(spool, LINES)
    truth = (folder / "whole" / "lines.lines").read_bytes()
    chance, found, place = random.Random(seed), Rot(), folder / "rotten"
    place.mkdir()
    for _ in range(flips):
        (place / "lines.lines").write_bytes(truth)
        at, bit = chance.randrange(len(truth)), chance.randrange(8)
        flip(place / "lines.lines", at, bit)
        found.told += (lost := _guarded(lambda: _go_on(place))) == ["a line is lost"]
        found.wrong += [f"byte {at}: bit {bit}: {one}" for one in lost if one != "a line is lost"]
        found.flips += 1
    return found


def _go_on(place: Path) -> list[str]:
    with Spool.open(place, SAMPLES, BANDS, header=HEADER) as spool:
        fill(spool, LINES)
        found = [one for block in spool.blocks() for one in block]
    lost = [one.number for one in found if not one.valid]
    wrong = [one.number for one in found if one.valid and not same(one, line(one.number))]
    return ["a line is lost"] * len(lost) + ["a line is another"] * len(wrong) + [f"{lost} lost"] * (len(lost) > 1)


def flip_journal(flips: int, seed: int = 0) -> Rot:
    """Flip bits of a rig's journal: a capture is held as it was, or not at all; the loss is told."""
    kept = KeptInMemory()
    journal = CaptureJournal(kept)
    truth = []
    for number in range(8):
        times = (float(number), number + 0.5)
        taken = CaptureRecord(SWEEP, 5 * number, 5 * number + 5, f"/captured/a_{number}", True, times, times)
        journal.record_capture(taken)
        truth.append(asdict(journal.record_end(taken)))
    content, chance, found = bytes(kept.files[JOURNAL]), random.Random(seed), Rot()
    for _ in range(flips):
        rotten = bytearray(content)
        at, bit = chance.randrange(len(rotten)), chance.randrange(8)
        rotten[at] ^= 1 << bit
        found.flips += 1
        for one in _guarded(lambda held=rotten: _held(held, truth, found)):
            found.wrong.append(f"byte {at}: bit {bit}: {one}")
    return found


def _held(rotten: bytearray, truth: list[dict[str, Any]], found: Rot) -> list[str]:
    journal = CaptureJournal(KeptInMemory({JOURNAL: rotten}))
    held = [taken for number in range(8) if (taken := journal.holding(SWEEP, 5 * number)) is not None]
    found.told += bool(journal.damage)
    return ["another capture"] * any(asdict(one) not in truth for one in held) + ["captures lost"] * (len(held) < 7)


def _guarded(tried: Callable[[], list[str]]) -> list[str]:
    try:
        return tried()
    except PipelineError as error:
        return [f"refused: {error}"]
    except Exception as error:
        return [f"defect: {error!r}"]


def rows(quick: bool = False) -> Sequence[Row]:
    clock, fraction = Clock(), (200 if quick else FLIPS) // 2
    with tempfile.TemporaryDirectory(prefix="growing-") as name:
        found = {"spool": flip_spool(fraction, Path(name))}
        found["journal"] = flip_journal(fraction)
    injected = "one bit of a spool or of a rig's journal"
    demanded = "no other number, no defect, no other line lost"
    words = "; ".join(f"{kind}: {one.words()}" for kind, one in found.items())
    met = not any(one.wrong for one in found.values())
    return [Row("a bit flips in a file that grows", injected, 2 * fraction, demanded, words, met, clock.seconds)]
