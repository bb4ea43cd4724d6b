"""Serve fields by Prefect: check every field, then run its schedule until stopped."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any

import tzlocal
from cyclopts import Parameter
from cyclopts.validators import Number
from httpx import HTTPError
from prefect.client.orchestration import get_client
from prefect.client.schemas.filters import FlowRunFilter
from prefect.client.schemas.schedules import CronSchedule, IntervalSchedule
from prefect.runner import Runner
from prefect.states import Cancelled, Crashed
from pydantic import ValidationError

from spectralzoom.flows.archive.plan_command import dry_run
from spectralzoom.flows.archive.reprocess_flow import ONE_AT_A_TIME, reprocess_deployment
from spectralzoom.flows.local_server import configured, local_server
from spectralzoom.flows.opening.rig_field import RIG_LIMIT
from spectralzoom.flows.prefect_flow import survey
from spectralzoom.flows.settings.settings import Settings, load_settings
from spectralzoom.flows.terminal.processes import DONE
from spectralzoom.flows.terminal.progress import show_text
from spectralzoom.pipeline.errors import ArchiveError, NoSceneYet, PipelineError, SettingsError
from spectralzoom.storage.store import Archive, run_stem
from spectralzoom.storage.whole_files import locked

NOT_IN_PREFECT = "/%&<>"  # not allowed in names of deployments
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def serve(
    fields: list[Path],
    /,
    *,
    cron: str | None = None,
    every: timedelta | None = None,
    timezone: str | None = None,
    out: str | None = None,
    limit: Annotated[int | None, Parameter(validator=Number(gte=1))] = None,
    port: int = 4200,
) -> int:
    """Survey fields on a schedule until stopped, by Prefect: a run of a field is a visit named by its due time.

    Parameters
    ----------
    fields
        A settings file for each field.
    cron
        Due times of all fields: minute hour day month weekday, such as '0 6-20 * * *'.
    every
        Interval between due times, in place of --cron: 30m, 2h, 1d; counted from midnight UTC of 1970, not from now.
    timezone
        Time zone, such as Europe/Berlin; by default this machine's for --cron, and UTC for --every.
    out
        Archive for all fields; by default that of each field's settings.
    limit
        Surveys at a time; by default one per field. A rig has always one.
    port
        Port of Prefect's pages on this machine; a server that PREFECT_API_URL names is used instead.
    """
    schedule = schedule_of(cron, every, timezone)
    served = load_fields(fields, out)
    archives = {settings.out: Archive.open(settings.out).root for settings in served.values()}
    home = next(iter(archives.values())) / ".prefect"
    with suppress(KeyboardInterrupt), ExitStack() as held:

        def hold(out: str, name: str) -> bool:
            return held.enter_context(locked(archives[out] / ".locks" / f"{name}.lock", wait=False))

        for settings in served.values():
            if not hold(settings.out, f"serve-{run_stem(str(settings.name))}"):
                raise ArchiveError(f"another serve surveys {settings.name} into {settings.out}: stop that one first")
        deployments = [survey_deployment(file, settings, schedule) for file, settings in served.items()]
        deployments += [reprocess_deployment(out) for out in archives if hold(out, "serve")]  # one serve has it
        if (pages := os.environ.get("PREFECT_API_URL")) is not None:
            held.enter_context(configured(home, {"api.url": pages}))
        elif hold(next(iter(archives)), "prefect"):
            pages = held.enter_context(local_server(home, port, schedules=True))
            show_text(f"the password of Prefect's pages is in {home / 'password'}")
        else:
            raise ArchiveError(f"another serve or survey uses {home}: name its server in PREFECT_API_URL, or stop it")
        names = ", ".join(str(settings.name) for settings in served.values())
        said = f"serving {names} at {pages.rstrip('/').removesuffix('/api')}; Ctrl-C stops it"
        _serve(deployments, limit or len(served) + 1, said)
    show_text("stopped: no run starts from now on; the same command serves again")
    return DONE


def load_fields(files: Sequence[Path], out: str | None = None) -> dict[Path, Settings]:
    """Return the settings of each file, with the field's name, after planning each one; no device is used.

    Raises PipelineError: a field cannot be surveyed; the message names its file.
    """
    fields: dict[str, tuple[Path, Settings]] = {}
    for file in files:
        given = load_settings(file, {"out": out})
        settings = load_settings(file, {"out": str(Path(given.out).absolute()), "name": given.name or file.stem})
        name = str(settings.name)
        if name in fields:
            raise SettingsError(
                f'{fields[name][0]} and {file} are both called {name}: give one of them another name = "..."'
            )
        try:
            dry_run(settings)
        except NoSceneYet as error:
            show_text(f"{name}: {error}; each due run looks for it again")
        except PipelineError as error:
            raise type(error)(f"{file}: {error}") from error
        fields[name] = file.absolute(), settings
    return dict(fields.values())


def survey_deployment(file: Path, settings: Settings, schedule: Any) -> Any:
    """Return a field's deployment of the flow `survey`; a run that is due during another is cancelled."""
    name = str(settings.name)
    return survey.to_deployment(
        run_stem(name) if {*name} & {*NOT_IN_PREFECT} else name,
        schedule=schedule,
        paused=False,
        parameters={"settings": {"settings_file": str(file), "name": settings.name, "out": settings.out}},
        tags=[settings.source, str(settings.name)],
        description=f"Surveys of {settings.name} by {file}.",
        **ONE_AT_A_TIME,
    )


