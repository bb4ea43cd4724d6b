"""Use of a trained segmenter on one scene: an overview of everything, then a full reading of chosen patches."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from models.network.sizes import PATCHES_AT_ONCE, TOKEN_PX
from models.network.spectral import (
    Capture,
    CaptureMap,
    LineSpec,
    all_alive,
    dead_pixels,
    fill_dead,
    patches_of,
    readable,
    with_planes,
)
from models.weights.files import Weights
from pipeline.errors import ShapeError
from pipeline.geometry.grid import UNLABELLED, SceneGrid, pad_by_reflection
from pipeline.lazy import deferred
from pipeline.signal.components import Components

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from models.network.segmenter import Overview, Segmenter
else:
    torch = deferred("torch")

ROWS_DRAWN = 64  # at once


@dataclass(frozen=True)
class CoarsePass:
    """Spectral features that the overview reads of a scene, or of a region of a field, on the padded grid."""

    grid: SceneGrid
    columns: NDArray[np.float32]  # (y, x, column) normalised
    capture: Capture = field(default=LineSpec(), kw_only=True)
    origin: tuple[int, int] = field(default=(0, 0), kw_only=True)  # row and column of the field's patch it begins at
    living: NDArray[np.bool_] | None = field(default=None, kw_only=True)  # (token,) which are read; None: all
    out_of_range: NDArray[np.bool_] | None = field(default=None, kw_only=True)  # (y, x) of the scene: seen, and unread
    filled: NDArray[np.bool_] | None = field(default=None, kw_only=True)  # (y, x) nothing was seen of; None: of all was

    @property
    def seen_columns(self) -> NDArray[np.float32]:
        """The columns with NaN where nothing was seen, and others only were filled in."""
        return (
            self.columns if self.filled is None else np.where(self.filled[..., None], np.float32(np.nan), self.columns)
        )

    def patches(self, patch_index: NDArray[np.integer]) -> NDArray[np.float32]:
        """The columns of some patches, (patch, p, p, column)."""
        return np.asarray(patches_of(self.columns, self.grid.patch)[patch_index], np.float32)


@dataclass(frozen=True)
class Read:
    """An overview, by whom and of what: the full network corrects it."""

    by: Segmenter
    of: CoarsePass
    overview: Overview

    def counts_for(self, weights: Weights, coarse_pass: CoarsePass) -> bool:
        """Return whether these weights would read the same of this coarse pass."""
        alike = self.of.columns is coarse_pass.columns and self.of.living is coarse_pass.living
        told = self.of.origin == coarse_pass.origin and self.of.capture == coarse_pass.capture
        return self.by is weights.segmenter and alike and told


@dataclass(frozen=True)
class CoarsePrediction(CoarsePass):
    """Prediction of the overview for a scene, on the padded grid."""

    probability: NDArray[np.float32]  # (y, x, class)
    gain: NDArray[np.float32] | None = field(default=None, kw_only=True)  # (patch_y, patch_x) expected [nat per px]
    read: Read | None = field(default=None, kw_only=True, repr=False, compare=False)


@dataclass(frozen=True)
class DrawnMap:
    """The map of a scene: class of each pixel and the probability given to it."""

    classes: NDArray[np.uint8]  # (y, x), 255 where nothing can be said
    confidence: NDArray[np.float32]  # (y, x), NaN there
    log_probability: NDArray[np.float32] | None = None  # (y, x, class) of all classes, where that is asked for

    def of_scene(self, grid: SceneGrid) -> DrawnMap:
        """Give what of the map of a padded grid lies on the scene."""
        scene = np.s_[: grid.height, : grid.width]
        every = None if self.log_probability is None else self.log_probability[scene]  # a copy may not fit the memory
        return DrawnMap(self.classes[scene].copy(), self.confidence[scene].copy(), every)


def coarse_prediction(
    weights: Weights,
    values: NDArray[np.floating],
    wavelength_nm: NDArray[np.floating],
    grid: SceneGrid,
    *,
    capture: Capture = LineSpec(),  # noqa: B008 - a value
    factor: int = 1,
) -> CoarsePrediction:
    """Read an overview of scene values (y, x, band), in pixels of ``factor`` fine ones; NaN where none was captured.

    A value that is no reading by the weights' `most_value` counts as NaN.
    """
    seen = read_coarse_pass(weights, [values], wavelength_nm, grid, capture=capture, factor=factor)
    return read_coarse_prediction(weights, seen)


def read_coarse_pass(
    weights: Weights,
    strips: Iterable[NDArray[np.floating]],
    wavelength_nm: NDArray[np.floating],
    grid: SceneGrid,
    *,
    capture: Capture = LineSpec(),  # noqa: B008 - a value
    factor: int = 1,
    origin: tuple[int, int] = (0, 0),
    components: Components | None = None,
) -> CoarsePass:
    """Bring a mosaic to the spectral columns of the weights, some rows at a time; coarse pixels are repeated.

    ``strips`` are (y, x, band) parts of the mosaic from the top down, together the scene in pixels of ``factor`` fine
    ones a side, or (y, x, component) scores of ``components``; ``origin`` is the row and column of the patch of a
    larger field in which the grid begins.
    """
    s, (rows, width) = factor, (-(-grid.height // factor), -(-grid.width // factor))
    columns, filled = np.empty((rows, width, weights.config.columns), np.float32), 0
    known = np.zeros((rows, width), np.bool_)
    for strip in strips:
        last = filled + len(strip)
        if components is None:
            columns[filled:last] = weights.columns(strip, wavelength_nm)
        else:
            columns[filled:last] = weights.columns_of_scores(strip, components, wavelength_nm)
        known[filled:last] = ~np.isnan(strip).all(axis=-1)
        filled = last
    wild = (dead_pixels(columns) & known).repeat(s, 0).repeat(s, 1)[: grid.height, : grid.width]
    fine = columns.repeat(s, 0).repeat(s, 1)[: grid.height, : grid.width] if s > 1 else columns
    columns = np.ascontiguousarray(pad_by_reflection(fine, grid.padded_shape), np.float32)
    dead = dead_pixels(columns)
    return CoarsePass(
        grid,
        columns,
        capture=capture.padded(grid.padded_shape) if isinstance(capture, CaptureMap) else capture,
        origin=origin,
        living=_mend(columns, grid.patch),
        out_of_range=wild if wild.any() else None,
        filled=dead if dead.any() else None,
    )


def _mend(columns: NDArray[np.float32], p: int) -> NDArray[np.bool_] | None:
    """Fill dead pixels from their patch, in place, and tell which tokens live (None: all)."""
    dead = dead_pixels(columns)
    if not dead.any():
        return None
    holes = patches_of(dead, p)
    for number in np.flatnonzero(holes.any(axis=(1, 2))):  # one by one: a copy of a field may not fit the memory
        y, x = (p * int(at) for at in divmod(number, columns.shape[1] // p))
        columns[y : y + p, x : x + p] = fill_dead(columns[None, y : y + p, x : x + p], holes[number][None])[0]
    whole = np.pad(dead, [(0, -size % TOKEN_PX) for size in dead.shape], mode="edge")
    return readable(patches_of(whole, TOKEN_PX))


def coarse_prediction_of_columns(
    weights: Weights,
    columns: NDArray[np.generic],
    grid: SceneGrid,
    capture: Capture = LineSpec(),  # noqa: B008 - a value
) -> CoarsePrediction:
    """Read normalised columns of the padded grid, (y, x, column); dead ones count as in a mosaic."""
    given = np.ascontiguousarray(columns, np.float32)
    mended = given if all_alive(given) else given.copy()
    living = _mend(mended, grid.patch)
    return read_coarse_prediction(weights, CoarsePass(grid, mended, capture=capture, living=living))


def coarse_prediction_of_patches(
    weights: Weights,
    patches: NDArray[np.float32],
    grid: SceneGrid,
    capture: Capture = LineSpec(),  # noqa: B008 - a value
) -> CoarsePrediction:
    """Read normalised columns of all patches of the padded grid, (patch, p, p, column)."""
    (down, across), (y, x) = grid.patch_shape, grid.padded_shape
    image = patches.reshape(down, across, grid.patch, grid.patch, -1).swapaxes(1, 2).reshape(y, x, -1)
    return coarse_prediction_of_columns(weights, image, grid, capture)


def read_coarse_prediction(weights: Weights, coarse_pass: CoarsePass) -> CoarsePrediction:
    """Read the overview of a coarse pass."""
    with torch.inference_mode():
        overview = overview_of(weights, coarse_pass)
        return CoarsePrediction(
            coarse_pass.grid,
            coarse_pass.columns,
            np.ascontiguousarray(overview.logits[0].softmax(dim=0).permute(1, 2, 0).cpu().numpy()),
            capture=coarse_pass.capture,
            origin=coarse_pass.origin,
            living=coarse_pass.living,
            out_of_range=coarse_pass.out_of_range,
            filled=coarse_pass.filled,
            gain=weights.segmenter.score(overview)[0].cpu().numpy(),
            read=Read(weights.segmenter, coarse_pass, overview),
        )


def segment(
    weights: Weights,
    seen: CoarsePass,
    patches: NDArray[np.floating],
    patch_index: NDArray[np.integer],
    *,
    capture: Capture | None = None,
    every_class: bool = False,
) -> DrawnMap:
    """Draw the class map from the overview and the patches that are read in full, of the scene's own size.

    ``patches`` (patch, p, p, column) are normalised columns, captured as ``capture`` says, or as the overview's where
    None. A dead pixel (see `dead_pixels`) counts as the mean of its patch; a patch of which more than half is dead
    counts as not captured. ``patch_index`` (patch,) are their numbers on the grid, each once; without one the map is
    the overview's. With ``every_class`` the map holds the log-probabilities of all classes too.

    Raises ShapeError for a patch given twice or outside the grid.
    """
    numbers = np.ascontiguousarray(patch_index, np.int64)
    check_patch_index(numbers, seen.grid)
    own, numbers = captured(patches, numbers)
    with torch.inference_mode():
        overview = overview_of(weights, seen)
        logits = overview.logits[0].cpu().clone()
        planes = (seen.capture if capture is None else capture).of_patches(numbers, seen.grid.patch)
        for (y, x), read in zip(
            seen.grid.patch_origin(numbers),
            itertools.chain.from_iterable(patch_logits(weights, overview, own, numbers, planes)),
            strict=True,
        ):
            logits[:, y : y + read.shape[1], x : x + read.shape[2]] = read
        return draw(_tempered(logits, weights), every_class=every_class).of_scene(seen.grid)


def patch_logits(
    weights: Weights,
    overview: Overview,
    patches: NDArray[np.floating],
    patch_index: NDArray[np.int64],
    capture: Capture,
) -> Iterator[Tensor]:
    """Give logits of patches (patch, p, p, column) that are read in full, (some, class, p, p) at a time.

    Chunks fit the processor's caches; what is not finite counts as 0, the median.
    """
    network = weights.segmenter
    for first in range(0, len(patches), PATCHES_AT_ONCE):
        some = slice(first, first + PATCHES_AT_ONCE)
        planes = CaptureMap(capture.specs, capture.number[some]) if isinstance(capture, CaptureMap) else capture
        chunk = torch.from_numpy(with_planes(patches[some], planes)).nan_to_num_(0.0, 0.0, 0.0)
        index = torch.from_numpy(patch_index[first : first + PATCHES_AT_ONCE])[None].to(network.device)
        yield network.read_patches(overview, chunk.permute(0, 3, 1, 2)[None].to(network.device), index)[0].cpu()


def map_of_columns(
    weights: Weights,
    columns: NDArray[np.floating],
    grid: SceneGrid,
    capture: Capture = LineSpec(),  # noqa: B008 - a value
) -> tuple[DrawnMap, NDArray[np.float32]]:
    """Read a scene whole, by normalised columns (y, x, column) of the padded grid; its map, and all log-probabilities.

    Raises as `segment`.
    """
    patch_index = grid.valid_patches()
    seen = coarse_prediction_of_columns(weights, columns, grid, capture)
    drawn = segment(weights, seen, seen.patches(patch_index), patch_index, every_class=True)
    assert drawn.log_probability is not None
    return drawn, drawn.log_probability


def _tempered(logits: Tensor, weights: Weights) -> Tensor:
    """Logits by which maps are as sure of themselves as they may be; the likeliest class stays what it is."""
    return logits if weights.temperature == 1 else logits / weights.temperature


def captured(
    patches: NDArray[np.floating], patch_index: NDArray[np.int64]
) -> tuple[NDArray[np.floating], NDArray[np.int64]]:
    """Keep the patches that show something of their patches, dead pixels filled, and these patches."""
    dead = dead_pixels(patches)
    if not dead.any():
        return patches, patch_index
    shown = readable(dead)
    return fill_dead(patches[shown], dead[shown]), patch_index[shown]


def check_patch_index(patch_index: NDArray[np.int64], grid: SceneGrid) -> None:
    """Refuse numbers that are none of the grid's patches, or given twice (ShapeError)."""
    count = grid.patch_shape[0] * grid.patch_shape[1]
    if outside := patch_index[(patch_index < 0) | (patch_index >= count)].tolist():
        raise ShapeError(f"patch {outside[0]} is none of the {count} patches of the scene, 0..{count - 1}")
    distinct, times = np.unique(patch_index, return_counts=True)
    if repeated := distinct[times > 1].tolist():
        raise ShapeError(f"patch {repeated[0]} is given more than once; give each patch one patch")


