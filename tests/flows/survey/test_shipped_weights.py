"""The weights that come with SpectralZoom: small, said how they were made, and good at what they are for."""

from __future__ import annotations

import numpy as np
import pytest

from flows.survey.run import shipped_weights
from flows.survey.stages.accuracy import columns_of_all_seats
from models.evaluation.metrics import mean_iou
from models.evaluation.placement import Controls, run_controls
from models.reading.inference import glance
from models.weights.files import Weights, content_key, describe_weights, load_weights
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.planning.coverage import coarse_sweeps, full_sweeps
from pipeline.rectify.region import mosaic_rows
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.farm.farm_plan import CLASSES
from pipeline.simulator.scenes.farm.farm_scene import FARM_LAW, farm_scene
from pipeline.simulator.simulated import SimulatedSource, SimulatedSweep

PATH = shipped_weights()
SHAPE = (512, 640)  # smaller farms hold too few pixels of rare classes to rank placements by them


@pytest.fixture(scope="module")
def weights() -> Weights:
    """The shipped weights."""
    return load_weights(PATH)


@pytest.fixture(scope="module")
def controls(weights: Weights) -> Controls:
    """Placements judged on a farm that training has not seen, through the exact rays of the simulated rig."""
    camera, scene = LineCamera(), farm_scene(41, SHAPE)
    grid = SceneGrid(*SHAPE, weights.config.patch, weights.config.factor)
    source = SimulatedSource(scene, Rig(camera), 41)
    coarse = [SimulatedSweep(source, sweep) for sweep in coarse_sweeps(grid, camera, "x")]
    mosaic = np.concatenate([rows for _, rows, _ in mosaic_rows(coarse, camera, grid, rows=64)])
    columns = columns_of_all_seats(
        source, full_sweeps(grid, camera, "x"), grid, weights, memory=2**30, kernel="catmull-rom"
    )
    seen = glance(weights, mosaic, scene.wavelength_nm, grid)
    return run_controls(weights, seen, columns, np.asarray(scene.labels), share=0.35, seed=41)


def test_file_is_sealed_and_its_key_is_that_of_before() -> None:
    """Every tensor has its hash; what was made with these weights before they had is still theirs."""
    assert describe_weights(PATH).sealed
    assert content_key(PATH) == "8ea1bd282d34bea7e1a8"


def test_file_is_small_and_tells_its_making(weights: Weights) -> None:
    """At most 8 MB, with command, seed, law of the data and validation figures."""
    assert PATH.stat().st_size <= 8e6
    assert weights.record["command"].startswith("spectralzoom train farm")
    assert weights.record["data"] == FARM_LAW
    assert weights.record["settings"]["seed"] == 0
    assert weights.record["validation"]["entropy"]["miou"] > 0.8
    assert weights.class_names == tuple(entry for entry in CLASSES)


def test_validation_scenes_were_not_trained_on(weights: Weights) -> None:
    """No scene is in both lists of the split."""
    split = weights.record["split"]
    assert not set(split["train"]) & set(split["validation"])


def test_detail_where_the_map_is_unsure_beats_chance(controls: Controls) -> None:
    """At K = 35 % entropy is above random by more than the spread of five random placements."""
    rows = controls.as_dict()
    assert rows["entropy"]["miou"] > rows["random"]["miou"] + rows["random"]["spread"]


def test_a_third_of_the_seats_is_nearer_to_all_than_to_none(controls: Controls) -> None:
    """At K = 35 % the map by entropy closes more than half of the way from no detail to all detail."""
    none, every = mean_iou(controls.none), mean_iou(controls.every)
    assert every - none > 0.05
    assert mean_iou(controls.policies["entropy"]) > (none + every) / 2
