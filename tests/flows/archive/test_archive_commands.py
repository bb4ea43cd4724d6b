"""ls, gc, explain and verify on the archive of real, tiny surveys: their output and their effects."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from spectralzoom.flows.archive.commands import command, contents, gc, ls, verify
from spectralzoom.flows.archive.explain_command import explain
from spectralzoom.flows.archive.reprocess_command import asked_again
from spectralzoom.flows.settings.settings import load_settings, parse_settings
from spectralzoom.flows.survey_command import run_survey
from spectralzoom.flows.terminal.figures import format_bytes
from spectralzoom.flows.terminal.processes import DONE, FAILED, PARTLY
from spectralzoom.pipeline.errors import ArchiveError
from spectralzoom.storage.runs import read_run
from spectralzoom.storage.store import Archive, manifest_path, publish
from spectralzoom.storage.whole_files import to_json
from tests.conftest import QUIET
from tests.storage.small_archive import flip, small_survey

pytestmark = pytest.mark.usefixtures("no_effects")


@pytest.fixture
def archive(two_budgets: Path, tmp_path: Path) -> Path:
    """Return a copy of an archive with two budgets."""
    return Path(shutil.copytree(two_budgets, tmp_path / "archive"))


def _json(capsys: pytest.CaptureFixture[str], run: Callable[[], int], code: int = DONE) -> dict[str, Any]:
    capsys.readouterr()
    assert run() == code
    content: dict[str, Any] = json.loads(capsys.readouterr().out)
    return content


def test_ls_shows_runs_and_stores(two_budgets: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """JSON has plain figures; the table has units and fits 80 columns, also in a pipe."""
    content = _json(capsys, lambda: ls(two_budgets, as_json=True))
    first, second = content["runs"]
    assert (first["survey"], first["budget"], second["budget"], first["seed"]) == ("scene", 0.8, 0.7, 0)
    assert first["state"] == second["state"] == "there"
    assert 0 < first["miou"] < 1
    assert first["bytes"] > second["bytes"] > 10_000
    shared = content["shared_bytes"]
    assert first["bytes"] - first["own_bytes"] == second["bytes"] - second["own_bytes"] == shared > 10_000
    assert content["bytes"] == first["own_bytes"] + second["own_bytes"] + shared
    stores = sum(row["bytes"] for rows in content["stages"].values() for row in rows)
    folders = sum(map(Archive(two_budgets).size_of, (f"runs/{run['id']}" for run in (first, second))))
    assert content["bytes"] == stores + folders
    assert [len(content["stages"][stage]) for stage in ("capture", "rectify", "segment")] == [3, 1, 2]
    assert content["stages"]["rectify"][0]["runs"] == 2
    ls(two_budgets)
    out = capsys.readouterr().out
    assert first["id"] in out
    assert content["stages"]["rectify"][0]["key"] in out
    assert format_bytes(first["own_bytes"]) in out
    assert f"2 runs, 18 stores, {format_bytes(content['bytes'])}, {format_bytes(shared)} shared by several runs" in out
    assert max(map(len, out.splitlines())) <= 80


def test_an_empty_and_a_damaged_archive_are_listed(archive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A damaged or missing item is reported at its place in the list."""
    Archive.open(archive.parent / "empty")
    assert ls(archive.parent / "empty") == DONE
    assert "no runs" in capsys.readouterr().out
    mosaic, coarse = (Archive.open(archive).refs(stage)[0] for stage in ("rectify", "locate"))
    flip(manifest_path(mosaic.path), at=40)
    (coarse.path / "manifest.json").unlink()
    flip(Archive.open(archive).runs()[0] / "receipt.json", at=40)
    content = _json(capsys, lambda: ls(archive, as_json=True))
    assert [run["state"] for run in content["runs"]] == ["damaged", "2 damaged"]
    flip(Archive.open(archive).runs()[0] / "manifest.json", at=40)
    assert gc(archive, keep_days=0) == PARTLY
    assert "no store is removed" in capsys.readouterr().out


