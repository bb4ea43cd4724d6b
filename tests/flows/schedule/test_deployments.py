"""Deployments of the survey on a real Prefect server: parameters, due times, limits, files, a kill."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from queue import Queue
from typing import Any
from unittest.mock import Mock

import pytest
import yaml

from spectralzoom.flows.cli.main import STOPPING
from spectralzoom.flows.cli.serve_command import _prepare, load_fields, schedule_of, survey_deployment
from spectralzoom.flows.opening import rig_field
from spectralzoom.flows.opening.rig_field import RIG_LIMIT, RigHold
from spectralzoom.storage.runs import read_run
from spectralzoom.storage.store import Archive
from tests.flows.conftest import server_for_all
from tests.source_paths import PYTHON_PATH

ROOT = Path(__file__).parents[3]
PATIENCE_S = 300.0
DUE = datetime(2026, 6, 1, 4, tzinfo=UTC)

pytestmark = pytest.mark.usefixtures("no_effects")


@pytest.fixture(scope="module")
def scheduling(prefect_home: Path) -> Iterator[str]:
    """Yield the API address of a server that schedules and watches deployments."""
    with server_for_all(prefect_home / "scheduling", schedules=True) as api:
        yield api


@pytest.fixture
def north(field_file: Callable[..., Path], scheduling: str) -> Any:
    """Return the deployment of the field north, due at six in Berlin, on the server that schedules."""
    ((file, settings),) = load_fields([field_file("north", source="raster", budget=None)]).items()
    return survey_deployment(file, settings, schedule_of("0 6 * * *", None, "Europe/Berlin"))


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

    from spectralzoom.flows.prefect_flow import survey

    return run_flow(survey, flow_run=run, return_type="state")


def settings_of(out: Path) -> list[dict[str, Any]]:
    """Return the requested settings of an archive's runs, oldest first."""
    return [dict(read_run(folder).settings) for folder in Archive.open(out).runs()]


def test_a_run_has_its_due_time_as_visit_and_the_newest_prior_map(north: Any) -> None:
    """The actual start does not matter; the first run finds no earlier one."""
    deployment, out = north.apply(), Path(north.parameters["settings"]["out"])
    states = [run_here(planned(deployment, DUE.replace(day=day))) for day in (1, 2)]
    assert [state.name for state in states] == ["Completed", "Completed"]
    assert [one["visit"] for one in settings_of(out)] == ["2026-06-01T04:00:00Z", "2026-06-02T04:00:00Z"]
    memories = [read_run(folder).receipt.get("prior_map") for folder in Archive.open(out).runs()]
    assert [memory is None for memory in memories] == [True, False]


