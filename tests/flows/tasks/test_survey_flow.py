"""The flow of a survey: the order of its steps, its parameters, and its display in Prefect."""

from __future__ import annotations

import gc
import json
import os
import signal
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
from pydantic import ValidationError

from spectralzoom.flows import survey as survey_flow
from spectralzoom.flows import survey_command
from spectralzoom.flows.settings.load import load_settings
from spectralzoom.flows.settings.parameters import SurveySettings
from spectralzoom.flows.survey import draw_class_map
from spectralzoom.flows.tasks.local_server import ServerUnavailable
from spectralzoom.flows.tasks.open_survey import Products
from spectralzoom.flows.tasks.run import SurveyRun
from spectralzoom.pipeline.errors import IncompleteStoreError
from spectralzoom.storage.store import Ref
from tests.flows.conftest import act_instead, newest_run
from tests.prior_work import with_effects

pytestmark = pytest.mark.usefixtures("no_effects")
RASTER: dict[str, Any] = {"source": "raster", "budget": None}


class UnmadeRef(Ref):
    """Address of a store that does not exist: it has no key."""

    uri = ""

    def __getattribute__(self, name: str) -> Any:
        """Raise for the key."""
        if name == "key":
            raise IncompleteStoreError("it was not made")
        return super().__getattribute__(name)


class Noted:
    """Open survey of an empty archive that records the inputs of each requested stage."""

    hold_rig = staticmethod(lambda *capture: None)

    def __init__(self, **facts: bool) -> None:
        self.uniform = self.registers = self.on_the_ground = self.is_map = False
        self.__dict__ |= facts
        self.steps: dict[str, list[str]] = {}
        self.products = Products()
        archive = SimpleNamespace(ref=UnmadeRef, is_there=lambda uri: True)
        self.run = SimpleNamespace(archive=archive, plan=SimpleNamespace(plain=self.uniform))

    def stop_after(self, ref: Ref, *stages: str) -> None:
        """Do not stop."""

    def goes_back(self, request: Ref) -> bool:
        """Return whether the plan asks for more lines."""
        return not self.uniform

    def __call__(self, stage: str, *inputs: Ref) -> Ref:
        """Record the names of the stages that wrote the inputs."""
        self.steps[stage] = [ref.stage for ref in inputs]
        self.products[stage] = UnmadeRef(stage, "", Path())
        return self.products[stage]


def steps(**facts: bool) -> dict[str, list[str]]:
    """Return the stages of a survey in order, each with its input stages."""
    noted: Any = Noted(**facts)
    draw_class_map(noted)
    return dict(noted.steps)


def test_a_zoomed_survey_captures_again() -> None:
    """Requested lines follow from the plan and are condensed with the first ones; the map uses both passes."""
    found = steps()
    assert list(found) == [
        *("choose_effects", "capture_coarse", "condense_coarse", "locate", "rectify", "score"),
        *("capture_fine", "condense_fine", "rectify_fine", "segment"),
    ]
    assert found["capture_fine"] == ["score", "choose_effects"]
    assert found["condense_fine"] == ["capture_fine", "capture_coarse"]
    assert found["rectify_fine"] == ["condense_fine"]
    assert found["segment"] == ["rectify_fine", "score"]


def test_a_uniform_scan_has_no_second_pass() -> None:
    """The map is made from the mosaic of the one scan."""
    found = steps(uniform=True)
    assert not [name for name in found if name.endswith("_fine")]
    assert found["segment"] == ["rectify", "score"]


@pytest.mark.parametrize(("uniform", "passes"), [(True, ["coarse"]), (False, ["coarse", "fine"])])
def test_a_mosaic_uses_the_registration_of_its_own_pass(uniform: bool, passes: list[str]) -> None:
    """The registration of the other pass is no input of it."""
    found = steps(registers=True, uniform=uniform)
    assert [name for name in found if name.startswith("register")] == [f"register_{one}" for one in passes]
    assert found["locate"] == ["condense_coarse", "register_coarse"]
    assert found["rectify"] == ["condense_coarse", "locate", "register_coarse"]
    assert found.get("rectify_fine") == (None if uniform else ["condense_fine", "register_fine"])


def test_a_survey_with_a_pose_has_a_ground_map() -> None:
    """The ground map is made from the class map and the mosaic."""
    assert steps(on_the_ground=True)["ground"] == ["segment", "rectify_fine"]


def test_a_raster_is_neither_captured_nor_rectified() -> None:
    """Its own pixels replace capture, geolocation grid and mosaic."""
    assert list(steps(is_map=True)) == ["condense_raster", "score", "segment"]


