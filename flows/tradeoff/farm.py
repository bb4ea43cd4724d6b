"""Trade-offs on a farm: patch budget; seats, precision and bands of segmenting; codec and kept bits of storing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flows.tasks.stages.accuracy import columns_of_all_seats
from flows.tasks.survey_model import shipped_weights
from flows.tradeoff.entries import Level, Setting, Tradeoff, register_all
from models.evaluation.metrics import confusion, mean_iou
from models.network.machine import keep_freed_memory
from models.policies.policies import score_seats
from models.reading.inference import CoarseLook, DrawnMap, Glance, glance, look_coarsely, read_glance, segment
from models.weights.files import Weights, load_weights
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Axis, CostModel, Sweep
from pipeline.planning.coverage import cheapest_full, coarse_sweeps
from pipeline.planning.fine_pass import FinePlan, plan_fine
from pipeline.planning.selection import frame_seats
from pipeline.rectify.region import mosaic_rows, read_seats
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.farm.farm_scene import farm_scene
from pipeline.simulator.scenes.scene import RasterScene
from pipeline.simulator.simulated import SimulatedSource, SimulatedSweep
from storage.arrays.layout import CODECS, round_bits, store_in_memory

Values = NDArray[np.float32]


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
    mosaic: Values  # (y, x, band)

    @property
    def labels(self) -> NDArray[np.uint8]:
        return np.asarray(self.scene.labels, np.uint8)

    def miss(self, drawn: DrawnMap) -> float:
        return 1 - mean_iou(confusion(self.labels, drawn.classes, self.weights.config.classes))


def look_at_farm(seed: int, shape: tuple[int, int], *, noise_seed: int | None = None) -> FarmLook:
    """Sweep a farm of (y, x) px coarsely with the shipped weights at hand; ``noise_seed`` draws other noise on it."""
    weights = load_weights(shipped_weights())
    camera, scene = LineCamera(), farm_scene(seed, shape)
    grid = SceneGrid(*shape, weights.config.patch, weights.config.factor)
    source = SimulatedSource(scene, Rig(camera), seed if noise_seed is None else noise_seed)
    along, full, full_s = cheapest_full(grid, camera, CostModel())
    coarse = coarse_sweeps(grid, camera, along)
    rows = mosaic_rows([SimulatedSweep(source, sweep) for sweep in coarse], camera, grid, rows=64)
    mosaic = np.concatenate([values for _, values, _ in rows])
    return FarmLook(weights, scene, source, grid, along, full, full_s, CostModel().seconds(coarse, camera), mosaic)


BUDGET_SHAPE = (768, 960)


@dataclass(frozen=True)
class FarmToSpendOn:
    """A farm seen coarsely and, for whatever the plan will ask, finely."""

    farm: FarmLook
    seen: Glance
    columns: Values  # (seat, p, p, column) of every seat


def _prepare_budget(seed: int) -> FarmToSpendOn:
    farm = look_at_farm(seed, BUDGET_SHAPE)
    columns = columns_of_all_seats(farm.source, farm.full, farm.grid, farm.weights, memory=2**31, kernel="catmull-rom")
    return FarmToSpendOn(farm, glance(farm.weights, farm.mosaic, farm.scene.wavelength_nm, farm.grid), columns)


def _spend(state: FarmToSpendOn, budget: Setting) -> tuple[FinePlan, DrawnMap]:
    farm, scores = state.farm, score_seats("entropy", state.seen)
    left = max(float(budget) * farm.full_s - farm.coarse_s, 0.0)
    plan = plan_fine(farm.grid, farm.source.camera, CostModel(), farm.along, scores, budget_s=left)
    return plan, segment(farm.weights, state.seen, state.columns[plan.seats], plan.seats)


BUDGET = Tradeoff(
    stage="plan",
    knob="budget",
    error="1 - mIoU",
    unit="scene px",
    reference=f"labels of a farm of {BUDGET_SHAPE[1]} x {BUDGET_SHAPE[0]} px; policy entropy, line blocks",
    settings=(1.0, 0.8, 0.65, 0.5, 0.4, 0.33),
    prepare=_prepare_budget,
    run=_spend,
    judge=lambda state, _budget, made: state.farm.miss(made[1]),
    work=lambda state, _budget: float(state.farm.labels.size),
    modelled_s=lambda state, _budget, made: state.farm.coarse_s + made[0].seconds,
)


SEGMENT_SHAPE = (384, 480)
SHARES = (1.0, 0.35, 0.2, 0.15, 0.1, 0.05, 0.0)
PRECISIONS = ("float32", "bfloat16")
BANDS = (270.0, 90.0, 30.0, 15.0, 8.0, 4.0)
POLICY = "gain"
COLUMN_BYTES, MAP_BYTES = 4 * 24, 5  # of a pixel: columns of the farm's weights; class and confidence


@dataclass(frozen=True)
class Pixels:
    """The same pixels in some of their bands."""

    coarse: Values  # (y, x, band)
    fine: Values  # (seat, p, p, band) of every valid seat
    wavelength_nm: NDArray[np.float64]


@dataclass(frozen=True)
class Farm:
    """A farm seen coarsely and finely everywhere, and the map that all of it gives in float32."""

    farm: FarmLook
    seats: NDArray[np.intp]  # valid ones
    look: CoarseLook
    columns: Values  # (seat, p, p, column) of them
    pixels: Mapping[Setting, Pixels]
    reference: DrawnMap
    again: DrawnMap  # of everything as well, with the noise drawn anew


def _prepare_segment(seed: int) -> Farm:
    keep_freed_memory()  # as surveys do
    farm = look_at_farm(seed, SEGMENT_SHAPE)
    fine = _fine_values(farm)
    other = look_at_farm(seed, SEGMENT_SHAPE, noise_seed=seed + 1)
    nm = np.asarray(farm.scene.wavelength_nm, np.float64)
    pixels: dict[Setting, Pixels] = {}
    for bands in BANDS:
        some = np.unique(np.linspace(0, len(nm) - 1, min(int(bands), len(nm))).round().astype(int))
        pixels[bands] = Pixels(farm.mosaic[..., some], np.ascontiguousarray(fine[..., some]), nm[some])
    look = look_coarsely(farm.weights, [farm.mosaic], nm, farm.grid)
    seats, columns = farm.grid.valid_seats(), farm.weights.columns(fine, nm)
    seen_again = look_coarsely(other.weights, [other.mosaic], nm, other.grid)
    again = segment(farm.weights, seen_again, farm.weights.columns(_fine_values(other), nm), seats)
    return Farm(farm, seats, look, columns, pixels, segment(farm.weights, look, columns, seats), again)


def _fine_values(farm: FarmLook) -> Values:
    sweeps = [SimulatedSweep(farm.source, sweep) for sweep in farm.full]
    values, _ = read_seats(sweeps, farm.source.camera, farm.grid, farm.grid.valid_seats(), "catmull-rom")
    return np.asarray(values, np.float32)


def _with_seats(state: Farm, share: Setting) -> DrawnMap:
    """Glance, score and draw; with every seat there is nothing to choose."""
    weights, wanted = state.farm.weights, float(share)
    if wanted == 1:
        return segment(weights, state.look, state.columns, state.seats)
    seen = read_glance(weights, state.look)
    chosen = frame_seats(score_seats(POLICY, seen), wanted, state.farm.grid.valid_share().ravel() > 0).seats
    return segment(weights, seen, state.columns[np.searchsorted(state.seats, chosen)], chosen)


def _with_bands(state: Farm, bands: Setting) -> DrawnMap:
    """From scene values on: fewer bands are fewer values to bring to spectral columns."""
    weights, pixels = state.farm.weights, state.pixels[bands]
    seen = glance(weights, pixels.coarse, pixels.wavelength_nm, state.farm.grid)
    return segment(weights, seen, weights.columns(pixels.fine, pixels.wavelength_nm), state.seats)


def _disagreement(state: Farm, _setting: Setting, drawn: DrawnMap) -> float:
    return float(np.mean(drawn.classes != state.reference.classes))


_PX = f"a farm of {SEGMENT_SHAPE[1]} x {SEGMENT_SHAPE[0]} px"
SEATS = Tradeoff(
    stage="segment",
    knob="share of seats",
    error="1 - mIoU",
    unit="scene px",
    reference=f"labels of {_PX}; policy {POLICY}, seats free of each other, glance and scores included",
    settings=SHARES,
    prepare=_prepare_segment,
    run=_with_seats,
    judge=lambda state, _setting, drawn: state.farm.miss(drawn),
    work=lambda state, _share: float(state.farm.labels.size),
    levels=lambda state: (
        Level("every seat and band in float32", state.farm.miss(state.reference)),
        Level("the same, noise drawn anew", state.farm.miss(state.again)),
    ),
    moved_bytes=float(COLUMN_BYTES + MAP_BYTES),
)
PRECISION = replace(
    SEATS,
    knob="precision",
    reference=f"labels of {_PX}; every seat",
    settings=PRECISIONS,
    run=lambda state, kind: segment(
        state.farm.weights,
        state.look,
        state.columns,
        state.seats,
        precision="bfloat16" if kind == "bfloat16" else "float32",
    ),
)
BAND_COUNT = replace(
    SEATS,
    knob="bands",
    reference=f"labels of {_PX}; every seat, from scene values to the map",
    settings=BANDS,
    run=_with_bands,
    moved_bytes=4 * min(BANDS) + MAP_BYTES,
)
AGREEMENT = tuple(
    replace(
        entry,
        knob=f"{entry.knob}, agreement",
        error="share of pixels whose class changes",
        judge=_disagreement,
        reference=f"the map of every seat and band of {_PX} in float32",
        levels=lambda state: (Level("everything captured again", _disagreement(state, 1.0, state.again)),),
    )
    for entry in (SEATS, PRECISION, BAND_COUNT)
)


STORE_SHAPE = (384, 640)
RAW_LINES = 96
Stored = tuple[int, NDArray[np.generic]]  # bytes, and the numbers read back


@dataclass(frozen=True)
class CapturedToStore:
    """A farm, raw lines of it, and the map that its mosaic gives as it is."""

    farm: FarmLook
    raw: NDArray[np.uint16]  # (line, sample, band)
    classes: NDArray[np.uint8]


def _prepare_store(seed: int) -> CapturedToStore:
    farm = look_at_farm(seed, STORE_SHAPE)
    raw = SimulatedSweep(farm.source, farm.full[0]).read(0, RAW_LINES)
    return CapturedToStore(farm, raw, _map_of(farm, farm.mosaic))


def _map_of(farm: FarmLook, mosaic: Values) -> NDArray[np.uint8]:
    weights, p = farm.weights, farm.grid.patch
    empty = np.empty((0, p, p, weights.basis.columns), np.float32)
    seen = glance(weights, mosaic, farm.scene.wavelength_nm, farm.grid)
    return segment(weights, seen, empty, np.empty(0, np.int64)).classes


def _bytes_a_sample(state: CapturedToStore, _codec: Setting, made: Stored) -> float:
    size, values = made
    assert np.array_equal(values, state.raw), "a codec of raw numbers must give them back"
    return size / state.raw.size


def _classes_changed(state: CapturedToStore, _bits: Setting, made: Stored) -> float:
    return float(np.mean(_map_of(state.farm, np.asarray(made[1], np.float32)) != state.classes))


CODEC = Tradeoff(
    stage="store",
    knob="codec",
    error="bytes stored a sample",
    unit="sample",
    reference=f"{RAW_LINES} raw lines of a farm, uint16, given back exactly",
    settings=CODECS,
    prepare=_prepare_store,
    run=lambda state, codec: store_in_memory(state.raw, str(codec)),
    judge=_bytes_a_sample,
    work=lambda state, _codec: float(state.raw.size),
)
BITS = Tradeoff(
    stage="store",
    knob="kept bits",
    error="share of pixels whose class changes",
    unit="px*band",
    reference=f"the map that the coarse mosaic of a farm of {STORE_SHAPE[1]} x {STORE_SHAPE[0]} px gives unrounded",
    settings=(23.0, 13.0, 11.0, 9.0, 7.0, 5.0),
    prepare=_prepare_store,
    run=lambda state, bits: store_in_memory(
        state.farm.mosaic if int(bits) >= 23 else round_bits(state.farm.mosaic, int(bits)), "zstd-3"
    ),
    judge=_classes_changed,
    work=lambda state, _bits: float(state.farm.mosaic.size),
)
SIZE = replace(
    BITS,
    knob="kept bits, size",
    error="bytes stored a sample",
    reference="the coarse mosaic, float32, rounded to so many bits",
    judge=lambda state, _bits, made: made[0] / state.farm.mosaic.size,
)
register_all(BUDGET, SEATS, PRECISION, BAND_COUNT, *AGREEMENT, CODEC, BITS, SIZE)
