"""Laws of schedules: every due time is accounted for exactly once, whatever happens to clock and process."""

from __future__ import annotations

import json
import tempfile
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from itertools import islice, pairwise
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from flows.schedule.due_runs import run_all
from flows.schedule.field_schedule import FieldSchedule
from flows.schedule.rig_lock import RigLock
from flows.schedule.times import exact_words, parse_every, parse_timetable, read_timetable
from pipeline.errors import RigError, SettingsError
from storage.archive.ledger import Ledger
from tests.flows.schedule.schedule_days import NOON, HandClock, accounted, field_schedule

CRONS = ("*/20 * * * *", "0 * * * *", "30 2 * * *", "15 1-3 * * *", "0 6 * * 1", "0 0 1 * *")
ZONES = ("UTC", "Europe/Berlin", "America/New_York", "Australia/Lord_Howe")
CHANGES = (datetime(2026, 3, 28, 20, tzinfo=UTC), datetime(2026, 10, 24, 20, tzinfo=UTC), NOON)


class Killed(BaseException):
    """Stands for a process that was killed."""


steps = st.lists(
    st.one_of(
        st.tuples(st.just("wait"), st.integers(1, 5000)),
        st.tuples(st.just("jump"), st.integers(-20_000, 200_000)),
        st.tuples(st.just("run"), st.sampled_from(["well", "fails", "killed", "long"])),
        st.tuples(st.just("start"), st.just(0)),
        st.tuples(st.just("look"), st.just(0)),
    ),
    max_size=25,
)


def do(schedule: FieldSchedule, clock: HandClock, step: tuple[str, object], lock: RigLock) -> None:
    """One thing that happens to a schedule."""

    def survey(field: str, due: datetime) -> Path:
        clock.sleep(5000 if step[1] == "long" else 30)
        if step[1] == "fails":
            raise RigError("no reply")
        if step[1] == "killed":
            raise Killed
        return Path("run")

    if step[0] == "wait":
        clock.sleep(float(str(step[1])))
    elif step[0] == "jump":
        clock.moment += timedelta(seconds=int(str(step[1])))
    elif step[0] == "start":
        schedule.open()
    elif step[0] == "look":
        schedule.pending()
    else:
        with suppress(Killed):
            run_all({schedule.field: schedule}, lambda name: lock, survey, lambda words: None)


@given(
    cron=st.sampled_from(CRONS),
    zone=st.sampled_from(ZONES),
    start=st.sampled_from(CHANGES),
    steps=steps,
    late=st.sampled_from([0.1, 0.5, 1.0]),
)
@example(  # set back while a due time waits to be begun
    cron="30 2 * * *",
    zone="UTC",
    start=CHANGES[0],
    late=0.1,
    steps=[*[("wait", 1)] * 3, ("jump", 109_858), ("start", 0), ("jump", -61), ("start", 0)],
)
@example(  # a run that died is resumed in what is its past by a clock that was set back
    cron="*/20 * * * *",
    zone="UTC",
    start=CHANGES[0],
    late=0.1,
    steps=[("wait", 2400), ("run", "killed"), ("jump", -1231), ("run", "well")],
)
@settings(max_examples=120, deadline=None)
def test_every_due_time_is_accounted_for_exactly_once(
    cron: str, zone: str, start: datetime, steps: list[tuple[str, object]], late: float
) -> None:
    """Waiting, jumps of the clock, kills, restarts and changes of the hour: none is missing, and none is twice."""
    with tempfile.TemporaryDirectory() as folder:
        clock, lock = HandClock(start), RigLock(Path(folder) / "rig.lock")
        schedule = FieldSchedule(Ledger(Path(folder), "north"), parse_timetable(cron, None, zone), late, clock)
        schedule.open()
        latest = start
        for step in steps:
            do(schedule, clock, step, lock)
            latest = max(latest, clock.moment)
        *_, clock.moment = islice(schedule.timetable.due_after(latest), 3)  # nothing is pending then, nor to be resumed
        schedule.reap()
        schedule.close()
        assert not schedule.state().open
        found = accounted(schedule.ledger.lines(), schedule.timetable)
        due = list(schedule.timetable.due_between(start, clock.moment))
        assert [(one, found[one]) for one in due if found[one] != 1] == []


@given(zone=st.sampled_from(ZONES), cron=st.sampled_from(CRONS), day=st.integers(0, 364), split=st.integers(0, 400_000))
@settings(max_examples=60, deadline=None)
def test_due_times_do_not_depend_on_when_they_are_asked_for(zone: str, cron: str, day: int, split: int) -> None:
    """Those of a span are those of its parts, they rise, and none is told twice, also where clocks change."""
    table = parse_timetable(cron, None, zone)
    start = datetime(2026, 1, 1, tzinfo=UTC) + timedelta(days=day)
    middle, end = start + timedelta(seconds=split), start + timedelta(seconds=400_000)
    whole = list(table.due_between(start, end))
    assert whole == [*table.due_between(start, middle), *table.due_between(middle, end)]
    assert all(one < two for one, two in pairwise(whole))


