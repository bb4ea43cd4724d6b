"""What has become known of due runs since the last look, whoever wrote it into the ledgers: told, and sent on."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from flows.schedule.due_runs import Outcome
from flows.schedule.field_schedule import FieldSchedule
from flows.schedule.ledger_state import read_moment, read_state
from pipeline.errors import PipelineError


@dataclass(frozen=True, kw_only=True)
class Several(Outcome):
    """Due runs of a field that ended alike. ``due`` is the last one's, ``since`` the first one's or shortly before it.

    ``count`` is None where there are too many to count.
    """

    since: datetime
    count: int | None

    def words(self) -> str:
        """In one line."""
        number = "very many" if self.count is None else self.count
        span = f"{self.since:%Y-%m-%d %H:%M:%S} and {self.due:%Y-%m-%d %H:%M:%S} UTC"
        return f"{self.field}, {number} due between {span}, {self.ending}: {self.reason}"


@dataclass
class ScheduleNews:
    """Endings that a ledger did not have before. What it has when this is made, or was first readable, is no news."""

    schedules: Mapping[str, FieldSchedule]
    refused: Callable[[str, PipelineError], None]  # told of a field whose ledger cannot be read
    _known: dict[str, set[datetime]] = field(default_factory=dict)
    _passed: dict[str, int] = field(default_factory=dict)  # lines for very many due times

    def __post_init__(self) -> None:
        self.fresh()

    def fresh(self) -> list[Outcome]:
        """How due runs ended since the last time, field after field."""
        return [outcome for name, schedule in self.schedules.items() for outcome in self._of(name, schedule)]

    def _of(self, name: str, schedule: FieldSchedule) -> list[Outcome]:
        try:
            lines = schedule.ledger.lines()
        except PipelineError as error:
            self.refused(name, error)
            return []
        ended, passed = read_state(lines).ended, [line for line in lines if line.get("event") == "passed"]
        known, told = self._known.get(name), self._passed.get(name, 0)
        self._known[name], self._passed[name] = set(ended), len(passed)
        if known is None:
            return []
        many = [found for line in passed[told:] if (found := _several(name, line)) is not None]
        return [*many, *(_outcome(name, due, ended[due]) for due in sorted(set(ended) - known))]


def together(outcomes: Iterable[Outcome]) -> list[Outcome]:
    """The same with one for all runs of a field that ended alike: after an outage there are very many."""
    alike: dict[tuple[str, str | None], list[Outcome]] = {}
    for outcome in outcomes:
        alike.setdefault((outcome.field, outcome.ending), []).append(outcome)
    return [_as_one(same) for same in alike.values()]


def _as_one(outcomes: Sequence[Outcome]) -> Outcome:
    if len(outcomes) == 1:
        return outcomes[0]
    last = max(outcomes, key=lambda one: one.due)
    counts = [one.count if isinstance(one, Several) else 1 for one in outcomes]
    return Several(
        last.field,
        last.due,
        last.ending,
        f"the last one: {last.reason}",
        since=min(one.since if isinstance(one, Several) else one.due for one in outcomes),
        count=None if None in counts else sum(filter(None, counts)),
    )


def _outcome(name: str, due: datetime, line: Mapping[str, Any]) -> Outcome:
    reason, run = line.get("reason"), line.get("run")
    return Outcome(name, due, line["event"], None if reason is None else str(reason), None if run is None else str(run))


def _several(name: str, line: Mapping[str, Any]) -> Several | None:
    """What a line for very many due times says; None where none was left to be accounted for."""
    after, until, count = read_moment(line.get("after")), read_moment(line.get("until")), line.get("count")
    if after is None or until is None or count == 0:
        return None
    number = count if isinstance(count, int) else None
    return Several(name, until, "skipped", str(line.get("reason")), since=after, count=number)
