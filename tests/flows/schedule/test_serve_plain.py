"""Schedules without a server: what is told of each run, and schedules that cannot be opened or closed."""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path

import pytest

from flows.schedule.due_runs import Outcome
from flows.schedule.rig_lock import RigLock
from flows.schedule.serve_command import serve_plain
from pipeline.errors import ArchiveError
from storage.archive.ledger import Ledger
from tests.flows.schedule.schedule_days import NOON, HandClock, field_schedule


def refuse(monkeypatch: pytest.MonkeyPatch, field: str, event: str) -> None:
    """Let the disk refuse one kind of line of one field."""
    real = Ledger.append

    def append(self: Ledger, line: dict[str, object]) -> None:
        if (self.field, line["event"]) == (field, event):
            raise ArchiveError("the disk is full")
        real(self, line)

    monkeypatch.setattr(Ledger, "append", append)


def test_what_waited_too_long_for_another_field_is_told_with_its_reason(tmp_path: Path) -> None:
    """One line a run, with how it ended: also where it was too late as its turn came."""
    clock, told, noted = HandClock(), list[str](), list[Outcome]()
    schedules = {name: field_schedule(tmp_path, clock, name) for name in ("north", "south")}
    lock = RigLock(tmp_path / "rig.lock")

    def survey(field: str, due: datetime) -> Path:
        clock.sleep(11 * 60)
        return tmp_path / "run"

    serve_plain(
        schedules,
        dict.fromkeys(schedules, lock),
        survey,
        told.append,
        clock=clock,
        note=noted.append,
        until=NOON + timedelta(minutes=35),
    )
    assert told == [
        "north, due 2026-06-01 12:20:00 UTC, done: runs/run",
        "south, due 2026-06-01 12:20:00 UTC, skipped: it could not begin in time (noted 11.0 min after it was due)",
    ]
    assert [(one.field, one.ending) for one in noted] == [("north", "done"), ("south", "skipped")]


def test_an_ending_from_elsewhere_is_told(tmp_path: Path) -> None:
    """A run that could not be resumed here, and that another process ended in the same look, is told as that."""
    clock, told, due = HandClock(), list[str](), NOON + timedelta(minutes=20)
    schedules = {name: field_schedule(tmp_path, clock, name, late=1.0) for name in ("south", "north", "west")}
    locks, other = {name: RigLock(tmp_path / name) for name in schedules}, RigLock(tmp_path / "north")

    def survey(field: str, due: datetime) -> Path:
        if field == "south":
            assert other.take("another process")
        elif field == "west":
            schedules["north"].end(due, "failed", "no reply")
        return tmp_path / "run"

    schedules["north"].open()
    clock.moment = due
    schedules["north"].begin(due)
    for name in ("south", "west"):
        schedules[name].open(due)
    serve_plain(schedules, locks, survey, told.append, clock=clock, until=due + timedelta(minutes=20))
    other.release()
    assert told == [
        "south, due 2026-06-01 12:20:00 UTC, done: runs/run",
        "north, due 2026-06-01 12:20:00 UTC, was not begun here",
        "west, due 2026-06-01 12:20:00 UTC, done: runs/run",
        "north, due 2026-06-01 12:20:00 UTC, failed: no reply",
    ]


def test_a_schedule_that_cannot_be_closed_is_told_of_and_the_others_are_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Serving ends as it was asked to; the field whose ledger refuses is named."""
    clock, told = HandClock(), list[str]()
    schedules = {name: field_schedule(tmp_path, clock, name) for name in ("north", "south")}
    locks = dict.fromkeys(schedules, RigLock(tmp_path / "rig.lock"))
    refuse(monkeypatch, "north", "closed")
    serve_plain(schedules, locks, lambda *given: tmp_path, told.append, clock=clock, until=NOON + timedelta(minutes=1))
    assert {name: schedule.state().serving for name, schedule in schedules.items()} == {"north": True, "south": False}
    assert told == ["north: the disk is full"]


def test_a_schedule_that_cannot_be_opened_leaves_none_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is served then: those that were opened before it are closed, and the message is the disk's."""
    clock = HandClock()
    schedules = {name: field_schedule(tmp_path, clock, name) for name in ("north", "south", "west")}
    locks = dict.fromkeys(schedules, RigLock(tmp_path / "rig.lock"))
    refuse(monkeypatch, "south", "opened")
    with pytest.raises(ArchiveError, match="the disk is full"):
        serve_plain(schedules, locks, lambda *given: tmp_path, lambda words: None, clock=clock)
    assert [line["event"] for line in schedules["north"].ledger.lines()] == ["opened", "closed"]
    assert not any(schedules[name].ledger.lines() for name in ("south", "west"))
