"""Serving fields: requests refused before anything runs, and the deployments of fields."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import timedelta
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from spectralzoom.flows.cli.serve_command import load_fields, schedule_of, survey_deployment
from spectralzoom.flows.observer import say_state
from spectralzoom.storage.store import Archive
from spectralzoom.storage.whole_files import locked

pytestmark = pytest.mark.usefixtures("no_effects")

BAD = {
    "no fields": ((), "--every 30m", 2, "parameter FIELDS requires an argument"),
    "cron out of range": (("north",), "--cron 0_25_*_*_*", 2, "no such schedule: .*Invalid cron string: .0 25"),
    "neither": (("north",), "", 2, "no such schedule: neither --every nor --cron; expected --every 30m"),
    "both": (("north",), "--every 1h --cron 0_6_*_*_*", 2, "no such schedule: both --every and --cron"),
    "no interval": (("north",), "--every 0s", 2, "no such schedule: Input should be greater than 0 seconds"),
    "no zone": (("north",), "--cron 0_6_*_*_* --timezone Mars/Base", 2, "no such schedule: .*Invalid timezone"),
    "no such file": (("nowhere",), "--every 30m", 2, "no settings file .*nowhere.toml"),
    "scene missing": (("gone",), "--every 30m", 1, "gone.toml: there is no file .*gone.png"),
    "no name": (("(-)",), "--every 30m", 2, "name must be a name of at most 255 characters with a letter or digit"),
    "twice": (("north", "north"), "--every 30m", 2, "are both called north"),
    "no unit": (("north",), "--every 5", 2, "--every: Interval between due times, .*: 30m, 2h, 1d; .*; see "),
    "limit": (("north",), "--every 30m --limit 0", 2, "Invalid value .*--limit.* >= 1"),
}


@pytest.mark.parametrize("case", BAD)
def test_refused_before_serving(case: str, field_file: Callable[..., Path], tmp_path: Path, command_line: Any) -> None:
    """One clear message comes with the right exit code; no server is left."""
    names, words, code, message = BAD[case]
    field_file("north")
    field_file("gone", scene="gone.png")
    field_file("(-)")
    given = [word.replace("_", " ") for word in words.split()]
    command_line("serve", *(tmp_path / f"{name}.toml" for name in names), *given).refused(code, message)
    assert not (tmp_path / "archive" / ".prefect").exists()


def test_a_second_serve_is_refused(field_file: Callable[..., Path], tmp_path: Path, command_line: Any) -> None:
    """It would end the runs of the same field; another field needs the server of the first serve."""
    file, locks = field_file(), Archive.open(tmp_path / "archive").root / ".locks"
    for name, message in (("serve-north", "another serve surveys north into"), ("prefect", "name its server in PREF")):
        with locked(locks / f"{name}.lock"):
            command_line("serve", file, "--every", "30m").refused(1, message)


@pytest.mark.parametrize(
    ("url", "words", "code", "message"),
    [
        ("http://127.0.0.1:9/api", (), 1, "Prefect's server does not answer as expected (.*): start it"),
        (None, ("--port", 70000), 2, "--port 70000 cannot be used"),
    ],
)
def test_serve_without_a_server_is_refused(
    url: str | None,
    words: Sequence[object],
    code: int,
    message: str,
    field_file: Callable[..., Path],
    command_line: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One message comes before anything is reported as served."""
    if url is not None:
        monkeypatch.setenv("PREFECT_API_URL", url)
    ended = command_line("serve", field_file(), "--every", "30m", *words)
    ended.refused(code, message)
    assert "serving" not in ended.err


@pytest.mark.parametrize(("deployment", "line"), [("id", "north: failed after 90 s. no such file\n"), (None, "")])
def test_a_failed_run_of_a_deployment_is_a_line(deployment: str | None, line: str, capfd: Any) -> None:
    """It has name, seconds and message; a survey by hand prints its own."""
    from prefect.states import Failed

    state = Failed(message="no such file")
    run = Mock(deployment_id=deployment, start_time=state.timestamp - timedelta(seconds=90))
    run.name = "north"
    say_state(None, run, state)
    assert capfd.readouterr().err == line


def test_prefect_asks_for_no_usage_data(tmp_path: Path) -> None:
    """At a terminal, the first command prints no notice."""
    terminal, inside = pty.openpty()
    kept = {name: text for name, text in os.environ.items() if name not in ("DO_NOT_TRACK", "CI", "GITHUB_ACTIONS")}
    words = [sys.executable, "-m", "spectralzoom.flows.cli.main", "serve", "--help"]
    streams = {"stdin": inside, "stdout": inside, "stderr": inside}
    with subprocess.Popen(words, **streams, env={**kept, "PREFECT_HOME": str(tmp_path), "COLUMNS": "80"}) as process:
        os.close(inside)
        said = b""
        with suppress(OSError):  # Linux: the other end is closed
            while part := os.read(terminal, 1 << 16):
                said += part
        assert process.wait(60) == 0
    os.close(terminal)
    assert b"Survey fields on a schedule" in said
    assert b"usage data" not in said


def test_a_field_is_a_deployment_of_the_survey(field_file: Callable[..., Path], tmp_path: Path) -> None:
    """Its parameters have file, field and archive and pass the flow's checks; a second run at a time is cancelled."""
    from spectralzoom.flows.archive.reprocess_flow import reprocess_deployment
    from spectralzoom.flows.prefect_flow import survey

    ((file, north),) = load_fields([field_file("north")], out=str(tmp_path / "other")).items()
    made = survey_deployment(file, north, schedule_of("0 6 * * *", None, "Europe/Berlin"))
    settings = survey.validate_parameters(made.parameters)["settings"]
    assert (settings.name, settings.out, settings.budget) == ("north", str(tmp_path / "other"), 0.8)
    assert (made.concurrency_limit, made.concurrency_options.collision_strategy.value) == (1, "CANCEL_NEW")
    (schedule,) = made.schedules
    assert (schedule.schedule.cron, schedule.schedule.timezone) == ("0 6 * * *", "Europe/Berlin")
    again = reprocess_deployment("/data/a b")
    assert (again.flow_name, again.name, again.schedules) == ("reprocess", "data-a-b", [])


def test_a_folder_of_another_user_is_named(
    field_file: Callable[..., Path], tmp_path: Path, command_line: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Prefect's runner has its folder in the temporary one, where another user may have created it."""
    refused = PermissionError(13, "Permission denied", "/tmp/runner_storage")
    monkeypatch.setattr("prefect.runner.Runner.start", Mock(side_effect=refused))
    ended = command_line("serve", field_file(), "--every", "30m", "--port", 0)
    ended.refused(1, "/tmp/runner_storage belongs to another user: set TMPDIR")
