"""The flow of a survey: the order of its steps, its parameters, and its display in Prefect."""

from __future__ import annotations

import gc
import json
import os
import signal
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from pydantic import ValidationError

from spectralzoom.flows import prefect_flow, survey_command
from spectralzoom.flows.local_server import ServerUnavailable
from spectralzoom.flows.opening.open_field import open_field
from spectralzoom.flows.plan import SurveyPlan
from spectralzoom.flows.planning.plan_survey import plan_survey
from spectralzoom.flows.publish.publishing import RunRef
from spectralzoom.flows.settings.settings import Settings, load_settings
from spectralzoom.flows.stage import Request, Stores
from spectralzoom.flows.survey import run_stages
from spectralzoom.pipeline.errors import SurveyStopped
from spectralzoom.storage.store import Archive, Ref
from tests.exported_run import POSE
from tests.flows.conftest import act_instead, newest_run, stages
from tests.prior_work import with_effects

pytestmark = pytest.mark.usefixtures("no_effects")
ONCE, TWICE = {"scan_step": "2", "scan_exposure_ms": "25"}, {"budget": "0.8"}
RASTER: dict[str, Any] = {"source": "raster", "budget": None}


class NotedStores(Stores):
    """Stores that make nothing, and note the stages of each request's inputs."""

    def __init__(self) -> None:
        super().__init__(Archive(Path("nowhere")), dry=True)
        self.inputs: dict[str, list[str]] = {}

    def get(self, request: Request, *_: Ref) -> Ref:
        """Return an address without a key, as of a store whose inputs are missing."""
        self.inputs[request.stage.name] = [ref.stage for ref in request.inputs]
        return Ref(request.stage.name, "", Path())


def steps(scene_files: Path, weights: Path, **flags: Any) -> dict[str, list[str]]:
    """Return the stages of a survey in order, each with its input stages."""
    files = {"scene": str(scene_files / "scene.png"), "labels": str(scene_files / "labels.png")}
    settings = load_settings(None, {"source": "sim", "weights": str(weights), **files, **flags})
    noted = NotedStores()
    run_stages(noted, plan_survey(open_field(settings, planning=True)))
    return noted.inputs


def test_a_zoomed_survey_captures_again(scene_files: Path, weights: Path) -> None:
    """Requested lines follow from the plan and are condensed with the first ones; the map uses both passes."""
    assert steps(scene_files, weights, budget="0.8") == {
        "choose_effects": [],
        "capture_coarse": ["choose_effects"],
        "condense_coarse": ["capture_coarse"],
        "locate": ["condense_coarse"],
        "rectify": ["condense_coarse", "locate"],
        "read_overview": ["rectify"],
        "score": ["rectify", "read_overview"],
        "capture_fine": ["score", "choose_effects"],
        "condense_fine": ["capture_fine", "capture_coarse"],
        "rectify_fine": ["condense_fine"],
        "segment": ["rectify_fine", "score", "read_overview"],
        "evaluate": ["segment"],
    }


@pytest.mark.parametrize("passes", [1, 2])
def test_a_mosaic_uses_the_registration_of_its_own_pass(scene_files: Path, weights: Path, passes: int) -> None:
    """The evaluation has that of the first pass, whose reference sweep is that of the map."""
    found = steps(scene_files, weights, **(TWICE if passes == 2 else ONCE), pointing_px=4)
    assert found["register_coarse"] == ["condense_coarse"]
    assert found["locate"] == ["condense_coarse", "register_coarse"]
    assert found["rectify"] == ["condense_coarse", "locate", "register_coarse"]
    assert found.get("register_fine") == (["condense_fine", "rectify"] if passes == 2 else None)
    assert found.get("rectify_fine") == (["condense_fine", "register_fine"] if passes == 2 else None)
    assert found["evaluate"] == ["segment", "register_coarse"]


def test_a_uniform_scan_has_one_pass_and_a_pose_a_ground_map(scene_files: Path, weights: Path) -> None:
    """The map is made from the mosaic of the one scan, and the ground map from both."""
    found = steps(scene_files, weights, **ONCE, pose=asdict(POSE))
    assert not [name for name in found if name.endswith("_fine")]
    assert found["segment"] == ["rectify", "score"]
    assert found["ground"] == ["segment", "rectify"]


