"""What is to be served: fields, when, and the deployments of Prefect that this comes to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from flows.field_schedule import FieldSchedule
from flows.schedule_times import Timetable
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

    def schedules(self) -> dict[str, FieldSchedule]:
        """The schedule of every field, by its name."""
        return {one.name: one.schedule(self.timetable, self.late) for one in self.fields}


def deployments(request: ServeRequest) -> list[Any]:
    """A deployment of the survey for each field, and of reprocessing for each archive.

    None has a schedule of Prefect's: the watcher plans each due time once, see `flows.serve_queue`.
    """
    from prefect.types.entrypoint import EntrypointType

    from flows.serve_flow import reprocess_archive, survey_scheduled

    made = [
        survey_scheduled.to_deployment(
            one.name, schedules=[], parameters={"field": one.name}, tags=[one.settings.source, one.name],
            description=f"Surveys of {one.name} by {one.file}, {request.timetable.words()}.", version="1",
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
