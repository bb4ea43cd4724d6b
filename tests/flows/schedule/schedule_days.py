"""Clocks turned by hand, and what a ledger's lines must add up to."""

from __future__ import annotations

from collections import Counter
from datetime import UTC, datetime, timedelta
from pathlib import Path

from flows.schedule.field_schedule import ENDINGS, FieldSchedule, read_moment, read_state
from flows.schedule.times import Timetable, parse_timetable
from storage.archive.ledger import Ledger

NOON = datetime(2026, 6, 1, 12, tzinfo=UTC)


class HandClock:
    """A time of day that moves only when it is told to, or is slept by."""

    def __init__(self, moment: datetime = NOON) -> None:
        self.moment = moment

    def now(self) -> datetime:
        """The moment."""
        return self.moment

    def sleep(self, seconds: float) -> None:
        """Move on at once."""
        self.moment += timedelta(seconds=max(seconds, 0.001))


def field_schedule(
    root: Path, clock: HandClock, field: str = "north", every: str = "20m", late: float = 0.5
) -> FieldSchedule:
    """A schedule of one field below ``root``."""
    return FieldSchedule(Ledger(root, field), parse_timetable(None, every, "UTC"), late, clock)


def opened(root: Path, every: str = "20m", late: float = 0.5) -> tuple[HandClock, FieldSchedule]:
    """A clock that shows noon, and a schedule by it that is served since then."""
    clock = HandClock()
    schedule = field_schedule(root, clock, every=every, late=late)
    schedule.open()
    return clock, schedule


def accounted(lines: list[dict[str, object]], timetable: Timetable) -> Counter[datetime]:
    """How often each due time is accounted for: by its own ending, or by a line for very many."""
    found: Counter[datetime] = Counter(list(read_state(lines).ended))
    endings = [line for line in lines if line["event"] in ENDINGS]
    assert len({line["due"] for line in endings}) == len(endings) or any(line["event"] == "clock" for line in lines)
    for line in lines:
        if line["event"] == "passed":
            after, until = read_moment(line["after"]), read_moment(line["until"])
            assert after is not None
            assert until is not None
            found.update(due for due in timetable.due_between(after, until) if due not in found)
    return found
