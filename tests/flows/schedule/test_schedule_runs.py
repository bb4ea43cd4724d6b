"""Schedules without a server: a day of surveys in turn, with kills, cables, full disks; locks, lateness, resuming."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections import Counter
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from flows.schedule.due_runs import run_all, run_due
from flows.schedule.field_schedule import NOT_SERVED, FieldSchedule
from flows.schedule.rig_lock import RigLock, rig_lock
from flows.settings.survey_settings import Settings
from pipeline.errors import ArchiveError, RigError
from storage.archive.ledger import Ledger
from tests.flows.schedule.schedule_days import NOON, HandClock, accounted, field_schedule, opened

FIELDS = ("north", "south", "west")
ROOT = Path(__file__).parents[3]


class Killed(BaseException):
    """Stands for a process that was killed: nothing after it runs."""


def endings(schedule: FieldSchedule) -> list[tuple[str, str]]:
    """Event and reason of every line that ends a due time."""
    lines = schedule.ledger.lines()
    return [(line["event"], line.get("reason", "")) for line in lines if line["event"] in ("done", "skipped", "failed")]


def test_a_day_of_72_surveys_over_3_fields_in_turn(tmp_path: Path) -> None:
    """With ten kills, five pulled cables and two full disks every due run is done, skipped by rule, or failed."""
    clock, rng, lock = HandClock(), np.random.default_rng(3), RigLock(tmp_path / "rig.lock")
    schedules = {name: field_schedule(tmp_path, clock, name, "1h") for name in FIELDS}
    troubles = {int(number): Killed("kill -9") for number in rng.choice(60, 10, replace=False)}
    for number in rng.permutation([one for one in range(60) if one not in troubles])[:7]:
        troubles[int(number)] = RigError("no reply from /dev/ttyUSB0") if len(troubles) < 15 else OSError(28, "full")
    surveys: list[tuple[str, datetime]] = []

    def survey(field: str, due: datetime) -> Path:
        clock.sleep(400)
        surveys.append((field, due))
        trouble = troubles.pop(len(surveys) - 1, None)
        if trouble is not None:
            raise trouble
        return tmp_path / f"{field}-{len(surveys)}"

    for schedule in schedules.values():
        schedule.open()
    while clock.now() < NOON + timedelta(hours=24, minutes=30):
        try:
            run_all(schedules, lambda name: lock, survey, lambda words: None)
        except Killed:
            clock.sleep(float(rng.choice([5.0, 900.0, 4000.0])))  # until somebody starts it again
            for schedule in schedules.values():
                schedule.open()
        clock.sleep(300)
    counts: Counter[str] = Counter()
    for schedule in schedules.values():
        schedule.close()
        due = list(schedule.timetable.due_between(NOON, NOON + timedelta(hours=24)))
        found = accounted(schedule.ledger.lines(), schedule.timetable)
        assert {one: found[one] for one in due if found[one] != 1} == {}
        assert not schedule.state().open
        assert all(reason for event, reason in endings(schedule) if event != "done")
        counts.update(event for event, _ in endings(schedule))
    assert not troubles
    assert counts["failed"] >= 7
    assert counts["done"] >= 45
    first = [field for field, due in surveys if due == NOON + timedelta(hours=1)]
    assert list(dict.fromkeys(first)) == list(FIELDS)


def test_a_run_that_could_not_begin_in_time_is_skipped(tmp_path: Path) -> None:
    """Half of the interval after its time nothing begins; until then it does."""
    clock, schedule = opened(tmp_path)
    clock.sleep(30 * 60)
    assert schedule.pending() == [NOON + timedelta(minutes=20)]
    clock.sleep(1)
    assert schedule.pending() == []
    assert endings(schedule) == [("skipped", "it could not begin in time (noted 10.0 min after it was due)")]
    assert schedule.begin(NOON + timedelta(minutes=20)) is None


def test_a_rig_in_use_is_waited_for_until_it_is_too_late(tmp_path: Path) -> None:
    """Another survey that holds the rig: the run is skipped by rule, and the reason names the holder."""
    (clock, schedule), other = opened(tmp_path), RigLock(tmp_path / "rig.lock")
    clock.sleep(20 * 60)
    assert other.take("a survey by hand")
    outcome = run_due(schedule, clock.now(), RigLock(tmp_path / "rig.lock"), lambda *given: tmp_path)
    other.release()
    assert outcome.ending == "skipped"
    assert f"in use by a survey by hand (process {os.getpid()})" in str(outcome.reason)
    assert clock.now() - NOON >= timedelta(minutes=30)


def test_a_killed_run_is_resumed_under_its_own_due_time(tmp_path: Path) -> None:
    """The second attempt has the due time of the first, so that the archive finds what was captured."""
    clock, lock = HandClock(), RigLock(tmp_path / "rig.lock")
    schedule, seen = field_schedule(tmp_path, clock), []

    def survey(field: str, due: datetime) -> Path:
        seen.append(due)
        if len(seen) == 1:
            raise Killed
        return tmp_path / "run-2"

    schedule.open()
    clock.sleep(20 * 60)
    with pytest.raises(Killed):
        run_all({"north": schedule}, lambda name: lock, survey, lambda words: None)
    clock.sleep(15 * 60)  # too late to begin, but the next is not yet due
    outcomes = run_all({"north": schedule}, lambda name: lock, survey, lambda words: None)
    assert seen == [NOON + timedelta(minutes=20)] * 2
    assert [(one.ending, one.run) for one in outcomes] == [("done", "runs/run-2")]
    assert schedule.ledger.lines()[-1]["attempts"] == 2


@pytest.mark.parametrize(("wait_s", "kills", "says"), [(1300, 1, "the next one was due"), (1, 3, "3 times over")])
def test_a_killed_run_fails_when_it_cannot_be_resumed(tmp_path: Path, wait_s: int, kills: int, says: str) -> None:
    """Once the next is due, or after three deaths, it is told as failed, and what it captured is kept."""
    clock, lock = HandClock(), RigLock(tmp_path / "rig.lock")
    schedule = field_schedule(tmp_path, clock)

    def survey(field: str, due: datetime) -> Path:
        raise Killed

    schedule.open()
    clock.sleep(20 * 60)
    for _ in range(kills):
        with pytest.raises(Killed):
            run_all({"north": schedule}, lambda name: lock, survey, lambda words: None)
    clock.sleep(wait_s)
    assert schedule.reap() == []
    assert endings(schedule)[0][0] == "failed"
    assert says in endings(schedule)[0][1]


def test_what_reaping_knows_better_is_the_reason(tmp_path: Path) -> None:
    """A run that the operator cancelled is not resumed."""
    clock, schedule = opened(tmp_path)
    clock.sleep(20 * 60)
    schedule.begin(clock.now(), flow_run="abc")
    assert schedule.reap(lambda line: "cancelled" if line["flow_run"] == "abc" else None) == []
    assert endings(schedule) == [("failed", "cancelled")]


def test_one_failed_field_does_not_stop_the_others(tmp_path: Path) -> None:
    """Errors of the pipeline, of the disk and defects are reasons; the fields after it are surveyed."""
    clock, lock = HandClock(), RigLock(tmp_path / "rig.lock")
    schedules = {name: field_schedule(tmp_path, clock, name) for name in FIELDS}
    errors = {"north": RigError("no reply; is it on?"), "south": ValueError("odd")}

    def survey(field: str, due: datetime) -> Path:
        if field in errors:
            raise errors[field]
        return tmp_path / "run"

    for schedule in schedules.values():
        schedule.open()
    clock.sleep(20 * 60)
    run_all(schedules, lambda name: lock, survey, lambda words: None)
    assert endings(schedules["north"]) == [("failed", "no reply; is it on?")]
    assert endings(schedules["south"])[0][1].startswith("ValueError: odd; this is a defect")
    assert endings(schedules["west"]) == [("done", "")]


def test_what_was_due_while_nothing_served_is_skipped(tmp_path: Path) -> None:
    """A serve that died left the schedule open, and the next accounts for what it missed; one that closed did not."""
    clock, schedule = opened(tmp_path)
    clock.sleep(65 * 60)
    schedule.open()
    assert [reason.split(" (")[0] for _, reason in endings(schedule)] == [NOT_SERVED] * 2  # the third may begin yet
    schedule.close()
    clock.sleep(3600)
    schedule.open()
    assert len(endings(schedule)) == 3
    assert schedule.pending() == []


def test_another_timetable_accounts_for_the_one_before(tmp_path: Path) -> None:
    """Due times of the old timetable end with it; those of the new one begin then."""
    clock, schedule = opened(tmp_path)
    clock.sleep(21 * 60)
    other = field_schedule(tmp_path, clock, every="15m")
    other.open()
    assert len(endings(schedule)) == 1
    clock.sleep(10 * 60)
    assert other.pending() == [NOON + timedelta(minutes=30)]


def test_very_many_missed_due_times_have_one_line(tmp_path: Path) -> None:
    """A machine that slept for a month does not write a line for each; the last one may still run."""
    clock, schedule = opened(tmp_path)
    clock.sleep(30 * 86400 + 60)
    assert schedule.pending() == [NOON + timedelta(days=30)]
    lines = schedule.ledger.lines()
    assert [line["event"] for line in lines] == ["opened", "passed"]
    assert lines[-1]["count"] == 30 * 72 - 1
    assert schedule.pending() == [NOON + timedelta(days=30)]
    assert schedule.ledger.lines() == lines
    assert schedule.begin(NOON + timedelta(minutes=20)) is None
    assert schedule.begin(clock.now() - timedelta(minutes=21)) is None
    assert schedule.begin(NOON + timedelta(days=30)) == 1
    assert [line["event"] for line in schedule.ledger.lines()] == ["opened", "passed", "begun"]


def test_a_clock_from_the_far_future_and_back(tmp_path: Path) -> None:
    """What was passed over in a future that did not come is due when its time comes."""
    clock, schedule = opened(tmp_path)
    clock.moment = NOON.replace(year=2099)
    schedule.pending()
    clock.moment = NOON + timedelta(minutes=5)
    assert schedule.pending() == []
    clock.sleep(16 * 60)
    assert schedule.pending() == [NOON + timedelta(minutes=20)]


def test_a_full_disk_is_told_of_and_the_run_accounted_for_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An ending that cannot be written leaves a beginning, which the next look accounts for."""
    clock, lock, told = HandClock(), RigLock(tmp_path / "rig.lock"), []
    schedule = field_schedule(tmp_path, clock)
    real = Ledger.append

    def refuse(self: Ledger, line: dict[str, object]) -> None:
        if line["event"] in ("done", "failed"):
            raise ArchiveError("the disk is full: free some space and run again")
        real(self, line)

    schedule.open()
    clock.sleep(20 * 60)
    with monkeypatch.context() as patch:
        patch.setattr(Ledger, "append", refuse)
        assert run_all({"north": schedule}, lambda name: lock, lambda *given: tmp_path, told.append) == []
    assert told == ["north: the disk is full: free some space and run again"]
    run_all({"north": schedule}, lambda name: lock, lambda *given: tmp_path, told.append)
    assert endings(schedule) == [("done", "")]


