"""Warnings about a map stand first on every page and in every file about it, and no score is expected under one."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest
import rasterio
from rich.console import Console

import spectralzoom
from spectralzoom.flows.archive.commands import contents, show_contents
from spectralzoom.flows.archive.explain_command import explanation, show_explanation
from spectralzoom.flows.archive.export_command import run_export
from spectralzoom.flows.archive.export_layers import ProductFlags
from spectralzoom.flows.archive.plan_command import plan_content, show_plan
from spectralzoom.flows.archive.reprocess_command import reprocess_fields
from spectralzoom.flows.cli.tiles import tile_row
from spectralzoom.flows.publish import publishing, run_folder
from spectralzoom.flows.publish.findings import no_expected_score, plots_csv
from spectralzoom.flows.publish.publishing import RunRef, outcome
from spectralzoom.flows.publish.receipt_table import format_score, print_summary
from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.flows.survey_command import run_survey
from spectralzoom.models.evaluation.expected_scores import MapScores
from spectralzoom.models.weights.files import MAP_SCORES, TRAINED_ON, _add_part, load_weights, save_weights, with_record
from spectralzoom.storage.store import Archive
from tests.conftest import CLASSES, QUIET, Flags, WeightsMaker
from tests.flows.publish.test_receipt import make_receipt
from tests.flows.surveys.test_uniform_scan import RECORD
from tests.flows.surveys.test_unlike_training import SEEN, with_spectra
from tests.prior_work import without_effects

SCORES = MapScores((1, 2), (6.0, 100.0), np.zeros((2, 2, len(CLASSES))), np.full((2, 2), 0.01), 4)
SCORE = re.compile(r"[Ee]xpected mIoU \d|\d ± \d|or more, one uniform")
BEYOND = r"outside of the training data of .*: exposures of 25 ms \(training: 50 ms and more.*Expect a poorer map"
UNLIKE = r"the scene is unlike the training \(its .* as far from it as any part"


@pytest.fixture(scope="module")
def judged(make_weights: WeightsMaker, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return tiny weights for exposures from 50 ms on, with records of scans and of expected scores."""
    path = tmp_path_factory.mktemp("judged") / "judged.safetensors"
    trained = asdict(replace(SEEN, exposure_ms=(50.0, 100.0)))
    save_weights(with_record(load_weights(make_weights(scans=RECORD)), **{TRAINED_ON: trained}), path)
    _add_part(path, path, MAP_SCORES, SCORES.as_dict(), {})
    return path


