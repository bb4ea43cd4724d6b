"""The map that a survey draws in its seconds, beside what anybody would do with them: plain scans, exposed shorter.

A plain scan takes every line, every second or every fourth, not binned, with one exposure; its whole picture is read.
Surveys are those of the command, with the coarse pass as long exposed as the fine one or half as long. Farms that
training never saw, each with noise of its own.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from measure import Row
from numpy.typing import NDArray
from rich.console import Console

from flows.publish.survey_command import run_survey
from flows.settings.load import load_settings
from flows.training.look import chosen_effects
from models.evaluation.metrics import agreement, confusion
from models.network.spectral import patches_of
from models.reading.inference import glance_of_columns, segment
from models.weights.files import Weights, load_weights
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid, pad_by_reflection
from pipeline.geometry.scan import CostModel, Sweep
from pipeline.planning.coverage import cheapest_full, coarse_sweeps
from pipeline.rectify.placed import PixelGrid, place
from pipeline.rectify.region import column_reach, mosaic_tile
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.farm.farm_scene import farm_scene
from pipeline.simulator.scenes.scene import RasterScene
from pipeline.simulator.simulated import SimulatedSource, SimulatedSweep, sweep_starts

SHAPE, SEEDS = (512, 640), (1, 2, 3)
CAMERA, COST = LineCamera(), CostModel()
STEPS, EXPOSURES_MS = (1, 2, 4), (100.0, 50.0, 25.0, 12.0)
BUDGETS, COARSE_MS = (0.35, 0.5, 0.65), (100.0, 50.0)
WEIGHTS = Path(__file__).parents[2] / "models" / "shipped" / "farm.safetensors"
Judged = list[tuple[float, float]]  # seconds and mIoU of each farm


def rows() -> list[Row]:
    """Every plan by its seconds; a survey's goal is the best plain scan that takes no longer."""
    weights = load_weights(WEIGHTS)
    plain: dict[str, Judged] = {}
    for step in STEPS:
        for exposure_ms in EXPOSURES_MS:
            every = {1: "every line", 2: "every 2nd line", 4: "every 4th line"}[step]
            plain[f"{every}, {exposure_ms:g} ms"] = [_plain(weights, seed, step, exposure_ms) for seed in SEEDS]
    surveys = {
        f"survey, budget {budget:g}, coarse lines {exposure_ms:g} ms": [
            _survey(seed, budget, exposure_ms) for seed in SEEDS
        ]
        for budget in BUDGETS
        for exposure_ms in COARSE_MS
    }
    found = [(_seconds(one), Row(name, _figure(one))) for name, one in plain.items()]
    for name, one in surveys.items():
        best, by = max((_mean(other), said) for said, other in plain.items() if _seconds(other) <= _seconds(one))
        goal, met = f">= {best:.1f}, {by}", _mean(one) >= best
        found.append((_seconds(one), Row(name, _figure(one), goal, met)))
    return [row for _, row in sorted(found, key=lambda pair: pair[0])]


def _mean(judged: Judged) -> float:
    return float(np.mean([accuracy for _, accuracy in judged]))


def _seconds(judged: Judged) -> float:
    return float(np.mean([seconds for seconds, _ in judged]))


def _figure(judged: Judged) -> str:
    each = " ".join(f"{accuracy:.1f}" for _, accuracy in judged)
    return f"{_seconds(judged):.1f} s: {_mean(judged):.1f} mIoU ({each})"


def _plain(weights: Weights, seed: int, step: int, exposure_ms: float) -> tuple[float, float]:
    """Seconds of the camera and mIoU of the map of a plain scan."""
    scene, rig = farm_scene(seed, SHAPE, camera=CAMERA), Rig(CAMERA)
    grid = SceneGrid(*SHAPE, weights.config.patch, weights.config.factor)
    along, sweeps, _ = cheapest_full(grid, CAMERA, COST)
    if step > 1:
        sweeps = coarse_sweeps(replace(grid, factor=step), CAMERA, along)
    sweeps = [replace(sweep, binning=1, exposure_ms=exposure_ms) for sweep in sweeps]
    chosen = chosen_effects(scene, rig, sweeps)
    source = SimulatedSource(scene, rig, seed, chosen, clock=sweep_starts(sweeps, CAMERA, COST))
    seen = _seen(weights, source, sweeps, grid)
    small = seen.reshape(len(seen) // grid.factor, grid.factor, -1, grid.factor, seen.shape[-1]).mean(axis=(1, 3))
    valid = grid.valid_seats()
    drawn = segment(weights, glance_of_columns(weights, small, grid), patches_of(seen, grid.patch)[valid], valid)
    return COST.seconds(sweeps, CAMERA), _judged(scene, drawn.classes, weights)


def _seen(weights: Weights, source: SimulatedSource, sweeps: list[Sweep], grid: SceneGrid) -> NDArray[np.float32]:
    """The rectified scan in the weights' columns, on the padded grid."""
    pixels = PixelGrid.of_scene(grid, 1)
    placed = [place(SimulatedSweep(source, sweep), CAMERA) for sweep in sweeps]
    rows, columns = (slice(0, size) for size in pixels.shape)
    reach = column_reach(placed, CAMERA, pixels, columns)
    values, _ = mosaic_tile(placed, CAMERA, pixels, rows, columns, reach=reach)  # at once: every line is made once
    return np.asarray(pad_by_reflection(weights.columns(values, source.wavelength_nm), grid.padded_shape), np.float32)


def _judged(scene: RasterScene, classes: NDArray[np.uint8], weights: Weights) -> float:
    assert scene.labels is not None
    counted = agreement(confusion(scene.labels, classes, weights.config.classes))
    return 100 * float(counted["miou_of_shown_classes"])


def _survey(seed: int, budget: float, coarse_ms: float) -> tuple[float, float]:
    """Seconds of the camera and mIoU of the map of the command's survey."""
    with tempfile.TemporaryDirectory() as out:
        given = {
            "scene": "farm",
            "size": f"{SHAPE[0]}x{SHAPE[1]}",
            "seed": str(seed),
            "budget": str(budget),
            "coarse_exposure_ms": str(coarse_ms),
            "engine": "plain",
            "controls": False,
            "out": out,
        }
        receipt = run_survey(load_settings(None, given), Console(quiet=True)).receipt
    return receipt["savings"]["capture_s"]["done"], 100 * receipt["accuracy"]["miou_of_shown_classes"]
