"""What is taken down of captures: the latest one that has a line counts, and nothing is told twice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.rig.camera.camera_files import KeptInMemory
from pipeline.rig.capture_paths import CaptureRecord, LinePositions
from pipeline.rig.capture_runner import JOURNAL, CaptureJournal
from pipeline.rig.mirror_controller import MotionLog
from tests.faults.growing_files import flip_journal
from tests.pipeline.rig.small_rig import COARSE, FINE

ONE = CaptureRecord(FINE, 0, 5, "/captured/a", True, (0.0, 0.1), (0.1, 0.2))
OTHER = replace(ONE, folder="/captured/b", first=3, stop=9)


def folders(journal: CaptureJournal) -> list[str]:
    """Which capture has each line of the sweep; empty where none has."""
    held = [journal.holding(FINE, line) for line in range(10)]
    return [taken.folder[-1:] if taken else "" for taken in held]


def test_latest_capture_of_a_line_counts() -> None:
    """Of two that have a line the later one is read, and the earlier one once that is spent; so by another process."""
    kept = KeptInMemory()
    journal = CaptureJournal(kept)
    journal.record_capture(ONE)
    journal.record_capture(OTHER)
    assert folders(journal) == folders(CaptureJournal(kept)) == [*"aaabbbbbb", ""]
    journal.record_spent(OTHER, "cut off")
    assert folders(journal) == folders(CaptureJournal(kept)) == [*"aaaaa", "", "", "", "", ""]
    assert journal.holding(COARSE, 0) is None


def test_folder_whose_name_comes_again_is_the_latest() -> None:
    """A camera that was emptied counts its folders anew: the new capture counts, is not spent, and is tied anew."""
    kept = KeptInMemory()
    journal, again = CaptureJournal(kept), replace(ONE, run_s=(7.0, 7.1))
    journal.record_capture(ONE)
    journal.record_positions(ONE, tied(1.0), ())
    journal.record_spent(ONE, "gone")
    journal.record_capture(replace(OTHER, first=0))
    journal.record_capture(again)
    journal.record_positions(again, tied(2.0), ())
    for told in (journal, CaptureJournal(kept)):
        assert told.holding(FINE, 0) == again
        assert [one["folder"] for one in told.captures] == ["/captured/b", "/captured/a"]
        assert told.captures[-1]["residual_px"] == 2.0
        assert "spent" not in told.captures[-1]


def tied(residual_px: float) -> LinePositions:
    """How lines were tied, with a residual that tells one from another."""
    return LinePositions(np.zeros((0, 2)), np.zeros(0, np.bool_), "log", residual_px)


def test_a_log_comes_back() -> None:
    """Positions that the mirror measured, bit for bit, by another process."""
    kept, position = KeptInMemory(), np.array([(0.1, -0.2), (0.3, 0.4)], np.float32)
    journal = CaptureJournal(kept)
    journal.record_capture(ONE)
    journal.record_end(replace(ONE, log=MotionLog(position, 1000.0, 0.06, 0.04)))
    found = CaptureJournal(kept).holding(FINE, 0)
    np.testing.assert_array_equal(found.log.position, position)
    assert (found.log.rate_hz, found.log.started_s, found.log.start_error_s) == (1000.0, 0.06, 0.04)


def test_flipped_bit_of_the_journal_changes_no_capture():
    """Whichever it is: each capture is held as it was or not at all, one is lost at most, and the journal says so."""
    found = flip_journal(150, seed=3)
    assert found.wrong == []
    assert found.told >= found.flips - 1  # the end of the last line is no part of it


def test_a_torn_journal_is_read():
    """Behind a torn record the next is whole; line 0 keeps its stamp."""
    kept = KeptInMemory()
    CaptureJournal(kept).record_capture(ONE)
    kept.append(JOURNAL, b'{"what": "spent", "fol')
    CaptureJournal(kept).record_capture(OTHER)
    journal = CaptureJournal(kept)
    assert folders(journal) == [*"aaabbbbbb", ""]
    assert journal.damage == []
    assert journal.origin_us(FINE) is None
    assert journal.origin_us(FINE, 500) == journal.origin_us(FINE, 500) == 500
    assert bytes(kept.files[JOURNAL]).count(b'"origin"') == 1
    assert journal.origin_us(FINE, 700) == CaptureJournal(kept).origin_us(FINE) == 700  # line 0 was captured again
