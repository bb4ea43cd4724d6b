"""Use of a trained segmenter on one scene: coarse prediction at the coarse pass, then go on from there with the fine patches."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from models.network.self_attention import TokenReading, queries_kept
from models.network.sizes import SegmenterConfig
from models.network.spectral import all_alive, dead_pixels, fill_dead, patches_of, readable
from models.weights.files import Weights
from pipeline.errors import ShapeError
from pipeline.geometry.grid import UNLABELLED, SceneGrid, pad_by_reflection
from pipeline.lazy import deferred
from pipeline.readings import beyond_range

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from models.network.segmenter import CoarseReading, Segmenter
else:
    torch = deferred("torch")

Precision = Literal["float32", "bfloat16"]
PATCHES_A_PACK = 256  # scenes are read together up to so many patches; one with more is read alone


@dataclass(frozen=True)
class CoarsePass:
    """The coarse pass of a scene, or of a region of a field, on the padded coarse grid."""

    grid: SceneGrid
    columns: NDArray[np.float32]  # (y, x, column) normalised
    origin: tuple[int, int] = field(default=(0, 0), kw_only=True)  # row and column of the field's patch it begins at
    living: NDArray[np.bool_] | None = field(default=None, kw_only=True)  # (token,) which are read; None: all
    out_of_range: NDArray[np.bool_] | None = field(
        default=None, kw_only=True
    )  # (y, x) of the scene: a value is no reading
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
    precision: Precision = "float32"
    living: NDArray[np.bool_] | None = None

    def fits(self, weights: Weights, coarse_pass: CoarsePass, precision: Precision) -> bool:
        """Whether these weights would read the same from this look."""
        whose = self.by is weights.segmenter and self.columns is coarse_pass.columns
        return (
            whose
            and self.living is coarse_pass.living
            and (self.origin, self.precision) == (coarse_pass.origin, precision)
        )


@dataclass(frozen=True)
class CoarsePrediction(CoarsePass):
    """What the coarse pass alone says of a scene, on the padded coarse grid."""

    probability: NDArray[np.float32]  # (y, x, class)
    gain: NDArray[np.float32] | None = field(default=None, kw_only=True)  # (seat_y, seat_x) expected [nat per px]
    read: Read | None = field(default=None, kw_only=True, repr=False, compare=False)
    tokens: TokenReading | None = field(default=None, kw_only=True, repr=False, compare=False)


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
) -> CoarsePass:
    """Bring the coarse mosaic to the spectral columns of the weights, some rows at a time.

    ``strips`` are (y, x, band) parts of the mosaic from the top down, together of the shape ``grid.coarse_shape``;
    ``origin`` is the row and column of the patch of a larger field in which the grid begins.
    """
    config = weights.config
    rows, width = grid.coarse_shape
    columns, filled = np.empty((rows, width, config.columns), np.float32), 0
    out_of_range: NDArray[np.bool_] | None = None
    for strip in strips:
        last = filled + len(strip)
        columns[filled:last] = weights.columns(strip, wavelength_nm)
        if (wild := beyond_range(strip, weights.normalisation.most_value)) is not None:
            out_of_range = np.zeros((rows, width), np.bool_) if out_of_range is None else out_of_range
            out_of_range[filled:last] = wild.any(axis=-1)
        filled = last
    y, x = grid.padded_shape
    columns = np.ascontiguousarray(pad_by_reflection(columns, (y // grid.factor, x // grid.factor)), np.float32)
    dead = dead_pixels(columns)
    living = _mend(columns, config)
    return CoarsePass(
        grid, columns, origin=origin, living=living, out_of_range=out_of_range, filled=dead if dead.any() else None
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


def read_coarse_prediction(
    weights: Weights, coarse_pass: CoarsePass, *, precision: Precision = "float32"
) -> CoarsePrediction:
    """Read a coarse pass alone."""
    return coarse_prediction_batch(weights, [coarse_pass], precision=precision)[0]


def coarse_prediction_batch(
    weights: Weights, coarse_passes: Sequence[CoarsePass], *, precision: Precision = "float32"
) -> list[CoarsePrediction]:
    """Read coarse passes of any sizes, each alone, their patches packed; as ``read_coarse_prediction`` one by one, but faster."""
    seen: list[CoarsePrediction] = []
    with torch.inference_mode(), _computing_in(precision, weights):
        for part in packs([_patches_in(coarse_pass) for coarse_pass in coarse_passes]):
            with queries_kept() as queries:
                readings = _read_coarse(weights, coarse_passes[part])
            asked = torch.split(queries[-1], [reading.memory[-1][0].shape[2] for reading in readings], dim=2)
            for coarse_pass, reading, own in zip(coarse_passes[part], readings, asked, strict=True):
                keys = reading.memory[-1][0][0].float().cpu().numpy()
                seen.append(
                    CoarsePrediction(
                        coarse_pass.grid,
                        coarse_pass.columns,
                        np.ascontiguousarray(reading.logits[0].float().softmax(dim=0).permute(1, 2, 0).cpu().numpy()),
                        origin=coarse_pass.origin,
                        living=coarse_pass.living,
                        gain=weights.segmenter.score(reading)[0].float().cpu().numpy(),
                        read=Read(
                            weights.segmenter,
                            coarse_pass.columns,
                            coarse_pass.origin,
                            reading,
                            precision,
                            coarse_pass.living,
                        ),
                        tokens=TokenReading(
                            own[0].float().cpu().numpy(), keys, weights.config.token_side, coarse_pass.living
                        ),
                    )
                )
    return seen


def segment(
    weights: Weights,
    seen: CoarsePass,
    patches: NDArray[np.floating],
    patch_index: NDArray[np.integer],
    *,
    precision: Precision = "float32",
    every_class: bool = False,
) -> DrawnMap:
    """Draw the class map from the coarse pass and the fine patches, of the scene's own size.

    ``patches`` (patch, p, p, column) are normalised columns of the fine pass. A dead pixel (see `dead_pixels`) counts as
    the mean of its patch; a patch of which more than half is dead counts as not captured. ``patch_index`` (patch,) are their
    numbers on the grid, each once; without one the map is the coarse prediction brought up to the fine grid. ``precision`` is that
    of convolutions and matrix products; norms, softmax and the decision are float32. With ``every_class`` the map holds
    the log-probabilities of all classes too.

    Raises ShapeError for a patch given twice or outside the grid.
    """
    return segment_batch(weights, [seen], [patches], [patch_index], precision=precision, every_class=every_class)[0]


def segment_batch(
    weights: Weights,
    seen: Sequence[CoarsePass],
    patches: Sequence[NDArray[np.floating]],
    patch_index: Sequence[NDArray[np.integer]],
    *,
    precision: Precision = "float32",
    every_class: bool = False,
) -> list[DrawnMap]:
    """Draw the maps of scenes of any sizes and numbers of patches together, as ``segment`` one by one, but faster."""
    scenes = []
    for coarse_pass, own, given in zip(seen, patches, patch_index, strict=True):
        numbers = np.asarray(given, np.int64)
        check_patch_index(numbers, coarse_pass.grid)
        scenes.append((coarse_pass, *captured(own, numbers)))
    with torch.inference_mode(), _computing_in(precision, weights):
        counts = [_patches_in(coarse_pass) + len(numbers) for coarse_pass, _, numbers in scenes]
        return [drawn for part in packs(counts) for drawn in _draw_pack(weights, scenes[part], precision, every_class)]


def _draw_pack(
    weights: Weights,
    pack: Sequence[tuple[CoarsePass, NDArray[np.floating], NDArray[np.int64]]],
    precision: Precision,
    every_class: bool,
) -> Iterator[DrawnMap]:
    """Maps of scenes that are read together."""
    coarse_passes = [coarse_pass for coarse_pass, _, _ in pack]
    readings = readings_of(weights, coarse_passes, precision=precision)
    padded = [
        draw_coarse(_tempered(reading.logits.float().cpu(), weights), coarse_pass.grid, every_class=every_class)
        for reading, coarse_pass in zip(readings, coarse_passes, strict=True)
    ]
    places = (
        (drawn, place)
        for drawn, (coarse_pass, _, patch_index) in zip(padded, pack, strict=True)
        for place in coarse_pass.grid.patch_origin(patch_index)
    )
    parts = [own for _, own, _ in pack], [torch.from_numpy(patch_index) for *_, patch_index in pack]
    p = weights.config.patch
    for read in weights.segmenter.eval().read_fine_packed(
        readings, *parts, [origin_of(coarse_pass) for coarse_pass in coarse_passes]
    ):
        logits = _tempered(read.float().cpu(), weights)
        confidence, classes = (part.numpy() for part in decide(logits, dim=1))
        every = logits.log_softmax(dim=1).permute(0, 2, 3, 1).numpy() if every_class else confidence
        for sure, values, own, (drawn, (y, x)) in zip(confidence, classes, every, places, strict=False):
            drawn.classes[y : y + p, x : x + p] = values
            drawn.confidence[y : y + p, x : x + p] = sure
            if drawn.log_probability is not None:
                drawn.log_probability[y : y + p, x : x + p] = own
    for drawn, coarse_pass in zip(padded, coarse_passes, strict=True):
        yield drawn.of_scene(coarse_pass.grid)


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


def _patches_in(coarse_pass: CoarsePass) -> int:
    rows, columns = coarse_pass.grid.patch_shape
    return rows * columns // coarse_pass.grid.factor**2


@contextmanager
def _computing_in(precision: Precision, weights: Weights) -> Iterator[None]:
    if precision == "float32":
        yield
        return
    with torch.autocast(weights.segmenter.device.type, dtype=torch.bfloat16), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Mismatch dtype between input and weight")  # slower, not less exact
        yield


def readings_of(
    weights: Weights, coarse_passes: Sequence[CoarsePass], *, precision: Precision = "float32"
) -> list[CoarseReading]:
    """Readings of coarse passes. Nothing flows back from fine patches, so one that a glance kept is not made twice."""
    kept = [
        coarse_pass.read.reading
        if isinstance(coarse_pass, CoarsePrediction)
        and coarse_pass.read
        and coarse_pass.read.fits(weights, coarse_pass, precision)
        else None
        for coarse_pass in coarse_passes
    ]
    fresh = iter(
        _read_coarse(
            weights, [coarse_pass for coarse_pass, reading in zip(coarse_passes, kept, strict=True) if reading is None]
        )
    )
    return [next(fresh) if reading is None else reading for reading in kept]


def _read_coarse(weights: Weights, coarse_passes: Sequence[CoarsePass]) -> list[CoarseReading]:
    images = [torch.from_numpy(coarse_pass.columns).permute(2, 0, 1)[None] for coarse_pass in coarse_passes]
    living = [
        None if coarse_pass.living is None else torch.from_numpy(coarse_pass.living) for coarse_pass in coarse_passes
    ]
    return weights.segmenter.eval().read_coarse_packed(
        images, [origin_of(coarse_pass) for coarse_pass in coarse_passes], living
    )


def packs(counts: Sequence[int], most: int = PATCHES_A_PACK) -> list[slice]:
    """Parts of a row of scenes that are read together: up to ``most`` patches each, or one scene."""
    starts, filled = [0], 0
    for number, count in enumerate(counts):
        if number > starts[-1] and filled + count > most:
            starts.append(number)
            filled = 0
        filled += count
    return [slice(start, end) for start, end in zip(starts, [*starts[1:], len(counts)], strict=True)] if counts else []


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