def overview_of(weights: Weights, coarse_pass: CoarsePass) -> Overview:
    """Read the overview of a coarse pass; one that a coarse prediction kept is not made twice."""
    kept = coarse_pass.read if isinstance(coarse_pass, CoarsePrediction) else None
    if kept is not None and kept.counts_for(weights, coarse_pass):
        return kept.overview
    network = weights.segmenter.eval()
    image = torch.from_numpy(with_planes(coarse_pass.columns, coarse_pass.capture)).permute(2, 0, 1)[None]
    living = None if coarse_pass.living is None else torch.from_numpy(coarse_pass.living).to(network.device)
    patches = TOKEN_PX / coarse_pass.grid.patch  # of a token
    origin = torch.tensor([coarse_pass.origin], dtype=torch.float64) / patches
    return network.read_overview(image.to(network.device), origin, living)


def draw(logits: Tensor, *, every_class: bool = False) -> DrawnMap:
    """Decide on the class of each pixel by logits (class, y, x), some rows at a time."""
    _, y, x = logits.shape
    every = np.empty((y, x, len(logits)), np.float32) if every_class else None
    drawn = DrawnMap(np.empty((y, x), np.uint8), np.empty((y, x), np.float32), every)
    for top in range(0, y, ROWS_DRAWN):
        rows = slice(top, top + ROWS_DRAWN)
        confidence, classes = decide(logits[:, rows], dim=0)
        drawn.classes[rows], drawn.confidence[rows] = classes.numpy(), confidence.numpy()
        if drawn.log_probability is not None:
            drawn.log_probability[rows] = logits[:, rows].log_softmax(dim=0).permute(1, 2, 0).numpy()
    return drawn


def decide(logits: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """The greatest probability and its class, uint8; NaN and 255 where a logit is not finite: that is no class."""
    confidence, classes = logits.softmax(dim=dim).max(dim=dim)
    return confidence, torch.where(confidence.isnan(), UNLABELLED, classes).to(torch.uint8)
