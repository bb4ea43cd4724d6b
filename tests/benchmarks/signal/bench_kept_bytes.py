"""Half of the bytes: does it pay to store some places more precisely than others?

Scores of a farm of one swath are rounded in coarser steps until they take half: all alike, each score alone or with the
means of blocks kept, or by blocks of 32 x 32 spectra, those that matter most in steps of the noise and all others in
steps of six deviations. What matters most is said by the entropy of the map, by where the coarse steps change it, by
chance, or by who knows the truth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from measure import Row
from numpy.typing import NDArray

from flows.settings.survey_settings import SignalChoice
from flows.tradeoff import store
from models.evaluation.metrics import confusion, mean_iou
from models.network.machine import one_thread
from models.network.spectral import LineSpec
from models.reading.inference import DrawnMap, coarse_prediction_of_patches, segment
from pipeline.geometry.grid import SceneGrid
from pipeline.rectify.region import read_patches
from pipeline.signal.components import Components
from pipeline.signal.condense import calibrated_blocks, score_lines, whole_steps
from pipeline.signal.subspace import SignalStatistics, find_components
from storage.arrays.layout import numbers_in_memory

SEEDS = (0, 1, 2)
BLOCK = 32
HALF, FINE, COARSE = 3.0, 1.0, 6.0  # steps: of all for half of the bytes; of what matters, and of the rest

Floats = NDArray[np.floating]


@dataclass(frozen=True)
class Farm:
    """The scores of a farm's lines, and how its map is drawn."""

    scan: store.ScanLines
    components: Components
    scores: NDArray[np.float32]  # (line, sample, component)
    maps: list[tuple[DrawnMap, SceneGrid, NDArray[np.uint8], float]]  # the last one drawn: grid, labels and mIoU

    def size(self, steps: Floats) -> float:
        """Bytes a spectrum."""
        packed = numbers_in_memory(np.ascontiguousarray(steps.transpose(2, 0, 1), np.int16))[0]
        return packed / steps[..., 0].size

    def draw(self, scores: Floats) -> tuple[DrawnMap, SceneGrid, NDArray[np.uint8], float]:
        """Map, grid, labels and mIoU [%] of restored scores."""
        self.scan.miou(self.components.restore(scores.astype(np.float32)))
        return self.maps[-1]

    def stored(self, fine: NDArray[np.bool_]) -> tuple[float, Floats]:
        """Bytes a spectrum and restored scores with (block, block) that are ``fine``."""
        here = np.kron(fine, np.ones((BLOCK, BLOCK), np.bool_))[: len(self.scores), : self.scores.shape[1], None]
        coarse, precise = whole_steps(self.scores, COARSE), whole_steps(self.scores, FINE)
        return self.size(np.where(here, precise, coarse)), np.where(here, precise * FINE, coarse * COARSE)


def rows() -> list[Row]:
    """Every way on three farms."""
    with one_thread():
        return [row for seed in SEEDS for row in _rows_of(_farm(seed), seed)]


def _farm(seed: int) -> Farm:
    maps = list[Any]()

    def judge(weights: Any, columns: Any, grid: SceneGrid, labels: NDArray[np.uint8], capture: LineSpec) -> float:
        index = grid.valid_patches()
        seen = coarse_prediction_of_patches(weights, columns, grid, capture)
        drawn = segment(weights, seen, columns[index], index, every_class=True)
        score = mean_iou(confusion(labels, drawn.classes, weights.config.classes))
        maps.append((drawn, grid, labels, 100 * score))
        return score

    store._miou = judge
    scan, choice = store.scan_farm(seed), SignalChoice()
    found = SignalStatistics(scan.values.shape[2], scan.values[..., 0].size)
    blocks = list(calibrated_blocks(scan.lines, scan.camera))
    for _, values, valid in blocks:
        found.add(values, valid)
    components = find_components(found, false_alarm=choice.false_alarm, least=choice.least)
    scores = np.concatenate([score_lines(values, valid, components).scores for _, values, valid in blocks])
    return Farm(scan, components, scores, maps)


