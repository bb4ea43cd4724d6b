"""What a field's ledger says by now: which due times are accounted for, which runs began and never ended."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any, Literal

from flows.schedule.times import Timetable, read_timetable

Ending = Literal["done", "skipped", "failed"]
ENDINGS = ("done", "skipped", "failed")


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
        if event == "clock":
            _set_back(state, at)
        state.seen = at if state.seen is None else max(state.seen, at)
        due = read_moment(line.get("due"))
        if event == "opened":
            _open(state, at, line)
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


def _open(state: ScheduleState, at: datetime, line: Mapping[str, Any]) -> None:
    known = line.get("schedule")
    state.timetable = read_timetable(known) if isinstance(known, Mapping) else None
    late = line.get("late")
    state.late = float(late) if isinstance(late, int | float) else 0.0
    if not state.serving:  # what would have been due while nothing was scheduled was not due
        first = read_moment(line.get("first"))
        _reach(state, at if first is None else min(at, first - timedelta.resolution))
    state.serving, state.opened = True, at


def _reach(state: ScheduleState, moment: datetime) -> None:
    state.since = moment if state.since is None else max(state.since, moment)


def _set_back(state: ScheduleState, at: datetime) -> None:
    """The clock was set back: what was skipped in a future that did not come is due again; what ran has run."""
    state.seen = at
    state.since = at if state.since is None else min(state.since, at)  # what waits to be begun waits still
    state.ended = {due: line for due, line in state.ended.items() if due <= at or line.get("event") != "skipped"}
