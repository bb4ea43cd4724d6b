"""The map of `survey --seconds` compared with uniform scans of shorter exposures or wider line spacings.

A uniform scan takes every line, every second or every fourth, without binning, with one exposure. All patches are read.
`survey --seconds` takes the scan with the highest expected mIoU in the weights' record, and is compared with all tried
scans. The farms are not in the training data, and each has its own noise. The last rows compare the expected mIoU of
all maps with the measured one.

`python tests/benchmarks/bench_frontier.py 1280x1024` draws only the map of `survey --seconds`, on larger farms,
by the shipped weights or by a file of weights.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from measure import Row

from flows.tasks.survey_model import shipped_weights
from flows.tradeoff.stages import PlannedPass, uniform_pass
from flows.training.observed_scenes import chosen_effects
from models.evaluation.expected_scores import MapScores, expected_counts
from models.evaluation.metrics import confusion, mean_iou
from models.network.spectral import LineSpec
from models.reading.inference import DrawnMap, segment
from models.weights.files import Weights, describe_weights, load_weights
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import CostModel
from pipeline.planning.coverage import cheapest_full, uniform_sweeps
from pipeline.planning.uniform_scans import MIOU, ScanPerformance, UniformScan, choose_scan, format_scan, uniform_scans
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.built_in import SCOUTING_LAW, built_in_scene
from pipeline.simulator.scenes.farm.farm_scene import farm_scene
from pipeline.simulator.scenes.scene import RasterScene
from pipeline.simulator.simulated import SimulatedSource, sweep_starts

SHAPE = (512, 640)
SEEDS = (1, 2, 3)
CAMERA = LineCamera()
COST = CostModel()
STEPS = (1, 2, 4)
EXPOSURES_MS = (100.0, 70.0, 50.0, 35.0, 25.0, 17.0, 14.0, 12.0, 10.0, 8.0, 6.0, 5.0, 4.0, 3.0)
FEWER_MS = (100.0, 25.0, 10.0, 6.0, 3.0)  # of scouting fields
SECONDS = (3.5, 5.0, 8.0, 15.0, 28.0)  # of surveys that choose their scan
SLACK = 0.3  # points of mIoU that such a survey may be below the best uniform scan
LARGE = {107.0: 95.0, 56.0: 94.5, 29.0: 94.1, 20.5: 93.6, 14.0: 92.5, 10.0: 91.0, 8.0: 88.3}  # goals for 1280 x 1024 px
BANDS = 270
RMS = 0.85  # goal of the expected mIoU [points]
WITHIN = 1.645  # standard errors, within which 90 % are
HELD = 0.9  # goal of the fraction within them


@dataclass(frozen=True)
class PlanMap:
    """Results of a plan: seconds of the camera, measured mIoU, expected mIoU and its error, in percent."""

    seconds: float
    miou: float
    expected: float = np.nan
    error: float = np.nan


Judged = list[PlanMap]  # one for each farm


def rows() -> list[Row]:
    """Return every plan by its seconds; a survey's goal is the best uniform scan of at most the same seconds."""
    plain = {
        format_scan(step, exposure_ms): [_plain(seed, step, exposure_ms) for seed in SEEDS]
        for step in STEPS
        for exposure_ms in EXPOSURES_MS
    }
    found = [(_seconds(one), Row(name, _figure(one))) for name, one in plain.items()]
    for seconds in SECONDS:
        scan = chosen_scan(SHAPE, seconds)
        judged = [_plain(seed, scan.step, scan.exposure_ms) for seed in SEEDS]
        found.append(_beside(plain, f"survey --seconds {seconds:g}: {_promise(scan)}", judged))
    of_farms = [one for judged in plain.values() for one in judged]
    of_scouting = [
        map_of(built_in_scene(SCOUTING_LAW, seed, SHAPE, camera=CAMERA), seed, step, exposure_ms)
        for seed in SEEDS
        for step in STEPS
        for exposure_ms in FEWER_MS
    ]
    told = [_told_row("farms", of_farms), _told_row("scouting", of_scouting)]
    return [row for _, row in sorted(found, key=lambda pair: pair[0])] + told


def _beside(plain: Mapping[str, Judged], what: str, one: Judged) -> tuple[float, Row]:
    """Return a survey's seconds and row; the goal is the best uniform scan of at most the same seconds, less SLACK."""
    best, by = max((_mean(other), said) for said, other in plain.items() if _seconds(other) <= _seconds(one) + 1e-9)
    goal = f">= {best - SLACK:.1f}, {by}, less {SLACK:g}"
    return _seconds(one), Row(what, _figure(one), goal, _mean(one) >= best - SLACK)


def _told_row(where: str, maps: Judged) -> Row:
    """Return the row that compares the expected mIoU of maps with their measured mIoU."""
    off = np.array([one.expected - one.miou for one in maps])
    held = np.abs(off) <= WITHIN * np.array([one.error for one in maps])
    rms = float(np.sqrt(np.mean(off**2)))
    figure = f"{rms:.2f} points rms, {off.mean():+.2f} in the mean, {100 * held.mean():.0f} % within their error"
    met = rms <= RMS and bool(held.mean() >= HELD)
    return Row(f"what {len(maps)} maps of {where} say of themselves", figure, f"<= {RMS:g} rms, {HELD:.0%} within", met)


