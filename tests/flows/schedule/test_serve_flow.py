"""The scheduled flow on a Prefect server: one run done, told, and accounted for once; runs that are gone are reaped."""

from __future__ import annotations

import importlib
import json
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from flows.schedule import served as serve_fields
from flows.schedule.field_schedule import moment_words
from flows.schedule.serve_command import load_fields
from flows.schedule.served import KEYS, NAMED_BY
from flows.schedule.times import parse_timetable
from storage.archive.archive import Archive
from storage.archive.ledger import Ledger
from storage.archive.staging import take_lock
from tests.flows.schedule.schedule_days import NOON, HandClock

pytestmark = pytest.mark.usefixtures("no_effects")


@pytest.fixture
def on_server(prefect_home: Path) -> Iterator[Path]:
    """Flows of the test run on an ephemeral server, without the heartbeat that costs a second each."""
    from prefect.settings import PREFECT_FLOWS_HEARTBEAT_FREQUENCY, temporary_settings

    with temporary_settings(updates={PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None}):
        yield prefect_home


def test_a_scheduled_run_by_prefect(
    on_server: Path, tmp_path: Path, scene_files: Path, weights: Path, served: Callable[..., Path]
) -> None:
    """The flow surveys its due time once, names itself by its field, and leaves artifacts; what died is reaped."""
    from prefect.client.orchestration import get_client
    from prefect.states import Running

    from flows.schedule.prefect_flows import survey_scheduled
    from flows.schedule.watcher import reap_flow_runs

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
    served(file, every=f"{seconds}s", late=0.9)
    state = survey_scheduled("north", moment_words(due), return_state=True)
    again = survey_scheduled("north", moment_words(due), return_state=True)
    lines = Ledger(one.archive, "north").lines()
    assert (state.name, again.name, again.type.value) == ("Completed", "Skipped", "CANCELLED")
    assert [line["event"] for line in lines] == ["opened", "begun", "done"]
    assert [path.name.split("-")[1] for path in Archive.open(one.archive).runs()] == ["north"]
    with get_client(sync_client=True) as client:
        runs = [run for run in client.read_flow_runs() if run.parameters.get("due") == moment_words(due)]
        assert {run.name for run in runs} == {"survey-north"}
        assert {"survey-north", "savings-north"} <= {found.key for found in client.read_artifacts()}
        client.set_flow_run_state(runs[0].id, Running(), force=True)
        assert reap_flow_runs(client, "south", None) == []
        assert reap_flow_runs(client, "north", None) == ["survey-north"]
        assert client.read_flow_run(runs[0].id).state.is_crashed()


def test_only_what_is_served_can_be_named(
    on_server: Path, tmp_path: Path, field_file: Callable[..., Path], served: Callable[..., Path]
) -> None:
    """Another field, archive or file of weights, or any file at all, ends a run as failed, before anything is read."""
    from flows.schedule.prefect_flows import reprocess_archive, survey_scheduled

    file, elsewhere = field_file(), tmp_path / "elsewhere"
    Archive.open(elsewhere)
    served(file, every="1h")
    states = [
        survey_scheduled("south", return_state=True),
        reprocess_archive(str(elsewhere), return_state=True),
        reprocess_archive(str(tmp_path / "archive"), weights=str(elsewhere / "w.safetensors"), return_state=True),
    ]
    told = ["the field 'south' is not served here", f"the archive '{elsewhere}' is not served", "are of no field that"]
    assert [state.is_failed() and words in str(state.message) for state, words in zip(states, told, strict=True)] == [
        True,
        True,
        True,
    ]
    assert not {"settings", "out", "notify"} & set(survey_scheduled.parameters.properties)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"files": ["none.toml"], "every": "1h"}', "no settings file"),
        ('{"files": [], "every": "1h"}', "names no field"),
        ('{"files": ["none.toml"], "evry": "1h"}', "expected an object with files, out, cron"),
        ("[", "cannot be read as JSON"),
        (None, "nothing says what may be surveyed here"),
    ],
)
def test_a_wrong_record_of_what_is_served(
    on_server: Path, served: Callable[..., Path], monkeypatch: pytest.MonkeyPatch, content: str | None, message: str
) -> None:
    """It ends a run as failed, with one message that says what was expected."""
    from flows.schedule.prefect_flows import survey_scheduled

    if content is None:
        monkeypatch.delenv(NAMED_BY, raising=False)
    else:
        served().write_text(content)
    state = survey_scheduled("north", return_state=True)
    assert state.is_failed()
    assert message in str(state.message)


