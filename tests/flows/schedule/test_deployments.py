"""Deployments of the survey on a real Prefect server: parameters, due times, limits, two machines, files, a kill."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextvars import copy_context
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from queue import Queue
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import httpx
import pytest
import yaml

from flows.archive.reprocess_flow import deployment as reprocessing
from flows.cli.serve_command import _prepare, load_fields, schedule_of
from flows.settings.load import load_settings
from flows.tasks.local_server import local_server
from flows.tasks.open_survey import LEASE_S, RIG_LIMIT, OpenSurvey
from flows.tasks.prefect_tasks import Observer
from pipeline.errors import SettingsError
from storage.archive.archive import Archive
from storage.archive.records import read_run
from storage.parallel.pool import THREADS
from tests.flows.schedule.prefect_server import free_port, server_process

ROOT = Path(__file__).parents[3]
PATIENCE_S = 300.0
DUE = datetime(2026, 6, 1, 4, tzinfo=UTC)

pytestmark = pytest.mark.usefixtures("no_effects")


@pytest.fixture(scope="module")
def scheduling(prefect_home: Path) -> Iterator[str]:
    """Yield the API address of a server that schedules and watches deployments."""
    with local_server(prefect_home / "scheduling", schedules=True) as api:
        yield api


@pytest.fixture
def north(field_file: Callable[..., Path], scheduling: str) -> Any:
    """Return the field north, due at six in Berlin, on the server that schedules."""
    return load_fields([field_file("north", source="raster", budget=None)])[0]


def deployed(field: Any) -> Any:
    """Return the id of a field's deployment on the server."""
    return field.deployment(schedule_of("0 6 * * *", None, "Europe/Berlin")).apply()


def client() -> Any:
    """Return a client of the server."""
    from prefect.client.orchestration import get_client

    return get_client(sync_client=True)


def planned(deployment: Any, due: datetime, parameters: Mapping[str, Any] | None = None) -> Any:
    """Return a run of a deployment, due at a given time."""
    from prefect.states import Scheduled

    with client() as asked:
        return asked.create_flow_run_from_deployment(
            deployment, parameters=dict(parameters or {}), state=Scheduled(scheduled_time=due)
        )


def run_here(run: Any) -> Any:
    """Run it with Prefect's engine in this process, as a runner does in its own; return the state."""
    from prefect.flow_engine import run_flow

    from flows.survey import survey

    return run_flow(survey, flow_run=run, return_type="state")


def settings_of(out: Path) -> list[dict[str, Any]]:
    """Return the requested settings of an archive's runs, oldest first."""
    return [dict(read_run(folder).settings) for folder in Archive.open(out).runs()]


def test_a_run_has_its_due_time_as_visit_and_the_newest_prior_map(north: Any) -> None:
    """The actual start does not matter; the first run finds no earlier one."""
    deployment = deployed(north)
    states = [run_here(planned(deployment, DUE.replace(day=day))) for day in (1, 2)]
    assert [state.name for state in states] == ["Completed", "Completed"]
    assert [one["visit"] for one in settings_of(north.settings.out)] == ["2026-06-01T04:00:00Z", "2026-06-02T04:00:00Z"]
    memories = [read_run(folder).receipt.get("prior_map") for folder in Archive.open(north.settings.out).runs()]
    assert [memory is None for memory in memories] == [True, False]


