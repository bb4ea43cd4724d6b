"""Use of a trained segmenter on one scene: glance at the coarse pass, then read coarse and fine together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 - its usual name
from numpy.typing import NDArray
from torch import Tensor

from models.weights import Weights
from pipeline.errors import ShapeError
from pipeline.grid import SceneGrid, pad_by_reflection

PATCHES_AT_ONCE = 64  # their features fit the caches; larger chunks go to memory and back at every layer


@dataclass(frozen=True)
class Glance:
    """What the coarse pass alone says of a scene, on the padded coarse grid."""

    grid: SceneGrid
    columns: NDArray[np.float32]  # (y, x, column) normalised
    probability: NDArray[np.float32]  # (y, x, class)


@dataclass(frozen=True)
class ClassMap:
    """The map of a scene: class of each pixel and the probability given to it."""

    classes: NDArray[np.uint8]  # (y, x)
    confidence: NDArray[np.float32]  # (y, x)


def glance(
    weights: Weights, coarse: NDArray[np.floating], wavelength_nm: NDArray[np.floating], grid: SceneGrid
) -> Glance:
    """Read the coarse mosaic alone.

    Parameters
    ----------
    coarse
        (y, x, band) scene values of the coarse pass, shape ``grid.coarse_shape``; NaN where nothing was captured.

    Raises
    ------
    ShapeError : the mosaic does not fit the grid, or the grid the weights.
    """
    _check_grid(weights, grid)
    if coarse.shape[:2] != grid.coarse_shape:
        raise ShapeError(f"the coarse mosaic is {coarse.shape[:2]}, the scene grid expects {grid.coarse_shape}")
    y, x = grid.padded_shape
    padded = pad_by_reflection(weights.columns(coarse, wavelength_nm), (y // grid.factor, x // grid.factor))
    return glance_of_columns(weights, padded, grid)


def glance_of_columns(weights: Weights, columns: NDArray[np.generic], grid: SceneGrid) -> Glance:
    """Read normalised columns of the padded coarse grid, (y, x, column)."""
    ready = np.ascontiguousarray(columns, np.float32)
    with torch.inference_mode():
        logits = _read(weights, ready, None, np.empty(0, np.int64))[1]
        probability = logits[0].softmax(dim=0).permute(1, 2, 0).numpy()
    return Glance(grid, ready, np.ascontiguousarray(probability))


def segment(weights: Weights, seen: Glance, patches: NDArray[np.floating], seats: NDArray[np.integer]) -> ClassMap:
    """Draw the class map from the glance and the fine patches.

    Parameters
    ----------
    patches
        (seat, p, p, column) normalised columns of the fine pass; anything not finite counts as the median.
    seats
        (seat,) their numbers on the grid, each once.

    Returns
    -------
    Maps of the scene's own size. Without a seat this is the glance brought up to the fine grid.

    Raises
    ------
    ShapeError : a seat given twice or outside the grid, or patches of another shape.
    """
    grid, p = seen.grid, seen.grid.patch
    numbers = np.asarray(seats, np.int64)
    _check_seats(numbers, grid)
    expected = (len(numbers), p, p, weights.config.columns)
    if patches.shape != expected:
        raise ShapeError(f"expected patches of shape {expected} (seat, y, x, column), got {patches.shape}")
    with torch.inference_mode():
        fine = torch.from_numpy(np.nan_to_num(np.asarray(patches, np.float32), nan=0.0, posinf=0.0, neginf=0.0))
        fine_classes, coarse_logits = _read(weights, seen.columns, fine, numbers)
        drawn = _draw_coarse(coarse_logits, grid)
    for (values, confidence), (y, x) in zip(fine_classes, grid.seat_origin(numbers), strict=True):
        drawn.classes[y : y + p, x : x + p] = values
        drawn.confidence[y : y + p, x : x + p] = confidence
    scene = np.s_[: grid.height, : grid.width]
    return ClassMap(drawn.classes[scene].copy(), drawn.confidence[scene].copy())


def _check_seats(seats: NDArray[np.int64], grid: SceneGrid) -> None:
    count = grid.seat_shape[0] * grid.seat_shape[1]
    if outside := seats[(seats < 0) | (seats >= count)].tolist():
        raise ShapeError(f"seat {outside[0]} is none of the {count} seats of the scene, 0..{count - 1}")
    distinct, times = np.unique(seats, return_counts=True)
    if repeated := distinct[times > 1].tolist():
        raise ShapeError(f"seat {repeated[0]} is given more than once; give each seat one patch")


def _check_grid(weights: Weights, grid: SceneGrid) -> None:
    config = weights.config
    if (grid.patch, grid.factor) != (config.patch, config.factor):
        raise ShapeError(
            f"the weights read patches of {config.patch} px at a factor of {config.factor},"
            f" the grid has {grid.patch} px and {grid.factor}"
        )


def _read(
    weights: Weights, columns: NDArray[np.float32], fine: Tensor | None, seats: NDArray[np.int64]
) -> tuple[list[tuple[NDArray[np.uint8], NDArray[np.float32]]], Tensor]:
    """Classes and confidence of each fine patch, and the coarse logits, after one reading of both scales."""
    model = weights.segmenter.eval()
    view = model.view(torch.from_numpy(columns).permute(2, 0, 1)[None].contiguous())
    numbers = torch.from_numpy(seats)[None]
    chunks = [] if fine is None else list(torch.split(fine.permute(0, 3, 1, 2), PATCHES_AT_ONCE))
    described = [model.stem(chunk.contiguous(), coarse=False) for chunk in chunks]
    empty = torch.zeros(1, 0, model.config.dim)
    tokens = torch.cat([token for _, token in described])[None] if described else empty
    grid = model.encode(view, tokens, numbers)
    canvas = model.coarse_canvas(view, grid)
    drawn: list[tuple[NDArray[np.uint8], NDArray[np.float32]]] = []
    for number, (features, _) in zip(torch.split(numbers, PATCHES_AT_ONCE, dim=1), described, strict=False):
        context = model.seat_context(grid, number)[0]
        logits = model.decode_fine(features, context, model.canvas_windows(canvas, number))
        confidence, classes = logits.softmax(dim=1).max(dim=1)
        drawn.extend(zip(classes.to(torch.uint8).numpy(), confidence.numpy(), strict=True))
    return drawn, model.coarse_logits(canvas)


def _draw_coarse(logits: Tensor, grid: SceneGrid) -> ClassMap:
    """Bring coarse logits up to the padded fine grid and decide, in strips of rows."""
    y, x = grid.padded_shape
    drawn = ClassMap(np.empty((y, x), np.uint8), np.empty((y, x), np.float32))
    cell = grid.patch
    padded = F.pad(logits, (0, 0, 1, 1), mode="replicate")
    for top in range(0, y // grid.factor, cell):
        strip = F.interpolate(
            padded[:, :, top : top + cell + 2], scale_factor=grid.factor, mode="bilinear", align_corners=False
        )[0, :, grid.factor : -grid.factor]
        confidence, classes = strip.softmax(dim=0).max(dim=0)
        rows = slice(top * grid.factor, (top + cell) * grid.factor)
        drawn.classes[rows], drawn.confidence[rows] = classes.to(torch.uint8).numpy(), confidence.numpy()
    return drawn
