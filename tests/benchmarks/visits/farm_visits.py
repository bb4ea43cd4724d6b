"""Visits to farms that no training saw, read by the shipped weights and by the memory that stands beside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from flows.tasks.survey_model import shipped_weights
from flows.tradeoff.stages import uniform_pass
from flows.training.observed_scenes import chosen_effects
from models.evaluation.metrics import confusion, mean_iou
from models.network.spectral import LineSpec
from models.network.temporal_reader import TemporalReader
from models.reading.inference import segment
from models.reading.prior_map import ClassProbabilities, CurrentVisit, PriorMap, first_probabilities, fuse, pooled
from models.training.capture_augmentation import REFERENCE_MS
from models.weights.files import Weights, load_reader, load_weights
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import CostModel
from pipeline.planning.coverage import cheapest_full, uniform_sweeps
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.farm.farm_scene import farm_scene
from pipeline.simulator.scenes.scene import RasterScene
from pipeline.simulator.simulated import SimulatedSource, sweep_starts

SHAPE, SEEDS = (512, 640), (1, 2, 3)  # pixels (y, x) of every farm, and most of the farms
CAMERA, COST = LineCamera(), CostModel()
ANEW, QUICK, REFERENCE = (1, 25.0), (2, 5.0), (1, 12.0)  # step and exposure [ms]
FIRST_DAY, HOUR = 172, 11.0
SEASON = [(110 + 6 * number, (11.0, 9.5, 13.0, 15.0)[number % 4]) for number in range(30)]
WEIGHTS = shipped_weights()
Classes = NDArray[np.uint8]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Seen:
    """A look at a farm: what it says, its true classes and the camera's seconds."""

    observation: CurrentVisit
    labels: Classes
    seconds: float

    def score(self, classes: Classes) -> float:
        """mIoU of a map of that day, in points."""
        return 100 * mean_iou(confusion(self.labels, classes, len(shipped().class_names)))

    @property
    def alone(self) -> Classes:
        """The map of this look alone."""
        return first_probabilities(self.observation).classes()[0]


@cache
def shipped() -> Weights:
    return load_weights(WEIGHTS)


@cache
def shipped_temporal() -> TemporalReader:
    return load_reader(WEIGHTS)


def view_farm(seed: int, day: int, hour: float, how: tuple[int, float], noise: int = 0) -> Seen:
    """Scan a farm as it is on a day, read by the shipped weights."""
    scene = farm_scene(seed, SHAPE, camera=CAMERA, day=day, hour=hour)
    return seen_by(scene, seed + 1000 * day + 100_000_000 * noise, how)


def seen_by(scene: RasterScene, seed: int, how: tuple[int, float]) -> Seen:
    weights, (step, exposure_ms), rig = shipped(), how, Rig(CAMERA)
    grid = SceneGrid(*SHAPE, weights.config.patch, 1)
    along, _, _ = cheapest_full(grid, CAMERA, COST)
    sweeps = uniform_sweeps(grid, CAMERA, along, step=step, exposure_ms=exposure_ms)
    clock = sweep_starts(sweeps, CAMERA, COST)
    source = SimulatedSource(scene, rig, seed, chosen_effects(scene, rig, sweeps), clock=clock)
    scan_pass = uniform_pass(weights, source, sweeps, grid, COST, LineSpec(exposure_ms / REFERENCE_MS, step))
    drawn = segment(weights, scan_pass.coarse, scan_pass.columns, scan_pass.patch_index, every_class=True)
    assert drawn.log_probability is not None
    seen = np.ones(SHAPE, np.bool_)
    columns = pooled(scan_pass.coarse.columns)
    observation = CurrentVisit(drawn.log_probability, seen, columns, exposure_ms / REFERENCE_MS, step)
    return Seen(observation, np.asarray(scene.labels, np.uint8), scan_pass.seconds)


def later(
    before: Seen,
    probabilities: ClassProbabilities,
    now: Seen,
    days: float,
    *,
    reader: bool = True,
    comparable: bool = True,
) -> ClassProbabilities:
    """What is believed after a later look, whose spectra are ``comparable`` to those of before."""
    memory = PriorMap(probabilities, before.observation.coarse if comparable else None, days)
    return fuse(memory, now.observation, shipped_temporal() if reader else None)


def mean_figure(values: Sequence[float]) -> str:
    return f"{np.mean(values):.1f} mIoU ({' '.join(f'{value:.1f}' for value in values)})"