def large_rows(shape: tuple[int, int], goals: dict[float, float], weights: Weights) -> Iterator[Row]:
    """Yield the rows of `survey --seconds` on farms of (y, x) px, each with its goal in mIoU."""
    for seconds, goal in goals.items():
        scan = chosen_scan(shape, seconds, weights)
        judged = [
            map_of(farm_scene(seed, shape, camera=CAMERA), seed, scan.step, scan.exposure_ms, weights) for seed in SEEDS
        ]
        yield Row(f"--seconds {seconds:g}: {_promise(scan)}", _figure(judged), f">= {goal}", _mean(judged) >= goal)


@cache
def shipped() -> Weights:
    """Return the weights that come with SpectralZoom."""
    return load_weights(shipped_weights())


def chosen_scan(shape: tuple[int, int], seconds: float, weights: Weights | None = None) -> UniformScan:
    """Return the scan that a survey of these seconds takes, by the shipped weights or others."""
    weights = weights or shipped()
    grid = SceneGrid(*shape, weights.config.patch)
    along, _, _ = cheapest_full(grid, CAMERA, COST)
    record = ScanPerformance.read(weights.record["scans"])
    sweeps = {step: uniform_sweeps(grid, CAMERA, along, step=step) for step in record.steps}
    return choose_scan(uniform_scans(record, sweeps, CAMERA, COST, BANDS, seconds=seconds), seconds)


def _promise(scan: UniformScan) -> str:
    return f"{scan.summary} (expected {100 * scan.expected[MIOU]:.1f})"


def _mean(judged: Judged) -> float:
    return float(np.mean([one.miou for one in judged]))


def _seconds(judged: Judged) -> float:
    return float(np.mean([one.seconds for one in judged]))


def _figure(judged: Judged) -> str:
    each = " ".join(f"{one.miou:.1f}" for one in judged)
    return f"{_seconds(judged):.1f} s: {_mean(judged):.1f} mIoU ({each})"


@cache
def scores() -> MapScores:
    """Return the calibration of the expected mIoU of the shipped weights."""
    ood_detector = describe_weights(shipped_weights()).ood_detector
    assert ood_detector is not None
    assert ood_detector.map_scores is not None
    return ood_detector.map_scores


@cache
def _plain(seed: int, step: int, exposure_ms: float) -> PlanMap:
    """Return the results of a farm's uniform scan."""
    return map_of(farm_scene(seed, SHAPE, camera=CAMERA), seed, step, exposure_ms)


def scanned(
    scene: RasterScene, weights: Weights, seed: int, step: int, exposure_ms: float
) -> tuple[PlannedPass, DrawnMap]:
    """Scan a scene uniformly; return the pass and its map with every patch read in full."""
    grid = SceneGrid(*scene.shape, weights.config.patch)
    rig = Rig(CAMERA)
    along, _, _ = cheapest_full(grid, CAMERA, COST)
    sweeps = uniform_sweeps(grid, CAMERA, along, step=step, exposure_ms=exposure_ms)
    chosen = chosen_effects(scene, rig, sweeps)
    source = SimulatedSource(scene, rig, seed, chosen, clock=sweep_starts(sweeps, CAMERA, COST))
    scan_pass = uniform_pass(weights, source, sweeps, grid, COST, LineSpec(exposure_ms / CAMERA.exposure_ms, step))
    index = scan_pass.patch_index
    return scan_pass, segment(weights, scan_pass.coarse, scan_pass.coarse.patches(index), index, every_class=True)


def map_of(scene: RasterScene, seed: int, step: int, exposure_ms: float, weights: Weights | None = None) -> PlanMap:
    """Return the results of a uniform scan; the expected mIoU is known only for the shipped weights."""
    others = weights is not None
    weights = weights or shipped()
    scan_pass, drawn = scanned(scene, weights, seed, step, exposure_ms)
    assert scene.labels is not None
    judged = 100 * mean_iou(confusion(scene.labels, drawn.classes, weights.config.classes))
    if others:
        return PlanMap(scan_pass.seconds, judged)
    assert drawn.log_probability is not None
    told = scores().expected(expected_counts([drawn.log_probability], weights.config.classes), step, exposure_ms)
    assert told is not None
    return PlanMap(scan_pass.seconds, judged, 100 * told.miou, 100 * told.error)


def main(arguments: Sequence[str]) -> int:
    """Draw maps of larger farms, WIDTHxHEIGHT, by the given weights, and print them with their goals."""
    size, *others = arguments
    width, height = (int(side) for side in size.split("x"))
    for row in large_rows((height, width), LARGE, load_weights(Path(others[0])) if others else shipped()):
        print(f"{row.what}: {row.figure}, goal {row.goal}: {'met' if row.met else 'MISSED'}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
