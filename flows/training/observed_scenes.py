"""Image scenes for training and evaluation by every line, as spectral features.

Built-in farms are captured by the simulated rig as in a survey. Effects are chosen by the defaults, and the full scan
is rendered, calibrated and rectified. Scene files are images of a camera already: they pass only the footprint and
noise of `models.training.examples.observe`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from spectralzoom.models.network.spectral import SpectralBasis, project
from spectralzoom.models.training.capture_augmentation import ColumnNoise, SceneSpectra
from spectralzoom.models.training.examples import Example, observe, value_of_electron
from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import UNLABELLED, SceneGrid, pad_by_reflection
from spectralzoom.pipeline.geometry.scan import CostModel, Sweep
from spectralzoom.pipeline.planning.coverage import cheapest_full
from spectralzoom.pipeline.rectify.region import mosaic_rows
from spectralzoom.pipeline.signal.subspace import FEW_BANDS
from spectralzoom.pipeline.simulator.effects.effect import Effect
from spectralzoom.pipeline.simulator.render import EFFECTS
from spectralzoom.pipeline.simulator.rig_model import Rig
from spectralzoom.pipeline.simulator.scenes.built_in import LAWS
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene
from spectralzoom.pipeline.simulator.selection.choice import decide
from spectralzoom.pipeline.simulator.selection.survey_probe import probe_survey
from spectralzoom.pipeline.simulator.simulated import SimulatedSource, SimulatedSweep, sweep_starts
from spectralzoom.pipeline.source import References

TOLERANCE_SIGMA = 0.1  # default of a survey
_ROWS = 64  # rectified at a time

Columns = NDArray[np.float32]


class _Taken(SimulatedSweep):
    """A sweep that keeps its rendered lines."""

    @cached_property
    def raw(self) -> NDArray[np.uint16]:
        return self.source.render(self.sweep, range(self.sweep.lines))

    @cached_property
    def references(self) -> References:
        return self.source.references(self.sweep)

    def read(self, start: int, stop: int) -> NDArray[np.uint16]:
        return self.raw[start:stop]


def observe_scene(
    scene: RasterScene, camera: LineCamera, grid: SceneGrid, basis: SpectralBasis, rng: np.random.Generator
) -> Example:
    """Image a labelled scene on the basis, with noise by ``rng``. Raises SceneError: a gap."""
    if scene.key.partition("/")[0] not in LAWS:
        return observe(scene, camera, grid, basis, rng)
    columns, noise = observe_finely(scene, camera, grid, basis, int(rng.integers(2**31)))
    labels = np.full(grid.padded_shape, UNLABELLED, np.uint8)
    labels[: grid.height, : grid.width] = np.asarray(scene.labels, np.uint8)
    padded = np.asarray(pad_by_reflection(columns, grid.padded_shape), np.float32)
    return Example(scene.name, padded, labels, (grid.height, grid.width), noise)


def observe_finely(
    scene: RasterScene, camera: LineCamera, grid: SceneGrid, basis: SpectralBasis, seed: int
) -> tuple[Columns, ColumnNoise]:
    """Scan a farm by every line; return columns on the basis, (y, x, column), and their noise."""
    rig = Rig(camera)
    cost = CostModel()
    _, full, _ = cheapest_full(grid, camera, cost)
    source = SimulatedSource(scene, rig, seed, chosen_effects(scene, rig, full), clock=sweep_starts(full, camera, cost))
    matrix, _ = basis.matrix(scene.wavelength_nm)
    bands = len(matrix)
    rows: list[Columns] = []
    count, total, products = 0, np.zeros(bands), np.zeros((bands, bands))  # sums of the powers 0, 1 and 2
    for part in mosaic_rows([_Taken(source, sweep) for sweep in full], camera, grid, rows=_ROWS):
        rows.append(project(part, matrix))
        some = part[::2, ::2].reshape(-1, bands).astype(np.float64)
        count += len(some)
        total += some.sum(axis=0)
        products += some.T @ some
    columns = np.concatenate(rows)
    if not np.isfinite(columns).all():
        raise SceneError(f"scene {scene.name} has pixels that no line reached; training needs all of it")
    mean = total / count
    covariance = products / count - np.outer(mean, mean)
    value = value_of_electron(scene)
    spectra = SceneSpectra(mean, covariance, matrix, value, camera.read_noise_e)
    noise = np.sum(spectra.noise(1.0), axis=0)
    power = np.linalg.eigvalsh(covariance / np.sqrt(np.outer(noise, noise)))
    floor = np.quantile(power, 0.1)  # of directions without a signal
    spectra = replace(spectra, covariance=covariance - floor * np.diag(noise))
    of_columns = ColumnNoise.of_bands(matrix, value, camera.read_noise_e)
    return columns, replace(of_columns, spectra=spectra if bands > FEW_BANDS else None)


def chosen_effects(scene: RasterScene, rig: Rig, sweeps: Sequence[Sweep]) -> dict[Effect, str]:
    """Choose effects as a survey of these sweeps does."""
    return decide(probe_survey(scene, rig, sweeps, "sigma"), rig, EFFECTS, TOLERANCE_SIGMA).chosen