def test_a_run_that_prefect_begins_early_waits(
    on_server: Path, field_file: Callable[..., Path], served: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Prefect begins runs up to seconds before their time: the survey is of that time, and done once."""
    from flows.schedule import prefect_flows as serve_flow

    clock, due = HandClock(NOON + timedelta(minutes=20) - timedelta(seconds=0.3)), NOON + timedelta(minutes=20)
    monkeypatch.setattr(serve_fields, "SystemWallClock", lambda: clock)
    monkeypatch.setattr(serve_flow, "_survey", lambda one, asked, request: Path(f"{asked:%H%M}"))
    file = field_file()
    served(file, every="20m")
    state = serve_flow.survey_scheduled("north", moment_words(due), return_state=True)
    assert (state.name, state.message) == ("Completed", "runs/1220")
    lines = load_fields([file])[0].schedule(parse_timetable(None, "20m", "UTC"), 0.5).ledger.lines()
    assert [(line["event"], line.get("due")) for line in lines[1:]] == [
        ("begun", "2026-06-01T12:20:00Z"),
        ("done", "2026-06-01T12:20:00Z"),
    ]
    far = moment_words(due + timedelta(hours=1))
    state = serve_flow.survey_scheduled("north", far, return_state=True)
    assert state.is_completed()
    assert len(load_fields([file])[0].schedule(parse_timetable(None, "20m", "UTC"), 0.5).ledger.lines()) == len(lines)


def test_one_reprocessing_at_a_time(
    on_server: Path, tmp_path: Path, field_file: Callable[..., Path], served: Callable[..., Path]
) -> None:
    """A second one of an archive is skipped and says why; the lock is free again after a run."""
    from flows.schedule.prefect_flows import reprocess_archive
    from flows.schedule.watcher import REPROCESS_LOCK

    out = tmp_path / "archive"
    served(field_file(), every="1h")
    lock = Archive.open(out).root / ".locks" / REPROCESS_LOCK
    release = take_lock(lock, wait=False)
    assert release is not None
    state = reprocess_archive(archive=str(out), return_state=True)
    assert (state.name, state.message) == ("Skipped", "this archive is being reprocessed already")
    release()
    assert [reprocess_archive(archive=str(out), return_state=True).name for _ in range(2)] == ["Completed"] * 2


def test_deployments_of_the_file_fit_the_flows(prefect_home: Path, field_file: Callable[..., Path]) -> None:
    """In prefect.yaml entrypoints can be imported, parameters are those of the flows, and cron is told twice alike.

    Its comments hold an example of the file that says what is served.
    """
    import yaml

    root = Path(__file__).parents[3]
    text = (root / "prefect.yaml").read_text(encoding="utf-8")
    content = yaml.safe_load(text)
    assert {one["name"] for one in content["deployments"]} == {"north", "archive"}
    for one in content["deployments"]:
        file, _, name = one["entrypoint"].partition(":")
        assert (root / file).is_file()
        flow = getattr(importlib.import_module(file.removesuffix(".py").replace("/", ".")), name)
        assert one["parameters"].keys() <= flow.parameters.properties.keys()
        assert set(flow.parameters.required or ()) <= one["parameters"].keys()
        flow.validate_parameters(one["parameters"])
        assert one["work_pool"] == content["definitions"]["pool"]
    assert content["deployments"][0]["parameters"]["field"] == content["deployments"][0]["name"]
    example = json.loads(
        "".join(line.removeprefix("#") for line in text.splitlines() if line.startswith("#   ") and '"' in line)
    )
    (schedule,) = content["deployments"][0]["schedules"]
    assert (example["cron"], example["timezone"]) == (schedule["cron"], schedule["timezone"])
    assert set(example) <= set(KEYS)
    assert parse_timetable(example["cron"], None, example["timezone"]).next_after(NOON) is not None


def test_deployments_of_serve_fit_the_flows(prefect_home: Path, field_file: Callable[..., Path]) -> None:
    """A deployment for each field, and one to reprocess the archive; Prefect schedules none, and names no file."""
    from flows.schedule.prefect_flows import deployments
    from flows.schedule.served import ServeRequest

    fields = load_fields([field_file("north"), field_file("south")])
    table = parse_timetable(None, "30d", "UTC")
    made = deployments(ServeRequest(fields=fields, timetable=table, late=0.5))
    assert [f"{one.flow_name}/{one.name}" for one in made] == ["survey/north", "survey/south", "reprocess/archive"]
    assert [one.parameters for one in made] == [
        {"field": "north"},
        {"field": "south"},
        {"archive": fields[0].settings.out},
    ]
    assert not any(one.schedules for one in made)
