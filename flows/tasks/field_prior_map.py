"""Prior map of a field as its stores hold it, read region by region where it lies by today's look."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flows.tasks.field_work import coarse_region
from flows.tasks.prior_maps import EarlierRun
from models.network.sizes import CELL_PX
from models.network.spectral import LineSpec
from models.reading.prior_map import ClassProbabilities, PriorMap, in_classes, pooled
from models.reading.regions import Region
from models.weights.files import Weights
from pipeline.rectify.registration.alignment import FieldShift, field_shift
from storage.arrays.class_maps import ProbabilityStore
from storage.arrays.mosaics import open_mosaic

REACH_PX = 64.0  # within which a memory that lies beside today's look is found
LEAST_SHIFT_PX = 2.0  # less is how well two looks can be laid on each other
Gap = tuple[int, int]  # what lies before the first and behind the last


@dataclass(frozen=True)
class FieldPriorMap:
    """Address of the prior map of a field, and how it is read."""

    probabilities: Path
    mosaic: Path | None  # of the last look alone, whose days these are; None where its pixels have another size
    days: float
    classes: tuple[int, ...]  # see `flows.tasks.prior_maps.Prior`
    shift_px: tuple[int, int] = (0, 0)  # down and to the right, that brings it onto today's look

    def of(self, region: Region, weights: Weights) -> PriorMap:
        """Read what is remembered of a region, in the classes of the weights."""
        store = ProbabilityStore(self.probabilities)
        rows, columns = (
            _moved(part, by, size)
            for part, by, size in zip((region.read.rows, region.read.columns), self.shift_px, store.shape, strict=True)
        )
        gaps = rows[1], columns[1]
        values, age, light = (_framed(part, gaps) for part in store.read(rows[0], columns[0]))
        if self.classes != tuple(range(values.shape[-1])):
            values = in_classes(values, self.classes)
        lies = None
        if self.mosaic is not None:
            coarse = pooled(coarse_region(weights, self.mosaic, region, LineSpec()).seen_columns)
            lies = shifted(coarse, _cells(self.shift_px, CELL_PX))
        return PriorMap(ClassProbabilities(values, age, np.nan_to_num(light)), lies, self.days)


def laid_together(images: Iterable[NDArray[np.float32]]) -> NDArray[np.float32]:
    """One image (y, x, ...) out of several of one size: at each pixel the first that is no NaN there."""
    whole: NDArray[np.float32] | None = None
    for image in images:
        if whole is None:
            whole = image
            continue
        finite = np.isfinite(whole)
        if finite.all():
            return whole
        whole = np.where(finite, whole, image)
    assert whole is not None
    return whole


def shifted(image: NDArray[np.float32], by: tuple[int, int]) -> NDArray[np.float32]:
    """An image (y, x, ...) moved down and to the right, with NaN where nothing lies."""
    parts = [_moved(slice(0, size), one, size) for size, one in zip(image.shape, by, strict=False)]
    return _framed(image[parts[0][0], parts[1][0]], (parts[0][1], parts[1][1]))


def prior_map_lies(before: Sequence[EarlierRun], now: Path) -> FieldShift:
    """Return how the field of stored coarse passes, the newest first, lies beside that of another, in fine px.

    All are compared in pixels that each of theirs divides.
    """
    cell = math.lcm(CELL_PX, open_mosaic(now).factor, *(scan_pass.factor for scan_pass in before))

    def picture(mosaic: Path) -> NDArray[np.float32]:
        return open_mosaic(mosaic).brightness(cell)

    pictures = (
        shifted(picture(scan_pass.mosaic.path / "mosaic.zarr"), _cells(scan_pass.shift_px, cell))
        for scan_pass in before
    )
    found = field_shift(picture(now), laid_together(pictures), reach_px=REACH_PX / cell)
    return replace(found, shift=(cell * found.shift[0], cell * found.shift[1]))


def whole_pixels(lies: FieldShift) -> tuple[int, int]:
    """Rows and columns to move a memory by; none where it lies as well as looks can be laid on each other."""
    down, across = lies.shift
    return (0, 0) if math.hypot(down, across) < LEAST_SHIFT_PX else (round(down), round(across))


def _cells(shift_px: ArrayLike, factor: int) -> tuple[int, int]:
    """The shift of a coarse image that is nearest to one in fine px."""
    down, across = np.rint(np.divide(shift_px, factor)).astype(int).tolist()
    return down, across


def _moved(part: slice, by: int, size: int) -> tuple[slice, Gap]:
    """Return where a part of an axis of ``size`` lies before it is moved ``by``, and its part beyond the ends."""
    start, stop = part.start - by, part.stop - by
    first, last = min(max(start, 0), size), min(max(stop, 0), size)
    whole = stop - start
    before = min(max(-start, 0), whole)
    return slice(first, last), (before, whole - before - (last - first))


def _framed(values: NDArray[np.float32], gaps: tuple[Gap, Gap]) -> NDArray[np.float32]:
    """Images (y, x, ...) with NaN where nothing lies."""
    if not any(map(any, gaps)):
        return values
    return np.pad(values, [*gaps, *[(0, 0)] * (values.ndim - 2)], constant_values=np.nan)
