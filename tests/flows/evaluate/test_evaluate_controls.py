"""Controls of an evaluation and plans of the rig at equal seconds: which rows they give, and which are refused."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from flows.evaluate.command import evaluate_weights, run_evaluate
from flows.evaluate.costs import plan_seconds
from flows.evaluate.frames import EvaluateRequest, Look, open_candidates
from flows.evaluate.plots import evaluation_figure, rig_figure
from flows.evaluate.rig_plans import BUDGETS, camera_of_equal_time, judge_equal_time, judge_rig
from flows.evaluate.rows import Trial, judge_frame, open_controls
from flows.evaluate.series import Row
from flows.evaluate.summary import choose_baseline, summarise_equal_time, summarise_rig
from flows.evaluate.table import budget_tables
from models.evaluation.metrics import mean_iou
from models.weights.files import Weights, save_weights
from pipeline.errors import SceneError, SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import CostModel
from tests.flows.small_fields import FRAMES, QUICK, looked_at, scene_at, write_field, write_weights
from tests.models.conftest import make_any_weights

DESIGNS = ("paper", "dense", "upsampled", "coarser")
# a narrow line, so that small frames take several strips, and a rig that is quick to set up
CAMERA = LineCamera(samples=32)
COST = CostModel(slew_s=0.01, settle_frames=0.5, capture_start_s=0.01, reload_s=0.0)
TRIAL = {"shares": (0.05,), "policies": ("entropy",), "seed": 0, "draws": 10}


@pytest.fixture(scope="module")
def judged(data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[EvaluateRequest, dict[str, Any]]:
    """Weights beside a control of every design."""
    folder = tmp_path_factory.mktemp("out")
    controls = tuple(write_weights(folder / f"{name}.safetensors", 3, name) for name in DESIGNS)  # type: ignore[arg-type]
    quick = {**QUICK, "timed_frames": 1, "policies": ("entropy", "sobel")}
    weights = (write_weights(folder / "w.safetensors"),)
    request = EvaluateRequest(str(data), weights, folder / "out", controls=controls, **quick)
    return request, evaluate_weights(request)


def test_every_control_has_its_rows(judged: tuple[EvaluateRequest, dict[str, Any]]):
    """The paper's network at every share, the others once; all with costs, none with a placement of its own."""
    rows = {(row["policy"], row["share"]): row for row in judged[1]["rows"] if row["control"]}
    assert list(rows) == [("paper", 0.25), ("paper", 0.5), ("dense", 1.0), ("upsampled", 0.0), ("coarser", 1.0)]
    for row in rows.values():
        assert 0 <= row["miou"] <= 1
        assert row["captured_gain"] is None
        assert row["cost"]["cpu_s"]["done"] is not None
        assert row["cost"]["multiply_adds"]["done"] > 0
    samples = {key: row["cost"]["samples"]["done"] for key, row in rows.items()}
    assert samples["dense", 1.0] == 24 * 40
    assert samples["upsampled", 0.0] == samples["coarser", 1.0] == 12 * 20
    assert rows["paper", 0.25]["cost"]["rig_s"]["done"] == _row(judged[1], "sobel", 0.25)["cost"]["rig_s"]["done"]


def _row(content: dict[str, Any], policy: str, share: float) -> dict[str, Any]:
    return next(row for row in content["rows"] if (row["policy"], row["share"]) == (policy, share))


def test_costs_and_differences_stand_beside_the_baseline(judged: tuple[EvaluateRequest, dict[str, Any]]):
    """The better of `all` and the dense control has ratios of 1 and no difference to itself."""
    content = judged[1]
    base, every = content["baseline"]["policy"], _row(content, "all", 1.0)
    dense = _row(content, "dense", 1.0)
    assert base == ("dense" if dense["miou"] > every["miou"] else "all")
    row = _row(content, base, 1.0)
    assert row["against_baseline"] is None
    assert row["cost"]["multiply_adds"]["ratio"] == row["cost"]["cpu_s"]["ratio"] == 1
    entropy = _row(content, "entropy", 0.25)
    assert entropy["against_baseline"]["difference"] == pytest.approx(entropy["miou"] - row["miou"])