@pytest.fixture(scope="module")
def asked(flags_png: Flags, judged: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """Return flags of three surveys: within the training, in too short exposures, and with spectra unlike it."""
    unlike = with_spectra(judged, judged.parent / "unlike.safetensors")
    out = tmp_path_factory.mktemp("archives")
    both = {"scan_step": "2", "engine": "plain", "effects": "none"}
    return {
        "": flags_png(out / "a", **both, weights=str(judged), scan_exposure_ms="100"),
        BEYOND: flags_png(out / "b", **both, weights=str(judged), scan_exposure_ms="25"),
        UNLIKE: flags_png(out / "c", **both, weights=unlike, scan_exposure_ms="100"),
    }


@pytest.fixture(scope="module")
def surveyed(asked: dict[str, dict[str, Any]]) -> dict[str, tuple[Any, str]]:
    """Return run and terminal of each survey of `asked`."""
    found = {}
    with without_effects():
        for words, flags in asked.items():
            console = Console(file=io.StringIO(), width=400)
            published = run_survey(load_settings(None, flags), console)
            found[words] = published, console.file.getvalue()
    return found


def shown(show: Callable[[Any, Console], None], content: Any) -> str:
    """Return the text that a command prints of a content."""
    console = Console(file=io.StringIO(), width=400)
    show(content, console)
    return console.file.getvalue()


def artifact(published: Any, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the text of the artifact of a run, without the escapes of Markdown."""
    import prefect.artifacts

    made: list[str] = []
    monkeypatch.setattr(publishing, "inside_flow", lambda: True)
    monkeypatch.setattr(prefect.artifacts, "create_markdown_artifact", lambda text, **more: made.append(text))
    publishing._show_artifact("field", "archive", published)
    return made[0].replace("\\", "")


@pytest.mark.parametrize("words", ["", BEYOND, UNLIKE], ids=["like", "beyond", "unlike"])
def test_warnings_stand_first_and_no_score_is_expected(
    asked: dict[str, Any], surveyed: dict[str, Any], monkeypatch: pytest.MonkeyPatch, words: str
) -> None:
    """Without a warning the same pages have an expected score."""
    published, terminal = surveyed[words]
    receipt, folder = published.receipt, published.folder
    out = Archive.open(asked[words]["out"])
    page = (folder / "report.html").read_text(encoding="utf-8")
    summary = shown(print_summary, receipt)
    console = outcome(RunRef(f"runs/{folder.name}", folder))
    planned = plan_content(load_settings(None, asked[words]))
    texts = {
        "terminal": terminal[terminal.rindex("Warning: ") :] if words else terminal,
        "summary": summary,
        "report": page[page.index("</h1>") :],
        "artifact": artifact(published, monkeypatch).partition("\n\n")[2],
        "serve": console.partition(": ")[2],
        "plan": shown(show_plan, planned),
        "explain": shown(show_explanation, explanation(out, "latest")),
    }
    for name, text in texts.items():
        first = re.match(rf"(</h1><p class=\"warning\" role=\"alert\">)?Warning: {words}", text)
        assert bool(first) == bool(words), (name, text[:200])
        if name != "explain":
            assert bool(SCORE.search(text)) != bool(words), name
        if name not in ("explain", "plan"):
            assert ("o expected score: under a warning" in text) == bool(words), name
    assert planned["estimate"]["miou"]["known_from"].startswith("no expected score") == bool(words)
    scans = [one["expected_miou"] for one in (*receipt["scans"].values(), *planned["scans"]["candidates"])]
    assert {one is None for one in scans} == {bool(words)}
    assert (next(iter(receipt)) == "warnings") == bool(words)
    assert planned["warnings"] == receipt.get("warnings", [])
    assert "Warning" not in json.dumps(receipt)
    assert ("!" in shown(show_contents, contents(out))) == bool(words)
    assert list(spectralzoom.open(out.name).latest.warnings) == receipt.get("warnings", [])
    assert (tile_row("x", published, 1.0)[1] == "warning") == bool(words)


@pytest.mark.parametrize("words", ["", BEYOND], ids=["like", "beyond"])
def test_exports_have_the_warnings(asked: dict[str, Any], surveyed: dict[str, Any], tmp_path: Path, words: str) -> None:
    """Terminal, STAC item, every image and the polygons have them."""
    console = Console(file=io.StringIO(), width=400)
    done = run_export(asked[words]["out"], None, tmp_path, console, ProductFlags(polygons=True))
    warned = surveyed[words][0].receipt.get("warnings", [])
    about = json.loads(Path(done["item"]).read_text())["properties"]
    assert done["warnings"] == about["spectralzoom:warnings"] == warned
    assert about["description"].startswith("Warning: outside of") == bool(words)
    assert console.file.getvalue().lstrip().startswith("Warning: outside of") == bool(words)
    images = [tmp_path / file for file in done["files"].values() if file.endswith(".tif")]
    assert len(images) >= 4
    for path in images:
        with rasterio.open(path) as file:
            assert file.tags().get("WARNING", "") == "; ".join(warned)
    layer = pyogrio.read_info(tmp_path / done["files"]["polygons"], layer="classes")["layer_metadata"] or {}
    assert layer.get("WARNING", "") == "; ".join(warned)
    areas = list(csv.DictReader((tmp_path / done["files"]["areas"]).read_text(encoding="utf-8").splitlines()))
    outlines = pyogrio.read_dataframe(tmp_path / done["files"]["polygons_shapefile"])
    assert {row.get("warning", "") for row in areas} == {"; ".join(warned)}
    assert set(outlines.get("warning", [""])) == {"; ".join(warned)[:254]}


def test_reprocessed_fields_have_the_warnings(asked: dict[str, Any], surveyed: dict[str, Any]) -> None:
    """The row of a field that is up to date has those of its run."""
    (row,) = reprocess_fields(asked[BEYOND]["out"], QUIET)["fields"]
    assert row["state"] == "skipped"
    assert row["warnings"] == surveyed[BEYOND][0].receipt["warnings"]


def test_the_quicklook_has_the_warnings(
    asked: dict[str, Any], surveyed: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are lines of its title."""
    drawn: list[Any] = []
    monkeypatch.setattr(run_folder, "draw_quicklook", lambda shown: drawn.append(shown) or b"")
    monkeypatch.setattr(publishing, "_show_artifact", lambda *_: None)
    for words in ("", BEYOND):
        run_survey(load_settings(None, asked[words]), QUIET)
    assert [one.about.startswith("Warning: outside of the training") for one in drawn] == [False, True]


def test_plots_have_the_warnings() -> None:
    """A column repeats them, which a table without any lacks."""
    plots = [{"plot": one, "pixels": 4, "mapped_pixels": 4, "area_m2": None, "confidence": 0.9} for one in "ab"]
    plots = [one | {"fractions": {"soil": 1.0}} for one in plots]
    rows = [list(csv.DictReader(plots_csv(plots, told).splitlines())) for told in ([], ["dark", "cold, wet"])]
    assert [[row.get("warning") for row in some] for some in rows] == [[None] * 2, ["dark; cold, wet"] * 2]


@pytest.mark.parametrize("found", ["outside", 7, [3, {}], {"a": 1}, None])
def test_other_things_in_the_place_of_warnings_are_none(found: Any) -> None:
    """A receipt of a stranger ends no command."""
    from spectralzoom.flows.publish.scores import warnings_of

    assert warnings_of({"warnings": found}) == []


def test_a_stranger_s_score_under_a_warning_is_not_shown() -> None:
    """A receipt may have both."""
    receipt: Any = make_receipt(labels=False) | {"expected": {"miou": 0.934, "error": 0.031}}
    assert "93.4 ± 3.1" in format_score(receipt)
    assert "93.4" not in format_score(receipt | {"warnings": ["outside"]})


@pytest.mark.parametrize(
    ("pixels", "words"), [(0, "0 px have a class"), (1, "1 px"), (1999, "1\u202f999 px"), (2000, "")]
)
def test_small_maps_have_no_expected_score(pixels: int, words: str) -> None:
    """2000 px with a class are the least."""
    assert re.search(words, no_expected_score([], pixels))
    assert bool(no_expected_score([], pixels)) == bool(words)


@pytest.mark.parametrize("size", [(1, 1), (3, 200), (16, 16), (50, 50)])
def test_plans_of_small_fields_have_no_expected_score(
    flags_png: Flags, make_weights: WeightsMaker, tmp_path: Path, size: tuple[int, int]
) -> None:
    """The record of scans is that of whole fields."""
    np.save(tmp_path / "small.npy", np.random.default_rng(3).random((*size, 3)).astype(np.float32))
    weights = make_weights(scans=RECORD)
    more = {"scene": str(tmp_path / "small.npy"), "weights": str(weights), "wavelengths": "460,550,640"}
    planned = plan_content(load_settings(None, flags_png(tmp_path / "a", **more, scan_step="1")))
    assert ("px have a class" in planned["estimate"]["miou"]["known_from"]) == (size != (50, 50))
