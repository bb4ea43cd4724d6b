"""Training of a temporal reader: its training data, its record, and the requests that it refuses."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import spectralzoom.flows.training.train_temporal as remember
from spectralzoom.flows.cli.model_verbs import run_training
from spectralzoom.flows.opening.survey_model import shipped_weights
from spectralzoom.flows.settings.model_flags import TrainFlags
from spectralzoom.flows.training.train_scenes import TrainRequest
from spectralzoom.flows.training.train_temporal import _moments, run_remember, train_temporal
from spectralzoom.models.evaluation.metrics import confusion, mean_iou
from spectralzoom.models.network.sizes import TemporalSizes
from spectralzoom.models.reading.prior_map import CurrentVisit, PriorMap, first_probabilities, fuse
from spectralzoom.models.training.temporal import PastPass, TemporalTraining, Visit, train_reader
from spectralzoom.models.weights.files import describe_weights, load_reader
from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.pipeline.simulator.render import USUAL
from tests.conftest import QUIET

QUICK: dict[str, Any] = {"minutes": 0.5, "steps": 2, "scenes": 1}


def test_reader_learns_to_distrust_a_prior_map() -> None:
    """Each class turns into the next between two visits: after one step the prior map stays, after 20 it is left.

    The later visit has 60 % of the labels right. Further training without time changes nothing.
    """
    rng = np.random.default_rng(0)
    classes = 3
    lands = []
    seen = np.ones((64, 64), np.bool_)
    coarse = np.zeros((32, 32, 4), np.float32)
    for _ in range(4):
        labels = rng.integers(0, classes, (64, 64), dtype=np.uint8)
        visits = []
        for day, right, step in ((1.0, 0.95, 1), (4.0, 0.6, 4)):
            said = np.where(rng.random(labels.shape) < right, labels, rng.integers(0, classes, labels.shape))
            probability = np.full((*labels.shape, classes), 0.1, np.float16)
            np.put_along_axis(probability, said[..., None], np.float16(0.8), axis=-1)
            visits.append(Visit(day, labels, [PastPass(step, 0.25, probability, coarse.astype(np.float16))]))
            labels = (labels + 1) % np.uint8(classes)
        lands.append(visits)
    images = [np.log(visit.scan_passes[0].probability.astype(np.float32)) for visit in lands[0]]
    before, now = (CurrentVisit(image, seen, coarse, 0.25, step) for image, step in zip(images, (1, 4), strict=True))
    quick = TemporalTraining(batch=2, visits=2, learning_rate=0.1, average=0.5)
    readers, steps = zip(*(train_reader(lands, replace(quick, steps=most)) for most in (1, 20)), strict=True)
    assert steps == (1, 20)
    fused = [fuse(PriorMap(first_probabilities(before), coarse, 3.0), now, reader) for reader in readers]
    scores = [
        mean_iou(confusion(lands[0][1].labels, one.classes()[0], classes))
        for one in (first_probabilities(before), first_probabilities(now), *fused)
    ]
    assert scores[2:] == pytest.approx(scores[:2], abs=0.01)
    assert scores[1] > scores[0] + 0.3
    again, none = train_reader(lands, TemporalTraining(minutes=1e-9, visits=2), start=readers[1])
    assert none == 0
    for one, other in zip(again.parameters(), readers[1].parameters(), strict=True):
        assert torch.equal(one, other)


def test_visit_days_are_in_order() -> None:
    """Each land has five visits on ascending days, all within the farm's season."""
    for seed in range(40):
        days = [day for day, _ in _moments(np.random.default_rng(seed))]
        assert days == sorted(days)
        assert len(days) == 5
        assert 95 <= days[0] < 290
        assert days[-1] <= 318


def test_the_command_trains_and_writes_its_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The reader belongs to the given weights; its record has seeds, settings and validation on another land."""
    # choosing takes seconds
    monkeypatch.setattr("spectralzoom.models.training.examples.chosen_effects", lambda *_: USUAL)
    monkeypatch.setattr(remember, "VISITS", 2)
    for name, value in {"JUDGED_AFTER": (3,), "JUDGED_LANDS": 1, "SHAPE": (64, 96)}.items():
        monkeypatch.setattr(remember, name, value)
    out = tmp_path / "farm.safetensors"
    weights = shipped_weights()
    request = TrainRequest("farm", out, TrainFlags(train_temporal=weights, **QUICK), "spectralzoom train")
    record = run_remember(request, QUIET)
    assert describe_weights(out).key == describe_weights(weights).key
    assert dict(describe_weights(out).reader.record) == record
    assert record["started_from"] == describe_weights(weights).reader.key
    assert (record["lands"], record["steps"], record["command"]) == ([200_000], 2, "spectralzoom train")
    assert [row["days"] for row in record["validation"]] == [3.0]
    for row in record["validation"]:
        assert row["prior_map"] > row["extent"] - 0.05  # after little training it relies on the prior map


@pytest.mark.parametrize(
    ("dataset", "out", "why"),
    [
        ("frames", "x.safetensors", "expected farm, the only data set with several days of one land"),
        ("farm", "no/x.safetensors", "expected the name of a file in a folder that exists"),
        ("farm", "x.safetensors", "in a folder that exists and can be written"),
    ],
)
def test_untrainable_requests_are_refused(
    tmp_path: Path, dataset: str, out: str, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Data other than the farm and a missing or read-only folder are refused before imaging."""
    monkeypatch.setattr(os, "access", lambda path, mode: path != tmp_path)
    with pytest.raises(SettingsError, match=why):
        train_temporal(TrainRequest(dataset, tmp_path / out, TrainFlags(train_temporal=shipped_weights())))


def test_weights_of_other_classes_are_refused(tmp_path: Path, weights: Path) -> None:
    """The reader is trained on the farm, so the weights need the farm's classes."""
    with pytest.raises(SettingsError, match="expected weights of the farm's classes, soil, maize"):
        train_temporal(TrainRequest("farm", tmp_path / "x.safetensors", TrainFlags(train_temporal=weights)))


def test_the_shipped_weights_have_a_reader() -> None:
    """Its record lists training lands of its own, with seeds from 200,000 up, and its sizes fit the weights."""
    weights = shipped_weights()
    found = describe_weights(weights).reader
    assert min(found.record["lands"]) >= 200_000
    assert found.sizes == load_reader(weights).sizes == TemporalSizes(11, 24)


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        ({"seed": -1}, "--seed must be 0 or more, got -1"),
        ({"scenes": 0}, "--scenes must be above 0, got 0"),
        ({"steps": 0}, "--steps must be above 0, got 0"),
        ({"hold_out": "3"}, "--hold-out is not for --train-temporal; leave it out"),
    ],
)
def test_flags_are_checked_before_the_first_visit(tmp_path: Path, flags: dict[str, Any], words: str) -> None:
    """Counts out of range and flags for the training of all weights are refused."""
    asked = TrainFlags(train_temporal=shipped_weights(), **flags)
    with pytest.raises(SettingsError, match=words):
        run_training("farm", tmp_path / "w.safetensors", asked, "", QUIET)
