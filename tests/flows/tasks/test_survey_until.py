"""A survey stops when the stage of `until` is stored, and the same survey without it goes on with these stores."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from spectralzoom.flows.settings.load import load_settings
from spectralzoom.flows.settings.survey_settings import Settings
from spectralzoom.flows.survey_command import run_survey
from spectralzoom.pipeline.errors import SurveyStopped
from spectralzoom.storage.store import Archive
from tests.conftest import QUIET
from tests.flows.conftest import CommandLine

pytestmark = pytest.mark.usefixtures("no_effects")
UNIFORM = {"scan_step": "2", "scan_exposure_ms": "10"}
TWICE = {"budget": "0.8"}


def small(out: Path, **given: Any) -> Settings:
    """Return settings of a tiny survey of the farm."""
    usual = {"size": "128x128", "bands": "40,90,150,200", "engine": "plain", "controls": False, "out": str(out)}
    return load_settings(None, usual | given)


def stages(archive: Path) -> set[str]:
    """Return the stages of which the archive has a store."""
    return {folder.name for folder in (archive / "stages").iterdir()}


@pytest.mark.parametrize(("scan", "engine"), [(UNIFORM, "plain"), (TWICE, "prefect")], ids=["uniform", "twice"])
def test_a_stopped_survey_goes_on(tmp_path: Path, scan: dict[str, str], engine: str) -> None:
    """Lines are captured once, and the map equals that of a survey in one go; no network reads a uniform mosaic."""
    asked = small(tmp_path / "a", **scan, engine=engine)
    with pytest.raises(SurveyStopped, match=r"stopped after capture: stored in .*; the same command without --until"):
        run_survey(replace(asked, until="capture"), QUIET)
    shutil.copytree(tmp_path / "a" / "stages", tmp_path / "copy" / "stages")  # as on another machine
    asked = replace(asked, out=str(tmp_path / "copy"))
    archive = Archive.open(tmp_path / "copy")
    before = {ref.uri: ref.path.stat().st_mtime_ns for ref in archive.refs("capture")}
    assert len(before) == (1 if scan is UNIFORM else 2)
    assert "segment" not in stages(tmp_path / "copy")
    with pytest.raises(SurveyStopped, match="stopped after mosaic"):
        run_survey(replace(asked, until="mosaic", keep="raw"), QUIET)
    assert (stages(tmp_path / "copy") & {"score", "segment"}) == (set() if scan is UNIFORM else {"score"})
    published = run_survey(replace(asked, keep="raw"), QUIET)
    assert {ref.uri: ref.path.stat().st_mtime_ns for ref in archive.refs("capture")} == before
    whole = run_survey(replace(asked, out=str(tmp_path / "b")), QUIET)
    assert published.receipt["products"]["class_map"] == whole.receipt["products"]["class_map"]


def test_the_command_says_what_is_stored(command_line: CommandLine, tmp_path: Path) -> None:
    """The exit code is 0, and no run is published."""
    flags = ("--size", "128x128", "--bands", "40,90", "--seconds", "2", "--engine", "plain", "--until", "capture")
    ended = command_line("survey", *flags, "--out", tmp_path / "a")
    assert ended.code == 0
    assert "stopped after capture" in ended.err
    assert not list((tmp_path / "a").glob("runs/*"))