def schedule_of(cron: str | None, every: timedelta | None, timezone: str | None = None) -> Any:
    """Return Prefect's schedule for a cron line in a time zone, or for an interval; SettingsError for others."""
    try:
        if every is not None and cron is None:
            return IntervalSchedule(interval=every, anchor_date=EPOCH, timezone=timezone or "UTC")
        if cron is not None and every is None:
            return CronSchedule(cron=cron, timezone=timezone or tzlocal.get_localzone_name())
        wrong = "neither --every nor --cron" if cron is None else "both --every and --cron"
    except ValidationError as error:
        wrong = error.errors()[0]["msg"]
    raise SettingsError(
        f"no such schedule: {wrong}; expected --every 30m, or --cron '0 6 * * *' --timezone Europe/Berlin"
    )


class InterruptedRunner(Runner):
    """Prefect's runner, which SIGTERM ends as Ctrl-C does; the runner's own answer leaves a coroutine and a warning."""

    def handle_sigterm(self, *args: Any, **kwargs: Any) -> None:
        """Interrupt the main thread."""
        raise KeyboardInterrupt


def _serve(deployments: Sequence[Any], limit: int, said: str) -> None:
    """Serve the deployments until SIGINT or SIGTERM, as `prefect.serve` does, then pause them.

    Raises PipelineError: Prefect's server does not answer, or its temporary folder belongs to another user.
    """
    began = datetime.now(UTC)
    try:
        runner = InterruptedRunner(limit=limit, pause_on_shutdown=False)  # SIGTERM would pause the first one only
        served: list[Any] = [runner.add_deployment(one) for one in deployments]
        _prepare(served, began)
        show_text(said)
        try:
            asyncio.run(runner.start())
        finally:
            with get_client(sync_client=True) as client:
                for one in served:
                    client.pause_deployment(one)
    except (HTTPError, ExceptionGroup) as error:
        raise PipelineError(
            f"Prefect's server does not answer as expected ({error}): start it, then the same command serves again"
        ) from error
    except PermissionError as error:
        raise PipelineError(f"{error.filename} belongs to another user: set TMPDIR to a folder of your own") from error


def _prepare(deployments: Sequence[Any], now: datetime) -> None:
    """Limit a rig to one survey at a time, and end the due runs of deployments (ids) that a killed serve left."""
    left = {
        "deployment_id": {"any_": deployments},
        "state": {"type": {"any_": ["SCHEDULED", "PENDING", "RUNNING", "CANCELLING"]}},
        "expected_start_time": {"before_": now},
    }
    with get_client(sync_client=True) as client:
        client.upsert_global_concurrency_limit_by_name(RIG_LIMIT, 1)
        while found := client.read_flow_runs(flow_run_filter=FlowRunFilter.model_validate(left)):  # a page at a time
            for run in found:
                ended = Crashed if run.start_time else Cancelled
                client.set_flow_run_state(run.id, ended(message="left by an earlier serve"), force=True)
