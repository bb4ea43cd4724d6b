"""The weights that come with SpectralZoom are small and good."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flows.settings.load import load_settings
from flows.tasks.run import open_run
from flows.tasks.survey_model import shipped_weights, weights_path
from flows.tradeoff.store import coarse_of_sweeps
from models.evaluation.metrics import mean_iou
from models.evaluation.placement import Placements, ReadTwice, placement_figures, run_controls
from models.weights.files import Weights, describe_weights, load_weights
from pipeline.errors import BudgetError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.planning.coverage import full_sweeps
from pipeline.planning.uniform_scans import ScanPerformance
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.built_in import SCOUTING_LAW
from pipeline.simulator.scenes.farm.farm_plan import CLASSES
from pipeline.simulator.scenes.farm.farm_scene import FARM_LAW, farm_scene
from pipeline.simulator.simulated import SimulatedSource, SimulatedSweep

PATH = shipped_weights()
SHAPE = (512, 640)  # smaller farms hold too few pixels of rare classes to rank placements by them


@pytest.fixture(scope="module")
def weights() -> Weights:
    """The shipped weights."""
    return load_weights(PATH)


def placements(weights: Weights) -> Placements:
    """Placements judged on a farm that training has not seen, through the exact rays of the simulated rig."""
    camera, scene = LineCamera(), farm_scene(41, SHAPE)
    grid, source = SceneGrid(*SHAPE, weights.config.patch), SimulatedSource(scene, Rig(camera), 41)
    sweeps = [SimulatedSweep(source, sweep) for sweep in full_sweeps(grid, camera, "x")]
    seen = coarse_of_sweeps(sweeps, camera, source.wavelength_nm, grid, weights)
    twice = ReadTwice.of(weights, seen, np.asarray(scene.labels))
    return run_controls(twice, weights.config.classes, fraction=0.35, seed=41)


def test_file_is_small_and_tells_its_making(weights: Weights) -> None:
    """The key that its products know, at most 3 MB; command, seed, law of the data, figures of scenes and scans."""
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


@pytest.mark.parametrize("asked", [{"budget": "0.5"}, {"scan_step": "4"}, {"seconds": "9"}, {}])
def test_one_file_reads_every_capture(asked: dict[str, str]) -> None:
    """One's own are taken for all."""
    assert weights_path(load_settings(None, asked)) == shipped_weights()
    assert weights_path(load_settings(None, {**asked, "weights": "mine.safetensors"})) == Path("mine.safetensors")


def test_seconds_that_no_scan_ends_in_are_refused(tmp_path: Path) -> None:
    """With the least."""
    asked = load_settings(None, {"seconds": "0.5", "size": "640x512", "out": str(tmp_path / "a")})
    with pytest.raises(BudgetError, match=r"--seconds 0.5; the least is .*every 8th line"):
        open_run(asked)
    assert not (tmp_path / "a").exists()


def test_a_full_reading_where_the_map_is_unsure_beats_chance(weights: Weights) -> None:
    """At K = 35 % expected gain is above random by more than its spread, and most of the way to all."""
    controls = placements(weights)
    rows = placement_figures(controls)
    assert rows["gain"]["miou"] > rows["random"]["miou"] + rows["random"]["spread"]
    none, every = mean_iou(controls["none"][0]), mean_iou(controls["all"][0])
    assert every > none
    assert mean_iou(controls["gain"][0]) > none + 0.7 * (every - none)
