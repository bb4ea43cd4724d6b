"""What a field's ledger may be told: beginnings and endings that are refused, and a clock that goes back."""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path

import pytest

from flows.schedule.due_runs import run_due
from flows.schedule.field_schedule import moment_words
from flows.schedule.rig_lock import RigLock
from pipeline.errors import NothingToMend
from tests.flows.schedule.schedule_days import NOON, HandClock, accounted, field_schedule, opened

FIRST, SECOND, THIRD = (NOON + timedelta(minutes=20 * number) for number in (1, 2, 3))


def test_what_ended_is_not_due_again_after_the_clock_was_set_back(tmp_path: Path) -> None:
    """Neither what was done later than the clock shows now, nor what was done before."""
    clock, schedule = opened(tmp_path)
    for due in (FIRST, SECOND):
        clock.moment = due
        schedule.begin(due)
        schedule.end(due, "done")
    clock.moment = NOON + timedelta(minutes=30)
    assert schedule.pending() == []
    clock.moment = SECOND
    assert schedule.pending() == []
    assert [schedule.begin(due) for due in (FIRST, SECOND)] == [None, None]
    assert [line["event"] for line in schedule.ledger.lines()].count("begun") == 2


def test_a_clock_that_is_put_right_is_no_event(tmp_path: Path) -> None:
    """Less than a minute back: no line tells of it, and what was skipped stays skipped."""
    clock, schedule = opened(tmp_path)
    clock.sleep(30 * 60 + 1)
    assert schedule.pending() == []
    lines = schedule.ledger.lines()
    clock.moment -= timedelta(seconds=59)
    assert schedule.pending() == []
    assert schedule.begin(FIRST) is None
    assert schedule.ledger.lines() == lines
    clock.moment -= timedelta(seconds=2)
    schedule.pending()
    assert schedule.ledger.lines()[-1]["event"] == "clock"


def test_a_due_time_that_has_not_come_is_not_begun(tmp_path: Path) -> None:
    """Nor one that is none: only what is due, and not accounted for, begins."""
    clock, schedule = opened(tmp_path)
    clock.moment = FIRST
    assert schedule.begin(SECOND) is None
    assert schedule.begin(FIRST - timedelta(minutes=1)) is None
    assert [line["event"] for line in schedule.ledger.lines()] == ["opened"]
    assert schedule.begin(FIRST) == 1


def test_the_newest_of_very_many_begins_at_once(tmp_path: Path) -> None:
    """Without a look before it: those that passed have their one line, and none of them another."""
    clock, schedule = opened(tmp_path)
    clock.sleep(30 * 86400)
    assert schedule.begin(clock.now()) == 1
    assert [line["event"] for line in schedule.ledger.lines()] == ["opened", "passed", "begun"]


def test_an_ending_is_noted_once(tmp_path: Path) -> None:
    """The second is refused, and the ledger is as it was."""
    clock, schedule = opened(tmp_path)
    clock.moment = FIRST
    schedule.begin(FIRST)
    assert schedule.end(FIRST, "failed", "no reply")
    lines = schedule.ledger.lines()
    assert not schedule.end(FIRST, "done")
    assert schedule.ledger.lines() == lines


@pytest.mark.parametrize("ending", ["done", "skipped"])
def test_a_later_run_in_the_place_of_an_earlier_one(tmp_path: Path, ending: str) -> None:
    """Where both may begin yet, and the later one does, or is skipped, the earlier one is skipped and told of."""
    clock, schedule = opened(tmp_path, late=1.0)
    clock.moment = SECOND
    assert schedule.pending() == [FIRST, SECOND]
    if ending == "done":
        assert schedule.begin(SECOND) == 1
    assert schedule.end(SECOND, ending)  # type: ignore[arg-type]
    assert schedule.pending() == []
    first = schedule.state().ended[FIRST]
    assert (first["event"], first["reason"]) == ("skipped", "a later one came first (noted 20.0 min after it was due)")
    schedule.close()
    assert accounted(schedule.ledger.lines(), schedule.timetable) == {FIRST: 1, SECOND: 1}


def test_an_ending_accounts_for_nothing_that_was_not_served(tmp_path: Path) -> None:
    """Once a schedule is closed nothing is due: a late ending has a line, and no due time before it has."""
    clock, schedule = opened(tmp_path)
    schedule.close()
    clock.moment = THIRD
    assert schedule.end(SECOND, "skipped", "the rig was in use")
    assert list(schedule.state().ended) == [SECOND]


