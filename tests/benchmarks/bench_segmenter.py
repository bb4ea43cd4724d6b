"""The segmenter's throughput: many frames packed, 270 bands against 4, what a fraction of the patches costs, half precision.

Weights are drawn, not trained: time does not depend on them. ``bench_regions.py`` has fields too large to read whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from measure import Row, Timing, ratio, time_in_turn
from numpy.typing import NDArray

from models.network.layers import Encoder, Memory, cut
from models.network.machine import keep_freed_memory, one_thread
from models.network.segmenter import Segmenter
from models.network.sizes import SegmenterConfig, multiply_adds
from models.network.spectral import Normalisation, SpectralBasis
from models.policies.policies import score_multiply_adds, score_patches
from models.reading.inference import (
    CoarsePass,
    CoarsePrediction,
    DrawnMap,
    coarse_prediction,
    draw_coarse,
    read_coarse_prediction,
    segment,
    segment_batch,
)
from models.weights.files import Weights
from pipeline.geometry.grid import SceneGrid
from pipeline.planning.selection import frame_patches

FRAMES, PADDED_AT_ONCE = 64, 8
SIDES_PX, FRACTIONS = (96, 480), (0.0, 0.05, 0.1, 0.2, 0.35)
FRAME = SceneGrid(966, 1296, 32, 4)
FRAME_SIZES = {"classes": 3, "columns": 2, "patch": 32, "factor": 4}
COST_GOALS = {0.05: 0.07, 0.10: 0.10, 0.15: 0.17, 0.20: 0.17, 0.35: None}
FIELD = SceneGrid(384, 640, 16, 4)
FIELD_SIZES = {"classes": 8, "columns": 24, "patch": 16, "factor": 4}
MANY, FEW, MOST_BANDS_RATIO = 270, 4, 1.5
ROUNDS = 5


@dataclass(frozen=True)
class Frame:
    """A frame to read: its coarse pass, and the patches of some of its patches."""

    scan_pass: CoarsePass
    patches: NDArray[np.float32]
    patch_index: NDArray[np.int64]


def rows() -> list[Row]:
    keep_freed_memory()
    with one_thread():
        return [*_batches(), *_bands(), *_fractions()]


def drawn_weights(**sizes: int) -> Weights:
    """Weights of these sizes that nothing was learned by."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = Segmenter(SegmenterConfig(**sizes)).eval()  # type: ignore[arg-type]
    columns, classes = model.config.columns, model.config.classes
    flat = Normalisation(np.zeros(columns, np.float32), np.ones(columns, np.float32), np.eye(columns, dtype=np.float32))
    names, colours = tuple(map(str, range(classes))), np.zeros((classes, 3), np.uint8)
    return Weights(model, SpectralBasis(400.0, 1000.0, columns), flat, names, colours)


