"""What is to be served: which fields, and when."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from flows.schedule.field_schedule import FieldSchedule
from flows.schedule.fields import ServedField
from flows.schedule.times import Timetable


@dataclass(frozen=True, kw_only=True)
class ServeRequest:
    """What is to be served, and how."""

    fields: Sequence[ServedField]
    timetable: Timetable
    late: float
    limit: int = 1
    port: int = 4200
    out: str | None = None
    notify: str | None = None

    @property
    def headline(self) -> str:
        """What is served, and how that is ended."""
        names = ", ".join(one.name for one in self.fields)
        return f"serving {names}, {self.timetable.words()}; stop with Ctrl-C, the same command goes on"

    def schedules(self) -> dict[str, FieldSchedule]:
        """The schedule of every field, by its name."""
        return {one.name: one.schedule(self.timetable, self.late) for one in self.fields}
