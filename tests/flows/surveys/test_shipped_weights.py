"""The shipped weights: their size, their record and their accuracy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from spectralzoom.flows.opening.open_field import open_field
from spectralzoom.flows.opening.survey_model import shipped_weights, weights_path
from spectralzoom.flows.planning.plan_survey import plan_survey
from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.flows.tradeoff import coarse_of_sweeps
from spectralzoom.models.evaluation.metrics import mean_iou
from spectralzoom.models.policies.placement import ReadTwice
from spectralzoom.models.weights.files import Weights, describe_weights, load_weights
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.planning.coverage import frame_patches, full_sweeps
from spectralzoom.pipeline.planning.uniform_scans import ScanPerformance
from spectralzoom.pipeline.simulator.rig_model import Rig
from spectralzoom.pipeline.simulator.scenes.farm.farm_plan import CLASSES
from spectralzoom.pipeline.simulator.scenes.farm.farm_scene import farm_scene
from spectralzoom.pipeline.simulator.scenes.laws import FARM_LAW, SCOUTING_LAW, TRIAL_LAW
from spectralzoom.pipeline.simulator.simulated import SimulatedSource, SimulatedSweep

PATH = shipped_weights()
SHAPE = (512, 640)  # smaller farms have too few pixels of rare classes to rank policies


@pytest.fixture(scope="module")
def weights() -> Weights:
    """Return the shipped weights."""
    return load_weights(PATH)


def test_file_is_small_and_has_a_training_record(weights: Weights) -> None:
    """It has the known key and at most 3 MB; the record has command, seed, data, validation and scan performance."""
    assert describe_weights(PATH).key == "916c1d7c050485d932b9"
    assert PATH.stat().st_size <= 3e6
    assert weights.record["command"].startswith("spectralzoom train farm@2,scouting@1")
    assert weights.record["data"] == f"{FARM_LAW},{SCOUTING_LAW}"
    assert weights.record["settings"]["seed"] == 4
    assert weights.record["validation"]["entropy"]["miou"] > 0.8
    assert weights.class_names == tuple(entry for entry in CLASSES)
    split = weights.record["split"]
    assert not set(split["train"]) & set(split["validation"])
    assert ScanPerformance.read(weights.record["scans"]).steps == (1, 2, 4, 8)


def test_a_plan_expects_the_score_of_its_law(tmp_path: Path) -> None:
    """A scan of a trial scores less than one of a farm; a scene without a law has the table of all."""
    described = describe_weights(PATH)
    assert described.scans("unknown@1") == described.scans() == described.record["scans"]
    expected = {}
    for scene in ("farm", "trial"):
        asked = {"scene": scene, "size": "64x64", "scan_step": "1", "scan_exposure_ms": "12", "out": str(tmp_path)}
        plan = plan_survey(open_field(load_settings(None, asked), planning=True))
        expected[scene] = plan.scans.chosen.expected["mIoU"]
    for scene, law in (("farm", FARM_LAW), ("trial", TRIAL_LAW)):
        table = described.record["scans"]["by_law"][law]
        assert expected[scene] == pytest.approx(table["miou"][0][table["exposures_ms"].index(12.0)])
    assert expected["trial"] < expected["farm"] - 0.05


def test_weights_of_the_user_replace_the_shipped_ones() -> None:
    """One file is the default for every capture."""
    assert weights_path(load_settings(None, {"budget": "0.5"})) == PATH
    assert weights_path(load_settings(None, {"weights": "mine.safetensors"})) == Path("mine.safetensors")


def test_reading_by_expected_gain_beats_random_patches(weights: Weights) -> None:
    """With K = 35 % its mIoU exceeds random by more than the spread, and closes over 70 % of the gap to all."""
    camera = LineCamera()
    scene = farm_scene(41, SHAPE)  # outside of the training
    grid = SceneGrid(*SHAPE, weights.config.patch)
    source = SimulatedSource(scene, Rig(camera), 41)
    sweeps = [SimulatedSweep(source, sweep) for sweep in full_sweeps(grid, camera, "x")]  # by the rig's exact rays
    seen = coarse_of_sweeps(sweeps, camera, source.wavelength_nm, grid, weights)
    twice = ReadTwice.of(weights, seen, np.asarray(scene.labels))
    every = len(twice.gain)
    some = {number: np.zeros(every, np.bool_) for number in range(6)}
    for number, chosen in some.items():  # by expected gain, then at random
        scores = twice.gain if number == 0 else np.random.default_rng(number).random(every)
        chosen[frame_patches(scores, 0.35)] = True
    gain, *random = (mean_iou(twice.counts(chosen, weights.config.classes)) for chosen in some.values())
    assert gain > np.mean(random) + np.std(random, ddof=1)
    ends = (np.zeros(every, np.bool_), np.ones(every, np.bool_))
    none, full = (mean_iou(twice.counts(chosen, weights.config.classes)) for chosen in ends)
    assert full > none
    assert gain > none + 0.7 * (full - none)