def test_controls_are_kept_and_printed(judged: tuple[EvaluateRequest, dict[str, Any]], capsys: Any):
    """The same command judges nothing anew, and its tables name the designs and the frames they cover."""
    again = run_evaluate(judged[0], Console(stderr=True))
    assert [row["miou"] for row in again["rows"]] == [row["miou"] for row in judged[1]["rows"]]
    shown = capsys.readouterr().out
    for words in ("control coarser, coarser.safetensors: 3 frames: 001, 002, 003", "baseline: ", "upsampled"):
        assert words in shown


def _counted(right: tuple[int, ...]) -> Row:
    counts = np.array([[[[hit, 10 - hit], [0, 10]] if hit else [[0, 0], [0, 0]] for hit in right]])
    return Row("dense", 1.0, counts, counts, counts, np.zeros(1, np.intp), [])


@pytest.mark.parametrize(
    ("dense", "base", "why"),
    [
        ((9, 9), "dense", "points above all"),
        ((3, 3), "all", "points below all"),
        ((9, 0), "all", "was trained on 1 of the frames"),
    ],
)
def test_the_baseline_is_the_better_one(dense: tuple[int, ...], base: str, why: str):
    """A control that lacks frames cannot be it, however good it is on the others."""
    rows = {("all", 1.0): replace(_counted((6, 6)), policy="all"), ("dense", 1.0): _counted(dense)}
    row, words = choose_baseline(rows, {"draws": 5, "seed": 0})
    assert row.policy == base
    assert why in words


def test_controls_that_do_not_fit_are_refused(data: Path, tmp_path: Path):
    """Weights of two scales, other classes, other sizes of one design, and a file given twice."""
    ours = open_candidates((write_weights(tmp_path / "w.safetensors"),))
    again = write_weights(tmp_path / "again.safetensors", 1)
    dense = write_weights(tmp_path / "dense.safetensors", 0, "dense")
    wide, other = tmp_path / "wide.safetensors", tmp_path / "other.safetensors"
    sized = make_any_weights(classes=2, columns=3, design="dense", width=16)
    save_weights(replace(sized, class_names=("soil", "crop")), wide)
    save_weights(make_any_weights(classes=2, columns=3, design="dense"), other)
    for paths, words in (
        ((again,), "is of two scales, and no control"),
        ((other,), "has other classes than"),
        ((dense, wide), "both dense and differ in sizes"),
        ((dense, dense), "given twice in --control"),
    ):
        with pytest.raises(SettingsError, match=words):
            open_controls(paths, ours)
    with pytest.raises(SettingsError, match="holds the control 'dense'; give it as --control"):
        open_candidates((dense,))


def test_a_control_is_judged_on_frames_it_never_saw(data: Path, tmp_path: Path):
    """Frames that taught it are left out of its rows; when none is left that is said."""
    weights = (write_weights(tmp_path / "w.safetensors"),)
    keys = {name: scene_at(data, name).key for name in FRAMES}
    part = write_weights(tmp_path / "part.safetensors", 1, "dense", split={"train": {"001": keys["001"]}})
    quick = {**QUICK, "timed_frames": 0}
    content = evaluate_weights(EvaluateRequest(str(data), weights, controls=(part,), **quick))
    assert _row(content, "dense", 1.0)["frames"] == 2
    assert _row(content, "dense", 1.0)["against_all"]["frames"] == 2
    assert content["baseline"]["policy"] == "all"
    every = write_weights(tmp_path / "every.safetensors", 2, "dense", split={"train": keys})
    with pytest.raises(SceneError, match=r"the control .*every.safetensors was trained on all 3 .* --hold-out NAMES$"):
        evaluate_weights(EvaluateRequest(str(data), weights, controls=(every,), **quick))


def test_a_control_far_below_does_not_squeeze_the_plot(judged: tuple[EvaluateRequest, dict[str, Any]]) -> None:
    """It is an arrow at the lower edge with its figure; the axis is that of the weights."""
    content = deepcopy(judged[1])
    own = [row for row in content["rows"] if not row["control"]]
    for number, row in enumerate(own):
        row["miou"] = 0.7 + 0.001 * number
    for row in content["rows"]:
        row["miou"] = 0.1 if row["control"] else row["miou"]
    content["baseline"]["policy"] = "all"  # the better of it and the dense control
    axes = evaluation_figure(content).axes[-1]
    assert axes.get_ylim()[0] > 69
    assert "coarser 10.0" in [text.get_text() for text in axes.texts]


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
