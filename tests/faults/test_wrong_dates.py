"""What wrong dates and small refusals must not do: raise doubts, clear fresh stores away, or hold others up."""

from __future__ import annotations

import errno
import os
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from storage.archive import run_folders, staging
from storage.archive.archive import Archive
from storage.archive.keys import StageRef
from storage.archive.run_folders import date_of_store
from storage.maintenance.garbage import plan_clearance
from storage.remote.opening import verify_archive
from tests.storage.small_archive import grow_old, small_survey


class Back(datetime):
    """The clock of a machine that was set back by a year."""

    @classmethod
    def now(cls, tz: object = None) -> datetime:  # type: ignore[override]
        return datetime.now(UTC) - timedelta(days=365)


def _problems(archive: Archive) -> list[str]:
    return [finding.problem for finding in verify_archive(archive) if finding.problem]


def test_a_store_made_anew_after_the_clock_was_set_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its date is after that of the run that knows it, so that it is not taken for one that somebody wrote."""
    archive = Archive.open(tmp_path)
    small = small_survey(archive)
    archive.discard(small.mosaic)
    monkeypatch.setattr(run_folders, "datetime", Back)
    small_survey(archive, named=False)
    assert _problems(archive) == []


def test_other_stores_have_the_date_of_the_clock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock that was once ahead does not date everything after it."""
    archive = Archive.open(tmp_path)
    small = small_survey(archive)
    monkeypatch.setattr(run_folders, "datetime", Back)
    behind = datetime.now(UTC) - timedelta(days=364)
    assert datetime.fromisoformat(date_of_store(tmp_path, "stages/segment/another")) < behind
    assert datetime.fromisoformat(date_of_store(tmp_path, small.map.uri)) > behind


def test_what_was_made_of_a_fresh_store_is_fresh(tmp_path: Path) -> None:
    """Whatever its dates say: gc leaves it for the survey that may name it."""
    archive = Archive.open(tmp_path)
    small = small_survey(archive, named=False)
    grow_old(small.map, days=400)
    plan = plan_clearance(archive)
    assert [removal.uri for removal in plan.removals] == []
    assert plan.kept[small.map.uri] == "made of what is younger than 1 days"


def test_a_lock_file_that_cannot_be_removed_holds_nobody_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What was made is published, and the same store can be worked on again."""
    archive = Archive.open(tmp_path)

    def refused(path: Path, missing_ok: bool = False) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))

    with monkeypatch.context() as disk:
        disk.setattr(Path, "unlink", refused)
        ref = _make(archive)
    assert [path.name for path in (tmp_path / ".locks").iterdir()] == [f"stage-{ref.key}.lock"]
    assert archive.discard(ref, wait=False)
    assert _make(archive) == ref


def test_new_folders_are_synced_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else the power may take a stage's folder away, with the stores in it."""
    archive, synced = Archive.open(tmp_path), list[Path]()
    monkeypatch.setattr(staging, "sync_path", synced.append)
    ref = _make(archive)
    assert {tmp_path / "stages", ref.path.parent} <= set(synced)


def _make(archive: Archive) -> StageRef:
    return archive.produce("stage", lambda path: None, version=1, params={})[0]
