"""Calls of a stage that mypy refuses before anything runs; where it does not, it reports an unused `type: ignore`."""

from __future__ import annotations

from spectralzoom.flows.stage import Stores
from spectralzoom.flows.stages.locate import locate
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.storage.store import Ref


def call(stores: Stores, signal: Ref, camera: LineCamera, grid: SceneGrid) -> None:
    """Call it as it is; with a renamed argument, and one too few."""
    locate(stores, signal, camera=camera, grid=grid)
    locate(stores, signal, lens=camera, grid=grid)  # type: ignore[call-arg]
    locate(stores, signal, camera=camera)  # type: ignore[call-arg]
