"""Run a trained segmenter on one scene: an overview of everything, then the full network on chosen patches."""

from __future__ import annotations

import io
import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from spectralzoom.models.network.sizes import PATCHES_AT_ONCE, TOKEN_PX
from spectralzoom.models.network.spectral import (
    Capture,
    CaptureMap,
    LineSpec,
    all_valid,
    fill_invalid,
    invalid_pixels,
    patches_of,
    readable,
    with_planes,
)
from spectralzoom.models.weights.files import Weights
from spectralzoom.pipeline.errors import ShapeError
from spectralzoom.pipeline.geometry.grid import UNLABELLED, SceneGrid, cuts, pad_by_reflection
from spectralzoom.pipeline.signal.components import Components

if TYPE_CHECKING:
    from torch import Tensor

    from spectralzoom.models.network.segmenter import Overview

ROWS_DRAWN = 64  # at once
# Factor of the octaves by which exposures are stated to be shorter than the reference. The network then relies more on
# the surroundings of a pixel: .4 to 1.4 points more on scans of 4 ms.
FAINTER = 1.4


@dataclass(frozen=True)
class CoarsePass:
    """Spectral features of a scene, or of a region of a field, on the padded grid."""

    grid: SceneGrid
    columns: NDArray[np.float32]  # (y, x, column) normalised
    capture: Capture = field(default=LineSpec(), kw_only=True)
    origin: tuple[int, int] = field(default=(0, 0), kw_only=True)  # row and column of its first patch in the field
    valid_tokens: NDArray[np.bool_] | None = field(default=None, kw_only=True)  # (token,) that are read; None: all
    out_of_range: NDArray[np.bool_] | None = field(default=None, kw_only=True)  # (y, x) of the scene: captured, invalid
    filled: NDArray[np.bool_] | None = field(default=None, kw_only=True)  # (y, x) pixels without data; None: no pixel

    @property
    def seen_columns(self) -> NDArray[np.float32]:
        """Return the columns with NaN in filled pixels."""
        return (
            self.columns if self.filled is None else np.where(self.filled[..., None], np.float32(np.nan), self.columns)
        )

    def patches(self, patch_index: NDArray[np.integer]) -> NDArray[np.float32]:
        """Return the columns of some patches, (patch, p, p, column)."""
        return np.asarray(patches_of(self.columns, self.grid.patch)[patch_index], np.float32)


@dataclass(frozen=True)
class CoarsePrediction(CoarsePass):
    """Prediction of the overview for a scene, on the padded grid."""

    probability: NDArray[np.float32]  # (y, x, class)
    overview: Overview | None = field(default=None, kw_only=True, repr=False, compare=False)  # by the same weights


@dataclass(frozen=True)
class DrawnMap:
    """Class of each pixel of a scene and its probability."""

    classes: NDArray[np.uint8]  # (y, x), 255 for no data
    confidence: NDArray[np.float32]  # (y, x), NaN there
    log_probability: NDArray[np.float32] | None = None  # (y, x, class), on request

    def of_scene(self, grid: SceneGrid) -> DrawnMap:
        """Crop the map of a padded grid to the scene."""
        scene = np.s_[: grid.height, : grid.width]
        every = None if self.log_probability is None else self.log_probability[scene]  # no copy: it is large
        return DrawnMap(self.classes[scene].copy(), self.confidence[scene].copy(), every)


def read_coarse_pass(
    weights: Weights,
    strips: Iterable[NDArray[np.floating]],
    wavelength_nm: NDArray[np.floating],
    grid: SceneGrid,
    *,
    capture: Capture = LineSpec(),  # noqa: B008 - a value
    origin: tuple[int, int] = (0, 0),
    components: Components | None = None,
) -> CoarsePass:
    """Project a mosaic onto the spectral columns of the weights, some rows at a time.

    ``strips`` are parts of the mosaic from the top down: values (y, x, band), or scores (y, x, component) of
    ``components``. ``origin`` is the row and column of the grid's first patch in a larger field. A value beyond
    `Normalisation.most_value` counts as NaN.
    """
    columns = np.empty((grid.height, grid.width, weights.config.columns), np.float32)
    known = np.zeros((grid.height, grid.width), np.bool_)
    filled = 0
    for strip in strips:
        last = filled + len(strip)
        if components is None:
            columns[filled:last] = weights.columns(strip, wavelength_nm)
        else:
            columns[filled:last] = weights.columns_of_scores(strip, components, wavelength_nm)
        known[filled:last] = ~np.isnan(strip).all(axis=-1)
        filled = last
    if isinstance(capture, CaptureMap):
        gap = [(0, whole - size) for whole, size in zip(grid.padded_shape, capture.number.shape, strict=True)]
        capture = CaptureMap(capture.specs, np.pad(capture.number, gap, mode="edge"))
    wild = invalid_pixels(columns) & known
    columns = np.ascontiguousarray(pad_by_reflection(columns, grid.padded_shape), np.float32)
    invalid = invalid_pixels(columns)
    return CoarsePass(
        grid,
        columns,
        capture=capture,
        origin=origin,
        valid_tokens=_mend(columns, grid.patch),
        out_of_range=wild if wild.any() else None,
        filled=invalid if invalid.any() else None,
    )


