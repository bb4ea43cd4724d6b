"""A week of two fields on Prefect's own schedules, hourly and daily; clocks are set back, the server is killed.

Prefect's scheduler plans the week, which lies in the past (its backfill, `POST /deployments/ID/schedule`): every run is
due, none waits for a clock. Prefect's engine then runs the flow `survey` for each, in the order of their due times, in
this process; the server is one of its own. What became of each run the server says, and the archive.
"""

from __future__ import annotations

import os
import resource
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
from PIL import Image

from flows.cli.serve_command import ServedField, load_fields, schedule_of
from flows.tasks.local_server import quiet_environment
from models.weights.files import save_weights
from storage.archive.archive import Archive
from storage.archive.records import read_run
from storage.remote.opening import verify_archive
from tests.conftest import CLASSES, RGB_NM, patchy_scene, random_weights
from tests.faults.fault_table import Clock, Row
from tests.faults.nursery import ROOT

ZONE = "Europe/Berlin"
FIELDS = {"hourly": "0 * * * *", "daily": "0 6 * * *"}
SCENE = 'source = "sim"\nscene = "scene.png"\nweights = "weights.safetensors"\n'
SETTINGS = f'{SCENE}budget = 0.8\neffects = "none"\ncontrols = false\n'
IN_THE_PAST = {"PREFECT_SERVER_SERVICES_LATE_RUNS_ENABLED": "false"}  # all of the week is late
KILLED_AT = 0.4  # of the runs
INTO_RUN_S, AWAY_S = 0.4, 2.0
STARTED_WITHIN_S = 120.0
SERVES = """
import sys, time
from pathlib import Path
from flows.tasks.local_server import local_server
with local_server(Path(sys.argv[1]), int(sys.argv[2]), schedules=True):
    print("started", flush=True)
    time.sleep(86_400)
"""


