"""The scheduled flow on a Prefect server: one run done, told, and accounted for once; runs that are gone are reaped."""

from __future__ import annotations

import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from flows.schedule_state import moment_words
from flows.schedule_times import parse_timetable
from flows.serve_fields import load_fields
from storage.archive import Archive
from storage.ledger import Ledger


@pytest.fixture
def on_server(prefect_home: Path) -> Iterator[Path]:
    """Flows of the test run on an ephemeral server, without the heartbeat that costs a second each."""
    from prefect.settings import PREFECT_FLOWS_HEARTBEAT_FREQUENCY, temporary_settings

    with temporary_settings(updates={PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None}):
        yield prefect_home


def test_a_scheduled_run_by_prefect(
    on_server: Path, tmp_path: Path, scene_files: Path, weights: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """The flow surveys its due time once, names itself by its field, and leaves artifacts; what died is reaped."""
    from prefect.client.orchestration import get_client
    from prefect.states import Running

    from flows.serve_flow import survey_scheduled
    from flows.serve_prefect import reap_flow_runs

    file = tmp_path / "north.toml"
    file.write_text(
        f'scene = "{scene_files / "scene.png"}"\nweights = "{weights}"\nbudget = 0.8\nout = "{tmp_path / "archive"}"\n'
    )
    (one,) = load_fields([file])
    seconds = next(one for one in (3600, 4200, 5400, 6600) if time.time() % one < 0.8 * one)  # not soon due again
    table = parse_timetable(None, f"{seconds}s", "UTC")
    schedule = one.schedule(table, 0.5)
    due = table.next_after(datetime.now(UTC) - timedelta(seconds=seconds))
    assert due is not None
    began = {"event": "opened", "at": moment_words(due - timedelta(minutes=1)), "late": 0.9, "pid": 1}
    schedule.ledger.append({**began, "schedule": table.to_dict()})
    given: dict[str, Any] = {"field": "north", "settings": str(file), "every": f"{seconds}s", "late": 0.9}
    state = survey_scheduled(**given, due=moment_words(due), return_state=True)
    again = survey_scheduled(**given, due=moment_words(due), return_state=True)
    lines = Ledger(one.archive, "north").lines()
    assert (state.name, again.name) == ("Completed", "Skipped")
    assert [line["event"] for line in lines] == ["opened", "begun", "done"]
    assert [path.name.split("-")[1] for path in Archive.open(one.archive).runs()] == ["north"]
    with get_client(sync_client=True) as client:
        runs = [run for run in client.read_flow_runs() if run.parameters.get("settings") == str(file)]
        assert {run.name for run in runs} == {"survey-north"}
        assert {"survey-north", "savings-north"} <= {found.key for found in client.read_artifacts()}
        client.set_flow_run_state(runs[0].id, Running(), force=True)
        told = runs[0].parameters
        assert reap_flow_runs(client, "north", str(told["settings"])) == ["survey-north"]
        assert client.read_flow_run(runs[0].id).state.is_crashed()


def test_a_wrong_field_is_a_failed_run(on_server: Path, tmp_path: Path) -> None:
    """A settings file that cannot be read ends the run as failed, with the message that the command line would give."""
    from flows.serve_flow import survey_scheduled

    state = survey_scheduled(field="north", settings=str(tmp_path / "none.toml"), every="1h", return_state=True)
    assert state.is_failed()
    assert "no settings file" in str(state.message)
