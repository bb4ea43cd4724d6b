"""Use of a trained segmenter on one scene: predict coarsely, then continue with the fine patches."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from models.network.sizes import SegmenterConfig
from models.network.spectral import all_alive, dead_pixels, fill_dead, patches_of, readable
from models.weights.files import Weights
from pipeline.errors import ShapeError
from pipeline.geometry.grid import UNLABELLED, SceneGrid, pad_by_reflection
from pipeline.lazy import deferred
from pipeline.signal.components import Components

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from models.network.segmenter import CoarseReading, Segmenter
else:
    torch = deferred("torch")


@dataclass(frozen=True)
class CoarsePass:
    """The coarse pass of a scene, or of a region of a field, on the padded coarse grid."""

    grid: SceneGrid
    columns: NDArray[np.float32]  # (y, x, column) normalised
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


@dataclass(frozen=True)
class Read:
    """A reading of a coarse pass, by whom and of what: the fine patches go on from there."""

    by: Segmenter
    columns: NDArray[np.float32]
    origin: tuple[int, int]
    reading: CoarseReading
    living: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class CoarsePrediction(CoarsePass):
    """What the coarse pass alone says of a scene, on the padded coarse grid."""

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
    weights: Weights, coarse: NDArray[np.floating], wavelength_nm: NDArray[np.floating], grid: SceneGrid
) -> CoarsePrediction:
    """Read the coarse mosaic alone.

    ``coarse`` (y, x, band) are scene values of the coarse pass, of shape ``grid.coarse_shape``; NaN where nothing was
    captured. What is no reading by the weights' `most_value` counts as NaN.
    """
    return read_coarse_prediction(weights, read_coarse_pass(weights, [coarse], wavelength_nm, grid))


def read_coarse_pass(
    weights: Weights,
    strips: Iterable[NDArray[np.floating]],
    wavelength_nm: NDArray[np.floating],
    grid: SceneGrid,
    *,
    origin: tuple[int, int] = (0, 0),
    components: Components | None = None,
) -> CoarsePass:
    """Bring the coarse mosaic to the spectral columns of the weights, some rows at a time.

    ``strips`` are (y, x, band) parts of the mosaic from the top down, together of the shape ``grid.coarse_shape``, or
    (y, x, component) scores of ``components``; ``origin`` is the row and column of the patch of a larger field in which
    the grid begins.
    """
    rows, width = grid.coarse_shape
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
    y, x = grid.padded_shape
    columns = np.ascontiguousarray(pad_by_reflection(columns, (y // grid.factor, x // grid.factor)), np.float32)
    dead = dead_pixels(columns)
    wild = dead[:rows, :width] & known
    return CoarsePass(
        grid,
        columns,
        origin=origin,
        living=_mend(columns, weights.config),
        out_of_range=wild if wild.any() else None,
        filled=dead if dead.any() else None,
    )


def _mend(columns: NDArray[np.float32], config: SegmenterConfig) -> NDArray[np.bool_] | None:
    """Fill dead pixels of coarse columns from their patch, in place, and tell which tokens live (None: all)."""
    dead = dead_pixels(columns)
    if not dead.any():
        return None
    p, holes = config.patch, patches_of(dead, config.patch)
    for number in np.flatnonzero(holes.any(axis=(1, 2))):  # one by one: a copy of a field may not fit the memory
        y, x = (p * int(at) for at in divmod(number, columns.shape[1] // p))
        columns[y : y + p, x : x + p] = fill_dead(columns[None, y : y + p, x : x + p], holes[number][None])[0]
    return readable(holes, config.token_side).ravel()


def coarse_prediction_of_columns(weights: Weights, columns: NDArray[np.generic], grid: SceneGrid) -> CoarsePrediction:
    """Read normalised columns of the padded coarse grid, (y, x, column); dead ones count as in a mosaic."""
    given = np.ascontiguousarray(columns, np.float32)
    mended = given if all_alive(given) else given.copy()
    return read_coarse_prediction(weights, CoarsePass(grid, mended, living=_mend(mended, weights.config)))


def coarse_prediction_of_patches(weights: Weights, columns: NDArray[np.float32], grid: SceneGrid) -> CoarsePrediction:
    """Read the means over coarse pixels of all patches of the padded grid, (patch, p, p, column), as a uniform scan."""
    down, across = grid.patch_shape
    p, s = grid.patch, grid.factor
    cells = columns.reshape(down, across, p // s, s, p // s, s, -1).mean(axis=(3, 5), dtype=np.float32)
    small = cells.swapaxes(1, 2).reshape(down * p // s, across * p // s, -1)
    return coarse_prediction_of_columns(weights, small, grid)


def read_coarse_prediction(weights: Weights, coarse_pass: CoarsePass) -> CoarsePrediction:
    """Read a coarse pass alone."""
    with torch.inference_mode():
        reading = _read_coarse(weights, coarse_pass)
        return CoarsePrediction(
            coarse_pass.grid,
            coarse_pass.columns,
            np.ascontiguousarray(reading.logits[0].softmax(dim=0).permute(1, 2, 0).cpu().numpy()),
            origin=coarse_pass.origin,
            living=coarse_pass.living,
            gain=weights.segmenter.score(reading)[0].cpu().numpy(),
            read=Read(weights.segmenter, coarse_pass.columns, coarse_pass.origin, reading, coarse_pass.living),
        )


def segment(
    weights: Weights,
    seen: CoarsePass,
    patches: NDArray[np.floating],
    patch_index: NDArray[np.integer],
    *,
    every_class: bool = False,
) -> DrawnMap:
    """Draw the class map from the coarse pass and the fine patches, of the scene's own size.

    ``patches`` (patch, p, p, column) are normalised columns of the fine pass. A dead pixel (see `dead_pixels`) counts
    as the mean of its patch; a patch of which more than half is dead counts as not captured. ``patch_index`` (patch,)
    are their numbers on the grid, each once; without one the map is the coarse prediction brought up to the fine grid.
    With ``every_class`` the map holds the log-probabilities of all classes too.

    Raises ShapeError for a patch given twice or outside the grid.
    """
    numbers = np.asarray(patch_index, np.int64)
    check_patch_index(numbers, seen.grid)
    own, numbers = captured(patches, numbers)
    p = weights.config.patch
    with torch.inference_mode():
        reading = reading_of(weights, seen)
        drawn = draw_coarse(_tempered(reading.logits.cpu(), weights), seen.grid, every_class=every_class)
        places = iter(seen.grid.patch_origin(numbers))
        for read in weights.segmenter.eval().read_fine_in_chunks(
            reading, own, torch.from_numpy(numbers), origin_of(seen)
        ):
            logits = _tempered(read.cpu(), weights)
            confidence, classes = (part.numpy() for part in decide(logits, dim=1))
            every = logits.log_softmax(dim=1).permute(0, 2, 3, 1).numpy() if every_class else confidence
            for sure, values, all_of_it, (y, x) in zip(confidence, classes, every, places, strict=False):
                drawn.classes[y : y + p, x : x + p] = values
                drawn.confidence[y : y + p, x : x + p] = sure
                if drawn.log_probability is not None:
                    drawn.log_probability[y : y + p, x : x + p] = all_of_it
    return drawn.of_scene(seen.grid)


def map_of_columns(
    weights: Weights, coarse: NDArray[np.generic], fine: NDArray[np.floating], grid: SceneGrid
) -> tuple[DrawnMap, NDArray[np.float32]]:
    """Read a scene whole, by normalised columns (y, x, column) of the padded grids; its map, and all log-probabilities.

    Raises as `segment`.
    """
    patch_index = grid.valid_patches()
    cells = patches_of(fine, grid.patch)[patch_index].astype(np.float32)
    drawn = segment(weights, coarse_prediction_of_columns(weights, coarse, grid), cells, patch_index, every_class=True)
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
    shown = readable(dead)[:, 0]
    return fill_dead(patches[shown], dead[shown]), patch_index[shown]


def check_patch_index(patch_index: NDArray[np.int64], grid: SceneGrid) -> None:
    """Refuse numbers that are none of the grid's patches, or given twice (ShapeError)."""
    count = grid.patch_shape[0] * grid.patch_shape[1]
    if outside := patch_index[(patch_index < 0) | (patch_index >= count)].tolist():
        raise ShapeError(f"patch {outside[0]} is none of the {count} patches of the scene, 0..{count - 1}")
    distinct, times = np.unique(patch_index, return_counts=True)
    if repeated := distinct[times > 1].tolist():
        raise ShapeError(f"patch {repeated[0]} is given more than once; give each patch one patch")


