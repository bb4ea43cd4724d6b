"""`gc --patches-too`: most of an archive goes, and every map is there yet, or can be made again from its lines."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from flows.archive.commands import contents, explain, gc, ls, run_verify
from flows.archive.export_command import run_export
from flows.archive.plan_command import forecast
from flows.archive.reprocess_command import run_judge, run_reprocess
from flows.settings.load import load_settings
from flows.tasks.open_survey import versions_made_again
from flows.terminal.processes import DONE
from models.weights.files import save_weights
from storage.archive.archive import Archive
from tests.conftest import RGB_NM, Survey, random_weights

pytestmark = pytest.mark.usefixtures("no_effects")

QUIET = Console(quiet=True)


@pytest.fixture
def archive(two_budgets: Path, tmp_path: Path) -> Archive:
    """A copy of two surveys, of which the patches are cleared."""
    out = Path(shutil.copytree(two_budgets, tmp_path / "archive"))
    assert gc(out, keep_days=0, patches_too=True) == DONE
    return Archive.open(out)


def _files(archive: Archive) -> dict[str, Any]:
    """What the manifests of all patches list."""
    return {ref.key: archive.manifest(ref)["files"] for ref in archive.refs("patches")}


def test_only_patches_are_soon_made_again() -> None:
    """Raw lines are the truth of a visit, and mosaics what the next visit is laid onto."""
    assert set(versions_made_again()) == {"patches"}


def test_the_archive_is_smaller_and_whole(two_budgets: Path, archive: Archive, capsys: Any) -> None:
    """No patch is left, nothing is missing, and the tables say so."""
    before, after = (contents(Archive.open(root))["bytes"] for root in (two_budgets, archive.root))
    for root, size in ((two_budgets, before), (archive.root, after)):
        files = [path for part in ("stages", "runs") for path in (root / part).rglob("*") if path.is_file()]
        assert size == sum(path.stat().st_size for path in files)
    gone = sum(entry["size"] for files in _files(Archive.open(two_budgets)).values() for entry in files.values())
    assert before - after > gone > 0  # a manifest that lists no file is smaller, too
    assert set(map(len, _files(archive).values())) == {0}
    assert run_verify(archive.root, QUIET) == DONE
    ls(archive.root)
    assert "cleared" in capsys.readouterr().out
    explain(archive.root, "class_map")
    assert "cleared away, made again when it is asked for" in " ".join(capsys.readouterr().out.split())


def test_the_same_survey_makes_the_same_patches(two_budgets: Path, archive: Archive, survey_png: Survey) -> None:
    """Every file by its hash; the map is found as it was."""
    row = {one.stage: one for one in forecast(_settings(archive)).stages}["extract_patches"]
    assert (row.state, row.why) == ("to run", "its files were cleared away by gc")
    states = {row["name"]: row["state"] for row in survey_png(archive.root).receipt["stages"]}
    assert states.pop("extract_patches") == "ran"
    assert set(states.values()) <= {"cached", "skipped"}
    known, found = _files(Archive.open(two_budgets)), _files(archive)
    made = {key for key, files in found.items() if files}
    assert len(made) == 1
    assert all(found[key] == known[key] for key in made)
    assert run_verify(archive.root, QUIET) == DONE


def _settings(archive: Archive) -> Any:
    """What the first of the two surveys was asked for."""
    receipt = json.loads((archive.runs()[0] / "receipt.json").read_text())
    given = {name: receipt["settings"][name] for name in ("scene", "source", "labels", "weights", "budget", "engine")}
    return load_settings(None, {**given, "out": str(archive.root), "controls": False})


def test_fields_are_as_they_would_become(archive: Archive) -> None:
    """What was cleared is nothing that a survey would find otherwise: nothing is surveyed again."""
    assert run_reprocess(archive.root, QUIET) == DONE
    assert len(archive.runs()) == 2


def test_other_weights_read_patches_that_are_cut_again(archive: Archive, tmp_path: Path) -> None:
    """A new map of the old light."""
    save_weights(random_weights(RGB_NM, width=12), tmp_path / "other.safetensors")
    assert run_reprocess(archive.root, QUIET, weights=tmp_path / "other.safetensors") == DONE
    newest = json.loads((archive.runs()[-1] / "receipt.json").read_text())
    states = {row["name"]: row["state"] for row in newest["stages"]}
    assert (states["capture_coarse"], states["rectify"], states["segment"]) == ("cached", "cached", "ran")
    assert run_verify(archive.root, QUIET) == DONE


def test_a_map_is_judged_by_patches_that_are_cut_again(survey_png: Survey, tmp_path: Path) -> None:
    """`evaluate ARCHIVE RUN` makes what it reads, and the run's accuracy is that of a run whose patches stayed."""
    scores = []
    for name, flag in (("kept", False), ("cleared", True)):
        out = tmp_path / name
        survey_png(out, accuracy=False, controls=True)
        assert gc(out, keep_days=0, patches_too=flag) == DONE
        scores.append(run_judge(str(out), "latest", QUIET)["accuracy"]["miou"])
        assert run_verify(out, QUIET) == DONE
    assert scores[0] == scores[1]


def test_an_export_names_what_there_is(two_budgets: Path, archive: Archive, tmp_path: Path) -> None:
    """Its images are those of before; only the store of the patches is not among its files."""
    roots = {"kept": two_budgets, "cleared": archive.root}
    out = {name: run_export(root, None, tmp_path / name, envi=False, console=QUIET) for name, root in roots.items()}
    kept, cleared = (json.loads((tmp_path / name / out[name]["item"]).read_text())["assets"] for name in roots)
    assert set(kept) - set(cleared) == {"patches_zarr"}
    for path in (tmp_path / "kept").rglob("attention.tif"):
        assert path.read_bytes() == (tmp_path / "cleared" / path.relative_to(tmp_path / "kept")).read_bytes()
