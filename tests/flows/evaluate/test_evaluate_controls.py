"""Controls of an evaluation: which rows they give, which of them is the baseline, and which are refused."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from flows.evaluate.command import evaluate_weights, run_evaluate
from flows.evaluate.frames import EvaluateRequest, open_candidates
from flows.evaluate.plots import evaluation_figure
from flows.evaluate.rows import open_controls
from flows.evaluate.series import Row
from flows.evaluate.summary import choose_baseline
from models.weights.files import save_weights
from pipeline.errors import SceneError, SettingsError
from tests.flows.small_fields import FRAMES, QUICK, scene_at, write_weights
from tests.models.conftest import make_any_weights

DESIGNS = ("paper", "dense", "upsampled", "coarser")


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
