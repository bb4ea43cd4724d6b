"""Expected scores of uniform scans of 16 farms and 16 scouting fields, each by the calibration of the other 31 scenes.

These are the validation scenes of `train farm@2,scouting@1 --validation 32`, which are not in the training data of the
shipped weights. `python tests/benchmarks/bench_expected.py` also refits the numbers of `PRESENT`. For each file of
weights that is given, it writes the calibration table of all scenes into the file. It takes twenty minutes of one core.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from unittest import mock

import numpy as np
import scipy
from measure import Row

from flows.tasks.survey_model import shipped_weights
from flows.training.data import open_training_data
from flows.training.figures import SCAN_EXPOSURES, _scanned
from flows.training.observed_scenes import observe_scene
from flows.training.train_scenes import training_capture
from models.evaluation import expected_scores
from models.evaluation.expected_scores import MapScores, ScoredMap, expected_score, fitted_bias
from models.evaluation.metrics import mean_iou
from models.training.capture_augmentation import REFERENCE_MS, STEPS
from models.training.examples import normalised
from models.weights.files import MAP_SCORES, add_ood, describe_weights, load_ood, load_weights
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid

SCENES = 32
SEED = 4
MIN_EXPOSURE_MS = 3.0
GOAL = 0.85
SCANS = [(step, light * REFERENCE_MS) for step in STEPS for light in SCAN_EXPOSURES]
LIKELIEST = (-3.92, 1.32, 0.89, 0.48, 0.87)  # numbers of `PRESENT` by the likelihood of presence: the start of the fit
HUBER = 3.0  # limit of linear errors [points]
HELD = 0.02  # weight of the start
OF_EIGHT = 0.3  # weight of lines 8 px apart
Scans = dict[tuple[int, float], ScoredMap]


@cache
def scenes() -> dict[str, Scans]:
    """Segment every scan of every scene."""
    weights = load_weights(shipped_weights())
    camera = LineCamera()
    found: dict[str, Scans] = {}
    augmentation = training_capture(weights.normalisation, MIN_EXPOSURE_MS)
    reached = np.ones(weights.basis.columns, bool)
    assert augmentation is not None
    data = open_training_data("farm@2,scouting@1", SCENES, 2, camera)
    for number, name in enumerate(data.validation):
        scene = data.scene(name)
        kind, of_kind = divmod(number, SCENES // 2)
        rng = np.random.default_rng([SEED, 0x0B6, of_kind + 1000 * kind])
        seen = observe_scene(scene, camera, SceneGrid(*scene.shape, weights.config.patch), weights.basis, rng)
        example = normalised(seen, weights.normalisation, reached)
        found[name] = {}
        for place, (step, exposure_ms) in enumerate(SCANS):
            noise = np.random.default_rng([SEED, 0x5CA, *divmod(place, len(SCAN_EXPOSURES)), of_kind])
            light = exposure_ms / REFERENCE_MS
            found[name][step, exposure_ms] = _scanned(weights, example, augmentation, step, light, noise)[0]
    return found


def calibration(names: Sequence[str]) -> MapScores:
    """Fit the calibration table to the given scenes."""
    return MapScores.fitted({scan: [scenes()[name][scan] for name in names] for scan in SCANS})


def rows() -> list[Row]:
    """Return the errors of the scenes of each kind, for line spacings of 1, 2 and 4 px."""
    off: dict[str, list[tuple[float, float]]] = {"farms": [], "scouting": []}
    for name, maps in scenes().items():
        scores = calibration([other for other in scenes() if other != name])
        for (step, exposure_ms), one in maps.items():
            told = scores.expected(one.expected, step, exposure_ms)
            if step < 8 and told is not None and told.error <= 0.1:  # else the survey does not give it
                error = 100 * (told.miou - mean_iou(one.counts)), 100 * told.error
                off["scouting" if name.startswith("scouting") else "farms"].append(error)
    found = []
    for kind, pairs in off.items():
        error, deviation = np.transpose(pairs)
        rms = float(np.sqrt(np.mean(error**2)))
        held = np.mean(np.abs(error) <= 1.645 * deviation)
        figure = f"{rms:.2f} points rms, {error.mean():+.2f} in the mean, {held:.0%} within 90 %"
        found.append(Row(f"{len(pairs)} maps of {kind}, left out in turn", figure, f"<= {GOAL:g} rms", rms <= GOAL))
    return found


def present() -> tuple[float, ...]:
    """Fit the numbers of `PRESENT`: the least error of the mIoU, with large errors counted linearly (Huber)."""
    known = list(scenes())
    bias = {
        (name, scan): fitted_bias([scenes()[one][scan] for one in known if one != name])
        for name in known
        for scan in SCANS
    }

    def loss(numbers: np.ndarray) -> float:
        off = []
        with mock.patch.object(expected_scores, "PRESENT", tuple(numbers)):
            for name, maps in scenes().items():
                for scan, one in maps.items():
                    told = expected_score(one.expected, bias[name, scan], 0.0, *scan)
                    off.append((100 * (told.miou - mean_iou(one.counts)), scan[0]))
        error, step = np.transpose(off)
        weight = np.where(step == 8, OF_EIGHT, 1.0)
        held = HELD * np.sum((numbers - LIKELIEST) ** 2)
        return float((2 * scipy.special.huber(HUBER, error) * weight).mean() + held)

    return tuple(scipy.optimize.minimize(loss, LIKELIEST, method="Nelder-Mead").x.round(2).tolist())


if __name__ == "__main__":
    print(*rows(), f"PRESENT = {present()}", sep="\n")
    for weights in map(Path, sys.argv[1:]):
        part = describe_weights(weights).ood_detector
        assert part is not None
        about = {**part.record, MAP_SCORES: calibration(list(scenes())).as_dict()}
        add_ood(weights, load_ood(weights), part.trained_on, about)