def test_serve_ends_the_runs_of_a_killed_serve(north: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Late runs are cancelled and started ones crash, which frees the limit; future runs and other flows stay."""
    from prefect import flow
    from prefect.client.orchestration import SyncPrefectClient
    from prefect.states import Cancelling, Pending, Running

    @flow(persist_result=False)
    def another() -> None:
        """Do nothing, as a flow of another project."""

    deployment, foreign = north.apply(), another.to_deployment("north").apply()
    ran, ended, waited, other, later = (
        planned(deployment, DUE.replace(year=year)).id for year in (2023, 2024, 2025, 2025, 2099)
    )
    strange = planned(foreign, DUE.replace(year=2025)).id
    read = SyncPrefectClient.read_flow_runs
    monkeypatch.setattr(SyncPrefectClient, "read_flow_runs", lambda self, **given: read(self, **given, limit=1))
    with client() as asked:
        for one, state in ((ran, Pending), (ran, Running), (ended, Cancelling), (strange, Pending)):
            asked.set_flow_run_state(one, state(), force=True)
        _prepare([deployment], datetime.now(UTC))
        kinds = [asked.read_flow_run(one).state.type.value for one in (ran, ended, waited, other, later, strange)]
        assert kinds == ["CRASHED", *["CANCELLED"] * 3, "SCHEDULED", "PENDING"]
        after = planned(deployment, DUE).id
        asked.set_flow_run_state(after, Pending())
        assert asked.read_flow_run(after).state.is_pending()


def test_a_survey_waits_for_the_rig_of_another_one(scheduling: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Prefect's limit makes it wait, where the rig's own lock would refuse it; it is taken once for all captures."""
    from prefect import flow

    monkeypatch.setattr(rig_field, "TRY_S", 1)
    slot = {"names": [RIG_LIMIT], "slots": 1}
    with client() as asked:
        asked.upsert_global_concurrency_limit_by_name(RIG_LIMIT, 1)
        asked.increment_concurrency_slots(**slot, mode="concurrency")
        note = Mock(side_effect=lambda text: asked.release_concurrency_slots(**slot, occupancy_seconds=1.0))

        @flow(persist_result=False)
        def captures() -> list[int]:
            with RigHold(f"/dev/ttyTURNS{os.getpid()}", note) as hold:
                hold.take()
                hold.take()
                return [asked.read_global_concurrency_limit_by_name(RIG_LIMIT).active_slots]

        assert captures() == [1]
        assert asked.read_global_concurrency_limit_by_name(RIG_LIMIT).active_slots == 0
    assert [words.args[0].split(":")[0] for words in note.call_args_list] == ["waits for the rig"]


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

    from spectralzoom.flows.archive.reprocess_flow import reprocess
    from spectralzoom.flows.prefect_flow import survey

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
    known = survey.parameters.model_dump()["definitions"]["Settings"]["properties"]
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
        assert run_here(planned(north.apply(), DUE, {"settings": settings})).is_failed()
        found = told.get(timeout=PATIENCE_S)
    finally:
        listener.shutdown()
        listener.server_close()
    assert found["state"] == "Failed"
    assert "no settings file" in found["why"]


def test_sigterm_ends_serve_after_a_run(field_file: Callable[..., Path], tmp_path: Path, scheduling: str) -> None:
    """A run that is asked for completes; SIGTERM then ends serve with one sentence and pauses the schedules.

    Serve starts as a shell's background job, which ignores SIGINT.
    """
    from prefect.deployments import run_deployment

    names = ("stopped", "paused")  # of no other test: a run of an earlier serve would be cancelled
    files = [field_file(name, source="raster", budget=None) for name in names]
    environment = {**os.environ, "PYTHONPATH": PYTHON_PATH, "PREFECT_RUNNER_POLL_FREQUENCY": "1"}
    words = ["sh", "-c", "trap '' INT; exec \"$@\"", "sh", sys.executable, "-m", "spectralzoom.flows.cli.main"]
    words += ["serve", *map(str, files), "--every", "365d"]
    with (
        (tmp_path / "said").open("w") as said,
        subprocess.Popen(words, cwd=ROOT, env={**environment, "PREFECT_API_URL": scheduling}, stderr=said) as process,
    ):
        try:
            for name in names:
                wait_for(f"survey/{name}")
            run: Any = run_deployment("survey/stopped", timeout=PATIENCE_S, poll_interval=0.5)
            assert run.state.is_completed()
            end = time.monotonic() + PATIENCE_S
            while "completed after" not in (tmp_path / "said").read_text():  # the server knows before
                assert time.monotonic() < end
                time.sleep(0.1)
            process.terminate()
            assert process.wait(PATIENCE_S) == 0
            with client() as asked:
                assert all(asked.read_deployment_by_name(f"survey/{name}").paused for name in names)
        finally:
            process.kill()
    lines = (tmp_path / "said").read_text().splitlines()
    began, ended = (one for one in lines if one.startswith("survey-stopped-20"))
    said = [line.split()[0] for line in lines if line not in (began, ended, STOPPING)]  # where it takes its time
    assert said == ["serving", "stopped:"]
    assert began.endswith("Z: started")
    wanted = rf"{began.removesuffix('started')}completed after [\d.]+ s\. {re.escape(run.state.message)}"
    assert re.fullmatch(wanted, ended), ended
    assert run.name == began.removesuffix(": started")
    assert re.fullmatch(r"runs/\S+-stopped: The score is not known: .*", run.state.message)
    assert len(settings_of(tmp_path / "archive")) == 1
