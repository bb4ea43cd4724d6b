"""Four days of an hourly and a daily field: by due times in one process, and its accidents on a real `serve`."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import httpx
import pytest
from prefect.client.orchestration import get_client
from prefect.client.schemas.filters import FlowRunFilter
from prefect.settings import temporary_settings
from prefect.states import Cancelled, Cancelling, Pending

from spectralzoom.flows.cli.serve_command import load_fields, schedule_of, survey_deployment
from spectralzoom.storage.runs import read_run
from spectralzoom.storage.store import Archive
from spectralzoom.storage.whole_files import locked
from tests.flows.conftest import problems, server_for_all
from tests.flows.schedule.test_deployments import PATIENCE_S, ROOT, planned, run_here
from tests.source_paths import PYTHON_PATH

pytestmark = pytest.mark.usefixtures("no_effects")

# the clock goes back on Sunday, the 26th: 6 o'clock in Berlin is then 5 instead of 4 o'clock UTC
HOURS, DAYS, ZONE = "0 6-8 * * *", "0 6 * * *", "Europe/Berlin"
THURSDAY = datetime(2025, 10, 23, tzinfo=UTC)
LATE, AFTER_IT = (("north", datetime(2025, 10, 23, hour, tzinfo=UTC)) for hour in (4, 5))
BY_HAND = ("north", datetime(2025, 10, 24, 5, tzinfo=UTC))


def due_runs(api: str, names: dict[Any, str]) -> dict[tuple[str, datetime], Any]:
    """Return the runs of deployments that Prefect schedules for these days, by field and due time, as they are due."""
    auth = tuple(os.environ["PREFECT_API_AUTH_STRING"].split(":"))
    end = THURSDAY + timedelta(days=4)
    days = {"start_time": THURSDAY.isoformat(), "end_time": end.isoformat(), "min_runs": 100}
    for deployment in names:
        httpx.post(f"{api}/deployments/{deployment}/schedule", json=days, auth=auth).raise_for_status()
    due_then = FlowRunFilter.model_validate(  # tests of this server have fields of these names
        {"deployment_id": {"any_": list(names)}, "expected_start_time": {"after_": THURSDAY, "before_": end}}
    )
    with get_client(sync_client=True) as asked:
        found = asked.read_flow_runs(flow_run_filter=due_then)
    due = {(names[run.deployment_id], run.expected_start_time): run for run in found}
    return dict(sorted(due.items(), key=lambda one: (one[0][1], one[0][0])))


def starts(run: Any) -> bool:
    """Ask to start a run, as Prefect's runner does; False where the run before is in progress, or it was cancelled."""
    with get_client(sync_client=True) as asked:
        asked.set_flow_run_state(run.id, Pending())
        return bool(asked.read_flow_run(run.id).state.is_pending())


def test_days_of_visits(field_file: Callable[..., Path], prefect_home: Path, tmp_path: Path) -> None:
    """Each run that starts is a visit of its due time, with the visit before it as prior map; the archive is whole.

    Both fields are due at six. One run outlives its interval, which cancels the next one; another is cancelled by hand.
    """
    files = [field_file(name, source="raster", budget=None) for name in ("north", "south")]
    with (
        temporary_settings({"server.services.late_runs.enabled": False}),  # it cancels what is late during a run
        server_for_all(prefect_home / "days", schedules=True) as api,
        get_client(sync_client=True) as asked,
    ):
        names = {
            survey_deployment(file, settings, schedule_of(cron, None, ZONE)).apply(): str(settings.name)
            for (file, settings), cron in zip(load_fields(files).items(), (HOURS, DAYS), strict=True)
        }
        runs = due_runs(api, names)
        asked.set_flow_run_state(runs[BY_HAND].id, Cancelled())
        for key, run in runs.items():
            if starts(run) and key != LATE:
                run_here(run)
            if key == AFTER_IT:
                run_here(runs[LATE])
        ended = {key: asked.read_flow_run(run.id).state.type.value for key, run in runs.items()}
    assert sorted(names.values()) == ["north", "south"]
    assert [sum(name == one for name, _ in runs) for one in ("north", "south")] == [12, 4]
    assert ended == dict.fromkeys(runs, "COMPLETED") | dict.fromkeys((AFTER_IT, BY_HAND), "CANCELLED")
    found = [read_run(folder) for folder in Archive.open(tmp_path / "archive").runs()]
    for name in ("north", "south"):
        own = [run for run in found if run.settings["name"] == name]
        due = [f"{due:%Y-%m-%dT%H:%M:%SZ}" for one, due in runs if one == name and ended[one, due] == "COMPLETED"]
        assert [run.settings["visit"] for run in own] == due
        assert [run.receipt.get("prior_map") is None for run in own] == [True] + [False] * (len(due) - 1)
    assert problems(tmp_path / "archive") == []


