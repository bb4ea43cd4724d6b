"""One due run of a field: wait for the rig, note the beginning, survey, note the end. Whatever happens has a line."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from flows.schedule.field_schedule import Ending, FieldSchedule
from flows.schedule.rig_lock import RigLock
from pipeline.errors import PipelineError

Survey = Callable[[str, datetime], Path]  # field and due time in, the folder of the published run out
Tell = Callable[[str], None]  # one line for the operator


@dataclass(frozen=True)
class Outcome:
    """What became of a due run; ``ending`` is None where it has none of its own in the ledger."""

    field: str
    due: datetime
    ending: Ending | None
    reason: str | None = None
    run: str | None = None
    error: BaseException | None = None

    def words(self) -> str:
        """In one line."""
        told = self.ending or "was not begun here"
        more = f": {self.reason}" if self.reason else f": {self.run}" if self.run else ""
        return f"{self.field}, due {self.due:%Y-%m-%d %H:%M:%S} UTC, {told}{more}"


def outcome_of(field: str, due: datetime, line: Mapping[str, Any]) -> Outcome:
    """What a line of the ledger says became of a due run."""
    return Outcome(field, due, line.get("event"), line.get("reason"), line.get("run"))


def run_due(
    schedule: FieldSchedule, due: datetime, lock: RigLock, survey: Survey, *, facts: Mapping[str, object] | None = None
) -> Outcome:
    """Run one due survey, or skip it where the rig is not free in time, and note how it ended.

    A process that dies in it, and an operator's interruption, leave a beginning without an end: the next process that
    looks resumes the run or notes that it failed.

    Raises
    ------
    ArchiveError : the ledger cannot be written; `FieldSchedule.reap` accounts for the run later.
    """
    latest = schedule.timetable.latest_start(due, schedule.late)
    resumed = due in schedule.state().open
    if resumed:  # its time to begin is over: until the next is due
        latest = due + schedule.timetable.interval(due)
    words = f"{schedule.field}, due {due:%H:%M:%S} UTC"
    if not lock.wait(latest, schedule.clock, words):
        if resumed:
            return _as_noted(schedule, due)
        reason = f"the rig was in use by {lock.holder()} until it was too late to begin"
        return _end(schedule, due, "skipped", reason)
    try:
        if schedule.begin(due, **(facts or {})) is None:
            return _as_noted(schedule, due)
        return _survey(schedule, due, survey)
    finally:
        lock.release()


def _survey(schedule: FieldSchedule, due: datetime, survey: Survey) -> Outcome:
    started = schedule.clock.now()
    try:
        folder = survey(schedule.field, due)
    except PipelineError as error:
        return _end(schedule, due, "failed", str(error), error=error)
    except OSError as error:
        return _end(schedule, due, "failed", f"{error}; check the machine and its disks", error=error)
    except Exception as error:
        reason = f"{type(error).__name__}: {error}; this is a defect of SpectralZoom, please report it"
        return _end(schedule, due, "failed", reason, error=error)
    seconds = round((schedule.clock.now() - started).total_seconds(), 3)
    return _end(schedule, due, "done", run=f"runs/{folder.name}", seconds=seconds)


def _end(
    schedule: FieldSchedule,
    due: datetime,
    ending: Ending,
    reason: str | None = None,
    *,
    run: str | None = None,
    seconds: float | None = None,
    error: BaseException | None = None,
) -> Outcome:
    if not schedule.end(due, ending, reason, run=run, seconds=seconds):
        return _as_noted(schedule, due)
    return Outcome(schedule.field, due, ending, reason, run, error)


def _as_noted(schedule: FieldSchedule, due: datetime) -> Outcome:
    """What the ledger says of a run that ended otherwise than here."""
    return outcome_of(schedule.field, due, schedule.state().ended.get(due, {}))


def run_all(
    schedules: Mapping[str, FieldSchedule], lock_of: Callable[[str], RigLock], survey: Survey, tell: Tell
) -> list[Outcome]:
    """Resume what died, skip what is too late, and run what is due by now, field after field in turn.

    A field whose ledger cannot be written is told of and left for the next time; the others go on.
    """
    outcomes: list[Outcome] = []
    waiting = [(due, name) for name in schedules for due in _to_run(schedules[name], lock_of(name), tell)]
    for due, name in sorted(waiting, key=lambda one: one[0]):  # of one due time, fields in the order given
        try:
            outcome = run_due(schedules[name], due, lock_of(name), survey)
        except PipelineError as error:
            tell(f"{name}: {error}")
            continue
        outcomes.append(outcome)
        tell(outcome.words())
    return outcomes


def _to_run(schedule: FieldSchedule, lock: RigLock, tell: Tell) -> list[datetime]:
    """Runs to resume, where the rig is free and tells that they died, and runs that are due."""
    try:
        if not lock.take(schedule.field):
            return schedule.pending(f"the rig was in use by {lock.holder()}")
        try:
            return [*schedule.reap(), *schedule.pending()]
        finally:
            lock.release()
    except PipelineError as error:
        tell(f"{schedule.field}: {error}")
        return []