def _rows_of(farm: Farm, seed: int) -> list[Row]:
    scores = farm.scores
    fine, grid, labels, whole = farm.draw(whole_steps(scores, FINE) * FINE)
    rough, _, _, _ = farm.draw(whole_steps(scores, COARSE) * COARSE)
    uniform, alone = whole_steps(scores, HALF), np.rint(scores / HALF)
    half, found = farm.size(uniform), farm.draw(uniform * HALF)[3]
    assert fine.log_probability is not None
    block, shape = _blocks(farm, grid)

    def by_block(pixels: Floats) -> Floats:
        counts = np.bincount(block.ravel(), minlength=shape[0] * shape[1])
        return np.bincount(block.ravel(), pixels.ravel(), counts.size) / np.maximum(counts, 1)

    worse = (rough.classes != labels).astype(float) - (fine.classes != labels)
    entropy = -(np.exp(fine.log_probability) * fine.log_probability).sum(axis=-1)
    worth = {
        "entropy": by_block(entropy),
        "changed": by_block((rough.classes != fine.classes).astype(float)),
        "chance": np.random.default_rng(seed).random(shape[0] * shape[1]),
        "the truth": by_block(worse),
    }
    scored = {name: farm.draw(_within(farm, -one, shape, half))[3] for name, one in worth.items()}
    ahead = max(scored["entropy"], scored["changed"]) - found
    figure = ", ".join(f"{name} {score:.2f}" for name, score in scored.items())
    each = f"in steps of 1: {whole:.2f} for {farm.size(whole_steps(scores, FINE)):.2f} B"
    return [
        Row(
            f"farm {seed}: mIoU for {half:.2f} B a spectrum, all in steps of {HALF:g}",
            f"{found:.2f}",
            "",
            None,
            f"each score rounded alone: {farm.draw(alone * HALF)[3]:.2f} for {farm.size(alone):.2f} B; {each}",
        ),
        Row(f"farm {seed}: some blocks in steps of 1, others of 6, by", figure, ">= 1 ahead", ahead >= 1, ""),
    ]


def _blocks(farm: Farm, grid: SceneGrid) -> tuple[NDArray[np.int64], tuple[int, int]]:
    """Block of lines and samples that shows each pixel (y, x) of the field, and how many there are."""
    lines, samples = farm.scores.shape[:2]
    places = np.stack(np.meshgrid(np.arange(lines), np.arange(samples), indexing="ij"), -1).astype(np.float32)
    plain = replace(farm.scan.lines, references=store._unit_references(places.shape), data=places)
    index = grid.valid_patches()
    values, _ = read_patches([plain], farm.scan.camera, grid, index, "nearest")
    image = np.zeros((*grid.padded_shape, 2), np.float32)
    for patch, (y, x) in zip(values, grid.patch_origin(index), strict=True):
        image[y : y + grid.patch, x : x + grid.patch] = patch
    seen = np.nan_to_num(image[: grid.height, : grid.width]).astype(np.int64) // BLOCK
    shape = (-(-lines // BLOCK), -(-samples // BLOCK))
    return seen[..., 0] * shape[1] + seen[..., 1], shape


def _within(farm: Farm, rank: Floats, shape: tuple[int, int], most: float) -> Floats:
    """Restored scores with as many blocks fine, in order of ``rank``, as ``most`` bytes a spectrum hold."""
    order = np.argsort(rank, kind="stable")

    def chosen(count: int) -> NDArray[np.bool_]:
        fine = np.zeros(len(order), np.bool_)
        fine[order[:count]] = True
        return fine.reshape(shape)

    fits: Callable[[int], bool] = lambda count: farm.stored(chosen(count))[0] <= most  # noqa: E731
    low, high = 0, len(order)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    return farm.stored(chosen(low))[1]
