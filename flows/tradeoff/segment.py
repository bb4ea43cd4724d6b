"""Trade-offs of segmenting: seats, precision and bands against the labels, and against the map of everything."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flows.tradeoff.entries import Level, Setting, Tradeoff, register
from flows.tradeoff.farm import FarmLook, look_at_farm
from models.evaluation.metrics import confusion, mean_iou
from models.policies.policies import score_seats
from models.reading.inference import CoarseLook, DrawnMap, Precision, glance, look_coarsely, read_glance, segment
from pipeline.planning.selection import frame_seats
from pipeline.rectify.region import read_seats
from pipeline.simulator.simulated import SimulatedSweep

SHAPE = (384, 480)
SHARES = (1.0, 0.35, 0.2, 0.15, 0.1, 0.05, 0.0)
PRECISIONS = ("float32", "bfloat16")
BANDS = (270.0, 90.0, 30.0, 15.0, 8.0, 4.0)
POLICY = "gain"
COLUMN_BYTES, MAP_BYTES = 4 * 24, 5  # of a pixel: columns of the farm's weights; class and confidence

Values = NDArray[np.float32]


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


def _prepare(seed: int) -> Farm:
    from models.network.process import keep_freed_memory

    keep_freed_memory()  # as surveys do
    farm = look_at_farm(seed, SHAPE)
    fine = _fine_values(farm)
    other = look_at_farm(seed, SHAPE, noise_seed=seed + 1)
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
    """Scene values of every valid seat, (seat, p, p, band)."""
    sweeps = [SimulatedSweep(farm.source, sweep) for sweep in farm.full]
    values, _ = read_seats(sweeps, farm.source.camera, farm.grid, farm.grid.valid_seats(), "catmull-rom")
    return np.asarray(values, np.float32)


def _with_seats(state: Farm, share: Setting) -> DrawnMap:
    """Glance, score and draw; with every seat there is nothing to choose."""
    weights, wanted = state.farm.weights, float(share)
    if wanted == 1:
        return segment(weights, state.look, state.columns, state.seats)
    seen = read_glance(weights, state.look)
    scores = score_seats(POLICY, seen)
    chosen = frame_seats(scores, wanted, state.farm.grid.valid_share().ravel() > 0).seats
    return segment(weights, seen, state.columns[np.searchsorted(state.seats, chosen)], chosen)


def _in_precision(state: Farm, precision: Setting) -> DrawnMap:
    chosen: Precision = "bfloat16" if precision == "bfloat16" else "float32"
    return segment(state.farm.weights, state.look, state.columns, state.seats, precision=chosen)


def _with_bands(state: Farm, bands: Setting) -> DrawnMap:
    """From scene values on: fewer bands are fewer values to bring to spectral columns."""
    weights, pixels = state.farm.weights, state.pixels[bands]
    seen = glance(weights, pixels.coarse, pixels.wavelength_nm, state.farm.grid)
    return segment(weights, seen, weights.columns(pixels.fine, pixels.wavelength_nm), state.seats)


def _miss(state: Farm, _setting: Setting, drawn: DrawnMap) -> float:
    return 1 - mean_iou(confusion(state.farm.labels, drawn.classes, state.farm.weights.config.classes))


def _disagreement(state: Farm, _setting: Setting, drawn: DrawnMap) -> float:
    return float(np.mean(drawn.classes != state.reference.classes))


def _accuracy_of_everything(state: Farm) -> tuple[Level, ...]:
    return (
        Level("every seat and band in float32", _miss(state, 1.0, state.reference)),
        Level("the same, noise drawn anew", _miss(state, 1.0, state.again)),
    )


def _noise(state: Farm) -> tuple[Level, ...]:
    return (Level("everything captured again", _disagreement(state, 1.0, state.again)),)


_PX = f"a farm of {SHAPE[1]} x {SHAPE[0]} px"
SEATS = register(
    Tradeoff(
        stage="segment",
        knob="share of seats",
        error="1 - mIoU",
        unit="scene px",
        reference=f"labels of {_PX}; policy {POLICY}, seats free of each other, glance and scores included",
        settings=SHARES,
        prepare=_prepare,
        run=_with_seats,
        judge=_miss,
        work=lambda state, _share: float(state.farm.labels.size),
        levels=_accuracy_of_everything,
        moved_bytes=float(COLUMN_BYTES + MAP_BYTES),
    )
)
PRECISION = register(
    replace(SEATS, knob="precision", reference=f"labels of {_PX}; every seat", settings=PRECISIONS, run=_in_precision)
)
BAND_COUNT = register(
    replace(
        SEATS,
        knob="bands",
        reference=f"labels of {_PX}; every seat, from scene values to the map",
        settings=BANDS,
        run=_with_bands,
        moved_bytes=4 * min(BANDS) + MAP_BYTES,
    )
)
AGREEMENT = tuple(
    register(
        replace(
            entry,
            knob=f"{entry.knob}, agreement",
            error="share of pixels whose class changes",
            judge=_disagreement,
            reference=f"the map of every seat and band of {_PX} in float32",
            levels=_noise,
        )
    )
    for entry in (SEATS, PRECISION, BAND_COUNT)
)