def drawn_frame(weights: Weights, grid: SceneGrid, fraction: float, rng: np.random.Generator) -> Frame:
    """Noise, with so much of the patches in use."""
    p, columns = grid.patch, weights.config.columns
    y, x = (size // grid.factor for size in grid.padded_shape)
    valid = grid.valid_patches()
    patch_index = np.sort(rng.permutation(valid)[: round(fraction * len(valid))]).astype(np.int64)
    patches = rng.standard_normal((len(patch_index), p, p, columns), dtype=np.float32)
    return Frame(CoarsePass(grid, rng.standard_normal((y, x, columns), dtype=np.float32)), patches, patch_index)


def _batches() -> list[Row]:
    weights, rng = drawn_weights(**FRAME_SIZES), np.random.default_rng(0)
    sides, fractions = rng.integers(*SIDES_PX, (FRAMES, 2)), rng.choice(FRACTIONS, FRAMES)
    frames = [
        drawn_frame(weights, SceneGrid(int(y), int(x), 32, 4), float(fraction), rng)
        for (y, x), fraction in zip(sides, fractions, strict=True)
    ]
    calls = {
        "packed": partial(_packed, weights, frames),
        "one by one": partial(_one_by_one, weights, frames),
        "padded": partial(_padded, weights, frames),
    }
    clocks = time_in_turn(calls, ROUNDS)
    apart = max(
        float(np.abs(one.confidence - other.confidence).max())
        for one, other in zip(calls["packed"](), calls["one by one"](), strict=True)
    )
    alike = all(
        (one.classes == other.classes).all()
        for one, other in zip(calls["packed"](), calls["one by one"](), strict=True)
    )
    alone, padded = (ratio(clocks, other, "packed") for other in ("one by one", "padded"))
    sizes = f"sides of {SIDES_PX[0]} to {SIDES_PX[1]} px, 0 to {max(FRACTIONS):.0%} of the patches"
    return [
        Row(
            f"{FRAMES} mixed frames packed ({sizes}): CPU of one by one over packed",
            f"{alone:.2f}",
            ">= 1",
            alone >= 1,
            f"frames a second of CPU: {', '.join(f'{name} {_rate(clock):.1f}' for name, clock in clocks.items())}",
        ),
        Row(
            f"the same: CPU of batches of {PADDED_AT_ONCE} padded to their largest over packed",
            f"{padded:.2f}",
            "> 1",
            padded > 1,
            "padded: the same network, masked attention",
        ),
        Row(
            "packed against one by one: greatest difference of confidence",
            f"{apart:.1e}",
            "<= 1e-6, same classes",
            apart <= 1e-6 and alike,
        ),
    ]


def _rate(clock: Timing) -> float:
    return FRAMES / clock.cpu_min_s


def _packed(weights: Weights, frames: Sequence[Frame]) -> list[DrawnMap]:
    scan_passes, patches, patch_index = zip(
        *((one.scan_pass, one.patches, one.patch_index) for one in frames), strict=True
    )
    return segment_batch(weights, scan_passes, patches, patch_index)


def _one_by_one(weights: Weights, frames: Sequence[Frame]) -> list[DrawnMap]:
    return [segment(weights, one.scan_pass, one.patches, one.patch_index) for one in frames]


def _padded(weights: Weights, frames: Sequence[Frame]) -> list[DrawnMap]:
    """The usual way: batches of equal shapes, what is missing filled with zeros and masked in attention."""
    with torch.inference_mode():
        starts = range(0, len(frames), PADDED_AT_ONCE)
        return [drawn for first in starts for drawn in _padded_batch(weights, frames[first : first + PADDED_AT_ONCE])]


def _padded_batch(weights: Weights, frames: Sequence[Frame]) -> list[DrawnMap]:
    model, config, p = weights.segmenter, weights.config, weights.config.patch
    rows, columns = (max(one.scan_pass.columns.shape[axis] for one in frames) // p for axis in (0, 1))
    most = max(len(one.patch_index) for one in frames)
    coarse = torch.zeros(len(frames), config.columns, rows * p, columns * p)
    there = torch.zeros(len(frames), rows, columns, dtype=torch.bool)
    fine, patch_index = (
        torch.zeros(len(frames), most, config.columns, p, p),
        torch.zeros(len(frames), most, dtype=torch.int64),
    )
    used = torch.zeros(len(frames), most, dtype=torch.bool)
    for number, one in enumerate(frames):
        y, x = one.scan_pass.columns.shape[:2]
        coarse[number, :, :y, :x] = torch.from_numpy(one.scan_pass.columns).permute(2, 0, 1)
        there[number, : y // p, : x // p] = True
        row, column = np.divmod(one.patch_index, one.scan_pass.grid.patch_shape[1])
        fine[number, : len(row)] = torch.from_numpy(one.patches).permute(0, 3, 1, 2)
        patch_index[number, : len(row)] = torch.from_numpy(row * columns * config.factor + column)
        used[number, : len(row)] = True
    side = config.token_side**2
    known, asked = (mask.flatten(1).repeat_interleave(side, dim=1) for mask in (there, used))
    features, tokens = model.coarse_stem(cut(coarse, model.config.patch)[0])
    read, memory = _masked(model.encoder, model.code_coarse(tokens, rows, columns), known, None)
    image = model.coarse_head(features, read.view(tokens.shape)) * there.flatten()[:, None, None, None]
    reading = model.reading_of(image, memory, rows, columns)
    logits = torch.zeros(len(frames), 0, config.classes, p, p)
    if most:
        features, tokens = model.fine_stem(fine.flatten(0, 1))
        coded = model.code_fine(tokens.view(len(frames), most, *tokens.shape[1:]), patch_index, columns)
        read, _ = _masked(model.encoder, coded, torch.cat([known, asked], dim=1), memory)
        windows = model.canvas_windows(reading.canvas, patch_index)
        logits = model.decode_fine(features, read.view(tokens.shape), windows).view(len(frames), most, -1, p, p)
    return [_drawn(one, reading.logits[number], logits[number]) for number, one in enumerate(frames)]


def _masked(
    encoder: Encoder, x: torch.Tensor, kept: torch.Tensor, before: list[Memory] | None
) -> tuple[torch.Tensor, list[Memory]]:
    memory = []
    for layer, block in enumerate(encoder.blocks):
        x, own = block(x, None if before is None else before[layer], kept)
        memory.append(own)
    return encoder.norm(x), memory


def _drawn(frame: Frame, coarse: torch.Tensor, fine: torch.Tensor) -> DrawnMap:
    grid, p = frame.scan_pass.grid, frame.scan_pass.grid.patch
    y, x = frame.scan_pass.columns.shape[:2]
    drawn = draw_coarse(coarse[None, :, :y, :x], grid)
    confidence, classes = (part.numpy() for part in fine[: len(frame.patch_index)].softmax(dim=1).max(dim=1))
    for (top, left), values, sure in zip(grid.patch_origin(frame.patch_index), classes, confidence, strict=True):
        drawn.classes[top : top + p, left : left + p] = values
        drawn.confidence[top : top + p, left : left + p] = sure
    scene = np.s_[: grid.height, : grid.width]
    return DrawnMap(drawn.classes[scene].copy(), drawn.confidence[scene].copy())


def _bands() -> list[Row]:
    """The whole way from scene values to the map, with all bands and with a few of the same pixels."""
    weights, rng = drawn_weights(**FIELD_SIZES), np.random.default_rng(0)
    nm = np.linspace(400, 1000, MANY)
    coarse = rng.uniform(0.1, 0.5, (*FIELD.coarse_shape, MANY)).astype(np.float32)
    valid = FIELD.valid_patches()
    patch_index = np.sort(rng.permutation(valid)[: round(0.35 * len(valid))])
    fine = rng.uniform(0.1, 0.5, (len(patch_index), FIELD.patch, FIELD.patch, MANY)).astype(np.float32)
    some = np.linspace(0, MANY - 1, FEW).astype(int)
    few = np.ascontiguousarray(coarse[..., some]), np.ascontiguousarray(fine[..., some])

    def draw(coarse: NDArray[np.float32], fine: NDArray[np.float32], nm: NDArray[np.float64]) -> DrawnMap:
        seen = coarse_prediction(weights, coarse, nm, FIELD)
        return segment(weights, seen, weights.columns(fine, nm), patch_index)

    clocks = time_in_turn({"many": partial(draw, coarse, fine, nm), "few": partial(draw, *few, nm[some])}, ROUNDS)
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
    """Glance, scores and map at each fraction of the patches over the map of every patch on its fastest path."""
    weights, rng = drawn_weights(**FRAME_SIZES), np.random.default_rng(0)
    every = drawn_frame(weights, FRAME, 1.0, rng)
    calls = {"all": lambda: segment(weights, every.scan_pass, every.patches, every.patch_index)}
    patches_of = {}
    for fraction in COST_GOALS:
        count = frame_patches(
            np.zeros(FRAME.valid_fraction().size), fraction, FRAME.valid_fraction().ravel() > 0
        ).patch_index
        patches_of[fraction] = len(count)
        calls[f"{fraction:.0%}"] = partial(_adaptive, weights, every, len(count))
    calls["35% in bfloat16"] = partial(_adaptive, weights, every, patches_of[0.35], "bfloat16")
    calls["all in bfloat16"] = lambda: segment(
        weights, every.scan_pass, every.patches, every.patch_index, precision="bfloat16"
    )
    clocks = time_in_turn(calls, ROUNDS)
    full = multiply_adds(weights.config, FRAME, len(every.patch_index), 2).total
    found = []
    for fraction, goal in COST_GOALS.items():
        cost = ratio(clocks, f"{fraction:.0%}", "all")
        score = score_multiply_adds("gain", weights.config, FRAME)
        macs = multiply_adds(weights.config, FRAME, patches_of[fraction], 2, score=score).total / full
        found.append(
            Row(
                f"CPU at {fraction:.0%} of the patches over every patch, frame of {FRAME.width} x {FRAME.height} px",
                f"{cost:.3f}",
                "" if goal is None else f"<= {goal}",
                None if goal is None else cost <= goal,
                f"multiply-adds {macs:.3f}; {clocks[f'{fraction:.0%}'].cpu_min_s:.3f} s against "
                f"{clocks['all'].cpu_min_s:.2f} s, coarse prediction and scorer included",
            )
        )
    half = {name: ratio(clocks, f"{name} in bfloat16", name) for name in ("35%", "all")}
    native = torch.ops.mkldnn._is_mkldnn_bf16_supported()
    return [
        *found,
        Row(
            "bfloat16 over float32: CPU at 35 % of the patches",
            f"{half['35%']:.2f}",
            peers=f"at every patch {half['all']:.2f}; the processor {'has' if native else 'lacks'} bfloat16 arithmetic",
        ),
    ]


def _adaptive(weights: Weights, every: Frame, count: int, precision: str = "float32") -> DrawnMap:
    seen: CoarsePrediction = read_coarse_prediction(weights, every.scan_pass, precision=precision)  # type: ignore[arg-type]
    scores = score_patches("gain", seen).ravel()[every.patch_index]
    best = np.sort(np.argsort(-scores, kind="stable")[:count])
    return segment(weights, seen, every.patches[best], every.patch_index[best], precision=precision)  # type: ignore[arg-type]
