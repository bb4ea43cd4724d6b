"""The segmenter's throughput: 270 bands against 4, and what a fraction of the patches costs.

Weights are drawn, not trained: time does not depend on them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from measure import Row, ratio, time_in_turn
from numpy.typing import NDArray

from models.network.machine import keep_freed_memory, one_thread
from models.network.segmenter import Segmenter
from models.network.sizes import SegmenterConfig, multiply_adds
from models.network.spectral import Normalisation, SpectralBasis
from models.policies.policies import score_multiply_adds, score_patches
from models.reading.inference import CoarsePass, DrawnMap, read_coarse_prediction, segment
from models.weights.files import Weights
from pipeline.geometry.grid import SceneGrid
from pipeline.planning.prices import frame_patches
from tests.models.conftest import coarse_prediction

FRAME = SceneGrid(966, 1296, 32, 1)
FRAME_SIZES = {"classes": 3, "columns": 2, "patch": 32}
SHARES = (0.05, 0.10, 0.15, 0.20, 0.35)
MOST_BEYOND = 1.2  # processor time of a share over its multiply-adds, both as parts of reading every patch
FIELD = SceneGrid(384, 640, 16, 1)
FIELD_SIZES = {"classes": 8, "columns": 24, "patch": 16}
MANY, FEW, MOST_BANDS_RATIO = 270, 4, 1.5
ROUNDS = 5


@dataclass(frozen=True)
class Frame:
    """A frame to read, and the numbers of its patches."""

    scan_pass: CoarsePass
    patch_index: NDArray[np.int64]

    def drawn(self, weights: Weights, seen: CoarsePass, patch_index: NDArray[np.int64]) -> DrawnMap:
        """Its map with some patches read in full."""
        return segment(weights, seen, seen.patches(patch_index), patch_index)


def rows() -> list[Row]:
    keep_freed_memory()
    with one_thread():
        return [*_bands(), *_fractions()]


def drawn_weights(**sizes: int) -> Weights:
    """Weights of these sizes that nothing was learned by."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = Segmenter(SegmenterConfig(**sizes)).eval()  # type: ignore[arg-type]
    columns, classes = model.config.columns, model.config.classes
    flat = Normalisation(np.zeros(columns, np.float32), np.ones(columns, np.float32), np.eye(columns, dtype=np.float32))
    names, colours = tuple(map(str, range(classes))), np.zeros((classes, 3), np.uint8)
    return Weights(model, SpectralBasis(400.0, 1000.0, columns), flat, names, colours)


def drawn_frame(weights: Weights, grid: SceneGrid, rng: np.random.Generator) -> Frame:
    """Noise."""
    image = rng.standard_normal((*grid.padded_shape, weights.config.columns), dtype=np.float32)
    return Frame(CoarsePass(grid, image), grid.valid_patches().astype(np.int64))


def _bands() -> list[Row]:
    """The whole way from scene values to the map, with all bands and with a few of the same pixels."""
    weights, rng = drawn_weights(**FIELD_SIZES), np.random.default_rng(0)
    nm = np.linspace(400, 1000, MANY)
    values = rng.uniform(0.1, 0.5, (FIELD.height, FIELD.width, MANY)).astype(np.float32)
    valid = FIELD.valid_patches()
    patch_index = np.sort(rng.permutation(valid)[: round(0.35 * len(valid))])
    some = np.linspace(0, MANY - 1, FEW).astype(int)
    few = np.ascontiguousarray(values[..., some])

    def draw(values: NDArray[np.float32], nm: NDArray[np.float64]) -> DrawnMap:
        seen = coarse_prediction(weights, values, nm, FIELD)
        return segment(weights, seen, seen.patches(patch_index), patch_index)

    clocks = time_in_turn({"many": partial(draw, values, nm), "few": partial(draw, few, nm[some])}, ROUNDS)
    found = ratio(clocks, "many", "few")
    spent = {name: clock.cpu_min_s for name, clock in clocks.items()}
    return [
        Row(
            f"{MANY} bands over {FEW} of the same pixels: CPU from values to map, 35 % of the patches of "
            f"{FIELD.width} x {FIELD.height} px",
            f"{found:.2f}",
            f"<= {MOST_BANDS_RATIO}",
            found <= MOST_BANDS_RATIO,
            f"{MANY} bands {spent['many']:.2f} s, {FEW} bands {spent['few']:.2f} s",
        )
    ]


def _fractions() -> list[Row]:
    """Overview, scores and map at each fraction of the patches over the map of every patch on its fastest path."""
    weights, rng = drawn_weights(**FRAME_SIZES), np.random.default_rng(0)
    every = drawn_frame(weights, FRAME, rng)
    calls = {"all": lambda: every.drawn(weights, every.scan_pass, every.patch_index)}
    patches_of = {}
    for fraction in SHARES:
        count = frame_patches(np.zeros(FRAME.valid_fraction().size), fraction, FRAME.valid_fraction().ravel() > 0)
        patches_of[fraction] = len(count)
        calls[f"{fraction:.0%}"] = partial(_adaptive, weights, every, len(count))
    clocks = time_in_turn(calls, ROUNDS)
    full = multiply_adds(weights.config, FRAME, len(every.patch_index), 2).total
    found = []
    for fraction in SHARES:
        cost = ratio(clocks, f"{fraction:.0%}", "all")
        score = score_multiply_adds("gain", weights.config, FRAME)
        macs = multiply_adds(weights.config, FRAME, patches_of[fraction], 2, score=score).total / full
        found.append(
            Row(
                f"CPU at {fraction:.0%} of the patches over every patch, frame of {FRAME.width} x {FRAME.height} px",
                f"{cost:.3f}",
                f"<= {MOST_BEYOND} x multiply-adds",
                cost <= MOST_BEYOND * macs,
                f"multiply-adds {macs:.3f}; {clocks[f'{fraction:.0%}'].cpu_min_s:.3f} s against "
                f"{clocks['all'].cpu_min_s:.2f} s, overview and scorer included",
            )
        )
    return found


def _adaptive(weights: Weights, every: Frame, count: int) -> DrawnMap:
    seen = read_coarse_prediction(weights, every.scan_pass)
    scores = score_patches("gain", seen).ravel()[every.patch_index]
    best = np.sort(np.argsort(-scores, kind="stable")[:count])
    return every.drawn(weights, seen, every.patch_index[best])