def _mend(columns: NDArray[np.float32], p: int) -> NDArray[np.bool_] | None:
    """Fill invalid pixels from their patch, in place; return which tokens are valid (None: all)."""
    invalid = invalid_pixels(columns)
    if not invalid.any():
        return None
    holes = patches_of(invalid, p)
    for number in np.flatnonzero(holes.any(axis=(1, 2))):  # one by one: a copy of a field is large
        y, x = (p * int(at) for at in divmod(number, columns.shape[1] // p))
        columns[y : y + p, x : x + p] = fill_invalid(columns[None, y : y + p, x : x + p], holes[number][None])[0]
    return readable(patches_of(np.pad(invalid, [(0, -size % TOKEN_PX) for size in invalid.shape], "edge"), TOKEN_PX))


def coarse_prediction_of_columns(
    weights: Weights,
    columns: NDArray[np.generic],
    grid: SceneGrid,
    capture: Capture = LineSpec(),  # noqa: B008 - a value
) -> CoarsePrediction:
    """Predict from normalised columns of the padded grid, (y, x, column); invalid pixels are filled."""
    given = np.ascontiguousarray(columns, np.float32)
    mended = given if all_valid(given) else given.copy()
    valid_tokens = _mend(mended, grid.patch)
    return read_coarse_prediction(weights, CoarsePass(grid, mended, capture=capture, valid_tokens=valid_tokens))


def read_coarse_prediction(
    weights: Weights, coarse_pass: CoarsePass, overview: Overview | None = None
) -> CoarsePrediction:
    """Predict class probabilities from a coarse pass, or from its ``overview`` where that is known."""
    import torch

    with torch.inference_mode():
        overview = overview_of(weights, coarse_pass) if overview is None else overview
        return CoarsePrediction(
            **vars(coarse_pass),
            probability=np.ascontiguousarray(overview.logits[0].softmax(dim=0).permute(1, 2, 0).cpu().numpy()),
            overview=overview,
        )


def overview_values(seen: CoarsePrediction) -> NDArray[np.float32]:
    """Return features and logits of the overview of a prediction, (1, feature, y, x)."""
    import torch

    assert seen.overview is not None
    values: NDArray[np.float32] = torch.cat([seen.overview.features, seen.overview.logits], dim=1).cpu().numpy()
    return values


def save_overview(path: Path, values: NDArray[np.float32]) -> None:
    """Store features and logits of an overview."""
    content = io.BytesIO()  # an error that numpy has with a file does not say that the disk is full
    np.save(content, values)
    path.write_bytes(content.getbuffer())


def load_overview(path: Path, weights: Weights) -> Overview | None:
    """Read an overview by the same weights; None where there is no file."""
    import torch

    if not path.exists():
        return None
    stored = torch.from_numpy(np.load(path)).to(weights.segmenter.device)
    width = weights.config.features
    from spectralzoom.models.network.segmenter import Overview

    return Overview(stored[:, :width], stored[:, width:])


def segment(
    weights: Weights,
    seen: CoarsePass,
    patches: NDArray[np.floating],
    patch_index: NDArray[np.integer],
    *,
    capture: Capture | None = None,
    every_class: bool = False,
) -> DrawnMap:
    """Return the class map of a scene by the overview and the patches read in full.

    ``patches`` (patch, p, p, column) are normalised columns and ``patch_index`` (patch,) their numbers on the grid,
    each once; without patches the map is the overview's. ``capture`` describes their capture; None is that of the
    overview. Invalid pixels (`invalid_pixels`) take the mean of their patch; a patch with more than half of its pixels
    invalid is left out. With ``every_class`` the map has the log-probabilities of all classes.

    Raises ShapeError for a patch given twice or outside the grid.
    """
    import torch

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
        if weights.temperature != 1:
            logits /= weights.temperature
        return draw(logits, every_class=every_class).of_scene(seen.grid)


def plain_classes(weights: Weights, seen: CoarsePass, part: int) -> NDArray[np.uint8]:
    """Return the class map (y, x) of a scene by one part of a mixture alone, numbered ``part``."""
    import torch

    network = weights.segmenter
    image = torch.from_numpy(seen.columns)[None].movedim(-1, 1).to(network.device)
    with torch.inference_mode():
        return draw(network.mixture.by_part(image, part)[0].cpu()).of_scene(seen.grid).classes


def patch_logits(
    weights: Weights,
    overview: Overview,
    patches: NDArray[np.floating],
    patch_index: NDArray[np.int64],
    capture: Capture,
) -> Iterator[Tensor]:
    """Yield logits of patches (patch, p, p, column) by the full network, (some, class, p, p) at a time.

    Chunks fit the processor's caches. Values that are not finite count as 0, the median.
    """
    import torch

    network = weights.segmenter
    for some in cuts(len(patches), PATCHES_AT_ONCE):
        planes = CaptureMap(capture.specs, capture.number[some]) if isinstance(capture, CaptureMap) else capture
        chunk = torch.from_numpy(with_planes(patches[some], planes, fainter=FAINTER)).nan_to_num_(0.0, 0.0, 0.0)
        index = torch.from_numpy(patch_index[some])[None].to(network.device)
        yield network.read_patches(overview, chunk.permute(0, 3, 1, 2)[None].to(network.device), index)[0].cpu()


def map_of_columns(
    weights: Weights,
    columns: NDArray[np.floating],
    grid: SceneGrid,
    capture: Capture = LineSpec(),  # noqa: B008 - a value
) -> tuple[DrawnMap, NDArray[np.float32]]:
    """Read all patches of normalised columns (y, x, column) of the padded grid; return map and log-probabilities.

    Raises as `segment`.
    """
    patch_index = grid.every_patch()
    seen = coarse_prediction_of_columns(weights, columns, grid, capture)
    drawn = segment(weights, seen, seen.patches(patch_index), patch_index, every_class=True)
    assert drawn.log_probability is not None
    return drawn, drawn.log_probability


def captured(
    patches: NDArray[np.floating], patch_index: NDArray[np.int64]
) -> tuple[NDArray[np.floating], NDArray[np.int64]]:
    """Keep the patches with enough valid pixels, the others filled, and their numbers."""
    invalid = invalid_pixels(patches)
    if not invalid.any():
        return patches, patch_index
    shown = readable(invalid)
    return fill_invalid(patches[shown], invalid[shown]), patch_index[shown]


def check_patch_index(patch_index: NDArray[np.int64], grid: SceneGrid) -> None:
    """Raise ShapeError for numbers outside the grid, or given twice."""
    count = grid.patch_shape[0] * grid.patch_shape[1]
    if outside := patch_index[(patch_index < 0) | (patch_index >= count)].tolist():
        raise ShapeError(f"patch {outside[0]} is none of the {count} patches of the scene, 0..{count - 1}")
    distinct, times = np.unique(patch_index, return_counts=True)
    if repeated := distinct[times > 1].tolist():
        raise ShapeError(f"patch {repeated[0]} is given more than once; give each patch once")


def overview_of(weights: Weights, coarse_pass: CoarsePass) -> Overview:
    """Return the overview of a coarse pass; a coarse prediction has it already."""
    import torch

    if isinstance(coarse_pass, CoarsePrediction) and coarse_pass.overview is not None:
        return coarse_pass.overview
    network = weights.segmenter.eval()
    image = with_planes(coarse_pass.columns, coarse_pass.capture, fainter=FAINTER)
    valid = None if coarse_pass.valid_tokens is None else torch.from_numpy(coarse_pass.valid_tokens).to(network.device)
    patches = TOKEN_PX / coarse_pass.grid.patch  # of a token
    origin = torch.tensor([coarse_pass.origin], dtype=torch.float64) / patches
    # numpy's image[None] has a stride of 0, with which torch copies the image in every first layer
    return network.read_overview(torch.from_numpy(image)[None].permute(0, 3, 1, 2).to(network.device), origin, valid)


def draw(logits: Tensor, *, every_class: bool = False) -> DrawnMap:
    """Choose the class of each pixel by logits (class, y, x), some rows at a time; none where one is not finite."""
    import torch

    _, y, x = logits.shape
    every = np.empty((y, x, len(logits)), np.float32) if every_class else None
    drawn = DrawnMap(np.empty((y, x), np.uint8), np.empty((y, x), np.float32), every)
    for rows in cuts(y, ROWS_DRAWN):
        confidence, classes = logits[:, rows].softmax(dim=0).max(dim=0)
        drawn.confidence[rows] = confidence.numpy()
        drawn.classes[rows] = torch.where(confidence.isnan(), UNLABELLED, classes).to(torch.uint8).numpy()
        if every is not None:
            every[rows] = logits[:, rows].log_softmax(dim=0).permute(1, 2, 0).numpy()
    return drawn
