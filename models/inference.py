"""Use of a trained segmenter on one scene: glance at the coarse pass, then read coarse and fine together."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from models.weights import Weights
from pipeline.errors import ShapeError
from pipeline.grid import SceneGrid, pad_by_reflection

if TYPE_CHECKING:
    from torch import Tensor

PATCHES_AT_ONCE = 64  # their features fit the caches; larger chunks go to memory and back at every layer


@dataclass(frozen=True)
class CoarseLook:
    """The coarse pass of a scene, or of a region of a field, on the padded coarse grid."""

    grid: SceneGrid
    columns: NDArray[np.float32]  # (y, x, column) normalised
    origin: tuple[int, int] = field(default=(0, 0), kw_only=True)  # row and column of the field's seat it begins at


@dataclass(frozen=True)
class Glance(CoarseLook):
    """What the coarse pass alone says of a scene, on the padded coarse grid."""

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
    return read_glance(weights, look_coarsely(weights, [coarse], wavelength_nm, grid))


def look_coarsely(
    weights: Weights,
    strips: Iterable[NDArray[np.floating]],
    wavelength_nm: NDArray[np.floating],
    grid: SceneGrid,
    *,
    origin: tuple[int, int] = (0, 0),
) -> CoarseLook:
    """Bring the coarse mosaic to the spectral columns of the weights, some rows at a time.

    Parameters
    ----------
    strips
        (y, x, band) parts of the mosaic from the top down; together of the shape ``grid.coarse_shape``.
    origin
        Row and column of the seat of a larger field in which the grid begins.

    Raises
    ------
    ShapeError : the mosaic does not fit the grid, or the grid the weights.
    """
    _check_grid(weights, grid)
    columns, filled = np.empty((*grid.coarse_shape, weights.config.columns), np.float32), 0
    for strip in strips:
        last = filled + len(strip)
        if strip.shape[1] != grid.coarse_shape[1] or last > grid.coarse_shape[0]:
            raise ShapeError(
                f"the coarse mosaic is {(last, strip.shape[1])}, the scene grid expects {grid.coarse_shape}"
            )
        columns[filled:last] = weights.columns(strip, wavelength_nm)
        filled = last
    if filled != grid.coarse_shape[0]:
        raise ShapeError(
            f"the coarse mosaic is {(filled, grid.coarse_shape[1])}, the scene grid expects {grid.coarse_shape}"
        )
    y, x = grid.padded_shape
    padded = pad_by_reflection(columns, (y // grid.factor, x // grid.factor))
    return CoarseLook(grid, np.ascontiguousarray(padded, np.float32), origin=origin)


def glance_of_columns(weights: Weights, columns: NDArray[np.generic], grid: SceneGrid) -> Glance:
    """Read normalised columns of the padded coarse grid, (y, x, column)."""
    return read_glance(weights, CoarseLook(grid, np.ascontiguousarray(columns, np.float32)))


def read_glance(weights: Weights, look: CoarseLook) -> Glance:
    """Read a coarse look alone."""
    import torch

    with torch.inference_mode():
        logits = _read(weights, look, None, np.empty(0, np.int64))[1]
        probability = logits[0].softmax(dim=0).permute(1, 2, 0).numpy()
    return Glance(look.grid, look.columns, np.ascontiguousarray(probability), origin=look.origin)


def segment(weights: Weights, seen: CoarseLook, patches: NDArray[np.floating], seats: NDArray[np.integer]) -> ClassMap:
    """Draw the class map from the coarse look and the fine patches.

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
    import torch

    grid, p = seen.grid, seen.grid.patch
    numbers = np.asarray(seats, np.int64)
    _check_seats(numbers, grid)
    expected = (len(numbers), p, p, weights.config.columns)
    if patches.shape != expected:
        raise ShapeError(f"expected patches of shape {expected} (seat, y, x, column), got {patches.shape}")
    with torch.inference_mode():
        fine = torch.from_numpy(np.nan_to_num(np.asarray(patches, np.float32), nan=0.0, posinf=0.0, neginf=0.0))
        fine_classes, coarse_logits = _read(weights, seen, fine, numbers)
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
    weights: Weights, look: CoarseLook, fine: Tensor | None, seats: NDArray[np.int64]
) -> tuple[list[tuple[NDArray[np.uint8], NDArray[np.float32]]], Tensor]:
    """Classes and confidence of each fine patch, and the coarse logits, after one reading of both scales."""
    import torch

    model = weights.segmenter.eval()
    origin = torch.tensor([look.origin]) if any(look.origin) else None
    view = model.view(torch.from_numpy(look.columns).permute(2, 0, 1)[None].contiguous(), origin)
    numbers = torch.from_numpy(seats)[None]
    chunks = [] if fine is None else list(torch.split(fine.permute(0, 3, 1, 2), PATCHES_AT_ONCE))
    described = [model.stem(chunk.contiguous(), coarse=False) for chunk in chunks]
    empty = torch.zeros(1, 0, model.config.dim)
    tokens = torch.cat([token for _, token in described])[None] if described else empty
    grid = model.encode(view, tokens, numbers, origin)
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
    import torch
    import torch.nn.functional as F  # noqa: N812 - its usual name

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
