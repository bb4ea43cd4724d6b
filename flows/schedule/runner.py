"""The process that lets Prefect start a schedule's runs: `serve` keeps it up, and starts it anew with the server.

By itself Prefect's runner does not come back once its server has been away. Run as ``python -m flows.schedule.runner``.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from prefect import serve
from prefect.types.entrypoint import EntrypointType

from flows.schedule.prefect_flows import reprocess_archive, survey_scheduled
from flows.schedule.served import ServeRequest, read_served


@contextmanager
def own_temporary_folder() -> Iterator[None]:
    """Let this process have its temporary files in a folder that is this user's alone.

    Prefect's runner keeps what it starts in /tmp/runner_storage, which belongs to the first user who ever ran one: that
    one could exchange it, and no other can run one.
    """
    usual = tempfile.tempdir
    with tempfile.TemporaryDirectory(prefix="spectralzoom-runner-", ignore_cleanup_errors=True) as own:
        tempfile.tempdir = own
        try:
            yield
        finally:
            tempfile.tempdir = usual


def deployments(request: ServeRequest) -> list[Any]:
    """A deployment for each field and each archive; without schedules: `flows.schedule.watcher` plans each time."""
    made = [
        survey_scheduled.to_deployment(
            one.name,
            schedules=[],
            parameters={"field": one.name},
            tags=[one.settings.source, one.name],
            description=f"Surveys of {one.name} by {one.file}, {request.timetable.words()}.",
            version="1",
            entrypoint_type=EntrypointType.MODULE_PATH,
        )
        for one in request.fields
    ]
    for number, out in enumerate(dict.fromkeys(one.settings.out for one in request.fields), 1):
        made.append(
            reprocess_archive.to_deployment(
                "archive" if number == 1 else f"archive-{number}",
                parameters={"archive": str(out)},
                description=f"Surveys of {out} again, with newer weights or stages; on request.",
                version="1",
                entrypoint_type=EntrypointType.MODULE_PATH,
            )
        )
    return made


def main() -> None:
    """Let the deployments of what is served run until told to stop."""
    request = read_served()
    with suppress(KeyboardInterrupt), own_temporary_folder():
        serve(*deployments(request), limit=request.limit, print_starting_message=False)


if __name__ == "__main__":
    main()
