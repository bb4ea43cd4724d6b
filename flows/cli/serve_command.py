"""Serve fields by Prefect: check every field, then run its schedules and surveys until stopped."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import tempfile
import threading
import time
import warnings
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any

import tzlocal
from cyclopts import Parameter
from cyclopts.validators import Number
from prefect.client.orchestration import get_client
from prefect.client.schemas import filters
from prefect.client.schemas.objects import ConcurrencyLimitConfig, ConcurrencyLimitStrategy, StateType
from prefect.client.schemas.schedules import CronSchedule, IntervalSchedule
from prefect.exceptions import ObjectNotFound
from prefect.runner import Runner
from prefect.states import Cancelled, Crashed
from prefect.types.entrypoint import EntrypointType
from pydantic import ValidationError

from flows.archive.reprocess_flow import deployment, reprocess
from flows.settings.load import load_settings
from flows.settings.survey_settings import Settings
from flows.survey import survey
from flows.tasks.local_server import ServerUnavailable, check_answers, local_server, quiet_environment
from flows.tasks.open_survey import RIG_LIMIT
from flows.tasks.run import open_run
from flows.tasks.survey_model import weights_path
from flows.terminal.processes import DONE, terminable
from flows.terminal.progress import show_text
from models.weights.files import describe_weights
from pipeline.errors import ArchiveError, NoSceneYet, PipelineError, SettingsError
from storage.archive.archive import Archive
from storage.archive.staging import read_toml, take_lock

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
STOPPED_AGAIN_S = 15.0  # interval of requests to a runner to stop
AGAIN_S = 2.0  # between two tries to reach a server


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
    archives = {one.settings.out: Archive.open(one.settings.out).root for one in served}
    try:
        with terminable(), ExitStack() as held:
            for name, root in archives.items():
                release = take_lock(root / ".locks" / "serve.lock", wait=False)
                if release is None:
                    raise ArchiveError(
                        f"another serve uses the archive {name}; give all its fields to that one, or stop it"
                    )
                held.callback(release)
            shared = "PREFECT_API_URL" in os.environ
            pages = _start_server(next(iter(archives.values())) / ".prefect", port, held)
            # Prefect's runner keeps the code that it starts in /tmp/runner_storage, which its first user could replace
            tempfile.tempdir = held.enter_context(
                tempfile.TemporaryDirectory(prefix="spectralzoom-runner-", ignore_cleanup_errors=True)
            )
            held.callback(setattr, tempfile, "tempdir", None)
            when = cron or f"every {every}".removesuffix(", 0:00:00")
            show_text(f"serving {', '.join(one.name for one in served)}, {when}; Ctrl-C stops it")
            show_text(f"Prefect's pages: {pages}")
            _serve(served, schedule, limit or len(served) + 1, shared=shared)
    except KeyboardInterrupt:
        show_text("stopped: no run starts from now on; the same command serves again")
    return DONE


@dataclass(frozen=True)
class ServedField:
    """A field: its name, its settings file and the settings in it."""

    name: str
    file: Path
    settings: Settings

    def deployment(self, schedule: Any) -> Any:
        """Return the field's deployment of the flow `survey`; a run that is due during another is cancelled."""
        return survey.to_deployment(
            self.name,
            schedule=schedule,
            paused=False,
            parameters={
                "settings": {"settings_file": str(self.file), "name": self.name, "out": str(self.settings.out)}
            },
            concurrency_limit=ConcurrencyLimitConfig(limit=1, collision_strategy=ConcurrencyLimitStrategy.CANCEL_NEW),
            tags=[self.settings.source, self.name],
            description=f"Surveys of {self.name} by {self.file}.",
            version="1",
            entrypoint_type=EntrypointType.MODULE_PATH,
        )


def load_fields(files: Sequence[Path], out: str | None = None) -> list[ServedField]:
    """Return the fields after planning each one; no device is used.

    Raises PipelineError: a field cannot be surveyed; the message names its file.
    """
    if not files:
        raise SettingsError("no fields: give the settings file of one or more, such as serve north.toml --every 30m")
    fields: dict[str, ServedField] = {}
    for file in files:
        settings = load_settings(file, {"out": out})
        settings = replace(settings, out=str(Path(settings.out).absolute()))
        if "scene" not in read_toml(file) and settings.source != "rig":
            raise SettingsError(
                f"{file} has neither scene nor source = 'rig'; set the field's scene ('field' for sweeps), or its rig"
            )
        name = settings.name or re.sub(r"[^A-Za-z0-9_.-]+", "-", file.stem).strip("-.") or "field"
        if name in fields:
            raise SettingsError(
                f'{fields[name].file} and {file} are both called {name}: give one of them another name = "..."'
            )
        try:
            open_run(replace(settings, name=name), planning=True)
        except NoSceneYet as error:
            describe_weights(weights_path(settings))  # raises where they are invalid
            show_text(f"{name}: {error}; each due run looks for it again")
        except PipelineError as error:
            raise type(error)(f"{file}: {error}") from error
        fields[name] = ServedField(name, file.absolute(), settings)
    return list(fields.values())


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
    try:
        if "PREFECT_API_URL" in os.environ:
            check_answers(os.environ["PREFECT_API_URL"])
            return os.environ["PREFECT_API_URL"].rstrip("/").removesuffix("/api")
        api = held.enter_context(local_server(home, port, schedules=True))
        return f"{api.removesuffix('/api')}; the password is in {home / 'password'}"
    except ServerUnavailable as error:
        named = "PREFECT_API_URL" in os.environ
        cure = ": start it, or unset PREFECT_API_URL and have one started here" if named else ""
        raise SettingsError(f"{error}{cure}") from error