def test_a_raster_is_neither_captured_nor_rectified(scene_files: Path, weights: Path) -> None:
    """Its own pixels replace capture, geolocation grid and mosaic."""
    found = steps(scene_files, weights, source="raster")
    assert list(found) == ["condense_raster", "score", "segment", "evaluate"]


SETTINGS = [
    {"scene": "farm", "seconds": "25", "camera.exposure_ms": "50", "size": "64x96", "tol": "0.5dn"},
    {
        **{"source": "sim", "scene": "field.png", "weights": "w.safetensors", "bands": "0-3"},
        **{"wavelengths": "500,600,700,800", "budget": "0.8"},
    },
    {"scene": "farm", "sky.started": "2026-06-01T12:00:00Z", "memory": "2GiB", "plots": "plots.gpkg"},
]


@pytest.mark.parametrize("given", SETTINGS)
def test_parameters_are_the_settings(given: dict[str, object]) -> None:
    """Parameters stored by a server give the same settings, with absolute paths."""
    settings = load_settings(None, given)
    again = Settings(**json.loads(settings.model_dump_json()))
    changed = {name for name, value in settings.to_dict().items() if again.to_dict()[name] != value}
    assert changed <= {"out", "scene", "weights", "plots"}
    assert Path(again.out) == Path.cwd() / settings.out


def test_a_password_is_no_parameter() -> None:
    """A server stores the parameters of its runs, so the password is left out and refused."""
    settings = load_settings(None, {"source": "rig", "rig.password": "secret-4711"})
    assert "secret-4711" not in settings.model_dump_json()
    with pytest.raises(ValidationError, match=r"rig\.password"):
        Settings(rig={"password": "secret-4711"})


def test_a_wrong_parameter_is_refused_with_the_message_of_the_command_line() -> None:
    """The error comes before a run begins."""
    with pytest.raises(ValidationError, match="fraction of the full scan's seconds, above 0 and at most 1, got 3"):
        Settings(budget=3)
    assert Settings(budget="70%").budget == 0.7
    with pytest.raises(ValidationError, match=r"unknown setting .*did you mean 'budget'"):
        Settings(bugdet=0.5)


def test_every_setting_is_a_described_field_of_the_form() -> None:
    """Prefect makes its form from the parameters of the flow."""

    forms = prefect_flow.survey.parameters.definitions
    assert set(forms["Settings"]["properties"]) == {*Settings.model_fields}
    fields = [(name, one) for form in forms.values() for name, one in form.get("properties", {}).items()]
    assert [name for name, one in fields if not one.get("description")] == []
    assert [name for name, one in fields if "default" in one or {"type": "null"} in one.get("anyOf", [])] == []
    assert "password" not in forms["SurveyRig"]["properties"]  # only in a settings file
    assert "stray_even" not in forms["Optics"]["properties"]  # a parameter of a model
    assert forms["Settings"]["properties"]["seconds"]["description"].endswith("[s]")


def test_prefect_makes_the_stores_of_plain(survey_png: Any, surveyed_png: Any, tmp_path: Path, server: str) -> None:
    """Keys, savings and accuracy are equal; tasks have their edges, logs and artifacts."""
    from prefect.client.orchestration import get_client
    from prefect.client.schemas.filters import ArtifactFilter, ArtifactFilterFlowRunId, LogFilter, LogFilterFlowRunId
    from prefect.logging.handlers import APILogHandler

    with with_effects():  # the plain survey has them too
        flow = survey_png(tmp_path / "flow", engine="prefect").receipt
    plain = surveyed_png(tmp_path / "plain").receipt
    assert [stage["key"] for stage in flow["stages"]] == [stage["key"] for stage in plain["stages"]]
    assert flow["savings"] == plain["savings"]
    assert flow["accuracy"] == plain["accuracy"]

    run, tasks = newest_run("survey", len(flow["stages"]) + len(STEPS))
    APILogHandler().flush()  # lines are sent in batches
    with get_client(sync_client=True) as client:
        log = [one.message for one in client.read_logs(LogFilter(flow_run_id=LogFilterFlowRunId(any_=[run.id])))]
        mine = ArtifactFilter(flow_run_id=ArtifactFilterFlowRunId(any_=[run.id]))
        artifacts = {one.key: one for one in client.read_artifacts(artifact_filter=mine)}
    assert run.name == "survey-scene"
    assert run.parameters["settings"]["budget"] == 0.8
    names = [*(stage["name"] for stage in flow["stages"]), *STEPS]
    assert sorted(tasks) == sorted(f"{name}-scene" for name in names)
    assert {one.state.type.value for one in tasks.values()} == {"COMPLETED"}
    assert edges(tasks, "condense_fine") == {"capture_fine", "capture_coarse"}
    assert edges(tasks, "rectify") == {"condense_coarse", "locate"}
    assert edges(tasks, "rectify_fine") == {"condense_fine"}
    assert edges(tasks, "publish") >= {"segment", "evaluate"}
    assert any(words.startswith("mosaic: ") and "stages/rectify/" in words for words in log)
    assert set(artifacts) == {"survey-scene"}
    assert "data:image/jpeg;base64," in artifacts["survey-scene"].data
    assert "report.html" in artifacts["survey-scene"].data


