"""Ours with a part of the patches read in full, beside smaller networks that read everything, at equal multiply-adds.

All are trained as long, from discriminants of their own, on the same farms in full light. Other farms judge them once.
A step takes 1 s of one core; with 400 steps everything scores 82.6, with 1200 89.9. An accelerator takes 15 minutes.
`python tests/benchmarks/bench_smaller.py 20` trains for 20 steps in place of `STEPS`.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from measure import Row

from flows.training.data import open_training_data
from flows.training.figures import read_twice
from flows.training.train_scenes import Scenes, TrainRequest, network_config, observe_all
from models.evaluation.metrics import mean_iou
from models.evaluation.placement import ReadTwice, run_controls
from models.network.machine import choose_device
from models.network.sizes import SegmenterConfig, multiply_adds
from models.network.spectral import Normalisation
from models.training.capture_augmentation import REFERENCE_MS
from models.training.examples import measured_normalisation
from models.training.train import LabelledPixels, TrainingSettings, linear_discriminants, train
from models.weights.files import Weights
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid

STEPS, TRAINED_ON, JUDGED = 3000, 24, 6  # steps, and farms
Sizes = tuple[int, int, int]
OURS: Sizes = (8, 20, 64)  # channels of the overview and of the full network, and the token width
SMALLER: tuple[Sizes, ...] = ((8, 16, 64), (10, 10, 64), (6, 12, 64), (12, 12, 64), (6, 8, 48), (4, 8, 32))
TODAY = 78_000  # multiply-adds a pixel of version d779c059, to which goals refer
GRID = SceneGrid(512, 640, 16)
PATCHES = int(np.prod(GRID.patch_shape))


def cost(config: SegmenterConfig, patches: int = PATCHES) -> float:
    """Return multiply-adds a pixel, with so many patches read in full."""
    return multiply_adds(config, GRID, patches, config.columns).total / (GRID.height * GRID.width)


def request(sizes: Sizes, settings: TrainingSettings) -> TrainRequest:
    """Return the request of a training of such a network."""
    overview_width, width, dim = sizes
    tokens = {"dim": dim}
    return TrainRequest("farm", Path(), width=width, overview_width=overview_width, tokens=tokens, settings=settings)


def trained(asked: TrainRequest, scenes: Scenes, normalisation: Normalisation) -> list[ReadTwice]:
    """Train a network; return the judged farms, read by its overview and in full."""
    common, examples, rng = scenes.common, scenes.train.examples, np.random.default_rng([0x1DA])
    config, shift = network_config(asked, common), normalisation.gain_shift
    start = linear_discriminants(LabelledPixels.drawn(examples, rng).brightened(shift, rng), config.classes)
    model, summary = train(config, examples, shift, asked.settings, start=start, device=choose_device("auto"))
    print(config, summary, flush=True)
    return read_twice(
        Weights(model, common.basis, normalisation, common.names, common.colours), scenes.validation.examples
    )


def score(judged: list[ReadTwice], classes: int, policy: str, fraction: float = 1.0) -> list[float]:
    """Return the mIoU [%] of all farms together, and of each, with a fraction of the patches by a policy."""
    counts = [run_controls(one, classes, fraction=fraction, seed=0)[policy][0] for one in judged]
    return [100 * mean_iou(one) for one in (np.sum(counts, axis=0), *counts)]


def rows(steps: int = STEPS) -> list[Row]:
    """Return a row for each smaller network: ours ahead of it at its multiply-adds."""
    settings = TrainingSettings(steps=steps, minutes=600.0)
    asked, data = request(OURS, settings), open_training_data("farm", JUDGED, TRAINED_ON, LineCamera())
    scenes = observe_all(asked, data, lambda what, done, figure: None)
    normalisation = measured_normalisation(scenes.train.examples, REFERENCE_MS)
    scenes = scenes.normalised(normalisation)
    ours, config = trained(asked, scenes, normalisation), network_config(asked, scenes.common)
    classes, least, most = config.classes, cost(config, 0), cost(config)
    found = [
        Row(f"{of:.0f} a pixel: ours, {policy} of the patches", f"{score(ours, classes, policy)[0]:.1f}")
        for policy, of in (("none", least), ("all", most))
    ]
    print(*found, sep="\n", flush=True)
    for sizes in SMALLER:
        asked = request(sizes, settings)
        peer = score(trained(asked, scenes, normalisation), classes, "all")
        paid = cost(network_config(asked, scenes.common))
        fraction = max(0.0, (paid - least) / (most - least))
        own = score(ours, classes, "gain", fraction)
        ahead, *by_farm = np.subtract(own, peer)
        what = f"{paid:.0f} a pixel, {paid / TODAY:.0%} of today's: ours with {fraction:.0%} of the patches"
        figure = f"{own[0]:.1f} ({ahead:+.1f}; farms {min(by_farm):+.1f} to {max(by_farm):+.1f})"
        smaller = "widths {} and {}, tokens {}: {:.1f}".format(*sizes, peer[0])
        found.append(Row(what, figure, "0.3 ahead", ahead >= 0.3, smaller))
        print(found[-1], flush=True)
    return found


if __name__ == "__main__":
    rows(int(sys.argv[1]) if len(sys.argv) > 1 else STEPS)
