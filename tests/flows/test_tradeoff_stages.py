"""Trade-offs of the stages: errors of resampling, simulation and segmentation have their known values."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from spectralzoom.flows import tradeoff as stages
from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.flows.survey_command import run_survey
from spectralzoom.flows.tradeoff import Tradeoff, measure_tradeoff, tradeoff
from spectralzoom.pipeline.errors import SceneError
from tests.conftest import QUIET


def errors(entry: Tradeoff) -> dict[object, float]:
    """Return the error of every setting."""
    run, judge = entry.prepare(0, None, None)
    return {setting: judge(setting, run(setting)).error for setting in entry.settings}


def test_kernels_differ_by_their_taps():
    """Interpolation errs less than nearest neighbour (erratum E10)."""
    nearest, bilinear, cubic = (point["error"] for point in measure_tradeoff(stages.RECTIFY, repeats=1)["points"])
    assert 0.03 < nearest < 0.05
    assert cubic < 0.7 * bilinear < 0.7 * 0.5 * nearest


def test_coarser_steps_take_fewer_bytes_and_err_more(monkeypatch):
    """Raw lines err by one deviation of their noise; components hold a fraction of it in a tenth of the bytes."""
    monkeypatch.setattr(stages, "FIELD_SHAPE", (64, 200))
    raw, *condensed = measure_tradeoff(stages.CONDENSE, repeats=1)["points"]
    assert raw["error"] == pytest.approx(1, abs=0.01)
    sizes, errors = ([point[name] for point in condensed] for name in ("bytes", "error"))
    assert sizes == sorted(sizes, reverse=True)
    assert errors == sorted(errors)
    assert errors[0] < 0.3
    assert sizes[0] < raw["bytes"] / 10


def test_chosen_effects_keep_bound_and_tolerance(monkeypatch):
    """The exact choice has no error; for others the error is within its bound and the bound within its tolerance."""
    monkeypatch.setattr(stages, "LAND_SHAPE", (96, 640))
    monkeypatch.setattr(stages, "LINES", 1)
    found = errors(stages.SIMULATE)
    bounds = {one: decision.error for one, decision in stages.decide_for_lines(0)[2].items()}
    assert found[stages.EXACT] == bounds[stages.EXACT] == 0
    assert all(found[one] <= bounds[one] <= one for one in stages.TOLERANCES)
    assert found[stages.TOLERANCES[-1]] > 0


def test_reading_all_patches_gives_a_better_map(monkeypatch):
    """Its error is below that of a map without patches."""
    monkeypatch.setattr(stages, "FARM_SHAPE", (96, 128))
    found = errors(stages.SEGMENT)
    assert 0 < found[1.0] < found[0.0] < 1


def test_trade_offs_of_a_labelled_scene_are_measured(
    scene_files: Path, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A raster gets the fractions of its patches and some scans of the simulated rig."""
    few = {name: scan for name, scan in stages.SCANS.items() if scan == (1, 25.0)}
    monkeypatch.setattr(stages, "SCANS", few)
    monkeypatch.setitem(stages.TRADEOFFS, "survey", replace(stages.SURVEY, settings=tuple(few)))
    scene = str(tmp_path / "scene.png")
    for name, to in (("scene.png", "scene.png"), ("labels.png", "scene_labels.png")):
        with Image.open(scene_files / name) as whole:
            whole.crop((0, 0, 64, 48)).save(tmp_path / to)
    tradeoff(scene=scene, weights=weights, out=tmp_path / "out", repeats=1)
    parts, scans = json.loads((tmp_path / "out" / "tradeoff.json").read_text())["tradeoffs"]
    assert parts["stage"] == "segment"
    assert scans["stage"] == "survey"
    assert all(0 <= point["error"] <= 1 and point["bytes"] > 0 for one in (parts, scans) for point in one["points"])
    asked = {"scene": scene, "weights": str(weights), "out": str(tmp_path / "a"), "engine": "plain"}
    surveyed = run_survey(load_settings(None, asked), QUIET)
    errors = {point["setting"]: point["error"] for point in parts["points"]}
    assert errors[1.0] == pytest.approx(1 - surveyed.receipt["accuracy"]["miou"], abs=1e-3)


def test_a_scene_without_labels_has_no_tradeoff(scene_files: Path, weights: Path, tmp_path: Path) -> None:
    """One message asks for a label file beside the scene."""
    shutil.copy(scene_files / "scene.png", tmp_path / "bare.png")
    with pytest.raises(SceneError, match="has no labels by which a map could be judged; lay a label file beside it"):
        stages.plan_fractions(0, str(tmp_path / "bare.png"), weights)
