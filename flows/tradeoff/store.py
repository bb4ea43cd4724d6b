"""Trade-offs of storing: codec against bytes, and kept bits of the mosaic against the class map that comes of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flows.survey.run import SHIPPED
from flows.tradeoff.entries import Setting, Tradeoff, register
from models.reading.inference import glance, segment
from models.weights.files import Weights, load_weights
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import CostModel
from pipeline.planning.coverage import cheapest_full, coarse_sweeps
from pipeline.rectify.region import mosaic_rows
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.farm.farm_scene import farm_scene
from pipeline.simulator.simulated import SimulatedSource, SimulatedSweep
from storage.arrays.layout import CODECS, round_bits, store_in_memory

SHAPE = (384, 640)
RAW_LINES = 96
KEPT_BITS = (23.0, 13.0, 11.0, 9.0, 7.0, 5.0)


@dataclass(frozen=True)
class CapturedToStore:
    """Raw lines of a farm, its coarse mosaic, and the map that the mosaic gives as it is."""

    raw: NDArray[np.uint16]  # (line, sample, band)
    mosaic: NDArray[np.float32]  # (y, x, band)
    weights: Weights
    grid: SceneGrid
    wavelength_nm: NDArray[np.float64]
    classes: NDArray[np.uint8]


@dataclass(frozen=True)
class Stored:
    """What one setting stored: bytes, and the numbers read back."""

    size: int
    values: NDArray[np.generic]


def _prepare(seed: int) -> CapturedToStore:
    weights = load_weights(Path(str(resources.files("models") / "shipped" / SHIPPED)))
    camera, scene = LineCamera(), farm_scene(seed, SHAPE)
    grid = SceneGrid(*SHAPE, weights.config.patch, weights.config.factor)
    source = SimulatedSource(scene, Rig(camera), seed)
    along, full, _ = cheapest_full(grid, camera, CostModel())
    sweeps = [SimulatedSweep(source, sweep) for sweep in coarse_sweeps(grid, camera, along)]
    mosaic = np.concatenate([values for _, values, _ in mosaic_rows(sweeps, camera, grid, rows=64)])
    raw = SimulatedSweep(source, full[0]).read(0, RAW_LINES)
    classes = _map_of(weights, mosaic, scene.wavelength_nm, grid)
    return CapturedToStore(raw, mosaic, weights, grid, scene.wavelength_nm, classes)


def _map_of(
    weights: Weights, mosaic: NDArray[np.float32], wavelength_nm: NDArray[np.float64], grid: SceneGrid
) -> NDArray[np.uint8]:
    empty = np.empty((0, grid.patch, grid.patch, weights.basis.columns), np.float32)
    return segment(weights, glance(weights, mosaic, wavelength_nm, grid), empty, np.empty(0, np.int64)).classes


def _write_raw(state: CapturedToStore, codec: Setting) -> Stored:
    return Stored(*store_in_memory(state.raw, str(codec)))


def _bytes_a_sample(state: CapturedToStore, _codec: Setting, made: Stored) -> float:
    assert np.array_equal(made.values, state.raw), "a codec of raw numbers must give them back"
    return made.size / state.raw.size


def _write_rounded(state: CapturedToStore, bits: Setting) -> Stored:
    kept = int(bits)
    return Stored(*store_in_memory(round_bits(state.mosaic, kept) if kept < 23 else state.mosaic, "zstd-3"))


def _rounded_bytes(state: CapturedToStore, _bits: Setting, made: Stored) -> float:
    return made.size / state.mosaic.size


def _disagreement(state: CapturedToStore, _bits: Setting, made: Stored) -> float:
    drawn = _map_of(state.weights, np.asarray(made.values, np.float32), state.wavelength_nm, state.grid)
    return float(np.mean(drawn != state.classes))


CODEC = register(
    Tradeoff(
        stage="store",
        knob="codec",
        error="bytes stored a sample",
        unit="sample",
        reference=f"{RAW_LINES} raw lines of a farm, uint16, given back exactly",
        settings=CODECS,
        prepare=_prepare,
        run=_write_raw,
        judge=_bytes_a_sample,
        work=lambda state, _codec: float(state.raw.size),
    )
)
BITS = register(
    Tradeoff(
        stage="store",
        knob="kept bits",
        error="share of pixels whose class changes",
        unit="px*band",
        reference=f"the map that the coarse mosaic of a farm of {SHAPE[1]} x {SHAPE[0]} px gives unrounded",
        settings=KEPT_BITS,
        prepare=_prepare,
        run=_write_rounded,
        judge=_disagreement,
        work=lambda state, _bits: float(state.mosaic.size),
    )
)
SIZE = register(
    replace(
        BITS,
        knob="kept bits, size",
        error="bytes stored a sample",
        reference="the coarse mosaic, float32, rounded to so many bits",
        judge=_rounded_bytes,
    )
)
