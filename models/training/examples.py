"""Training data: labelled scenes as spectral features, and random crops of them.

Built-in farms are captured by the simulated rig as in a survey. Effects are chosen by the defaults, and the full scan
is rendered, calibrated and rectified. Scene files are images of a camera already: they pass only the footprint and
noise of `observe`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from numpy.typing import NDArray
from torch import Tensor

from spectralzoom.models.network.machine import PROCESSOR
from spectralzoom.models.network.sizes import TOKEN_PX
from spectralzoom.models.network.spectral import LineSpec, Normalisation, SpectralBasis, project
from spectralzoom.models.training.capture_augmentation import (
    REFERENCE_MS,
    CaptureAugmentation,
    ColumnNoise,
    SceneSpectra,
    beside,
    normal,
    with_capture,
)
from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.geometry.camera import LineCamera, expose, footprint
from spectralzoom.pipeline.geometry.grid import UNLABELLED, SceneGrid, pad_by_reflection
from spectralzoom.pipeline.geometry.scan import CostModel, Sweep
from spectralzoom.pipeline.planning.coverage import cheapest_full
from spectralzoom.pipeline.rectify.region import mosaic_rows
from spectralzoom.pipeline.signal.condense import UNUSABLE, score_lines
from spectralzoom.pipeline.signal.rounding import whole_steps
from spectralzoom.pipeline.signal.subspace import FEW_BANDS, SignalStatistics, components_of_raster
from spectralzoom.pipeline.simulator.effects.effect import Chosen
from spectralzoom.pipeline.simulator.render import EFFECTS
from spectralzoom.pipeline.simulator.rig_model import Rig
from spectralzoom.pipeline.simulator.scenes.laws import LAWS
from spectralzoom.pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene
from spectralzoom.pipeline.simulator.selection.choice import decide
from spectralzoom.pipeline.simulator.selection.survey_probe import probe_survey
from spectralzoom.pipeline.simulator.simulated import SimulatedSource, SimulatedSweep, sweep_starts
from spectralzoom.pipeline.source import References

NOISY = 0.25  # fraction of crops with added noise
BRIGHTNESS = 0.04  # standard deviation of the factor of a crop's light
ZOOMED = 0.7  # fraction of crops that are zoomed, if any
ZOOMS = (-0.6, 0.5)  # octaves of their pixels
HALO = 8  # rows around a strip that its footprint reaches
STRIP_ROWS = 64  # most rows of a strip, and rows that are rectified at a time
TOLERANCE_SIGMA = 0.1  # default of a survey


@dataclass(frozen=True)
class Example:
    """One labelled scene, captured by every line at the reference exposure; its sizes are whole patches."""

    name: str
    columns: NDArray[np.floating]  # (y, x, column) spectral features: float32, float16 once they are normalised
    labels: NDArray[np.uint8]  # (y, x), 255 unlabelled
    shape: tuple[int, int]  # of the scene before padding
    noise: ColumnNoise | None = None


def untaught_classes(examples: Sequence[Example], classes: int) -> tuple[int, ...]:
    """Return the classes without a labelled pixel, ascending."""
    return tuple(sorted({*range(classes)} - {number for one in examples for number in np.unique(one.labels).tolist()}))


def observe_scene(
    scene: RasterScene,
    camera: LineCamera,
    grid: SceneGrid,
    basis: SpectralBasis,
    rng: np.random.Generator,
    *,
    captured: bool = True,
) -> Example:
    """Image a labelled scene on the basis, with noise by ``rng``; a file that is not ``captured`` stays as it is.

    Raises SceneError: a gap.
    """
    if scene.key.partition("/")[0] in LAWS:
        return observe_farm(scene, camera, grid, basis, rng)
    return observe(scene, camera, grid, basis, rng) if captured else as_it_is(scene, camera, grid, basis)


def as_it_is(scene: RasterScene, camera: LineCamera, grid: SceneGrid, basis: SpectralBasis) -> Example:
    """Project the pixels of a file onto the basis, by the components in which a survey of the raster keeps them."""
    matrix, _ = basis.matrix(scene.wavelength_nm)
    values = electrons_of(scene, scene.planes, camera) * value_of_electron(scene).astype(np.float32)
    values *= np.float32(DEFAULT_EXPOSURE_MS / camera.exposure_ms)
    valid = np.isfinite(values)
    found = SignalStatistics(values.shape[-1], valid[..., 0].size)
    found.add(values, np.asarray(valid.all(axis=2) if valid.all() else valid))
    whole = np.allclose(values, np.rint(values), rtol=1e-6, atol=0, equal_nan=True)
    components = components_of_raster(found, scene.wavelength_nm, whole=whole)
    scored = score_lines(values, valid, components)
    weights, offset = components.onto(np.where(np.isfinite(components.mean)[:, None], matrix, 0))
    columns = whole_steps(scored.scores, 1.0) @ weights + offset
    columns[scored.quality == UNUSABLE] = np.nan
    noise = ColumnNoise.of_bands(matrix, value_of_electron(scene), camera.read_noise_e)
    return _example(scene, grid, np.asarray(pad_by_reflection(columns, grid.padded_shape), np.float32), noise)


def observe(
    scene: RasterScene, camera: LineCamera, grid: SceneGrid, basis: SpectralBasis, rng: np.random.Generator
) -> Example:
    """Image a labelled scene by the footprint and noise of the camera, and project it onto the basis.

    Strips of rows have random streams of their own.
    """
    matrix, _ = basis.matrix(scene.wavelength_nm)
    planes = np.asarray(pad_by_reflection(scene.planes, grid.padded_shape), np.float32)
    rows, width = grid.padded_shape
    strip = math.gcd(rows, STRIP_ROWS)
    columns = np.empty((rows, width, basis.columns), np.float32)
    exposure = camera.exposure_ms / DEFAULT_EXPOSURE_MS
    scale = (scene.white_reference / (scene.white_reference_electrons * exposure)).astype(np.float32)
    for top, stream in zip(range(0, rows, strip), rng.spawn(rows // strip), strict=True):
        first, last = max(top - HALO, 0), min(top + strip + HALO, rows)
        blurred = footprint(planes[first:last], camera)[top - first : top - first + strip]
        electrons = electrons_of(scene, blurred, camera)
        columns[top : top + strip] = (expose(electrons, camera, rng=stream) * scale) @ matrix
    noise = ColumnNoise.of_bands(matrix, value_of_electron(scene), camera.read_noise_e)
    return _example(scene, grid, columns, noise)


def _example(scene: RasterScene, grid: SceneGrid, columns: NDArray[np.float32], noise: ColumnNoise) -> Example:
    """Return an example with columns of the padded grid; labels are padded by unlabelled pixels."""
    gap = [(0, whole - size) for whole, size in zip(grid.padded_shape, scene.shape, strict=True)]
    labels = np.pad(np.asarray(scene.labels, np.uint8), gap, constant_values=UNLABELLED)
    return Example(scene.name, columns, labels, scene.shape, noise)


class _KeptSweep(SimulatedSweep):
    """A sweep that keeps its rendered lines."""

    @cached_property
    def raw(self) -> NDArray[np.uint16]:
        return self.source.render(self.sweep, range(self.sweep.lines))

    @cached_property
    def references(self) -> References:
        return self.source.references(self.sweep)

    def read(self, start: int, stop: int, samples: slice = slice(None)) -> NDArray[np.uint16]:
        return self.raw[start:stop, samples]


def observe_farm(
    scene: RasterScene, camera: LineCamera, grid: SceneGrid, basis: SpectralBasis, rng: np.random.Generator
) -> Example:
    """Scan a farm by every line of the simulated rig. Raises SceneError: a gap."""
    rig, cost = Rig(camera), CostModel()
    _, full, _ = cheapest_full(grid, camera, cost)
    effects, clock = chosen_effects(scene, rig, full), sweep_starts(full, camera, cost)
    source = SimulatedSource(scene, rig, int(rng.integers(2**31)), effects, clock=clock)
    matrix, _ = basis.matrix(scene.wavelength_nm)
    bands = len(matrix)
    rows: list[NDArray[np.float32]] = []
    count, total, products = 0, np.zeros(bands), np.zeros((bands, bands))  # sums of the powers 0, 1 and 2
    for part in mosaic_rows([_KeptSweep(source, sweep) for sweep in full], camera, grid, rows=STRIP_ROWS):
        rows.append(project(part, matrix))
        some = part[::2, ::2].reshape(-1, bands).astype(np.float64)
        count += len(some)
        total += some.sum(axis=0)
        products += some.T @ some
    columns = np.concatenate(rows)
    if not np.isfinite(columns).all():
        raise SceneError(f"scene {scene.name} has pixels that no line reached; training needs all of it")
    mean = total / count
    value = value_of_electron(scene)
    noise = ColumnNoise.of_bands(matrix, value, camera.read_noise_e)
    if bands > FEW_BANDS:
        spectra = SceneSpectra(mean, products / count - np.outer(mean, mean), matrix, value, camera.read_noise_e)
        noise = replace(noise, spectra=spectra.without_noise())
    return _example(scene, grid, np.asarray(pad_by_reflection(columns, grid.padded_shape), np.float32), noise)


def chosen_effects(scene: RasterScene, rig: Rig, sweeps: Sequence[Sweep]) -> Chosen:
    """Choose effects as a survey of these sweeps does."""
    return decide(probe_survey(scene, rig, sweeps, "sigma"), rig, EFFECTS, TOLERANCE_SIGMA).chosen


def value_of_electron(scene: RasterScene) -> NDArray[np.float64]:
    """Return the scene values (band,) of an electron at the reference exposure."""
    return np.asarray(scene.white_reference / scene.white_reference_electrons, np.float64)


def electrons_of(scene: RasterScene, planes: NDArray[np.float32], camera: LineCamera) -> NDArray[np.float32]:
    """Return expected electrons of component planes, (y, x, component) -> (y, x, band)."""
    own_planes = scene.electrons.ndim == 1  # a plane for each band
    electrons = planes * scene.electrons if own_planes else planes @ scene.electrons
    return np.asarray(electrons * np.float32(camera.exposure_ms / DEFAULT_EXPOSURE_MS), np.float32)


def measured_normalisation(observations: list[Example], exposure_ms: float = REFERENCE_MS) -> Normalisation:
    """Measure the normalisation of all scenes (every third pixel of every third row) for an exposure."""
    sample = np.concatenate([seen.columns[::3, ::3].reshape(-1, seen.columns.shape[-1]) for seen in observations])
    noises = [seen.noise for seen in observations if seen.noise is not None]
    if exposure_ms >= REFERENCE_MS or not noises:
        return Normalisation.measured(sample)
    middle = np.median(sample, axis=0)
    added = [noise.covariance(middle, exposure_ms / REFERENCE_MS) - noise.covariance(middle, 1.0) for noise in noises]
    return Normalisation.measured(sample, np.mean(added, axis=0))


def normalised(seen: Example, normalisation: Normalisation, reached: NDArray[np.bool_]) -> Example:
    """Normalise the columns of a scene."""
    return replace(seen, columns=np.clip(normalisation.apply(seen.columns, reached), -60000, 60000).astype(np.float16))


@dataclass(frozen=True)
class Batch:
    """Crops for one training step, with the planes of their capture."""

    image: Tensor  # (B, J + PLANES, y, x) that the overview reads
    detail: Tensor  # (B, J + PLANES, y, x) that the full network reads
    labels: Tensor  # (B, y, x) int64
    origin: Tensor  # (B, 2) random offsets of the places [tokens]


@dataclass(eq=False)
class CropSampler:
    """Draw random crops: place, scale, flips, transposition, brightness and noise."""

    examples: list[Example]
    patch: int
    crop: int
    noise: float = 0.0  # largest that is added without an augmentation [spreads of the columns]
    zoomed: bool = False  # most crops are enlarged or reduced
    augmentation: CaptureAugmentation | None = None
    device: str = PROCESSOR  # where the scenes stay and crops are made

    def __post_init__(self) -> None:
        self.smallest: int = min(min(example.labels.shape) for example in self.examples)
        self.columns = [torch.from_numpy(example.columns).to(self.device) for example in self.examples]
        areas = np.array([np.count_nonzero(example.labels != UNLABELLED) for example in self.examples], np.float64)
        if not areas.any():
            raise SceneError(f"none of {len(self.examples)} scenes has a labelled pixel; training needs some")
        self.fraction = areas / areas.sum()

    def size(self, larger: int = 1) -> int:
        """Return the side [px] of crops whose area is ``larger`` times that of ``crop``, or of the smallest scene."""
        cell = max(TOKEN_PX, self.patch) if self.smallest >= TOKEN_PX else self.patch
        return max(cell, min(round(self.crop * math.sqrt(larger)), self.smallest) // cell * cell)

    def draw(self, count: int, rng: np.random.Generator, gain_shift: NDArray[np.float32], *, larger: int = 1) -> Batch:
        """Draw ``count`` crops. ``gain_shift`` is the shift of normalised columns by brightness."""
        crops = [self._crop(rng, gain_shift, self.size(larger)) for _ in range(count)]
        image, detail, labels = (torch.stack(one) for one in zip(*crops, strict=True))
        return Batch(image, detail, labels.to(torch.int64), torch.from_numpy(rng.integers(0, 4096, (count, 2))))

    def _crop(
        self, rng: np.random.Generator, gain_shift: NDArray[np.float32], size: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        number = int(rng.choice(len(self.examples), p=self.fraction))
        example = self.examples[number]
        zoom = 2 ** rng.uniform(*ZOOMS) if self.zoomed and rng.random() < ZOOMED else 1.0
        side = min(round(size * zoom), *example.labels.shape)
        nearest = ((np.arange(size) + 0.5) * side / size).astype(int)
        for _ in range(20):  # until the crop has a label
            y, x = (int(rng.integers(0, most - side + 1)) for most in example.labels.shape)
            labels = example.labels[y + nearest[:, None], x + nearest]
            if (labels != UNLABELLED).any():
                break
        gain = float(rng.normal(1.0, BRIGHTNESS))
        transpose, *flipped = rng.integers(0, 2, 3)  # one of the eight symmetries of a square

        def turn(image: Tensor) -> Tensor:
            turned = image.transpose(0, 1) if transpose else image
            return turned.flip([axis for axis, back in enumerate(flipped) if back])

        seen = self.columns[number][y : y + side, x : x + side].float()
        if side != size:
            planes = F.interpolate(seen.permute(2, 0, 1)[None], (size, size), mode="bilinear", antialias=True)
            seen = planes[0].permute(1, 2, 0).contiguous()
        plain = turn(seen)
        columns = plain * gain + beside(plain, (gain - 1) * gain_shift)
        if self.augmentation is not None and example.noise is not None:
            image, detail = self.augmentation.draw(columns, example.noise, rng)
        else:
            if rng.random() < NOISY:
                columns += normal(columns, rng) * rng.uniform(0, self.noise)
            image = detail = with_capture(columns, LineSpec().planes)
        return image.permute(2, 0, 1), detail.permute(2, 0, 1), turn(torch.from_numpy(labels).to(self.device))
