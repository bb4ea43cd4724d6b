"""A run whose time lies in the future is never the latest one nor a prior map, and a note says so."""

from __future__ import annotations

import json
import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

import spectralzoom
from tests.faults.nursery import Ended
from tests.faults.whole_survey import Whole, asked
from tests.storage.small_archive import rewrite

MOMENTS = {"both": (True, True), "name": (True, False), "manifest": (False, True)}  # whose time lies ahead


@pytest.fixture(params=MOMENTS)
def ahead(whole: Whole, tmp_path: Path, request: pytest.FixtureRequest) -> tuple[Path, str]:
    """Return an archive with one more run, from tomorrow by its name or its manifest, and the name of that."""
    out = whole.copy(tmp_path / "archive")
    by_name, by_manifest = MOMENTS[request.param]
    now = datetime.now(UTC)
    tomorrow = now + timedelta(days=1)
    name = f"{tomorrow if by_name else now:%Y%m%dT%H%M%S}-scene-9"
    shutil.copytree(out / whole.run, out / "runs" / name)
    created = (tomorrow if by_manifest else now).isoformat(timespec="milliseconds")
    rewrite(out / "runs" / name / "manifest.json", run=name, created=created)
    return out, name


def said(ended: Ended, name: str) -> bool:
    """Return whether a note says of a run that it lies in the future."""
    return any(name in line and "future" in line for line in ended.text.splitlines())


def test_latest_is_never_a_run_of_the_future(whole: Whole, ahead: tuple[Path, str], tmp_path: Path) -> None:
    """Package, explain and export take the one before; by its own name the run is still read."""
    out, name = ahead
    before = whole.run.removeprefix("runs/")
    assert spectralzoom.open(out).latest.name == before
    assert spectralzoom.open(out)[name].name == name
    explained = whole.nursery.run(["explain", str(out), "latest"])
    assert (explained.code, said(explained, name)) == (0, True), explained.text
    assert f"runs/{name}" not in explained.text.splitlines()
    exported = whole.nursery.run(["export", str(out), "--out", str(tmp_path / "exported")])
    assert (exported.code, said(exported, name)) == (0, True), exported.text
    assert (tmp_path / "exported" / before).is_dir()
    assert not (tmp_path / "exported" / name).exists()
    assert whole.nursery.run(["verify", str(out)]).code == 0


def test_a_prior_map_is_never_of_the_future(whole: Whole, ahead: tuple[Path, str]) -> None:
    """The survey takes the run before it as prior map, and its note names the other."""
    out, name = ahead
    ended = whole.nursery.run([*asked(out), "--seed", "1", "--prior", "latest"])
    assert (ended.code, said(ended, name)) == (0, True), ended.text
    newest = max(out.glob("runs/*/receipt.json"), key=lambda path: path.stat().st_mtime_ns)
    assert json.loads(newest.read_text())["prior_map"]["run"] == whole.run.removeprefix("runs/")


def test_a_prior_map_of_the_future_is_refused_by_name(whole: Whole, ahead: tuple[Path, str]) -> None:
    """One message says why."""
    out, name = ahead
    ended = whole.nursery.run([*asked(out), "--seed", "1", "--prior", name])
    errors = [line for line in ended.text.splitlines() if line.startswith("error: ")]
    assert (ended.code in (1, 2), len(errors)) == (True, 1), ended.text
    assert name in errors[0]
    assert "future" in errors[0]


def test_an_archive_with_runs_of_the_future_alone_has_no_latest_run(whole: Whole, ahead: tuple[Path, str]) -> None:
    """The message says so."""
    out, name = ahead
    shutil.rmtree(out / whole.run)
    with pytest.raises(spectralzoom.Error, match="run"):
        _ = spectralzoom.open(out).latest
    ended = whole.nursery.run(["explain", str(out), "latest"])
    assert (ended.code in (1, 2), "Traceback" in ended.text) == (True, False), ended.text
    assert name in ended.text
