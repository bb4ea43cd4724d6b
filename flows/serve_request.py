"""What is to be served: fields, when, and the deployments of Prefect that this comes to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from flows.field_schedule import FieldSchedule
from flows.schedule_times import EPOCH, Timetable, exact_words
from flows.serve_fields import ServedField


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

    def parameters(self, one: ServedField) -> dict[str, Any]:
        """Parameters of a field's deployment."""
        every = None if self.timetable.every is None else exact_words(self.timetable.every)
        return {
            "field": one.name, "settings": str(one.file), "out": one.settings.out if self.out else None,
            "cron": self.timetable.cron, "every": every, "timezone": self.timetable.timezone, "late": self.late,
            "notify": None,  # what serves sees the ledgers, which have more to tell than one run
        }  # fmt: skip

    def words(self) -> dict[str, Any]:
        """All of it as plain values, for another process."""
        given = self.parameters(self.fields[0])
        return {
            "files": [str(one.file) for one in self.fields], "out": self.out, "limit": self.limit,
            **{name: given[name] for name in ("cron", "every", "timezone", "late")},
        }  # fmt: skip

    def schedules(self) -> dict[str, FieldSchedule]:
        """The schedule of every field, by its name."""
        return {one.name: one.schedule(self.timetable, self.late) for one in self.fields}


def deployments(request: ServeRequest) -> list[Any]:
    """A deployment of the survey for each field, and of reprocessing for each archive, on request."""
    from prefect.schedules import Cron, Interval
    from prefect.types.entrypoint import EntrypointType

    from flows.serve_flow import reprocess_archive, survey_scheduled

    timetable = request.timetable
    when: Any = (
        Interval(timetable.every, anchor_date=EPOCH, timezone="UTC")
        if timetable.every is not None
        else Cron(str(timetable.cron), timezone=timetable.timezone)
    )
    made = [
        survey_scheduled.to_deployment(
            one.name, schedules=[when], parameters=request.parameters(one), tags=[one.settings.source, one.name],
            description=f"Surveys of {one.name} by {one.file}, {timetable.words()}.", version="1",
            entrypoint_type=EntrypointType.MODULE_PATH,
        )
        for one in request.fields
    ]  # fmt: skip
    for number, out in enumerate(dict.fromkeys(one.settings.out for one in request.fields), 1):
        made.append(
            reprocess_archive.to_deployment(
                "archive" if number == 1 else f"archive-{number}", parameters={"archive": str(out)},
                description=f"Surveys of {out} again, with newer weights or stages; on request.", version="1",
                entrypoint_type=EntrypointType.MODULE_PATH,
            )
        )  # fmt: skip
    return made
