"""The farm that trade-offs of planning and segmenting work on: looked at coarsely, and ready to be scanned in full."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flows.survey.run import SHIPPED
from models.weights.files import Weights, load_weights
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Axis, CostModel, Sweep
from pipeline.planning.coverage import cheapest_full, coarse_sweeps
from pipeline.rectify.region import mosaic_rows
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.farm.farm_scene import farm_scene
from pipeline.simulator.scenes.scene import RasterScene
from pipeline.simulator.simulated import SimulatedSource, SimulatedSweep


@dataclass(frozen=True)
class FarmLook:
    """A farm, the weights that read it, and its coarse mosaic."""

    weights: Weights
    scene: RasterScene
    source: SimulatedSource
    grid: SceneGrid
    along: Axis
    full: Sequence[Sweep]
    full_s: float
    coarse_s: float
    mosaic: NDArray[np.float32]  # (y, x, band)

    @property
    def labels(self) -> NDArray[np.uint8]:
        """Class of each pixel, (y, x)."""
        return np.asarray(self.scene.labels, np.uint8)


def look_at_farm(seed: int, shape: tuple[int, int], *, noise_seed: int | None = None) -> FarmLook:
    """Sweep a farm of (y, x) px coarsely with the shipped weights at hand; ``noise_seed`` draws other noise on it."""
    weights = load_weights(Path(str(resources.files("models") / "shipped" / SHIPPED)))
    camera, scene = LineCamera(), farm_scene(seed, shape)
    grid = SceneGrid(*shape, weights.config.patch, weights.config.factor)
    source = SimulatedSource(scene, Rig(camera), seed if noise_seed is None else noise_seed)
    along, full, full_s = cheapest_full(grid, camera, CostModel())
    coarse = coarse_sweeps(grid, camera, along)
    rows = mosaic_rows([SimulatedSweep(source, sweep) for sweep in coarse], camera, grid, rows=64)
    mosaic = np.concatenate([values for _, values, _ in rows])
    return FarmLook(weights, scene, source, grid, along, full, full_s, CostModel().seconds(coarse, camera), mosaic)
