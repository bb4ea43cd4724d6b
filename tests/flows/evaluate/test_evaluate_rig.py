"""Evaluations over seconds of capture: plans of the rig at equal seconds, and the exposure of equal time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from flows.evaluate.costs import plan_seconds
from flows.evaluate.frames import Look
from flows.evaluate.plots import rig_figure
from flows.evaluate.rig_plans import BUDGETS, camera_of_equal_time, judge_equal_time, judge_rig
from flows.evaluate.rows import Trial, judge_frame
from flows.evaluate.summary import summarise_equal_time, summarise_rig
from flows.evaluate.table import budget_tables
from models.evaluation.metrics import mean_iou
from models.weights.files import Weights
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import CostModel
from tests.flows.small_fields import looked_at, scene_at, write_field

# a narrow line, so that small frames take several strips, and a rig that is quick to set up
CAMERA = LineCamera(samples=32)
COST = CostModel(slew_s=0.01, settle_frames=0.5, capture_start_s=0.01, reload_s=0.0)
TRIAL = {"shares": (0.05,), "policies": ("entropy",), "seed": 0, "draws": 10}


@pytest.fixture(scope="module")
def looked(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Look, Weights]:
    """A frame of 48 x 64 px as small weights see it."""
    folder = tmp_path_factory.mktemp("rig")
    data = write_field(folder / "field", (48, 64))
    return data, *looked_at(data, folder / "w.safetensors", factor=4, seed=1)


@pytest.fixture(scope="module")
def record(looked: tuple[Path, Look, Weights]) -> dict[str, Any]:
    """The frame judged in rig mode."""
    return judge_rig(looked[1], looked[2], CAMERA, COST, 0)


def test_no_plan_takes_more_than_its_budget(record: dict[str, Any]):
    """Each plan that pays for the coarse pass is within its seconds; ours stands against both others."""
    assert record["rows"]
    for row in record["rows"]:
        assert row["seconds"] <= row["share"] * row["full_s"] * (1 + 1e-9)
        assert np.sum(row["counts"]) == 48 * 64
    plans = {(row["policy"], row["draw"]) for row in record["rows"]}
    assert len(plans) == 3 + 5
    assert len(record["rows"]) == len(plans) * (len(BUDGETS) - len(record["left_out"]))
    assert {plan for plan, _ in plans} == {
        row["policy"] for row in record["rows"] if row["share"] == 0.8 and row["seats"]
    }
    found = summarise_rig([[record, {**record, "frame": "002"}]], TRIAL)
    rows = {(row["policy"], row["budget"]): row for row in found["rows"]}
    budget = record["rows"][0]["share"]
    ours, even = rows["gain", budget], rows["uniform lines", budget]
    assert ours["against_uniform"]["difference"] == pytest.approx(ours["miou"] - even["miou"])
    assert ours["frames"] == 2
    assert even["against_uniform"] is None


def test_a_budget_below_the_coarse_pass_is_left_out(looked: tuple[Path, Look, Weights]):
    """With a word; where nothing fits, every budget is."""
    dear = replace(COST, capture_start_s=30.0)
    found = judge_rig(looked[1], looked[2], CAMERA, dear, 0)
    assert found["rows"] == []
    assert [one["budget"] for one in found["left_out"]] == list(BUDGETS)
    assert "the coarse pass alone" in found["left_out"][0]["why"]


def test_the_table_says_what_is_left_out(record: dict[str, Any], capsys: pytest.CaptureFixture[str]):
    """Rows of plans, and the budgets without one; the plot has a line for each plan."""
    missing = {**record, "frame": "002", "rows": [], "left_out": [{"budget": 0.1, "why": "too little"}]}
    rig = summarise_rig([[record, missing]] * 2, TRIAL)  # of two seeds the frame is one
    ends = [{"policy": name, "miou": 0.5, "thresholds": None} for name in ("none", "all")]
    content = {"dataset": "field", "frames": ["001"], "rig": rig, "equal_time": [], "rows": ends}
    for table in budget_tables(content):
        Console(width=200).print(table)
    shown = capsys.readouterr().out
    assert "uniform lines" in shown
    assert "left out on 1 frame, 10 %: too little" in shown
    labels = {line.get_label() for line in rig_figure(content).axes[0].lines}
    assert labels >= {"gain", "entropy", "uniform lines", "random lines", "all: every seat"}


def test_the_exposure_of_equal_time_takes_the_full_scans_seconds(looked: tuple[Path, Look, Weights]):
    """Set-ups do not grow with the exposure; what is found counts them."""
    look = looked[1]
    seats = look.seen.grid.valid_seats()[:4]
    exposed = camera_of_equal_time(look, CAMERA, COST, seats)
    before, full_s = plan_seconds(look, CAMERA, COST, seats)
    assert before < full_s
    assert exposed.exposure_ms > CAMERA.exposure_ms
    assert plan_seconds(look, exposed, COST, seats)[0] == pytest.approx(full_s, rel=0.01)


def test_equal_time_stands_beside_equal_exposure(looked: tuple[Path, Look, Weights]):
    """Each row has its exposure, and its differences to `all` and to the same row at equal exposure."""
    data, look, weights = looked
    trial = Trial((0.05,), ("entropy", "random"))
    longer = judge_equal_time(trial, scene_at(data), look, weights, CAMERA, COST)
    assert longer is not None
    usual = judge_frame(trial, look, weights)
    rig = {**longer, "rows": [{**one, "policy": "entropy"} for one in longer["rows"]]}
    row, chance, *plans = summarise_equal_time([[longer]], [[usual]], [[rig]], {**TRIAL, "policies": trial.policies})
    first = next(one for one in usual["rows"] if (one["policy"], one["draw"]) == ("random", 0))
    assert chance["equal_exposure_miou"] == pytest.approx(
        mean_iou(np.array(first["counts"]))
    )  # the draw that was exposed for longer
    assert row["exposure"] > 1
    assert row["seconds"] == pytest.approx(row["full_s"], rel=0.3)  # other seats than those the exposure was found for
    assert row["against_equal_exposure"]["difference"] == pytest.approx(row["miou"] - row["equal_exposure_miou"])
    assert plans
    for plan in plans:
        assert plan["policy"] == "entropy lines"
        assert plan["exposure"] == pytest.approx(1 / plan["share"])
        assert plan["seconds"] <= plan["full_s"] * (1 + 1e-9)
        assert plan["against_equal_exposure"]["difference"] == pytest.approx(0)
