"""The weights that come with SpectralZoom are small and good."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flows.settings.load import load_settings
from flows.tasks.run import open_run
from flows.tasks.stages.accuracy import columns_of_all_patches
from flows.tasks.survey_model import UNIFORM_STEPS, shipped_weights, weights_offered, weights_path
from models.evaluation.metrics import mean_iou
from models.evaluation.placement import Controls, run_controls
from models.reading.inference import coarse_prediction
from models.weights.files import Weights, describe_weights, load_weights
from pipeline.errors import BudgetError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.planning.coverage import coarse_sweeps, full_sweeps
from pipeline.planning.uniform_scans import ScanPerformance
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
    columns = columns_of_all_patches(
        source, full_sweeps(grid, camera, "x"), grid, weights, memory=2**30, resampling="catmull-rom"
    )
    seen = coarse_prediction(weights, mosaic, scene.wavelength_nm, grid)
    return run_controls(weights, seen, columns, np.asarray(scene.labels), fraction=0.35, seed=41)


def test_file_is_small_and_tells_its_making(weights: Weights) -> None:
    """The key that its products know, at most 8 MB; command, seed, law of the data, figures of unseen scenes."""
    assert describe_weights(PATH).key == "1e1fce42c3bb18c27d7d"
    assert PATH.stat().st_size <= 8e6
    assert weights.record["command"].startswith("spectralzoom train farm")
    assert weights.record["data"] == FARM_LAW
    assert weights.record["settings"]["seed"] == 0
    assert weights.record["validation"]["entropy"]["miou"] > 0.8
    assert weights.class_names == tuple(entry for entry in CLASSES)
    split = weights.record["split"]
    assert not set(split["train"]) & set(split["validation"])


def test_plain_scans_have_weights_of_their_own() -> None:
    """Their coarse pixels are 2 px wide; what they know of scans is what surveys take them for."""
    plain, two_passes = (describe_weights(shipped_weights(plain=which)) for which in (True, False))
    assert (plain.config.factor, two_passes.config.factor) == (2, 4)
    assert plain.class_names == two_passes.class_names
    assert ScanPerformance.read(plain.record["scans"]).steps == UNIFORM_STEPS
    assert all(plain.config.factor % step == 0 for step in UNIFORM_STEPS)
    assert set(two_passes.record["split"]["validation"]) == set(plain.record["split"]["validation"])


@pytest.mark.parametrize(
    ("asked", "plain"),
    [
        ({"budget": "0.5"}, [False]),
        ({"scan_step": "1"}, [True]),
        ({"scan_step": "2", "macs": "25%"}, [True]),
        ({"scan_step": "4"}, [False]),
        ({"seconds": "9"}, [True, False]),
    ],
)
def test_the_look_says_which_weights_read_it(asked: dict[str, str], plain: list[bool]) -> None:
    """One's own are taken for all; of the house's those that know lines so far apart."""
    assert weights_offered(load_settings(None, asked)) == tuple(shipped_weights(plain=which) for which in plain)
    own = load_settings(None, {**asked, "weights": "mine.safetensors"})
    assert weights_offered(own) == (Path("mine.safetensors"),)


@pytest.mark.parametrize(("seconds", "factor", "step"), [(3.5, 2, 2), (2.4, 4, 4)])
def test_who_has_few_seconds_gets_the_weights_that_read_fewer_lines(
    tmp_path: Path, seconds: float, factor: int, step: int
) -> None:
    """Every 2nd line of 640 x 512 px takes 2.6 s at least; in less every 4th is read by those that know it."""
    run = open_run(
        load_settings(None, {"seconds": str(seconds), "size": "640x512", "out": str(tmp_path)}), planning=True
    )
    assert (run.described.config.factor, run.settings.scan_step) == (factor, step)
    assert weights_path(run.settings) == shipped_weights(plain=factor == 2)
    assert run.settings.weights is None


def test_seconds_that_no_weights_have_a_scan_for_are_refused(tmp_path: Path) -> None:
    """With the least of those weights that read the fewest lines."""
    asked = load_settings(None, {"seconds": "1", "size": "640x512", "out": str(tmp_path / "a")})
    with pytest.raises(BudgetError, match=r"--seconds 1; the least is .*every 4th line"):
        open_run(asked)
    assert not (tmp_path / "a").exists()


def test_detail_where_the_map_is_unsure_beats_chance(controls: Controls) -> None:
    """At K = 35 % entropy is above random by more than its spread, and more than half of the way to all."""
    rows = controls.as_dict()
    assert rows["entropy"]["miou"] > rows["random"]["miou"] + rows["random"]["spread"]
    none, every = mean_iou(controls.none), mean_iou(controls.every)
    assert every - none > 0.05
    assert mean_iou(controls.policies["entropy"]) > (none + every) / 2