def test_explain_shows_lineage(two_budgets: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It is a tree of stages with their keys, and with the names that runs give them."""
    content = _json(capsys, lambda: explain(two_budgets, "class_map", as_json=True))
    (top,) = content["lineage"]
    assert (top["stage"], top["called"]) == ("segment", ["segment"])
    assert [one["stage"] for one in top["inputs"]] == ["rectify_fine", "score", "overview"]
    explain(two_budgets, "class_map")
    out = capsys.readouterr().out
    assert "segment" in out
    assert "└── capture" in out
    assert "(capture_fine)" in out
    assert "named by runs/" in out


def test_explain_covers_captures_and_runs(two_budgets: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Both runs name the first sweeps, one the fine ones; a run has its command, and shows each store once."""
    named = []
    for sweeps in ("raw_coarse", "raw_fine"):
        explain(two_budgets, sweeps, as_json=True)
        named.append(json.loads(capsys.readouterr().out)["runs"])
    assert [len(runs) for runs in named] == [2, 1]
    (first, _) = (run["id"] for run in contents(Archive.open(two_budgets))["runs"])
    content = _json(capsys, lambda: explain(two_budgets, first, as_json=True))
    assert [tree["stage"] for tree in content["lineage"]] == ["evaluate"]
    assert "--budget 0.8" in content["command"]
    explain(two_budgets, first)
    out = capsys.readouterr().out
    assert "spectralzoom survey --scene" in " ".join(out.split())
    whole = [line for line in out.splitlines() if "(capture_coarse)" in line and not line.endswith("above")]
    assert len(whole) == 1  # lines that were condensed twice are shown once


def test_explain_shows_damaged_and_circular_lineage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It shows the lineage as far as it can be read."""
    archive = Archive.open(tmp_path)
    small = small_survey(archive)
    flip(small.raw.path / "manifest.json", at=40)
    archive.discard(small.mosaic.uri)
    for key, given in (("aaaa", "bbbb"), ("bbbb", "aaaa")):
        publish(archive.ref("segment", key).path, lambda folder, given=given: {"inputs": [f"stages/segment/{given}"]})
    (top,) = _json(capsys, lambda: explain(tmp_path, small.map.uri, as_json=True))["lineage"]
    assert [one["problem"].split(":")[0] for one in top["inputs"]] == ["is not there", "manifest.json is damaged"]
    (top,) = _json(capsys, lambda: explain(tmp_path, "aaaa", as_json=True))["lineage"]
    assert top["inputs"][0]["inputs"][0]["see"] == "above"
    for product in (small.map.uri, small.raw.uri, "aaaa"):
        explain(tmp_path, product)
    assert "damaged" in capsys.readouterr().out
    with pytest.raises(ArchiveError, match="cannot be a name"):
        explain(tmp_path, "../../etc/passwd")


def test_a_damaged_store_is_named_removed_and_made_again(archive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Verify names it with what was made of it, and prints the commands that remove and make them."""
    opened = Archive.open(archive)
    flip(opened.refs("rectify_fine")[0].path / "lines.json")
    (archive / "stages" / "notes.txt").write_text("mine")
    content = _json(capsys, lambda: verify(archive, as_json=True), FAILED)
    assert content["checked"] - content["whole"] == 1
    assert [uri.split("/")[1] for uri in content["made_of_them"]] == ["evaluate", "segment"]
    assert verify(archive) == FAILED
    shown = capsys.readouterr().out
    assert content["removal"] == f"spectralzoom gc {archive} --damaged"
    assert content["removal"] in shown
    assert all(one["command"] in shown for one in content["surveys"])
    gone = _json(capsys, lambda: gc(archive, damaged=True, as_json=True))
    assert [row["uri"].split("/")[1] for row in gone["removals"]] == ["evaluate", "segment", "rectify_fine"]
    (one,) = content["surveys"]
    (archive / "stages" / "notes.txt").unlink()
    run_survey(asked_again(read_run(archive / one["run"]), archive, None), QUIET)
    assert verify(archive) == DONE
    assert "21 stores and runs are as published, out of 21" in capsys.readouterr().out


def test_missing_stores_and_empty_receipts_count_as_damaged(archive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A run with an empty receipt is removed."""
    run = next(archive.glob("runs/*"))
    (run / "receipt.json").write_text("")
    shutil.rmtree(Archive.open(archive).refs("rectify_fine")[0].path)
    content = _json(capsys, lambda: verify(archive, as_json=True), FAILED)
    assert content["checked"] - content["whole"] == 2
    gone = _json(capsys, lambda: gc(archive, damaged=True, as_json=True))
    assert [row["uri"] for row in gone["removals"]] == [f"runs/{run.name}"]
    assert not run.exists()


def test_commands_repeat_the_settings_of_a_run(tmp_path: Path) -> None:
    """They have the differences from the defaults only."""
    flags = {"scene": "farm", "size": "640x512", "bands": "3,4", "camera.exposure_ms": 50}
    told = command({**load_settings(None, flags).to_dict(), "notes": ["x"]}, "archive")
    assert told == "spectralzoom survey --bands 3,4 --size 640x512 --camera.exposure-ms 50.0"
    receipt = json.loads(to_json(load_settings(None, {"scene": "farm"}).to_dict()))
    assert command(receipt, "archive") == "spectralzoom survey"
    assert command({}, "archive") == ""


@pytest.mark.parametrize(
    ("chosen", "told"),
    [
        ({"zoom": "never", "seconds": 25.0, "scan_step": 1, "scan_exposure_ms": 9.9}, "--scan-exposure-ms 9.9"),
        ({"zoom": "always", "seconds": 8.0, "scan_step": 4, "scan_exposure_ms": 84.3}, "--scan-exposure-ms 84.3"),
        ({"sweeps": __file__, "scan_step": 2, "scan_exposure_ms": 25.0}, "--scan-step 2"),
        (
            {"sweeps": __file__, "zoom": "always", "seconds": 8.0, "scan_step": 4, "scan_exposure_ms": 84.3},
            f"--sweeps {__file__}",
        ),
    ],
)
def test_commands_name_scans_that_a_survey_accepts(chosen: dict[str, Any], told: str) -> None:
    """The settings of a receipt have both the request and the choice of the weights."""
    source = {"source": "recorded", "scene": "field"} if "sweeps" in chosen else {}
    words = command(parse_settings({**source, **chosen}).to_dict(), "archive").split()[2:]
    assert told in " ".join(words)
    load_settings(None, {flag[2:].replace("-", "_"): value for flag, value in pairwise(words) if flag.startswith("--")})
