"""Scenes and weights of the paper's tables: farms with four bands and with all, and folders of labelled frames.

Networks that are trained here see the images of the paper's camera: area means for the overview, and fine patches.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from measure import ROOT
from numpy.typing import NDArray
from torch import Tensor

from spectralzoom.flows.opening.scene import scene_of_file
from spectralzoom.flows.training.data import FARM_SHAPE, FARM_TRAIN_SEED, farm_days, load_data_set, read_farm_name
from spectralzoom.flows.training.train_scenes import Common, network_config
from spectralzoom.models.network.spectral import LineSpec, SpectralBasis
from spectralzoom.models.training.capture_augmentation import CaptureAugmentation, ColumnNoise, with_capture
from spectralzoom.models.training.examples import measured_normalisation, normalised, observe
from spectralzoom.models.training.train import LabelledPixels, Progress, TrainingSettings, linear_classifier, train
from spectralzoom.models.weights.files import Weights, load_encoder, load_weights
from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.once import Once
from spectralzoom.pipeline.simulator.scenes.farm.farm_scene import farm_scene
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene, SceneRadiance
from tests.blocks import block_means

SIDE = 1024  # px
INPUTS = (4, 2)  # fine pixels a side of a coarse one
FARM_SEEDS = (51, 52, 53)
TAUGHT_FARMS = 12
FOUR_NM = (450.0, 550.0, 650.0, 850.0)  # near the centres of the paper's RGB and near-infrared bands
PATCH = 16
CAMERA = LineCamera()
Image = NDArray[np.float32]
Say = Callable[[str], None]


@dataclass(frozen=True)
class DataSet:
    """Scenes for an evaluation, made one at a time, with the weights that read them."""

    name: str
    weights: Weights
    scenes: Mapping[str, Callable[[], RasterScene]]


def coarse_image(columns: Image, factor: int) -> Image:
    """Return area means of ``factor`` x ``factor`` px, each repeated over its pixels."""
    return block_means(columns, factor).repeat(factor, 0).repeat(factor, 1)


class PaperCaptures(CaptureAugmentation):
    """Train with the images of the paper: area means for the overview, fine pixels for the full network."""

    def draw(self, columns: Tensor, noise: ColumnNoise, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
        factor = int(rng.choice((1, *INPUTS)))
        fine = with_capture(columns, LineSpec().planes)
        coarse = torch.from_numpy(coarse_image(columns.numpy(), factor))
        return with_capture(coarse, LineSpec(step=factor, binned=factor).planes), fine


def trained(name: str, scenes: Mapping[str, Callable[[], RasterScene]], patch: int, steps: int, say: Say) -> Weights:
    """Train a network."""
    say(f"{name}: {len(scenes)} scenes to train on, {steps} steps")
    made = [make() for make in scenes.values()]
    first = made[0]
    rng = np.random.default_rng(0)
    basis = SpectralBasis.spanning(first.wavelength_nm)
    seen = [observe(scene, CAMERA, SceneGrid(*scene.shape, patch), basis, rng) for scene in made]
    normalisation = measured_normalisation(seen)
    examples = [normalised(one, normalisation, np.ones(basis.columns, np.bool_)) for one in seen]
    common = Common(basis, first.class_names, first.class_colours, patch, first.wavelength_nm)
    config = network_config(common)
    start = linear_classifier(LabelledPixels.drawn(examples, rng), config.classes)
    if config.deep:
        start |= load_encoder()

    def progress(now: Progress) -> None:
        if now.step % 50 == 0:
            say(f"{name}: step {now.step} of {steps}, loss {now.loss:.3f}")

    asked = TrainingSettings(steps=steps, minutes=1e6)
    seen = PaperCaptures(normalisation)
    model, _ = train(config, examples, normalisation.gain_shift, asked, progress, start=start, augmentation=seen)
    return Weights(model, basis, normalisation, first.class_names, first.class_colours)


def with_bands(scene: RasterScene, wanted_nm: Sequence[float]) -> RasterScene:
    """Return a scene with only the bands nearest to the given wavelengths."""
    at = [int(np.abs(scene.wavelength_nm - one).argmin()) for one in wanted_nm]
    return replace(
        scene,
        light=Once.of(SceneRadiance(scene.electrons[:, at], scene.white_reference_electrons[at])),
        white_reference=scene.white_reference[at],
        wavelength_nm=scene.wavelength_nm[at],
        fwhm_nm=None if scene.fwhm_nm is None else scene.fwhm_nm[at],
    )


def farm_four(steps: int, say: Say, side: int = SIDE, seeds: Sequence[int] = FARM_SEEDS) -> DataSet:
    """Return farms with four bands, and weights trained on other farms."""

    def taught(name: str) -> RasterScene:
        seed, day, hour = read_farm_name(name)
        return with_bands(farm_scene(seed, FARM_SHAPE, camera=CAMERA, day=day, hour=hour), FOUR_NM)

    def judged(seed: int) -> RasterScene:
        return with_bands(farm_scene(seed, (side, side), camera=CAMERA), FOUR_NM)

    others = {name: partial(taught, name) for name in farm_days(FARM_TRAIN_SEED, TAUGHT_FARMS)}
    weights = trained("farm, 4 bands", others, PATCH, steps, say)
    return DataSet("farm, 4 bands", weights, {f"{seed}": partial(judged, seed) for seed in seeds})


def farm_all(side: int = SIDE, seeds: Sequence[int] = FARM_SEEDS) -> DataSet:
    """Return the same farms with all bands, and the shipped weights."""
    scenes = {f"{seed}": partial(farm_scene, seed, (side, side), camera=CAMERA) for seed in seeds}
    return DataSet("farm, 270 bands", load_weights(ROOT / "models" / "shipped" / "farm.safetensors"), scenes)


def folder(path: Path, held_out: Sequence[str], steps: int, patch: int, say: Say, given: Path | None) -> DataSet:
    """Return the held-out frames of a folder, by default every third, and weights of the other frames."""
    files = load_data_set(path)
    held_out = held_out or tuple(files.files)[1::3]
    scenes = {name: partial(lambda name: scene_of_file(files.load(name), CAMERA), name) for name in files.files}
    taught = {name: make for name, make in scenes.items() if name not in held_out}
    weights = load_weights(given) if given else trained(f"{path.resolve()}", taught, patch, steps, say)
    split = weights.record.get("split", {})
    known = {*split.get("train", ()), *split.get("validation", ())}
    judged = {name: scenes[name] for name in held_out if name not in known}
    if not judged:
        raise SceneError(f"{given or path} leaves no frame to judge; train with some held out, or name others")
    return DataSet(path.name, weights, judged)
