"""Schedules without a server: this process waits until fields are due and surveys them in turn."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from datetime import datetime, timedelta

from flows.schedule.due_runs import Outcome, Survey, Tell, run_all
from flows.schedule.field_schedule import FieldSchedule
from flows.schedule.news import ScheduleNews, together
from flows.schedule.rig_lock import RigLock
from flows.schedule.times import SystemWallClock, WallClock
from pipeline.errors import PipelineError

LOOK_AGAIN = timedelta(seconds=30)  # a clock that jumps, or a run that died, is seen after this at the latest


def serve_plain(
    schedules: Mapping[str, FieldSchedule],
    locks: Mapping[str, RigLock],
    survey: Survey,
    tell: Tell,
    *,
    clock: WallClock | None = None,
    note: Callable[[Outcome], None] = lambda outcome: None,
    until: datetime | None = None,
) -> None:
    """Serve schedules until ``until``, or until interrupted; then they are closed, and what began is resumed later.

    Raises
    ------
    PipelineError : a ledger cannot be written at the start; what was opened until then is closed.
    """
    watch, news = clock or SystemWallClock(), ScheduleNews(schedules, lambda name, error: tell(f"{name}: {error}"))
    with ExitStack() as opened:
        for name, schedule in schedules.items():
            opened.callback(_close, name, schedule, tell)
            schedule.open()
        while until is None or watch.now() < until:
            outcomes = run_all(schedules, lambda name: locks[name], survey, tell)
            ran = {(outcome.field, outcome.due) for outcome in outcomes if outcome.ending}
            fresh = news.fresh()
            for outcome in fresh:  # also what was skipped, or found dead
                if (outcome.field, outcome.due) not in ran:
                    tell(outcome.words())
            for outcome in together(fresh):
                note(outcome)
            if not any(outcome.ending for outcome in outcomes):  # else others may have become due meanwhile
                watch.sleep(_pause(schedules.values(), watch.now()).total_seconds())


def _close(name: str, schedule: FieldSchedule, tell: Tell) -> None:
    """Close a schedule; one that cannot be closed keeps the others from nothing."""
    try:
        schedule.close()
    except PipelineError as error:
        tell(f"{name}: {error}")


def _pause(schedules: Iterable[FieldSchedule], now: datetime) -> timedelta:
    due = [schedule.timetable.next_after(now) for schedule in schedules]
    soonest = min((one - now for one in due if one is not None), default=LOOK_AGAIN)
    return min(soonest, LOOK_AGAIN)