def test_serve_ends_the_runs_of_a_killed_serve(north: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Late runs are cancelled and started ones crash, which frees the limit; future runs and other flows stay."""
    from prefect import flow
    from prefect.client.orchestration import SyncPrefectClient
    from prefect.states import Cancelling, Pending, Running

    @flow(persist_result=False)
    def another() -> None:
        """Do nothing, as a flow of another project."""

    made = north.deployment(schedule_of("0 6 * * *", None, "Europe/Berlin"))
    again = reprocessing(str(north.settings.out))
    deployment, foreign = made.apply(), another.to_deployment("north").apply()
    ran, ended, waited, other, later = (
        planned(deployment, DUE.replace(year=year)).id for year in (2023, 2024, 2025, 2025, 2099)
    )
    ahead, strange = planned(again.apply(), DUE.replace(year=2099)).id, planned(foreign, DUE.replace(year=2025)).id
    read = SyncPrefectClient.read_flow_runs
    monkeypatch.setattr(SyncPrefectClient, "read_flow_runs", lambda self, **given: read(self, **given, limit=1))
    with client() as asked:
        begun = ((ran, Pending), (ran, Running), (ended, Cancelling), (ahead, Pending), (strange, Pending))
        for one, state in begun:
            asked.set_flow_run_state(one, state(), force=True)
        _prepare([made, again], shared=False)
        every = (ran, ended, waited, other, later, ahead, strange)
        kinds = [asked.read_flow_run(one).state.type.value for one in every]
        assert kinds == ["CRASHED", *["CANCELLED"] * 3, "SCHEDULED", "CRASHED", "PENDING"]
        after = planned(deployment, DUE).id
        asked.set_flow_run_state(after, Pending())
        assert asked.read_flow_run(after).state.is_pending()


def test_a_shared_server_keeps_the_fields_of_others(north: Any) -> None:
    """A field of another archive with the same name is refused; the reprocessing is named after its archive."""
    schedule = schedule_of(None, timedelta(hours=1))
    north.deployment(schedule).apply()
    _prepare([north.deployment(schedule), reprocessing("/data/a b", shared=True)], shared=True)
    moved = replace(north, settings=replace(north.settings, out="/data/a b"))
    with pytest.raises(SettingsError, match=r"the Prefect server has a field north of the archive .*another name"):
        _prepare([moved.deployment(schedule)], shared=True)
    assert reprocessing("/data/a b", shared=True).name == "data-a-b"


@pytest.mark.usefixtures("scheduling")
def test_two_fields_due_at_once_use_the_rig_in_turn(tmp_path: Path) -> None:
    """Prefect's limit makes the second wait; the rig's own lock would refuse it."""
    from prefect import flow

    usual = load_settings(None, {"scene": "farm"})
    rig = replace(usual, source="rig", rig=replace(usual.rig, port=f"/dev/ttyTURNS{os.getpid()}"))
    run: Any = SimpleNamespace(settings=rig, archive=Archive.open(tmp_path / "archive"), name="x")
    held: list[tuple[float, float]] = []
    inside = threading.Barrier(2)

    @flow(persist_result=False)
    def scan_pass() -> None:
        plan = OpenSurvey(run, Observer())
        capture: Any = SimpleNamespace(wants=Mock(), find=lambda *_: None)
        inside.wait(PATIENCE_S)
        with plan.at_work():
            plan.hold_rig(capture)
            began = time.monotonic()
            time.sleep(0.5)
            held.append((began, time.monotonic()))

    assert rig.pool == THREADS
    with client() as asked:
        asked.upsert_global_concurrency_limit_by_name(RIG_LIMIT, 1)
    threads = [threading.Thread(target=copy_context().run, args=(scan_pass,)) for _ in range(2)]
    for one in threads:
        one.start()
    for one in threads:
        one.join(PATIENCE_S)
    (_, ended), (began, _) = sorted(held)
    assert ended <= began


def wait_for(name: str) -> None:
    """Wait until a deployment is on the server."""
    from prefect.exceptions import ObjectNotFound

    end = time.monotonic() + PATIENCE_S
    with client() as asked:
        while time.monotonic() < end:
            try:
                asked.read_deployment_by_name(name)
                return
            except ObjectNotFound:
                time.sleep(0.5)
    pytest.fail(f"{name} is not served")


def prefect_cli(folder: Path, *words: str) -> str:
    """Run Prefect's command line in a folder and return its output."""
    command = [sys.executable, "-m", "prefect", *words]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_file_of_deployments_is_complete(scheduling: str) -> None:
    """`prefect deploy --all --no-prompt` makes two deployments, with schedule, pools, limits and valid parameters."""
    from prefect.client.schemas.actions import WorkPoolCreate

    from flows.archive.reprocess_flow import reprocess
    from flows.survey import survey

    with client() as asked:
        asked.create_work_pool(WorkPoolCreate(name="reading", type="process"))
    prefect_cli(ROOT, "deploy", "--all", "--no-prompt")
    with client() as asked:
        north, archive = map(asked.read_deployment_by_name, ("survey/north", "reprocess/archive"))
    pools = [(one.work_pool_name, one.global_concurrency_limit.limit) for one in (north, archive)]
    assert pools == [("reading", 1), ("reading", 1)]
    assert north.concurrency_options.collision_strategy.value == "CANCEL_NEW"
    schedules = [(one.schedule.cron, one.schedule.timezone) for one in north.schedules]
    assert schedules == [("0 6-20 * * *", "Europe/Berlin")]
    known = survey.parameters.model_dump()["definitions"]["SurveySettings"]["properties"]
    assert set(north.parameters["settings"]) <= set(known)
    reprocess.validate_parameters(archive.parameters)


def test_the_automation_reports_a_failed_run(north: Any, tmp_path: Path, scheduling: str) -> None:
    """Prefect accepts the file with the id of a block, and a failed run posts its error."""
    from prefect.blocks.webhook import Webhook

    told: Queue[dict[str, Any]] = Queue()

    class Listener(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            told.put(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(200)
            self.end_headers()

        def log_message(self, *words: object) -> None:
            pass

    listener = ThreadingHTTPServer(("127.0.0.1", 0), Listener)
    threading.Thread(target=listener.serve_forever, daemon=True).start()
    try:
        block = Webhook(url=f"http://127.0.0.1:{listener.server_port}/").save("surveys", overwrite=True)
        text = (ROOT / "automation.yaml").read_text(encoding="utf-8")
        unset = yaml.safe_load(text)["actions"][0]["block_document_id"]
        assert set(unset) == {"0", "-"}
        (tmp_path / "automation.yaml").write_text(text.replace(unset, str(block)))
        prefect_cli(tmp_path, "automation", "create", "--from-file", "automation.yaml")
        settings = {"settings_file": str(tmp_path / "gone.toml")}
        assert run_here(planned(deployed(north), DUE, {"settings": settings})).is_failed()
        found = told.get(timeout=PATIENCE_S)
    finally:
        listener.shutdown()
        listener.server_close()
    assert found["state"] == "Failed"
    assert "no settings file" in found["why"]


def take_rig(limits: httpx.Client) -> None:
    """Take the only slot of the rig's limit, as a survey does."""
    wanted = {"names": [RIG_LIMIT], "slots": 1, "lease_duration": LEASE_S}
    while (taken := limits.post("/increment-with-lease", json=wanted)).status_code == httpx.codes.SERVICE_UNAVAILABLE:
        time.sleep(0.5)  # another service of the server locks the database
    taken.raise_for_status()
    assert limits.get(f"/{RIG_LIMIT}").json()["active_slots"] == 1


def test_serve_resumes_after_the_server_restarts(field_file: Callable[..., Path], tmp_path: Path) -> None:
    """A later run completes; SIGTERM then ends serve with one sentence and pauses the schedule.

    A lease of the rig outlives the server, and the restarted server frees it after its expiry. Serve starts as a
    shell's background job, which ignores SIGINT.
    """
    from prefect.deployments import run_deployment
    from prefect.settings import PREFECT_API_AUTH_STRING, PREFECT_API_URL, temporary_settings

    file = field_file("north", source="raster", budget=None)
    home = tmp_path / "home"
    port = free_port()
    with server_process(home, port) as server:
        password = (home / "password").read_text().strip()
        api = f"http://127.0.0.1:{port}/api"
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "PREFECT_RUNNER_POLL_FREQUENCY": "1"}
        environment |= {"PREFECT_API_URL": api, "PREFECT_API_AUTH_STRING": password}
        environment |= {"PREFECT_CLIENT_MAX_RETRIES": "0"}  # else it retries for minutes
        words = ["sh", "-c", "trap '' INT; exec \"$@\"", "sh", sys.executable, "-m", "flows.cli.main"]
        words += ["serve", str(file), "--every", "365d"]
        with (
            temporary_settings({PREFECT_API_URL: api, PREFECT_API_AUTH_STRING: password}),
            httpx.Client(base_url=f"{api}/v2/concurrency_limits", auth=tuple(password.split(":", 1))) as limits,
            (tmp_path / "said").open("w") as said,
            subprocess.Popen(words, cwd=ROOT, env=environment, stderr=said) as process,
        ):
            try:
                wait_for("survey/north")
                take_rig(limits)
                server.kill()
                server.wait()
                for lease in (home / "concurrency_leases").glob("*.json"):  # a minute later
                    lease.write_text(re.sub(r'"20\d\d-', '"2020-', lease.read_text()))
                end = time.monotonic() + PATIENCE_S
                while "does not answer" not in (tmp_path / "said").read_text() and time.monotonic() < end:
                    time.sleep(0.2)
                with server_process(home, port):
                    run: Any = run_deployment("survey/north", timeout=PATIENCE_S, poll_interval=0.5)
                    assert run.state.is_completed()
                    while limits.get(f"/{RIG_LIMIT}").json()["active_slots"]:
                        assert time.monotonic() < end
                        time.sleep(0.5)
                    process.terminate()
                    assert process.wait(PATIENCE_S) == 0
                    with client() as asked:
                        assert asked.read_deployment_by_name("survey/north").paused
            finally:
                process.kill()
    lines = (tmp_path / "said").read_text().splitlines()
    assert lines[-1].endswith("stopped: no run starts from now on; the same command serves again"), lines
    assert len(settings_of(tmp_path / "archive")) == 1