STEPS = ("publish", "clear_raw")


def edges(tasks: dict[str, Any], name: str) -> set[str]:
    """Return the names of the tasks from which a task got an input."""
    by_id = {one.id: key.removesuffix("-scene") for key, one in tasks.items()}
    given = (one for some in tasks[f"{name}-scene"].task_inputs.values() for one in some)
    return {by_id[one.id] for one in given if hasattr(one, "id")}


def prefect_variables() -> dict[str, str]:
    """Return Prefect's settings in the environment; other libraries set theirs on import."""
    return {name: value for name, value in os.environ.items() if name.startswith("PREFECT")}


def plans_in_memory() -> set[int]:
    """Return the ids of the plans of surveys in memory."""
    gc.collect()
    return {id(one) for one in gc.get_objects() if type(one) is SurveyPlan}


def test_a_survey_has_a_server_of_its_own(survey_png: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The server's files are in the archive, and the environment is unchanged afterwards."""
    monkeypatch.delenv("PREFECT_API_URL", raising=False)
    before = prefect_variables()
    opened = plans_in_memory()
    survey_png(tmp_path, engine="prefect", **RASTER)
    assert plans_in_memory() <= opened  # no run stays in memory
    assert (tmp_path / ".prefect" / "prefect.db").exists()
    assert prefect_variables() == before


def test_without_a_server_a_survey_runs_plain(survey_png: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The server cannot start, and every stage runs without it."""
    refuse = Mock(side_effect=ServerUnavailable("the Prefect server did not start (no port)"))
    monkeypatch.setattr(survey_command, "_prefect_server", refuse)
    receipt = survey_png(tmp_path, engine="prefect", **RASTER).receipt
    assert {stage["state"] for stage in receipt["stages"]} == {"ran"}


def test_a_named_server_that_does_not_answer_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """The message has its address."""
    monkeypatch.setenv("PREFECT_API_URL", "http://127.0.0.1:9/api")
    with pytest.raises(ServerUnavailable, match=r"no Prefect server answers at http://127\.0\.0\.1:9/api"):  # noqa: SIM117
        with survey_command._prefect_server("x"):
            pytest.fail("it was taken for one that answers")


def test_sigterm_in_a_stage(field_file: Any, server: str, monkeypatch: pytest.MonkeyPatch, command_line: Any) -> None:
    """SIGTERM gives exit code 143 and one sentence, despite Prefect's own handling; the same command resumes."""
    file = field_file(**RASTER)

    def terminated(*given: Any, **facts: Any) -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        pytest.fail("SIGTERM was not heard")

    with monkeypatch.context() as patch:
        act_instead(patch, "segment", replace(stages()["segment"], build=terminated))
        ended = command_line("survey", file)
    assert (ended.code, ended.out, ended.errors) == (143, "", [])
    assert ended.err.splitlines()[-1] == "terminated; run the same command to resume"
    assert command_line("survey", file).code == 0
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_the_note_on_a_lost_server_says_what_became_of_the_survey() -> None:
    """A survey that was stopped before its map has stored stages and no run."""
    notes: list[str] = []
    whole = RunRef("runs/one", Path("x"))
    for run in (whole, replace(whole, stopped=SurveyStopped("mosaic", "stages/rectify/k", "x"))):
        assert survey_command.FlowWork(run).without_server(Settings(), OSError("timed out"), notes.append) is run
    assert [note.rpartition(": ")[2] for note in notes] == ["the run is published", "its stages are stored"]
