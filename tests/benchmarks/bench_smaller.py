"""Our network with a part of the patches read in full, against smaller full networks of equal multiply-adds.

All start from linear classifiers and have the same number of steps and the same farms in full light; other farms test.
A step takes 1 s of one core; all patches score 82.6 with 400 steps, 89.9 with 1200. An accelerator takes 15 minutes.
`python tests/benchmarks/bench_smaller.py 20` trains for 20 steps instead of `STEPS`.

`python tests/benchmarks/bench_smaller.py cut 2300` instead cuts smaller networks out of the shipped weights and trains
them further, with the token width of ours; ours is as shipped. Test fields are not in the training data. A network
takes 15 to 40 minutes of a core.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from measure import Row
from torch import Tensor

from flows.tasks.survey_model import shipped_weights
from flows.training.data import farm_test_data, open_training_data
from flows.training.figures import read_twice
from flows.training.train_scenes import Scenes, TrainRequest, network_config, observe_all, training_capture
from models.evaluation.metrics import mean_iou
from models.network.machine import choose_device
from models.network.segmenter import Segmenter
from models.network.sizes import BOTTOM, PLANES, TOKEN_PX, SegmenterConfig, level_widths, multiply_adds
from models.network.spectral import Normalisation
from models.policies.placement import ReadTwice
from models.training.capture_augmentation import REFERENCE_MS
from models.training.examples import measured_normalisation
from models.training.train import LabelledPixels, TrainingSettings, linear_classifier, train
from models.weights.files import Weights, load_weights
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.planning.coverage import frame_patches
from pipeline.simulator.scenes.built_in import SCOUTING_LAW
from pipeline.simulator.scenes.farm.farm_scene import FARM_LAW

STEPS = 3000
TRAINED_ON = 24  # farms
JUDGED = 6  # farms
Sizes = tuple[int, int, int]
OURS: Sizes = (8, 20, 64)  # channels of the overview and of the full network, and the token width
SMALLER: tuple[Sizes, ...] = ((8, 16, 64), (10, 10, 64), (6, 12, 64), (12, 12, 64), (6, 8, 48), (4, 8, 32))
TODAY = 78_000  # multiply-adds a pixel of version d779c059, to which goals refer
GRID = SceneGrid(512, 640, 16)
PATCHES = int(np.prod(GRID.patch_shape))


def cost(config: SegmenterConfig, patches: int = PATCHES) -> float:
    """Return the multiply-adds a pixel with this number of patches read in full."""
    return multiply_adds(config, GRID, patches, config.columns).total / (GRID.height * GRID.width)


def request(sizes: Sizes, settings: TrainingSettings) -> TrainRequest:
    """Return the request to train a network of these sizes."""
    overview_width, width, dim = sizes
    tokens = {"dim": dim}
    return TrainRequest("farm", Path(), width=width, overview_width=overview_width, tokens=tokens, settings=settings)


def trained(asked: TrainRequest, scenes: Scenes, normalisation: Normalisation) -> list[ReadTwice]:
    """Train a network; return the test farms, read by its overview and in full."""
    common = scenes.common
    examples = scenes.train.examples
    rng = np.random.default_rng([0x1DA])
    config = network_config(asked, common)
    shift = normalisation.gain_shift
    start = linear_classifier(LabelledPixels.drawn(examples, rng).brightened(shift, rng), config.classes)
    model, summary = train(config, examples, shift, asked.settings, start=start, device=choose_device("auto"))
    print(config, summary, flush=True)
    weights = Weights(model, common.basis, normalisation, common.names, common.colours)
    return read_twice(weights, scenes.validation.examples)


def score(judged: list[ReadTwice], classes: int, policy: str, fraction: float = 1.0) -> list[float]:
    """Return the mIoU [%] of all farms together, and of each, with a fraction of the patches by a policy."""
    counts = []
    for one in judged:
        chosen = np.full(one.gain.shape, policy == "all")
        if policy == "gain":
            chosen[frame_patches(one.gain, fraction)] = True
        counts.append(one.counts(chosen, classes))
    return [100 * mean_iou(one) for one in (np.sum(counts, axis=0), *counts)]


def beside(smaller: str, config: SegmenterConfig, own: list[float], peer: list[float]) -> Row:
    """Return the row that compares ours with a smaller network at equal multiply-adds; scores have all fields first."""
    ahead, *by_field = np.subtract(own, peer)
    figure = f"{own[0]:.2f} ({ahead:+.2f}; fields {min(by_field):+.1f} to {max(by_field):+.1f})"
    what = f"ours at {cost(config):.0f} a pixel, {cost(config) / TODAY:.0%} of today's"
    return Row(what, figure, "0.3 ahead", bool(ahead >= 0.3), f"{smaller}: {peer[0]:.2f}")


def rows(steps: int = STEPS) -> list[Row]:
    """Return a row for each smaller network: our lead at its multiply-adds."""
    settings = TrainingSettings(steps=steps, minutes=600.0)
    asked = request(OURS, settings)
    data = open_training_data("farm", JUDGED, TRAINED_ON, LineCamera())
    scenes = observe_all(asked, data, lambda what, done, figure: None)
    normalisation = measured_normalisation(scenes.train.examples, REFERENCE_MS)
    scenes = scenes.normalised(normalisation)
    ours = trained(asked, scenes, normalisation)
    config = network_config(asked, scenes.common)
    classes = config.classes
    least = cost(config, 0)
    most = cost(config)
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
        words = f"widths {sizes[0]} and {sizes[1]}, tokens {sizes[2]}"
        found.append(beside(words, network_config(asked, scenes.common), own, peer))
        print(found[-1], flush=True)
    return found


CUT_ON = 176  # scenes
CUT_RATE = 6e-4  # learning rate
MIN_EXPOSURE_MS = 3.0  # shortest exposure of crops [ms]


def cut_rows(steps: int, trained_on: int = CUT_ON) -> list[Row]:
    """Return a row for each network that is cut out of the shipped weights and trained further: our lead over it."""
    shipped = load_weights(shipped_weights())
    camera = LineCamera()
    settings = TrainingSettings(steps=steps, minutes=600.0, learning_rate=CUT_RATE, seed=5, darkest_ms=MIN_EXPOSURE_MS)
    laws = f"{FARM_LAW},{SCOUTING_LAW}"
    data = open_training_data(laws, 0, trained_on, camera)
    held_out = [farm_test_data(4, camera, law).train for law in (FARM_LAW, SCOUTING_LAW)]
    data = replace(data, validation=tuple(name for names in held_out for name in names))
    asked = TrainRequest(laws, Path(), settings=settings)
    scenes = observe_all(asked, data, lambda what, done, figure: None).normalised(shipped.normalisation)
    ours = read_twice(shipped, scenes.validation.examples)
    classes = shipped.config.classes
    augmentation = training_capture(shipped.normalisation, MIN_EXPOSURE_MS)
    found: list[Row] = []
    for overview_width, width, _ in SMALLER:
        config = replace(shipped.config, overview_width=overview_width, width=width)
        model, summary = train(
            config,
            scenes.train.examples,
            shipped.normalisation.gain_shift,
            settings,
            start=cut(shipped.segmenter, config),
            augmentation=augmentation,
        )
        print(config, summary, flush=True)
        peer = score(read_twice(replace(shipped, segmenter=model), scenes.validation.examples), classes, "all")
        fraction = (cost(config) - cost(shipped.config, 0)) / (cost(shipped.config) - cost(shipped.config, 0))
        own = score(ours, classes, "gain", fraction)
        found.append(beside(f"widths {overview_width} and {width}", config, own, peer))
        print(found[-1], flush=True)
    return found


def cut(model: Segmenter, config: SegmenterConfig) -> dict[str, Tensor]:
    """Return tensors of a network of other widths: channels with the largest weights are kept, new ones are random."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(7)
        made = Segmenter(config).state_dict()
    old = model.state_dict()
    classes = torch.arange(config.classes)
    inputs = torch.arange(config.columns + PLANES)
    dim = torch.arange(config.dim)

    def put(name: str, outputs: Tensor, taken: Tensor | None = None) -> None:
        """Copy the kept channels of a weight, which become the first ones, and of its bias."""
        if taken is None:  # a norm
            made[name][: len(outputs)] = old[name][outputs]
            return
        made[f"{name}.weight"][: len(outputs)] = 0
        made[f"{name}.weight"][: len(outputs), : len(taken)] = old[f"{name}.weight"][outputs][:, taken]
        made[f"{name}.bias"][: len(outputs)] = old[f"{name}.bias"][outputs]

    def cells(kept: Tensor, side: int) -> Tensor:
        """Return the channels that a shuffle of ``side`` x ``side`` px turns into the kept ones."""
        return (kept[:, None] * side**2 + torch.arange(side**2)).flatten()

    def put_pyramid(part: str, width: int, size: int, taken: Tensor) -> list[Tensor]:
        """Copy stem and head of a part; return the kept channels of each level."""
        kept = [_strongest(old, part, level, most) for level, most in enumerate(level_widths(width, size))]
        put(f"{part}_stem.enter", kept[0], taken)
        for level, own in enumerate(kept):
            for side in ("stem", "head")[: 1 + (level < len(kept) - 1)]:
                put(f"{part}_{side}.blocks.{level}.norm.weight", own)
                put(f"{part}_{side}.blocks.{level}.conv", own, own)
        for level, (upper, lower) in enumerate(pairwise(kept)):
            put(f"{part}_stem.down.{level}", lower, upper)
            put(f"{part}_head.up.{level}", cells(upper, 2), lower)
        return kept

    made |= {name: tensor for name, tensor in old.items() if name.startswith(("encoder.", "spectral."))}
    seen = put_pyramid("overview", config.overview_width, TOKEN_PX, inputs)
    put("to_token", dim, seen[-1])
    put("from_token", cells(seen[-1], BOTTOM), dim)
    put("overview_classes", classes, seen[0])
    fine = put_pyramid("full", config.width, config.patch, torch.cat([inputs, len(inputs) + seen[0]]))
    put("full_classes", classes, fine[0])
    return made


def _strongest(old: Mapping[str, Tensor], part: str, level: int, most: int) -> Tensor:
    """Return the channels of a level with the largest weights, in ascending order, at most ``most``."""
    kernels = rf"{part}_(stem|head)\.blocks\.{level}\.conv\.weight"
    own = [weight for name, weight in old.items() if re.fullmatch(kernels, name)]
    size = sum((one.abs().sum((0, 2, 3)) + one.abs().sum((1, 2, 3)) for one in own), torch.zeros(len(own[0])))
    way = old.get(f"{part}_stem.down.{level}.weight")
    way = old[f"{part}_head.up.{level - 1}.weight"] if way is None else way
    size = size + 2 * way.abs().sum((0, 2, 3))
    return size.argsort(descending=True)[:most].sort().values


if __name__ == "__main__":
    words = sys.argv[1:]
    if words[:1] == ["cut"]:
        cut_rows(*map(int, words[1:]))
    else:
        rows(*map(int, words))