@contextmanager
def serving(file: Path, port: int, **environment: str) -> Iterator[subprocess.Popen[str]]:
    """Run `serve` for a field in another process for the block, with a runner that asks every second."""
    known = {**os.environ, "PYTHONPATH": PYTHON_PATH, "PREFECT_RUNNER_POLL_FREQUENCY": "1", **environment}
    words = [sys.executable, "-m", "spectralzoom.flows.cli.main", "serve", file, "--every", "365d", "--port", port]
    with subprocess.Popen(list(map(str, words)), cwd=ROOT, env=known, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            assert any(line.startswith("serving") for line in process.stderr)
            yield process
        finally:
            process.kill()


def ask(name: str) -> Any:
    """Ask for a run of a field, due now; return its id."""
    with get_client(sync_client=True) as asked:
        return planned(asked.read_deployment_by_name(f"survey/{name}").id, datetime.now(UTC)).id


def wait_until(run: Any, *states: str) -> None:
    """Wait until a run is in one of the states."""
    end = time.monotonic() + PATIENCE_S
    with get_client(sync_client=True) as asked:
        while (state := asked.read_flow_run(run).state.name) not in states:
            assert time.monotonic() < end, state
            time.sleep(0.2)


def test_accidents_of_served_fields(field_file: Callable[..., Path], tmp_path: Path) -> None:
    """Two fields of two schedules share a server, are due at once, and go on after a kill with the archive whole.

    A lock on the archive holds surveys in mid-run, as long ones.
    """
    north, south = (field_file(name, source="raster", budget=None) for name in ("north", "south"))
    root = Archive.open(tmp_path / "archive").root
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    api, password = f"http://127.0.0.1:{port}/api", root / ".prefect" / "password"
    with ExitStack() as stack:
        first = stack.enter_context(serving(north, port))
        known = {"PREFECT_API_URL": api, "PREFECT_API_AUTH_STRING": password.read_text().strip()}
        second = stack.enter_context(serving(south, port, **known))
        stack.enter_context(temporary_settings({"api.url": api, "api.auth_string": known["PREFECT_API_AUTH_STRING"]}))
        for run in [ask("north"), ask("south")]:
            wait_until(run, "Completed")
        with locked(root / ".locks" / "use.lock"):
            outlives = ask("north")
            wait_until(outlives, "Running")
            wait_until(ask("north"), "Cancelled")
        wait_until(outlives, "Completed")
        with locked(root / ".locks" / "use.lock"):
            by_hand = ask("north")
            wait_until(by_hand, "Running")
            with get_client(sync_client=True) as asked:
                asked.set_flow_run_state(by_hand, Cancelling())
            wait_until(by_hand, "Cancelled")
            killed = ask("north")
            wait_until(killed, "Running")
            first.send_signal(signal.SIGKILL)
            first.wait()
        stack.enter_context(serving(north, port))
        wait_until(killed, "Crashed", "Completed")  # its process outlives the killed server, and may end before
        wait_until(ask("north"), "Completed")
        assert second.poll() is None
    assert problems(root) == []