def free_port() -> int:
    """Return a port of this machine that is free."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


@contextmanager
def server_process(home: Path, port: int, **settings: str) -> Iterator[subprocess.Popen[str]]:
    """Have a Prefect server in a process of its own, on a port, with more settings; killed at the end."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    words = [sys.executable, "-c", SERVES, str(home), str(port)]
    environment |= {
        "PYTHONPATH": str(ROOT),
        "DO_NOT_SCAN_PATH": "1",
        "PREFECT_SERVER_LOGGING_LEVEL": "CRITICAL",
    } | settings
    with subprocess.Popen(words, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            if process.stdout.readline().strip() != "started":
                raise RuntimeError(f"no Prefect server on port {port}")
            yield process
        finally:
            process.kill()


def changed_week(now: datetime, month: int, days: int = 7) -> tuple[datetime, datetime]:
    """Return the first and last moment (excluded) of the days around the month's clock change, the newest before now.

    Local midnights, as UTC; the change, on a Sunday, is in the middle.
    """
    zone = ZoneInfo(ZONE)
    year = now.year if datetime(now.year, month, 31, tzinfo=UTC) + timedelta(days=7) < now else now.year - 1
    last = datetime(year, month, 31, tzinfo=zone)
    sunday = last - timedelta(days=(last.weekday() + 1) % 7)
    first = sunday - timedelta(days=days // 2)
    return first.astimezone(UTC), (first + timedelta(days=days)).astimezone(UTC)


def due_between(name: str, first: datetime, until: datetime) -> list[datetime]:
    """Return when a field is due by the clock on the wall: an hour that comes twice counts once, one left out never."""
    zone, hours = ZoneInfo(ZONE), int((until - first) / timedelta(hours=1))
    local = [(first + timedelta(hours=hour)).astimezone(zone) for hour in range(hours)]
    wanted = [one for one in local if not one.fold and (name == "hourly" or one.hour == 6)]
    return [one.astimezone(UTC) for one in wanted]


@dataclass
class Week:
    """What the server and the archive say of the runs."""

    due: dict[str, list[datetime]] = field(default_factory=dict)  # as Prefect planned them
    wanted: dict[str, list[datetime]] = field(default_factory=dict)
    states: dict[str, Counter[str]] = field(default_factory=dict)
    visits: dict[str, list[str]] = field(default_factory=dict)
    completed: dict[str, list[str]] = field(default_factory=dict)
    hit: str = "none"  # what became of the run in which the server was killed
    spring: Mapping[str, bool] = field(default_factory=dict)
    cpu_s: float = 0.0


def rows(quick: bool) -> list[Row]:
    """Plan, run, kill, count."""
    clock = Clock()
    with tempfile.TemporaryDirectory(prefix="soak-week-") as name:
        folder = Path(name)
        fields = small_fields(folder)
        week = _run(folder, fields, 1 if quick else 7)
        archive = Archive.open(folder / "archive")
        problems = [f"{one.uri}: {one.problem}" for one in verify_archive(archive) if one.problem is not None]
        for folder in archive.runs():
            settings = read_run(folder, {}).settings
            week.visits.setdefault(str(settings["name"]), []).append(str(settings["visit"]))
    return _judged(week, problems, clock.seconds)


def small_fields(folder: Path) -> list[ServedField]:
    """Write the settings of both fields, a small picture and small weights, and open them."""
    values, _ = patchy_scene((48, 64), 3, seed=1)
    Image.fromarray(values.astype(np.uint8)).save(folder / "scene.png")
    save_weights(random_weights(RGB_NM, CLASSES), folder / "weights.safetensors")
    files = [folder / f"{name}.toml" for name in FIELDS]
    for file in files:
        file.write_text(SETTINGS)
    return load_fields(files, str(folder / "archive"))


def _run(folder: Path, fields: list[ServedField], days: int) -> Week:
    """Have the week planned by the server and run here; the server is killed on the way."""
    home, port, week = folder / "home", free_port(), Week()
    with ExitStack() as held:
        held.enter_context(quiet_environment(home))
        servers = [held.enter_context(server_process(home, port, **IN_THE_PAST))]
        held.enter_context(_using(home, port))
        planned = _plan(fields, week, days)
        print(f"  {len(planned)} runs are planned", file=sys.stderr, flush=True)
        before = resource.getrusage(resource.RUSAGE_SELF)
        for number, run in enumerate(planned):
            killer = None
            if number == int(KILLED_AT * len(planned)):
                killer = threading.Thread(target=_kill_and_start, args=(servers, held, home, port))
                killer.start()
            _run_here(run, killer)
            if number % 25 == 24:
                print(f"  {number + 1} have been run", file=sys.stderr, flush=True)
            if killer is not None:
                week.hit = _state_of(run)
                print(f"  the server was killed in run {number}: {week.hit}", file=sys.stderr, flush=True)
        after = resource.getrusage(resource.RUSAGE_SELF)
        week.cpu_s = (after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime) / len(planned)
        for run in planned:
            name = run.parameters["settings"]["name"]
            state = _state_of(run)
            week.states.setdefault(name, Counter())[state] += 1
            if state == "Completed":
                due = run.expected_start_time.astimezone(UTC).isoformat().replace("+00:00", "Z")
                week.completed.setdefault(name, []).append(due)
    return week


@contextmanager
def _using(home: Path, port: int) -> Iterator[None]:
    from prefect.settings import (
        PREFECT_API_AUTH_STRING,
        PREFECT_API_URL,
        PREFECT_FLOWS_HEARTBEAT_FREQUENCY,
        temporary_settings,
    )

    password = (home / "password").read_text().strip()
    known = {PREFECT_API_URL: f"http://127.0.0.1:{port}/api", PREFECT_API_AUTH_STRING: password}
    with temporary_settings(updates={**known, PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None}):
        yield


def _plan(fields: list[ServedField], week: Week, days: int) -> list[Any]:
    """Have Prefect plan both weeks of changed clocks; gives the runs of autumn's, in order."""
    now, found = datetime.now(UTC), []
    autumn, spring = changed_week(now, 10, days), changed_week(now, 3, days)
    met = {}
    for one in fields:
        deployment = one.deployment(schedule_of(FIELDS[one.name], None, ZONE)).apply()
        runs = [_planned(deployment, *span) for span in (autumn, spring)]
        week.due[one.name] = [run.expected_start_time for run in runs[0]]
        week.wanted[one.name] = due_between(one.name, *autumn)
        met[one.name] = [run.expected_start_time for run in runs[1]] == due_between(one.name, *spring)
        found += runs[0]
    week.spring = met
    return sorted(found, key=lambda run: (run.expected_start_time, run.name))


def _planned(deployment: Any, first: datetime, until: datetime) -> list[Any]:
    """Have Prefect's scheduler plan a deployment's runs, and give them in order."""
    from prefect.client.orchestration import get_client
    from prefect.client.schemas import filters

    last = until - timedelta(seconds=1)
    span = {"start_time": first.isoformat(), "end_time": last.isoformat(), "min_runs": 500, "max_runs": 500}
    with get_client(sync_client=True) as client:
        client.request("POST", "/deployments/{id}/schedule", path_params={"id": deployment}, json=span)
        known = {
            "deployment_filter": filters.DeploymentFilter(id=filters.DeploymentFilterId(any_=[deployment])),
            "flow_run_filter": filters.FlowRunFilter(
                expected_start_time=filters.FlowRunFilterExpectedStartTime(after_=first, before_=last)
            ),
        }
        runs = [run for offset in (0, 200) for run in client.read_flow_runs(**known, limit=200, offset=offset)]
    return sorted(runs, key=lambda run: run.expected_start_time)


def _run_here(run: Any, killer: threading.Thread | None) -> None:
    """Run it as Prefect's runner has it run, in this process; a process that would have died is told as crashed."""
    from asyncio import CancelledError

    from prefect.client.orchestration import get_client
    from prefect.flow_engine import run_flow
    from prefect.states import Crashed, Pending

    from flows.survey import survey

    with get_client(sync_client=True) as client:
        client.set_flow_run_state(run.id, Pending())
        run = client.read_flow_run(run.id)
    try:
        run_flow(survey, flow_run=run, return_type="state")
    except (Exception, CancelledError) as error:  # no answer, or Prefect gives a run up that cannot renew its place
        if killer is None:
            raise
        killer.join()
        with get_client(sync_client=True) as client:
            client.set_flow_run_state(run.id, Crashed(message=f"its process ended: {error!r}"), force=True)
    finally:
        if killer is not None:
            killer.join()


def _kill_and_start(servers: list[subprocess.Popen[str]], held: ExitStack, home: Path, port: int) -> None:
    time.sleep(INTO_RUN_S)
    servers[-1].kill()
    servers[-1].wait()
    time.sleep(AWAY_S)
    servers.append(held.enter_context(server_process(home, port, **IN_THE_PAST)))


def _state_of(run: Any) -> str:
    from prefect.client.orchestration import get_client

    with get_client(sync_client=True) as client:
        return str(client.read_flow_run(run.id).state.name)


def _judged(week: Week, problems: list[str], seconds: float) -> list[Row]:
    """Return a row for each demand, and whether it was met."""
    total = {name: len(due) for name, due in week.due.items()}
    listed = ", ".join(f"{count} {name}" for name, count in total.items())
    states = "; ".join(f"{name}: {dict(found)}" for name, found in week.states.items())
    lost = sum(sum(found.values()) - found["Completed"] for found in week.states.values())
    final = all(found.keys() <= {"Completed", "Crashed", "Failed"} for found in week.states.values())
    named = {name: sorted(week.visits.get(name, [])) == sorted(due) for name, due in week.completed.items()}
    published = ", ".join(f"{len(week.visits.get(name, []))} {name}" for name in total)
    return [
        Row(
            "clocks set back",
            f"Prefect plans the days around the end of summer time, {ZONE}",
            sum(total.values()),
            "due at every hour on the wall once; daily at six",
            f"{listed}; {'as demanded' if week.due == week.wanted else 'OTHERWISE'}",
            week.due == week.wanted,
            0.0,
        ),
        Row(
            "clocks set forward",
            "the same at the beginning of summer time, planned only",
            len(week.spring),
            "the hour that is left out is not due",
            ", ".join(f"{name}: {'as demanded' if met else 'OTHERWISE'}" for name, met in week.spring.items()),
            all(week.spring.values()),
            0.0,
        ),
        Row(
            "two fields",
            "Prefect's engine runs each due survey",
            sum(total.values()),
            "one final state each; all completed but the one in which the server is killed",
            f"{states}; {week.cpu_s:.2f} s of processor time each",
            final and lost <= 1 and sum(sum(found.values()) for found in week.states.values()) == sum(total.values()),
            seconds,
        ),
        Row(
            "server killed",
            f"SIGKILL {INTO_RUN_S} s into a run, started again {AWAY_S:.0f} s later",
            1,
            "that run has a final state, later ones complete",
            f"that run: {week.hit}",
            week.hit in ("Completed", "Crashed", "Failed"),
            0.0,
        ),
        Row(
            "visits",
            "runs published in the archive",
            sum(map(len, week.visits.values())),
            "one for each completed run, named by its due time",
            f"{published}; {'as demanded' if all(named.values()) else 'OTHERWISE'}",
            len(named) == len(total) and all(named.values()),
            0.0,
        ),
        Row("the archive", "verify", 1, "whole", f"{len(problems)} problems{': ' + problems[0] if problems else ''}",
            not problems, 0.0),
    ]  # fmt: skip