def _serve(fields: Sequence[ServedField], schedule: Any, limit: int, *, shared: bool) -> None:
    """Serve the fields and the reprocessing of their archives until interrupted, also while the server is away."""
    # Prefect's runner drops this coroutine where it has given up; the interpreter would say so at its end
    warnings.filterwarnings("ignore", "coroutine 'Runner._handle_cancellation_observer_failure' was never awaited")
    surveys = [one.deployment(schedule) for one in fields]
    outs = dict.fromkeys(str(one.settings.out) for one in fields)
    again = [deployment(out, number, shared=shared) for number, out in enumerate(outs, 1)]
    _prepare([*surveys, *again], shared=shared)
    asked_to_stop = threading.Event()
    try:
        while not asked_to_stop.is_set():
            try:
                asyncio.run(_run([*surveys, *again], limit, asked_to_stop))
            except asyncio.CancelledError:
                break
            except Exception as error:  # the runner gives up after three tries, also while it stops
                if not asked_to_stop.is_set():
                    show_text(
                        f"Prefect's server does not answer ({type(error).__name__}); serving continues when it answers"
                    )
                    with terminable():  # the handler of SIGTERM ended with the event loop
                        _wait_for_server()
        raise KeyboardInterrupt
    finally:
        try:
            with get_client(sync_client=True) as client:
                for one in fields:
                    client.pause_deployment(client.read_deployment_by_name(f"survey/{one.name}").id)
        except Exception as error:
            show_text(f"the schedules could not be paused ({type(error).__name__}); runs that are due start late")


async def _run(deployments: Sequence[Any], limit: int, asked_to_stop: threading.Event) -> None:
    """Run due flow runs by Prefect's runner until it is interrupted."""
    runner = Runner(pause_on_shutdown=False, limit=limit)
    for one in deployments:
        await runner.aadd_deployment(one)
    running = asyncio.ensure_future(runner.start())
    await asyncio.sleep(0)  # the runner installs its own handler of SIGTERM here
    loop = asyncio.get_running_loop()

    def stop() -> None:
        asked_to_stop.set()
        running.cancel()
        loop.call_later(STOPPED_AGAIN_S, stop)  # the runner may lose the first request

    loop.add_signal_handler(signal.SIGTERM, stop)  # SIGINT may be ignored here
    await running


def _prepare(deployments: Sequence[Any], *, shared: bool) -> None:
    """Limit a rig to one survey at a time in Prefect, and end the runs that an earlier serve left.

    Runs that were due while serve was stopped are cancelled; those that ran at its end have crashed.
    Raises SettingsError: on a ``shared`` server a deployment of the same name is for another archive.
    """
    own: dict[str, Any] = {
        "deployment_filter": filters.DeploymentFilter(
            name=filters.DeploymentFilterName(any_=[one.name for one in deployments])
        ),
        "flow_filter": filters.FlowFilter(name=filters.FlowFilterName(any_=[survey.name, reprocess.name])),
    }
    now: Any = datetime.now(UTC)
    due = filters.FlowRunFilterExpectedStartTime(before_=now)
    states: Any = (
        ([StateType.SCHEDULED], Cancelled(message="no serve was running when it was due"), due),
        ([StateType.PENDING, StateType.RUNNING], Crashed(message="the process that ran it is gone"), None),
        ([StateType.CANCELLING], Cancelled(message="cancelled; the process that ran it is gone"), None),
    )
    with get_client(sync_client=True) as client:
        for one in deployments if shared else ():
            name = f"{one.flow_name}/{one.name}"
            with suppress(ObjectNotFound):
                known = client.read_deployment_by_name(name).parameters.get("settings", {}).get("out")
                if known is not None and known != one.parameters.get("settings", {}).get("out"):
                    raise SettingsError(
                        f"the Prefect server has a field {one.name} of the archive {known}: give this field another "
                        f"name, or delete the deployment {name} there"
                    )
        client.upsert_global_concurrency_limit_by_name(RIG_LIMIT, 1)
        for kinds, ended, when in states:
            left = filters.FlowRunFilter(
                state=filters.FlowRunFilterState(type=filters.FlowRunFilterStateType(any_=kinds)),
                expected_start_time=when,
            )
            while found := client.read_flow_runs(**own, flow_run_filter=left):  # a page at a time
                for run in found:
                    client.set_flow_run_state(run.id, ended, force=True)


def _wait_for_server() -> None:
    while True:
        with suppress(ServerUnavailable):
            check_answers(os.environ["PREFECT_API_URL"])
            return
        time.sleep(AGAIN_S)
