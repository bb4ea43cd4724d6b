"""Training data: labelled scenes as the camera would see them, and random crops of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.network.layers import cut
from models.network.spectral import Normalisation, SpectralBasis
from models.training.capture_augmentation import REFERENCE_MS, CaptureAugmentation, ColumnNoise
from pipeline.errors import SceneError
from pipeline.geometry.camera import LineCamera, expose, footprint
from pipeline.geometry.grid import UNLABELLED, SceneGrid, pad_by_reflection
from pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene

NOISY = 0.25  # fraction of the crops that get the noise of a shorter exposure
HALO = 8  # rows around a strip that the footprint reaches, a multiple of every factor up to 8


@dataclass(frozen=True)
class Example:
    """One labelled scene in both looks. Sizes are whole cells of patch * factor px; columns until they are normalised
    are float32.
    """

    name: str
    fine: NDArray[np.floating]  # (y, x, column), float16 once it is normalised
    coarse: NDArray[np.float32]  # (y / s, x / s, column)
    labels: NDArray[np.uint8]  # (y, x), 255 unlabelled
    shape: tuple[int, int]  # of the scene before padding
    noise: ColumnNoise | None = None


def observe(
    scene: RasterScene, camera: LineCamera, grid: SceneGrid, basis: SpectralBasis, rng: np.random.Generator
) -> Example:
    """Look at a labelled scene with the camera's own operator, fine and coarse, and project onto the basis.

    Goes in strips of rows; each strip draws its noise from a stream of its own.

    Raises SceneError where the scene has no labels.
    """
    if scene.labels is None:
        raise SceneError(f"scene {scene.name} has no labels; training needs them")
    matrix, _ = basis.matrix(scene.wavelength_nm)
    planes = np.asarray(pad_by_reflection(scene.planes, grid.padded_shape), np.float32)
    labels = np.full(grid.padded_shape, UNLABELLED, np.uint8)
    labels[: grid.height, : grid.width] = scene.labels
    rows, width = grid.padded_shape
    s, cell = grid.factor, grid.patch * grid.factor
    fine = np.empty((rows, width, basis.columns), np.float32)
    coarse = np.empty((rows // s, width // s, basis.columns), np.float32)
    exposure = camera.exposure_ms / DEFAULT_EXPOSURE_MS
    scale = (scene.white_reference / (scene.white_reference_electrons * exposure)).astype(np.float32)
    for top, stream in zip(range(0, rows, cell), rng.spawn(rows // cell), strict=True):
        first, last = max(top - HALO, 0), min(top + cell + HALO, rows)
        blurred = footprint(planes[first:last], camera)[top - first : top - first + cell]
        electrons = electrons_of(scene, blurred, camera)
        fine[top : top + cell] = (expose(electrons, camera, step=1, rng=stream) * scale) @ matrix
        coarse[top // s : (top + cell) // s] = (expose(electrons, camera, step=s, rng=stream) * scale) @ matrix
    return Example(scene.name, fine, coarse, labels, (grid.height, grid.width), noise_of(scene, matrix, camera))


def noise_of(scene: RasterScene, matrix: NDArray[np.float32], camera: LineCamera) -> ColumnNoise:
    """What light and readings of a camera leave in the columns of a scene."""
    return ColumnNoise.of_bands(matrix, scene.white_reference / scene.white_reference_electrons, camera.read_noise_e)


def electrons_of(scene: RasterScene, planes: NDArray[np.float32], camera: LineCamera) -> NDArray[np.float32]:
    """Expected electrons of component planes, (y, x, component) -> (y, x, band)."""
    exposure = np.float32(camera.exposure_ms / DEFAULT_EXPOSURE_MS)
    if scene.electrons.ndim == 1:  # every band has a plane of its own
        return np.asarray(planes * scene.electrons * exposure, np.float32)
    return np.asarray(planes @ scene.electrons * exposure, np.float32)


def measured_normalisation(observations: list[Example], exposure_ms: float = REFERENCE_MS) -> Normalisation:
    """Normalisation over the fine passes of all scenes (every third pixel of every third row), for looks so exposed."""
    sample = np.concatenate([seen.fine[::3, ::3].reshape(-1, seen.fine.shape[-1]) for seen in observations])
    noises = [seen.noise for seen in observations if seen.noise is not None]
    if exposure_ms >= REFERENCE_MS or not noises:
        return Normalisation.measured(sample)
    middle = np.median(sample, axis=0)
    added = [noise.covariance(middle, exposure_ms / REFERENCE_MS) - noise.covariance(middle, 1.0) for noise in noises]
    return Normalisation.measured(sample, np.mean(added, axis=0))


def normalised(seen: Example, normalisation: Normalisation, reached: NDArray[np.bool_]) -> Example:
    """Return a scene with normalised columns."""
    fine = np.clip(normalisation.apply(seen.fine, reached), -60000, 60000).astype(np.float16)
    return replace(seen, fine=fine, coarse=normalisation.apply(seen.coarse, reached))


@dataclass(frozen=True)
class Batch:
    """Crops for one training step."""

    coarse: Tensor  # (B, J, y / s, x / s)
    fine: Tensor  # (B, patches, J, p, p), every patch of the crop
    labels: Tensor  # (B, y, x) int64
    origin: Tensor  # (B, 2) random offsets of the places [patches]

    def on(self, device: str) -> Batch:
        """The same where a device computes."""
        return Batch(*(one.to(device) for one in (self.coarse, self.fine, self.labels, self.origin)))


class CropSampler:
    """Draws random crops: place, flips, transposition, brightness and noise all come from the given generator."""

    def __init__(
        self,
        examples: list[Example],
        config_patch: int,
        factor: int,
        crop: int,
        *,
        noise: float = 0.0,
        augmentation: CaptureAugmentation | None = None,
    ) -> None:
        """``noise`` is the most that is added, in spreads of the normalised columns, unless ``augmentation`` add it."""
        cell = config_patch * factor
        smallest = min(min(example.labels.shape) for example in examples)
        self.size = max(cell, min(crop, smallest) // cell * cell)
        self.examples, self.patch, self.factor, self.noise = examples, config_patch, factor, noise
        self.augmentation = augmentation
        areas = np.array([np.count_nonzero(example.labels != UNLABELLED) for example in examples], np.float64)
        if not areas.any():
            raise SceneError(f"none of {len(examples)} scenes has a labelled pixel; training needs some")
        self.fraction = areas / areas.sum()

    def draw(self, count: int, rng: np.random.Generator, gain_shift: NDArray[np.float32]) -> Batch:
        """Give ``count`` crops. ``gain_shift`` is centre / spread: what brightness does to normalised columns."""
        crops = [self._crop(rng, gain_shift) for _ in range(count)]
        coarse, fine, labels = (torch.stack([torch.from_numpy(crop[i]) for crop in crops]) for i in range(3))
        origin = torch.from_numpy(rng.integers(0, 4096, (count, 2)))
        return Batch(coarse, cut(fine, self.patch), labels, origin)

    def _crop(self, rng: np.random.Generator, gain_shift: NDArray[np.float32]) -> tuple[NDArray[np.generic], ...]:
        s, size = self.factor, self.size
        example = self.examples[rng.choice(len(self.examples), p=self.fraction)]
        for _ in range(20):  # a crop without a label teaches nothing
            y, x = (rng.integers(0, (side - size) // s + 1) * s for side in example.labels.shape)
            labels = example.labels[y : y + size, x : x + size]
            if (labels != UNLABELLED).any():
                break
        gain = np.float32(rng.normal(1.0, 0.04))
        transpose, down, across = rng.integers(0, 2, 3)  # one of the eight symmetries of a square

        def turn(image: NDArray[np.generic]) -> NDArray[np.generic]:
            turned = image.swapaxes(0, 1) if transpose else image
            return turned[:: 1 - 2 * down, :: 1 - 2 * across]

        coarse = turn(example.coarse[y // s : (y + size) // s, x // s : (x + size) // s]).astype(np.float32) * gain
        fine = turn(example.fine[y : y + size, x : x + size]).astype(np.float32) * gain
        shift = (gain - 1) * gain_shift
        if self.augmentation is not None and example.noise is not None:
            fine, coarse = self.augmentation.draw(fine + shift, coarse + shift, example.noise, s, rng)
            channels = [np.ascontiguousarray(image.transpose(2, 0, 1)) for image in (coarse, fine)]
            return channels[0], channels[1], np.ascontiguousarray(turn(labels)).astype(np.int64)
        channels_first = [np.ascontiguousarray((image + shift).transpose(2, 0, 1)) for image in (coarse, fine)]
        if rng.random() < NOISY:  # a coarse pixel gathers s times the light of a fine one, in as many readings
            noise = rng.uniform(0, self.noise)
            for image, sigma in zip(channels_first, (noise / math.sqrt(s), noise), strict=True):
                image += np.float32(sigma) * rng.standard_normal(image.shape, np.float32)
        return channels_first[0], channels_first[1], np.ascontiguousarray(turn(labels)).astype(np.int64)