SETTINGS = [
    {"scene": "farm", "seconds": "25", "camera.exposure_ms": "50", "size": "64x96", "tol": "0.5dn"},
    {
        **{"source": "sim", "scene": "field.png", "weights": "w.safetensors", "bands": "0-3"},
        **{"wavelengths": "500,600,700,800", "budget": "0.8"},
    },
    {"scene": "farm", "sky.started": "2026-06-01T12:00:00Z", "memory": "2GiB", "zones.plots": "plots.gpkg"},
]


@pytest.mark.parametrize("given", SETTINGS)
def test_parameters_are_the_settings(given: dict[str, object]) -> None:
    """Parameters stored by a server give the same settings, with absolute paths."""
    settings = load_settings(None, given)
    parameters = SurveySettings.of(settings)
    assert parameters.settings() is settings
    kept = json.loads(parameters.model_dump_json(exclude_none=True))
    again = SurveySettings(**kept).settings()
    changed = {name for name, value in settings.to_dict().items() if again.to_dict()[name] != value}
    assert changed <= {"out", "scene", "weights", "zones"}
    assert Path(again.out) == Path.cwd() / settings.out


def test_a_password_is_no_parameter() -> None:
    """A server stores the parameters of its runs, so the password is left out and refused."""
    settings = load_settings(None, {"source": "rig", "rig.password": "secret-4711"})
    assert "secret-4711" not in SurveySettings.of(settings).model_dump_json()
    with pytest.raises(ValidationError, match=r"rig\.password"):
        SurveySettings(rig={"password": "secret-4711"})


def test_a_wrong_parameter_is_refused_with_the_message_of_the_command_line() -> None:
    """The error comes before a run begins."""
    with pytest.raises(ValidationError, match="fraction of the full scan's seconds, above 0 and at most 1, got 3"):
        SurveySettings(budget=3)
    with pytest.raises(ValidationError, match=r"unknown setting .*did you mean 'budget'"):
        SurveySettings(bugdet=0.5)


def test_every_setting_is_a_described_field_of_the_form() -> None:
    """Prefect makes its form from the parameters of the flow."""
    from spectralzoom.flows.settings.load import SURVEY

    schema = survey_flow.survey.parameters.definitions["SurveySettings"]["properties"]
    assert set(schema) == {*SURVEY, "settings_file"}
    assert all(one.get("description") or "$ref" in json.dumps(one) for one in schema.values())


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
    assert edges(tasks, "condense_fine") == {"plan_capture", "capture_fine", "capture_coarse"}
    assert edges(tasks, "rectify") == {"plan_capture", "condense_coarse", "locate"}
    assert edges(tasks, "rectify_fine") == {"plan_capture", "condense_fine"}
    assert edges(tasks, "publish") >= {"plan_capture", "segment", "evaluate"}
    assert any(words.startswith("mosaic: ") and "stages/rectify/" in words for words in log)
    assert set(artifacts) == {"survey-scene"}
    assert "data:image/jpeg;base64," in artifacts["survey-scene"].data
    assert "report.html" in artifacts["survey-scene"].data


STEPS = ("plan_capture", "publish", "clear_raw")


def edges(tasks: dict[str, Any], name: str) -> set[str]:
    """Return the names of the tasks from which a task got an input."""
    by_id = {one.id: key.removesuffix("-scene") for key, one in tasks.items()}
    given = (one for some in tasks[f"{name}-scene"].task_inputs.values() for one in some)
    return {by_id[one.id] for one in given if hasattr(one, "id")}


def prefect_variables() -> dict[str, str]:
    """Return Prefect's settings in the environment; other libraries set theirs on import."""
    return {name: value for name, value in os.environ.items() if name.startswith("PREFECT")}


def opened_surveys() -> set[int]:
    """Return the ids of the survey runs in memory."""
    gc.collect()
    return {id(one) for one in gc.get_objects() if type(one) is SurveyRun}


def test_a_survey_has_a_server_of_its_own(survey_png: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The server's files are in the archive, and the environment is unchanged afterwards."""
    monkeypatch.delenv("PREFECT_API_URL", raising=False)
    before = prefect_variables()
    opened = opened_surveys()
    survey_png(tmp_path, engine="prefect", **RASTER)
    assert opened_surveys() <= opened  # no run stays in memory
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

    def terminated(*given: Any) -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        pytest.fail("SIGTERM was not heard")

    with monkeypatch.context() as patch:
        act_instead(patch, "segment", terminated)
        ended = command_line("survey", file)
    assert (ended.code, ended.out, ended.errors) == (143, "", [])
    assert ended.err.splitlines()[-1] == "terminated; run the same command to resume"
    assert command_line("survey", file).code == 0
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