def reading_of(weights: Weights, coarse_pass: CoarsePass) -> CoarseReading:
    """Read a coarse pass. Nothing flows back from fine patches, so a reading that a glance kept is not made twice."""
    if isinstance(coarse_pass, CoarsePrediction) and (kept := coarse_pass.read) is not None:
        same = (
            kept.by is weights.segmenter and kept.columns is coarse_pass.columns and kept.living is coarse_pass.living
        )
        if same and kept.origin == coarse_pass.origin:
            return kept.reading
    return _read_coarse(weights, coarse_pass)


def _read_coarse(weights: Weights, coarse_pass: CoarsePass) -> CoarseReading:
    image = torch.from_numpy(coarse_pass.columns).permute(2, 0, 1)[None]
    living = None if coarse_pass.living is None else torch.from_numpy(coarse_pass.living)
    return weights.segmenter.eval().read_coarse_in_chunks(image, origin_of(coarse_pass), living)


def origin_of(coarse_pass: CoarsePass) -> Tensor | None:
    """Patch of the field in which a look begins, (1, 2); None at the field's own corner."""
    return torch.tensor([coarse_pass.origin]) if any(coarse_pass.origin) else None


def draw_coarse(logits: Tensor, grid: SceneGrid, *, every_class: bool = False) -> DrawnMap:
    """Bring coarse logits up to the padded fine grid and decide, in strips of rows."""
    y, x = grid.padded_shape
    every = np.empty((y, x, logits.shape[1]), np.float32) if every_class else None
    drawn = DrawnMap(np.empty((y, x), np.uint8), np.empty((y, x), np.float32), every)
    cell = grid.patch
    padded = torch.nn.functional.pad(logits, (0, 0, 1, 1), mode="replicate")
    padded = padded.contiguous(memory_format=torch.channels_last)
    for top in range(0, y // grid.factor, cell):
        strip = torch.nn.functional.interpolate(
            padded[:, :, top : top + cell + 2], scale_factor=grid.factor, mode="bilinear", align_corners=False
        )[0, :, grid.factor : -grid.factor]
        confidence, classes = decide(strip, dim=0)
        rows = slice(top * grid.factor, (top + cell) * grid.factor)
        drawn.classes[rows], drawn.confidence[rows] = classes.numpy(), confidence.numpy()
        if drawn.log_probability is not None:
            drawn.log_probability[rows] = strip.log_softmax(dim=0).permute(1, 2, 0).numpy()
    return drawn


def decide(logits: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """The greatest probability and its class, uint8; NaN and 255 where a logit is not finite: that is no class."""
    confidence, classes = logits.softmax(dim=dim).max(dim=dim)
    return confidence, torch.where(confidence.isnan(), UNLABELLED, classes).to(torch.uint8)