HOLDS = """
import sys, time
from pathlib import Path
from flows.schedule.rig_lock import RigLock
print(RigLock(Path(sys.argv[1])).take("a survey"), flush=True)
time.sleep(60)
"""


def test_the_kernel_frees_the_rig_of_a_killed_process(tmp_path: Path) -> None:
    """While a process holds the lock nobody else gets it; when it is killed anybody does, at once."""
    path, environment = tmp_path / "rig.lock", {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen([sys.executable, "-c", HOLDS, path], env=environment, stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == b"True\n"
    lock = RigLock(path)
    assert not lock.take()
    assert f"process {process.pid}" in lock.holder()
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    assert lock.take()
    lock.release()


def test_each_rig_has_one_lock(tmp_path: Path) -> None:
    """The simulated one is the archive's own; a look does not keep a survey off, a survey does."""
    rig = replace(Settings(), source="rig")
    assert rig_lock(rig, tmp_path / "a").place == rig_lock(rig, tmp_path / "b").place
    assert rig_lock(Settings(), tmp_path / "a").place != rig_lock(Settings(), tmp_path / "b").place
    looking, survey = RigLock(tmp_path / "rig.lock"), RigLock(tmp_path / "rig.lock")
    assert looking.take("a look at the schedule")
    later = threading.Timer(0.2, looking.release)
    later.start()
    assert survey.take_soon("by hand")
    later.join()
    assert not RigLock(tmp_path / "rig.lock").take_soon("another")
    survey.release()
