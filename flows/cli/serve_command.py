"""Serve fields by Prefect: check every field, then run its schedules and surveys until stopped."""

from __future__ import annotations

import asyncio
import os
import re
import tempfile
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

from spectralzoom.flows.archive.reprocess_flow import ONE_AT_A_TIME, reprocess_deployment
from spectralzoom.flows.field import open_field
from spectralzoom.flows.plan import plan_survey
from spectralzoom.flows.prefect_flow import survey
from spectralzoom.flows.settings.settings import Settings, load_settings
from spectralzoom.flows.tasks.local_server import check_answers, local_server, quiet_environment
from spectralzoom.flows.tasks.rig_field import RIG_LIMIT
from spectralzoom.flows.tasks.survey_model import weights_path
from spectralzoom.flows.terminal.processes import DONE, terminable
from spectralzoom.flows.terminal.progress import show_text
from spectralzoom.models.weights.files import describe_weights
from spectralzoom.pipeline.errors import ArchiveError, NoSceneYet, PipelineError, SettingsError
from spectralzoom.pipeline.toml_files import read_toml
from spectralzoom.storage.store import Archive
from spectralzoom.storage.whole_files import locked

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def serve(
    *fields: Path,
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
        Or an interval: 30m, 2h, 1d; counted from midnight UTC of 1970, not from now.
    timezone
        Time zone of --cron, such as Europe/Berlin; this machine's by default.
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
    with suppress(KeyboardInterrupt), terminable(), ExitStack() as held:
        for name, root in archives.items():
            if not held.enter_context(locked(root / ".locks" / "serve.lock", wait=False)):
                raise ArchiveError(
                    f"another serve uses the archive {name}; give all its fields to that one, or stop it"
                )
        pages = _start_server(home, port, held)
        tempfile.tempdir = str(home)  # for Prefect's runner: another user may own its folder in /tmp
        when = cron or f"every {every}".removesuffix(", 0:00:00")
        show_text(f"serving {', '.join(str(one.name) for one in served.values())}, {when}; Ctrl-C stops it")
        show_text(f"Prefect's pages: {pages}")
        surveys = [survey_deployment(file, settings, schedule) for file, settings in served.items()]
        _serve([*surveys, *map(reprocess_deployment, archives)], limit or len(served) + 1)
    show_text("stopped: no run starts from now on; the same command serves again")
    return DONE


def load_fields(files: Sequence[Path], out: str | None = None) -> dict[Path, Settings]:
    """Return the settings of each file, with the field's name, after planning each one; no device is used.

    Raises PipelineError: a field cannot be surveyed; the message names its file.
    """
    if not files:
        raise SettingsError("no fields: give the settings file of one or more, such as serve north.toml --every 30m")
    fields: dict[str, tuple[Path, Settings]] = {}
    for file in files:
        settings = load_settings(file, {"out": out})
        if "scene" not in read_toml(file) and settings.source != "rig":
            raise SettingsError(
                f"{file} has neither scene nor source = 'rig'; set the field's scene ('field' for sweeps), or its rig"
            )
        name = settings.name or re.sub(r"[^A-Za-z0-9_.-]+", "-", file.stem).strip("-.") or "field"
        if name in fields:
            raise SettingsError(
                f'{fields[name][0]} and {file} are both called {name}: give one of them another name = "..."'
            )
        settings = settings.but(name=name, out=str(Path(settings.out).absolute()))
        try:
            plan_survey(open_field(settings, planning=True))
        except NoSceneYet as error:
            describe_weights(weights_path(settings))  # raises where they are invalid
            show_text(f"{name}: {error}; each due run looks for it again")
        except PipelineError as error:
            raise type(error)(f"{file}: {error}") from error
        fields[name] = file.absolute(), settings
    return dict(fields.values())


def survey_deployment(file: Path, settings: Settings, schedule: Any) -> Any:
    """Return a field's deployment of the flow `survey`; a run that is due during another is cancelled."""
    return survey.to_deployment(
        str(settings.name),
        schedule=schedule,
        paused=False,
        parameters={"settings": {"settings_file": str(file), "name": settings.name, "out": settings.out}},
        tags=[settings.source, str(settings.name)],
        description=f"Surveys of {settings.name} by {file}.",
        **ONE_AT_A_TIME,
    )


def schedule_of(cron: str | None, every: timedelta | None, timezone: str | None = None) -> Any:
    """Return Prefect's schedule for a cron line in a time zone, or for an interval; SettingsError for others."""
    if (cron is None) == (every is None):
        got = "neither" if cron is None else "both"
        raise SettingsError(f"a schedule needs --cron or --every, got {got}; such as --every 30m or --cron '0 6 * * *'")
    try:
        if every is not None and timezone is not None:
            raise SettingsError("--timezone is that of --cron, and --every counts from midnight UTC; leave one out")
        if every is not None:
            return IntervalSchedule(interval=every, anchor_date=EPOCH, timezone="UTC")
        return CronSchedule(cron=str(cron), timezone=timezone or tzlocal.get_localzone_name())
    except ValidationError as error:
        raise SettingsError(
            f"no such schedule: {error.errors()[0]['msg']}; expected such as --every 30m or --cron '0 6 * * *' "
            "--timezone Europe/Berlin"
        ) from None


def _start_server(home: Path, port: int, held: ExitStack) -> str:
    """Start a server on this machine until ``held`` ends, or use that of PREFECT_API_URL; return its pages' address.

    Raises SettingsError: that server does not answer, or the port is in use.
    """
    held.enter_context(quiet_environment(home))
    if (named := os.environ.get("PREFECT_API_URL")) is not None:
        check_answers(named)
        return named.rstrip("/").removesuffix("/api")
    api = held.enter_context(local_server(home, port, schedules=True))
    return f"{api.removesuffix('/api')}; the password is in {home / 'password'}"


class InterruptedRunner(Runner):
    """Prefect's runner, which SIGTERM ends as Ctrl-C does; the runner's own answer leaves a coroutine and a warning."""

    def handle_sigterm(self, *args: Any, **kwargs: Any) -> None:
        """Interrupt the main thread."""
        raise KeyboardInterrupt


def _serve(deployments: Sequence[Any], limit: int) -> None:
    """Serve the deployments until SIGINT or SIGTERM, then pause them. Raises PipelineError: the server is away."""
    began = datetime.now(UTC)
    try:
        runner = InterruptedRunner(pause_on_shutdown=False, limit=limit)  # it would pause the first one only
        served: list[Any] = [runner.add_deployment(one) for one in deployments]
        _prepare(served, began)
        try:
            asyncio.run(runner.start())
        finally:
            with get_client(sync_client=True) as client:
                for one in served:
                    client.pause_deployment(one)
    except (HTTPError, ExceptionGroup) as error:
        raise PipelineError(
            f"Prefect's server does not answer as expected ({error}); the same command serves again"
        ) from error


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
