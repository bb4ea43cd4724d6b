"""The journal of captures: the latest capture with a line counts, also for another process, and damage is reported."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from spectralzoom.pipeline.rig.camera.camera_files import KeptInMemory
from spectralzoom.pipeline.rig.capture_paths import CaptureRecord, LinePositions
from spectralzoom.pipeline.rig.capture_runner import JOURNAL, CaptureJournal
from tests.faults.growing_files import flip_journal
from tests.pipeline.rig.small_rig import COARSE, FINE

ONE = CaptureRecord(FINE, 0, 5, "/captured/a", (0.0, 0.1), (0.1, 0.2))
OTHER = replace(ONE, folder="/captured/b", first=3, stop=9)


def folders(journal: CaptureJournal) -> list[str]:
    """Return the capture of each line of the sweep, or an empty text."""
    held = [journal.holding(FINE, line) for line in range(10)]
    return [taken.folder[-1:] if taken else "" for taken in held]


def test_latest_capture_of_a_line_counts() -> None:
    """If the later capture of a line is spent, the earlier one counts. Another process reads the same."""
    kept = KeptInMemory()
    journal = CaptureJournal(kept)
    journal.record_capture(ONE)
    journal.record_capture(OTHER)
    assert folders(journal) == folders(CaptureJournal(kept)) == [*"aaabbbbbb", ""]
    journal.record_spent(OTHER, "cut off")
    assert folders(journal) == folders(CaptureJournal(kept)) == [*"aaaaa", "", "", "", "", ""]
    assert journal.holding(COARSE, 0) is None


def test_a_reused_folder_name_counts_as_the_latest_capture() -> None:
    """An emptied camera numbers its folders anew: the new capture counts, is not spent, and gets its own positions."""
    kept = KeptInMemory()
    journal = CaptureJournal(kept)
    again = replace(ONE, run_s=(7.0, 7.1), capture_s=(7.1, 7.2))
    journal.record_capture(ONE)
    journal.record_positions(ONE, tied(1.0), ())
    journal.record_spent(ONE, "gone")
    journal.record_capture(replace(OTHER, first=0))
    journal.record_capture(again)
    journal.record_positions(again, tied(2.0), ())
    for told in (journal, CaptureJournal(kept)):
        assert told.holding(FINE, 0) == replace(again, residual_px=2.0)
        assert [one["folder"] for one in told.captures] == ["/captured/b", "/captured/a"]
        assert told.captures[-1]["residual_px"] == 2.0
        assert "spent" not in told.captures[-1]


def tied(residual_px: float) -> LinePositions:
    """Return line positions with a residual that identifies them."""
    return LinePositions(np.zeros((0, 2)), np.zeros(0, np.bool_), residual_px)


def test_a_flipped_bit_of_the_journal_changes_no_capture():
    """A capture stays unchanged or is lost; at most one is lost, and the journal reports the damage."""
    found = flip_journal(150, seed=3)
    assert found.wrong == []
    assert found.told >= found.flips - 1  # the newline at the end is no part of a record


def test_records_after_a_torn_one_are_read():
    """The record after a torn one is whole, and line 0 keeps its time stamp until it is captured again."""
    kept = KeptInMemory()
    CaptureJournal(kept).record_capture(ONE)
    kept.append(JOURNAL, b'{"what": "spent", "fol')
    CaptureJournal(kept).record_capture(OTHER)
    journal = CaptureJournal(kept)
    assert folders(journal) == [*"aaabbbbbb", ""]
    assert journal.damage == [f"record 2 of {JOURNAL} is ignored: it is torn or has changed"]
    assert journal.origin_us(FINE) is None
    assert journal.origin_us(FINE, 500) == journal.origin_us(FINE, 500) == 500
    assert bytes(kept.files[JOURNAL]).count(b'"origin"') == 1
    assert journal.origin_us(FINE, 700) == CaptureJournal(kept).origin_us(FINE) == 700  # line 0 was captured again
