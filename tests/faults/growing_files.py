"""Flip bits in a rig's journal, which only grows: ``python tests/faults growing_files``.

The journal is opened again as by a rig. It must give no wrong capture and no defect, and lose at most one capture.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.rig.camera.camera_files import KeptInMemory
from spectralzoom.pipeline.rig.capture_paths import CaptureRecord
from spectralzoom.pipeline.rig.capture_runner import JOURNAL, CaptureJournal
from tests.faults.fault_table import Row, reported_wrong

SWEEP = Sweep("fine-0", "fine", "x", 0.0, -7.5, 40)


@dataclass
class Rot:
    """Count the results of the flips. ``told`` counts flips that the journal reports as damage."""

    flips: int = 0
    told: int = 0
    wrong: list[str] = field(default_factory=list)

    def words(self) -> str:
        """Return the figures as text."""
        return f"{self.told} of {self.flips} told; {reported_wrong(self.wrong)}"


def flip_journal(flips: int, seed: int = 0) -> Rot:
    """Flip bits of a rig's journal: each capture must be unchanged or missing; count the reported damage."""
    kept = KeptInMemory()
    journal = CaptureJournal(kept)
    truth = []
    for number in range(8):
        times = (float(number), number + 0.5)
        taken = CaptureRecord(SWEEP, 5 * number, 5 * number + 5, f"/captured/a_{number}", times, times)
        journal.record_capture(taken)
        truth.append(asdict(taken))
    content = bytes(kept.files[JOURNAL])
    chance = random.Random(seed)
    found = Rot()
    for _ in range(flips):
        rotten = bytearray(content)
        at, bit = chance.randrange(len(rotten)), chance.randrange(8)
        rotten[at] ^= 1 << bit
        found.flips += 1
        try:
            lost = _held(rotten, truth, found)
        except Exception as error:
            lost = [f"defect: {error!r}"]
        found.wrong += [f"byte {at}: bit {bit}: {one}" for one in lost]
    return found


def _held(rotten: bytearray, truth: list[dict[str, Any]], found: Rot) -> list[str]:
    journal = CaptureJournal(KeptInMemory({JOURNAL: rotten}))
    held = [taken for number in range(8) if (taken := journal.holding(SWEEP, 5 * number)) is not None]
    found.told += bool(journal.damage)
    return ["another capture"] * any(asdict(one) not in truth for one in held) + ["captures lost"] * (len(held) < 7)


def rows(quick: bool = False) -> Sequence[Row]:
    found = flip_journal(200 if quick else 2000)
    injected, demanded = "one bit of a rig's journal", "no other capture, no defect, one capture lost at most"
    return [Row("a bit flips", injected, found.flips, demanded, found.words(), not found.wrong)]
