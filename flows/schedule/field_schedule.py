"""The schedule of one field: what is due, what may still begin, what is skipped; each due time accounted for once.

The ledger is the truth, and every look at it that leads to a line holds it against other writers.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from itertools import islice
from typing import Any, Literal

from flows.schedule.times import Timetable, WallClock, read_timetable
from storage.archive.ledger import Ledger

Ending = Literal["done", "skipped", "failed"]
ENDINGS = ("done", "skipped", "failed")
SET_BACK = timedelta(minutes=1)  # a clock that goes back by less is being put right
MOST_LINES = 100  # due times that passed and have a line each; more have one together
MOST_COUNTED = 100_000
MOST_ATTEMPTS = 3
NOT_SERVED = "nothing was serving the schedule when it was due, or was killed before it could begin"
TOO_LATE = "it could not begin in time"
GONE = "its process was gone before it ended (killed, or a power cut)"
OVERTAKEN = "a later one came first"


@dataclass
class ScheduleState:
    """A ledger read to its end. ``since``: due times up to it are accounted for, or their runs have begun."""

    timetable: Timetable | None = None
    late: float = 0.0
    serving: bool = False  # opened, and not closed
    opened: datetime | None = None
    since: datetime | None = None
    seen: datetime | None = None  # the latest that a clock has shown here
    ended: dict[datetime, Mapping[str, Any]] = field(default_factory=dict)
    begun: dict[datetime, list[Mapping[str, Any]]] = field(default_factory=dict)

    @property
    def open(self) -> dict[datetime, list[Mapping[str, Any]]]:
        """Runs that began and have not ended: the lines of each attempt."""
        return {due: lines for due, lines in self.begun.items() if due not in self.ended}


def read_state(lines: Iterable[Mapping[str, Any]]) -> ScheduleState:
    """Go through a ledger; lines that are not understood count as nothing."""
    state = ScheduleState()
    for line in lines:
        at, event = read_moment(line.get("at")), line.get("event")
        if at is None:
            continue
        if event == "clock":  # set back: what was skipped in a future that did not come is due again; what ran has run
            state.seen = at
            state.since = at if state.since is None else min(state.since, at)  # what waits to be begun waits still
            state.ended = {due: one for due, one in state.ended.items() if due <= at or one.get("event") != "skipped"}
        state.seen = at if state.seen is None else max(state.seen, at)
        due = read_moment(line.get("due"))
        if event == "opened":
            known, late, first = line.get("schedule"), line.get("late"), read_moment(line.get("first"))
            state.timetable = read_timetable(known) if isinstance(known, Mapping) else None
            state.late = float(late) if isinstance(late, int | float) else 0.0
            if not state.serving:  # what would have been due while nothing was scheduled was not due
                _reach(state, at if first is None else min(at, first - timedelta.resolution))
            state.serving, state.opened = True, at
        elif event == "closed":
            state.serving = False
        elif event == "passed" and (until := read_moment(line.get("until"))) is not None:
            _reach(state, until)
        elif event == "begun" and due is not None:
            if due not in state.begun:
                _reach(state, due)
            state.begun.setdefault(due, []).append(line)
        elif event in ENDINGS and due is not None and due not in state.ended:
            state.ended[due] = line
            if due not in state.begun:
                _reach(state, due)
    return state


def read_moment(value: object) -> datetime | None:
    """A moment as `moment_words` writes it; None where it is none."""
    try:
        found = datetime.fromisoformat(value) if isinstance(value, str) else None
    except ValueError:
        return None
    return None if found is None else found.replace(tzinfo=found.tzinfo or UTC).astimezone(UTC)


def moment_words(moment: datetime) -> str:
    """A moment in ISO 8601, UTC, to the second (with parts of it where there are any)."""
    return moment.astimezone(UTC).isoformat().replace("+00:00", "Z")


def _reach(state: ScheduleState, moment: datetime) -> None:
    state.since = moment if state.since is None else max(state.since, moment)


@dataclass(frozen=True)
class FieldSchedule:
    """Due times of one field and its ledger. ``late``: share of the interval after which a run may not begin."""

    ledger: Ledger
    timetable: Timetable
    late: float
    clock: WallClock

    @property
    def field(self) -> str:
        return self.ledger.field

    def state(self) -> ScheduleState:
        return read_state(self.ledger.lines())

    def open(self, first: datetime | None = None) -> None:
        """Begin to serve, or go on where a process died that served; what it missed is accounted for.

        ``first`` is a due time that is served still, though it may have come already.
        """
        with self.ledger.held():
            state, now = self._state_now()
            same = state.timetable == self.timetable and state.late == self.late
            if state.serving and state.timetable is not None:
                before = now if first is None else min(now, first - timedelta.resolution)
                self._pass_over(state, now, NOT_SERVED, keep=same, until=before)
            if not (state.serving and same):
                facts = {"schedule": self.timetable.to_dict(), "late": self.late, "host": platform.node()}
                known = {} if first is None else {"first": moment_words(first)}
                self._write("opened", now, **facts, **known, pid=os.getpid())

    def join(self, due: datetime) -> bool:
        """Serve a due time as part of what serves the field; open the schedule where nothing does, or by another one.

        What started the run for that time was scheduling before it, with or without a line in the ledger. False where
        that is not so any more: another schedule was opened after that time, and this run is left over from before.
        """
        state = self.state()
        if not state.serving or state.timetable != self.timetable or state.late != self.late:
            if state.serving and state.opened is not None and due < state.opened:
                return False
            self.open(due)
        return True

    def close(self, at: datetime | None = None) -> None:
        """Stop serving: nothing is due from now on, or from ``at`` on, when it was told to stop."""
        with self.ledger.held():
            state, now = self._state_now()
            if state.serving:
                self._pass_over(state, now, "the schedule was stopped", keep=False, until=at)
                self._write("closed", now)

    def pending(self, why: str | None = None) -> list[datetime]:
        """Skip what is too late by now, for the reason given, and tell which due times are to be run now."""
        with self.ledger.held():
            state, now = self._state_now()
            return self._pass_over(state, now, why or TOO_LATE, keep=True) if state.serving else []

    def begin(self, due: datetime, **facts: object) -> int | None:
        """Which attempt begins; None where accounted for. What began is begun again only by who knows it is dead."""
        with self.ledger.held():
            state, now = self._state_now()
            waiting = self._pass_over(state, now, TOO_LATE, keep=True)
            attempts = len(state.begun.get(due, ()))
            if due in state.ended or (not attempts and due not in waiting):
                return None
            if not attempts:
                self._overtake(state, now, due)
            self._write("begun", now, due=moment_words(due), attempt=attempts + 1, pid=os.getpid(), **facts)
            return attempts + 1

    def end(self, due: datetime, ending: Ending, reason: str | None = None, **facts: object) -> bool:
        """Note how a due time ended; False where that is noted already."""
        with self.ledger.held():
            state, now = self._state_now()
            if due in state.ended:
                return False
            began = state.begun.get(due)
            if began is None:
                self._overtake(state, now, due)
            attempts = {} if began is None else {"attempts": len(began)}
            self._write(ending, now, due=moment_words(due), reason=reason, **attempts, **facts)
            return True

    def reap(self, why: Callable[[Mapping[str, Any]], str | None] = lambda line: None) -> list[datetime]:
        """End runs whose process is gone, and tell which may be resumed: those whose next due time has not come.

        Only for whoever holds the rig's lock, so that no run of the field can be alive. ``why`` may know why a run
        (by its last line) is not to be resumed.
        """
        resumed: list[datetime] = []
        for due, lines in self.state().open.items():
            told = why(lines[-1])
            if told is None and len(lines) >= MOST_ATTEMPTS:
                told = f"{GONE}, {len(lines)} times over; what it captured is kept"
            if told is None and self.clock.now() >= due + self.timetable.interval(due):
                told = f"{GONE}, and the next one was due before it could be resumed; what it captured is kept"
            if told is None:
                resumed.append(due)
            else:
                self.end(due, "failed", told)
        return resumed

    def _overtake(self, state: ScheduleState, now: datetime, due: datetime) -> None:
        """Skip what is due before a due time that is about to be accounted for: later looks begin after that."""
        if state.serving:
            self._pass_over(state, now, OVERTAKEN, keep=False, until=due - timedelta.resolution)

    def _pass_over(
        self, state: ScheduleState, now: datetime, why: str, *, keep: bool, until: datetime | None = None
    ) -> list[datetime]:
        """Account for due times until now (or ``until``) not begun; ``keep``: those that may begin are given back."""
        timetable = state.timetable or self.timetable
        if state.since is None:
            return []
        end = now if until is None else until
        passed = list(islice(timetable.due_between(state.since, end), MOST_LINES + 1))
        if len(passed) > MOST_LINES:
            return self._pass_many(state, now, why, keep=keep, end=end)
        kept: list[datetime] = []
        for due in passed:
            if due in state.ended or due in state.begun:
                continue
            if keep and now <= timetable.latest_start(due, state.late):
                kept.append(due)
            else:
                minutes = (now - due).total_seconds() / 60
                reason = f"{why} (noted {minutes:.1f} min after it was due)"
                self._write("skipped", now, due=moment_words(due), reason=reason)
                state.ended[due] = {"event": "skipped"}
        return kept

    def _pass_many(self, state: ScheduleState, now: datetime, why: str, *, keep: bool, end: datetime) -> list[datetime]:
        """One line for very many due times; a newest one that may still begin is left out of it."""
        timetable, since = state.timetable or self.timetable, state.since
        assert since is not None
        count, looked, last, before = 0, 0, since, since
        for due in islice(timetable.due_between(since, end), MOST_COUNTED):
            count += due not in state.ended and due not in state.begun
            looked, last, before = looked + 1, due, last
        if looked == MOST_COUNTED:  # counting them all would take too long
            self._write("passed", now, after=moment_words(since), until=moment_words(end), count=None, reason=why)
            state.since = end
            return []
        fresh = last not in state.ended and last not in state.begun
        spared = keep and fresh and now <= timetable.latest_start(last, state.late)
        until, number = (before, count - 1) if spared else (last, count)
        self._write("passed", now, after=moment_words(since), until=moment_words(until), count=number, reason=why)
        state.since = until
        return [last] if spared else []

    def _state_now(self) -> tuple[ScheduleState, datetime]:
        """State and time; a clock that was set back is noted first."""
        state, now = self.state(), self.clock.now().astimezone(UTC)
        if state.seen is not None and now < state.seen - SET_BACK:
            self._write("clock", now, was=moment_words(state.seen), reason="the clock was set back")
            state = self.state()
        return state, now

    def _write(self, event: str, now: datetime, **facts: object) -> None:
        line = {"event": event, "at": moment_words(now), **facts}
        self.ledger.append({name: value for name, value in line.items() if value is not None or name == "count"})