def test_due_times_when_clocks_change_and_whoever_began() -> None:
    """A half past two that is not there is due when the lost hour ends; crons read back with their zone."""
    table = parse_timetable(None, "30m", "UTC")
    assert table.next_after(NOON + timedelta(minutes=7)) == NOON + timedelta(minutes=30)
    assert table.next_after(NOON) == NOON + timedelta(minutes=30)
    table = parse_timetable("30 2 * * *", None, "Europe/Berlin")
    spring = list(table.due_between(datetime(2026, 3, 28, 12, tzinfo=UTC), datetime(2026, 3, 29, 12, tzinfo=UTC)))
    autumn = list(table.due_between(datetime(2026, 10, 24, 12, tzinfo=UTC), datetime(2026, 10, 25, 12, tzinfo=UTC)))
    assert spring == [datetime(2026, 3, 29, 1, 0, tzinfo=UTC)]
    assert autumn == [datetime(2026, 10, 25, 0, 30, tzinfo=UTC)]
    table = parse_timetable("0 6 * * 1", None, "Europe/Berlin")
    assert read_timetable(table.to_dict()) == table
    assert read_timetable({"cron": "nonsense"}) is None
    assert parse_every("1.5h") == timedelta(minutes=90)


@pytest.mark.parametrize(
    ("cron", "every", "zone", "words"),
    [
        (None, None, None, "needs --cron or --every, got neither"),
        ("* * * * *", "30m", None, "got both"),
        ("hourly", None, None, "expected five fields, .* got 1"),
        ("61 * * * *", None, None, "Bad minute"),
        ("0 0 31 2 *", None, "UTC", "Bad day-of-month"),
        (None, "30", None, "expected a number and s, m, h or d"),
        (None, "1s", None, "expected 10s to 366d"),
        (None, "999999999999999999999d", None, "expected 10s to 366d"),
        ("0 6 * * *", None, "Mars/Olympus", "is no time zone"),
    ],
)
def test_nonsense_is_refused(cron: str | None, every: str | None, zone: str | None, words: str) -> None:
    """One message that says what is expected."""
    with pytest.raises(SettingsError, match=words):
        parse_timetable(cron, every, zone)


@pytest.mark.parametrize(
    ("every", "words"),
    [
        ("10s", "10s"),
        ("30m", "30m"),
        ("1.5h", "90m"),
        ("48h", "2d"),
        ("90.5s", "90.5s"),
        ("1234567s", "1234567s"),
        ("100000.5s", "100000.5s"),
        ("0.1d", "144m"),
        ("11d", "11d"),
        ("366d", "366d"),
        ("10.000001s", "10.000001s"),
    ],
)
def test_a_span_is_told_exactly(every: str, words: str) -> None:
    """In its largest unit, with every digit: what is told, or stands in a ledger, can be given again."""
    table = parse_timetable(None, every, "UTC")
    assert table.words() == f"every {words}"
    assert table.every is not None
    assert parse_every(words) == parse_every(exact_words(table.every)) == table.every
    assert read_timetable(json.loads(json.dumps(table.to_dict()))) == table


@pytest.mark.parametrize("before", ["never served", "closed", "served by another schedule", "served less patiently"])
def test_the_first_due_time_of_a_deployment_is_served(tmp_path: Path, before: str) -> None:
    """A run that Prefect started opens the schedule that it is of, and is to be run; it is not skipped for that."""
    clock = HandClock()
    if before != "never served":
        other = {"served by another schedule": {"every": "15m"}, "served less patiently": {"late": 0.1}}
        old = field_schedule(tmp_path, clock, **other.get(before, {}))  # type: ignore[arg-type]
        old.open()
        if before == "closed":
            old.close()
    schedule = field_schedule(tmp_path, clock)
    due = NOON + timedelta(minutes=20)
    clock.moment = due + timedelta(seconds=7)
    schedule.join(due)
    assert schedule.pending() == [due]
    assert schedule.begin(due) == 1
    assert schedule.end(due, "done", run="runs/one")
    assert due not in [one for one in schedule.state().ended if schedule.state().ended[one]["event"] == "skipped"]
    clock.sleep(20 * 60)
    schedule.join(due + timedelta(minutes=20))
    assert schedule.pending() == [due + timedelta(minutes=20)]
    assert [line["event"] for line in schedule.ledger.lines()].count("opened") == (1 if before == "never served" else 2)
