"""Fraction of patches that a policy reads in full for a mean loss of 0.3 points, with one threshold for all fields.

Half of the fields are farms, half are scouting fields, all on odd days, which are not in the training data. Each one
is read as captured with 100 ms, and as simulated with 10 ms.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from measure import Row

from flows.tasks.survey_model import shipped_weights
from flows.training.data import FARM_SHAPE, farm_test_data
from flows.training.figures import read_twice
from flows.training.observed_scenes import observe_scene
from flows.training.train_scenes import training_capture
from models.evaluation.metrics import mean_iou
from models.policies.placement import COMPARED, ReadTwice
from models.training.examples import Example, normalised
from models.weights.files import load_weights
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid

FIELDS = 16
LOSS = 0.003  # mean loss of mIoU
DARK = 0.1  # short exposure as a fraction of the reference
THRESHOLDS = 400


def fields() -> list[ReadTwice]:
    """Read each field by the overview and in full, in both exposures."""
    weights = load_weights(shipped_weights())
    camera = LineCamera()
    examples: list[Example] = []
    augmentation = training_capture(weights.normalisation, 3.0)
    assert augmentation is not None
    data = farm_test_data(FIELDS, camera, "farm,scouting")
    grid = SceneGrid(*FARM_SHAPE, weights.config.patch)
    for number, name in enumerate(data.train):
        rng = np.random.default_rng([number, 0xC0])
        seen = observe_scene(data.scene(name), camera, grid, weights.basis, rng)
        bright = normalised(seen, weights.normalisation, np.ones(weights.basis.columns, np.bool_))
        assert bright.noise is not None
        dark = augmentation.scanned(bright.columns, bright.noise, light=DARK, step=1, rng=rng)
        examples += [bright, replace(bright, columns=dark.astype(np.float16))]
    return read_twice(weights, examples)


def losses(scenes: list[ReadTwice], policy: str, least: float) -> tuple[float, list[float]]:
    """Return the fraction of patches at or above a threshold, and the loss of mIoU of each field."""
    chosen = [scene.scores[policy] >= least for scene in scenes]
    classes = int(max(scene.full.max() for scene in scenes)) + 1
    full = [mean_iou(scene.counts(np.ones_like(some), classes)) for scene, some in zip(scenes, chosen, strict=True)]
    part = [mean_iou(scene.counts(some, classes)) for scene, some in zip(scenes, chosen, strict=True)]
    return float(np.mean(chosen)), [one - other for one, other in zip(full, part, strict=True)]


def rows() -> list[Row]:
    """Return a row for each policy, with the loss of each field."""
    scenes = fields()
    found: list[Row] = []
    for policy in COMPARED:
        every = np.concatenate([scene.scores[policy].ravel() for scene in scenes])
        thresholds = np.quantile(every, np.linspace(1, 0, THRESHOLDS))
        share, lost = next(one for least in thresholds if np.mean((one := losses(scenes, policy, least))[1]) <= LOSS)
        spread = f"loss of a field {100 * np.std(lost):.2f} rms of the mean, most {100 * max(lost):.2f}"
        found.append(Row(f"{policy}, mean loss {100 * LOSS:g} points", f"{share:.1%} of the patches", peers=spread))
    return found


if __name__ == "__main__":
    print(*rows(), sep="\n")
