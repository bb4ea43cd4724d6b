"""The survey as a Prefect flow on an ephemeral server: stores as plain makes them, references, errors as they are."""

from __future__ import annotations

import io
import json
import os
import signal
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from flows.tasks import prefect_engine as engine
from flows.tasks.stages import accuracy as evaluation
from flows.tasks.survey import STAGES
from flows.terminal.processes import Terminated
from pipeline.errors import RigError
from storage.archive.archive import Archive
from tests.flows.conftest import CommandLine, act_instead, problems
from tests.remembered_work import with_effects

pytestmark = pytest.mark.usefixtures("no_effects")


@pytest.fixture
def passed_on(monkeypatch: pytest.MonkeyPatch, prefect_home: Path) -> list[tuple[str, Any, Any]]:
    """What every Prefect task of the test was given and gave: name, arguments, result."""
    import prefect

    seen: list[tuple[str, Any, Any]] = []
    real = prefect.task

    def recording(**options: Any) -> Any:
        def wrap(function: Any) -> Any:
            one = real(**options)(function)

            def call(*given: Any) -> Any:
                result = one(*given)
                seen.append((options["name"], given, result))
                return result

            return call

        return wrap

    monkeypatch.setattr(prefect, "task", recording)
    return seen


def test_prefect_makes_the_stores_that_plain_makes(
    survey_png: Any, surveyed_png: Any, tmp_path: Path, passed_on: list[tuple[str, Any, Any]], prefect_home: Path
) -> None:
    """Every stage is a task that takes and gives addresses and keys only; keys and figures are those of plain."""
    console = io.StringIO()
    with with_effects():  # as the other has them
        flow = survey_png(tmp_path / "flow", Console(file=console), engine="prefect").receipt
    plain = surveyed_png(tmp_path / "plain").receipt
    assert "going on with --engine plain" not in console.getvalue()
    assert [stage["key"] for stage in flow["stages"]] == [stage["key"] for stage in plain["stages"]]
    assert flow["savings"] == plain["savings"]
    assert flow["accuracy"] == plain["accuracy"]
    assert [name for name, _, _ in passed_on] == [stage["name"] for stage in flow["stages"]]
    for _, given, result in passed_on:
        assert len(json.dumps([given, result])) < 1000
    assert (prefect_home / "prefect.db").exists()
    assert not (tmp_path / "flow" / ".prefect").exists()


def test_a_device_that_answers_the_second_time_is_asked_again(
    survey_png: Any, tmp_path: Path, prefect_home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A capture that failed for its device is tried again, and the survey ends well."""
    real, tries = STAGES["capture_coarse"], []

    def shaky(*given: Any) -> Any:
        tries.append("capture")
        if len(tries) == 1:
            raise RigError("no reply from the camera after 2 s; is it on?")
        return real(*given)

    act_instead(monkeypatch, "capture_coarse", shaky)
    monkeypatch.setattr(engine, "RETRY_DELAY_S", 0.0)
    states = {stage["name"]: stage["state"] for stage in survey_png(tmp_path, engine="prefect").receipt["stages"]}
    assert tries == ["capture", "capture"]
    assert set(states.values()) == {"ran", "skipped"}


def test_without_a_server_the_survey_runs_plain(
    survey_png: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A server that cannot start is told of in one line, and the survey goes on without it."""

    def refuse(*given: Any) -> None:
        raise engine.EngineUnavailable("the Prefect server did not start (no port)")

    monkeypatch.setattr("flows.publish.survey_command.survey_with_prefect", refuse)
    console = io.StringIO()
    found = survey_png(tmp_path, Console(file=console, width=200), engine="prefect").receipt
    assert "did not start (no port); going on with --engine plain" in console.getvalue()
    assert {stage["state"] for stage in found["stages"]} == {"ran", "skipped"}


def test_the_run_is_published_before_its_map_is_judged(
    survey_png: Any, tmp_path: Path, prefect_home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the same flow; a stop while it is judged leaves the run, and the same command adds its accuracy to it."""

    def interrupt(*given: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(evaluation, "load_class_map", interrupt)
        with pytest.raises(KeyboardInterrupt):
            survey_png(tmp_path, engine="prefect")
    (run,) = Archive.open(tmp_path).runs()
    assert json.loads((run / "receipt.json").read_text())["accuracy_is"] == "pending"
    published = survey_png(tmp_path, engine="prefect")
    assert published.folder == run
    assert published.receipt["accuracy_is"] == "judged"
    assert problems(tmp_path) == []


def test_sigterm_in_a_stage(
    scene_files: Path,
    weights: Path,
    tmp_path: Path,
    prefect_home: Path,
    monkeypatch: pytest.MonkeyPatch,
    command_line: CommandLine,
) -> None:
    """143 and one sentence, whatever Prefect makes of it; the same command goes on."""
    real = STAGES["rectify"]

    def terminated(*given: Any) -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        pytest.fail("SIGTERM was not heard")

    words = ("survey", "--scene", scene_files / "scene.png", "--weights", weights, "--out", tmp_path / "archive")
    act_instead(monkeypatch, "rectify", terminated)
    ended = command_line(*words)
    assert (ended.code, ended.out, ended.errors) == (143, "", [])
    assert ended.err.splitlines()[-1] == "terminated; the same command goes on from here"
    monkeypatch.setitem(STAGES, "rectify", real)
    assert command_line(*words).code == 0
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_sigterm_that_ends_the_server_too(prefect_home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Prefect cannot tell its server any more, tries once, and raises what it likes: the survey was terminated."""
    import prefect
    from prefect.settings import PREFECT_CLIENT_MAX_RETRIES, temporary_settings

    tries: list[int] = []

    def flow(**options: Any) -> Any:
        def call(body: Any) -> Any:
            def run(*given: Any) -> None:
                try:
                    body(*given)
                except KeyboardInterrupt:
                    tries.append(PREFECT_CLIENT_MAX_RETRIES.value())
                    raise ConnectionError("no server") from None

            return run

        return call

    def terminate(*given: Any) -> None:
        raise Terminated

    monkeypatch.setattr(prefect, "flow", flow)
    monkeypatch.setattr(engine, "survey", terminate)
    settings = SimpleNamespace(scene="farm", seed=0, budget=0.5)
    with temporary_settings(), pytest.raises(Terminated):
        engine._run_flow(SimpleNamespace(run=SimpleNamespace(name="farm", settings=settings)), terminate)  # type: ignore[arg-type]
    assert tries == [0]