def test_a_run_skipped_as_it_was_to_begin_says_why(tmp_path: Path) -> None:
    """Its outcome has the ending and the reason of the ledger."""
    (clock, schedule), lock = opened(tmp_path), RigLock(tmp_path / "rig.lock")
    clock.sleep(30 * 60 + 1)
    outcome = run_due(schedule, FIRST, lock, lambda *given: tmp_path)
    assert outcome.ending == "skipped"
    assert outcome.reason == schedule.state().ended[FIRST]["reason"]
    assert outcome.words() == (
        "north, due 2026-06-01 12:20:00 UTC, skipped: it could not begin in time (noted 10.0 min after it was due)"
    )


def test_a_visit_that_looks_at_nothing_is_done(tmp_path: Path) -> None:
    """It is accounted for by the run whose map stands, with the reason."""
    (clock, schedule), lock = opened(tmp_path), RigLock(tmp_path / "rig.lock")
    clock.moment = FIRST

    def survey(*given: object) -> Path:
        raise NothingToMend("20260601T110000-north", 0.012, 0.02)

    outcome = run_due(schedule, FIRST, lock, survey)
    assert (outcome.ending, outcome.run) == ("done", "runs/20260601T110000-north")
    line = schedule.state().ended[FIRST]
    assert line["seconds"] == 0
    assert "1.2% of what is remembered is expected to be wrong" in line["reason"]


def test_a_run_that_another_process_ended_is_told_as_that(tmp_path: Path) -> None:
    """Done by another is done, with its folder; nothing is surveyed again."""
    (clock, schedule), lock = opened(tmp_path), RigLock(tmp_path / "rig.lock")
    clock.moment = FIRST
    schedule.begin(FIRST)
    schedule.end(FIRST, "done", run="runs/one")
    outcome = run_due(schedule, FIRST, lock, lambda *given: pytest.fail("surveyed twice"))
    assert (outcome.ending, outcome.run) == ("done", "runs/one")
    later = run_due(schedule, SECOND, lock, lambda *given: pytest.fail("surveyed before its time"))
    assert (later.ending, later.words()) == (None, "north, due 2026-06-01 12:40:00 UTC, was not begun here")


def test_a_run_that_cannot_be_resumed_before_the_next_is_left_open(tmp_path: Path) -> None:
    """While another holds the rig, until the next is due: it has no ending here, and the ledger gets no line."""
    (clock, schedule), other = opened(tmp_path), RigLock(tmp_path / "rig.lock")
    clock.moment = FIRST
    schedule.begin(FIRST)
    lines = schedule.ledger.lines()
    assert other.take("a survey by hand")
    outcome = run_due(schedule, FIRST, RigLock(tmp_path / "rig.lock"), lambda *given: tmp_path)
    other.release()
    assert (outcome.ending, clock.now()) == (None, SECOND)
    assert schedule.ledger.lines() == lines


def test_a_run_that_was_ended_meanwhile_is_told_as_the_ledger_has_it(tmp_path: Path) -> None:
    """The first ending holds, also for whoever surveyed on."""
    (clock, schedule), lock = opened(tmp_path), RigLock(tmp_path / "rig.lock")
    clock.moment = FIRST

    def survey(field: str, due: datetime) -> Path:
        schedule.end(due, "failed", "it was cancelled in Prefect")
        return tmp_path / "run"

    outcome = run_due(schedule, FIRST, lock, survey)
    assert (outcome.ending, outcome.reason, outcome.run) == ("failed", "it was cancelled in Prefect", None)


def test_what_came_due_while_it_was_being_stopped_is_not_due(tmp_path: Path) -> None:
    """Stopping takes its time; what was due before it was told to stop is accounted for, and nothing after that."""
    clock, schedule = opened(tmp_path)
    clock.moment = SECOND + timedelta(seconds=9)
    schedule.close(SECOND - timedelta(seconds=9))
    lines = schedule.ledger.lines()
    assert [(line["event"], line.get("due")) for line in lines[1:]] == [
        ("skipped", moment_words(FIRST)),
        ("closed", None),
    ]
    schedule.open()
    assert schedule.pending() == []


def test_a_run_of_an_earlier_schedule_opens_nothing(tmp_path: Path) -> None:
    """One that Prefect begins late, when another schedule is served, is left over: it is not served by either."""
    clock = HandClock()
    earlier, later = (field_schedule(tmp_path, clock, every=every) for every in ("20m", "10m"))
    earlier.open()
    earlier.close()
    clock.moment = FIRST + timedelta(seconds=30)
    later.open()
    assert not earlier.join(FIRST)
    assert later.state().timetable == later.timetable
    assert later.join(FIRST + timedelta(minutes=10))
    clock.moment = SECOND
    assert earlier.join(SECOND)  # of a deployment that has another cron since
    assert earlier.state().timetable == earlier.timetable
