"""Archives that something else has written to, and file systems whose locks fail: one message, and nothing is damaged.

``python tests/faults hostile_archives`` tries all places.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.faults import hostile_archives
from tests.faults.hostile_archives import CASES, LOCK_ERRORS
from tests.faults.small_survey import Subject
from tests.faults.whole_survey import Whole

TABLES = ("{segment}/manifest.json", "{run}/manifest.json", "{run}/receipt.json", "{effects}/effects.json")
SOME = [*CASES[::10], *((place, "pipe") for place in (*TABLES, "spool/{capture}"))]


@pytest.mark.parametrize("first", range(3))
def test_strange_things_in_an_archive_end_in_one_message(whole: Whole, tmp_path: Path, first: int) -> None:
    """A file, a pipe or a link where something else belongs is named, not waited for, and not followed."""
    tries = hostile_archives.try_places(whole, SOME[first::3], tmp_path)
    assert tries.wrong == []
    assert tries.commands >= 10 * tries.places >= 40


def test_missing_rights_end_in_one_message(whole: Whole, tmp_path: Path) -> None:
    """Who may not read or write one place is told so, and the archive stays whole."""
    tries = hostile_archives.try_rights(whole, tmp_path, list(hostile_archives.RIGHTS)[::4])
    assert tries.wrong == []
    assert tries.places == 4


def test_failing_locks_end_in_one_message(whole: Whole, tmp_path: Path) -> None:
    """Each command tells of errors that no system is known to give, and the archive stays whole."""
    tries = hostile_archives.refuse_locks(whole, tmp_path, LOCK_ERRORS)
    assert tries.wrong == []
    assert tries.places == len(LOCK_ERRORS)


def test_two_writers_without_locks_damage_nothing(subject: Subject, tmp_path: Path) -> None:
    """One is held before a random change until the other has ended; both end well, or one says why not."""
    tries = hostile_archives.write_without_locks(subject, tmp_path, hostile_archives.moments_of(subject, 4, seed=0))
    assert tries.wrong == []
    assert tries.places >= 3
