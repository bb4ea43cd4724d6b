"""Read the stored prior map of a field, region by region, registered to the current visit."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flows.tasks.field_work import coarse_region
from flows.tasks.prior_maps import REACH_PX, EarlierRun
from models.network.sizes import CELL_PX
from models.network.spectral import LineSpec
from models.reading.prior_map import ClassProbabilities, PriorMap, in_classes, pooled
from models.reading.regions import Box, Region
from models.weights.files import Weights
from pipeline.geometry.grid import pad_by_reflection
from pipeline.rectify.registration.alignment import FieldShift, field_shift
from storage.archive.keys import StageRef
from storage.arrays.class_maps import ProbabilityStore
from storage.arrays.mosaics import open_mosaic

LEAST_SHIFT_PX = 2.0  # accuracy of the registration of two visits
Gap = tuple[int, int]  # pixels before the first and after the last


@dataclass(frozen=True)
class FieldPriorMap:
    """Stores of the prior map of a field, its age and shift."""

    probabilities: StageRef  # the class map of the last visit
    mosaic: StageRef
    days: float
    day_of_year: float | None  # of the current visit
    classes: tuple[int, ...]  # see `flows.tasks.prior_maps.Prior`
    shift_px: tuple[int, int] = (0, 0)  # down and right, to the current visit

    @property
    def inputs(self) -> list[StageRef]:
        """Return the stores that workers read."""
        return [self.probabilities, self.mosaic]

    def of(self, region: Region, weights: Weights) -> PriorMap:
        """Read the prior map of a region, in the classes of the weights."""
        store = ProbabilityStore(self.probabilities.path / "class_probabilities.zarr")
        rows, columns = (
            _moved(part, by, size)
            for part, by, size in zip((region.read.rows, region.read.columns), self.shift_px, store.shape, strict=True)
        )
        gaps = rows[1], columns[1]
        values, age, light = (_framed(part, gaps) for part in store.read(rows[0], columns[0]))
        if self.classes != tuple(range(values.shape[-1])):
            values = in_classes(values, self.classes)
        moved = replace(region, read=Box(rows[0].start, columns[0].start, rows[0].stop, columns[0].stop))
        height, width = moved.read.shape
        columns_before = np.empty((height, width, weights.config.columns), np.float32)
        if height and width:
            columns_before = coarse_region(weights, self.mosaic, moved, LineSpec()).seen_columns[:height, :width]
        whole = np.asarray(pad_by_reflection(_framed(columns_before, gaps), region.grid.padded_shape), np.float32)
        before = ClassProbabilities(values, age, np.nan_to_num(light))
        return PriorMap(before, pooled(whole), self.days, self.day_of_year)


def laid_together(images: Iterable[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Return one image (y, x, ...) from several of one size: the first that is not NaN, by pixel."""
    others = iter(images)
    whole = next(others)
    for image in others:
        finite = np.isfinite(whole)
        if finite.all():
            return whole
        whole = np.where(finite, whole, image)
    return whole


def shifted(image: NDArray[np.float32], by: Sequence[int]) -> NDArray[np.float32]:
    """Return an image (y, x, ...) shifted down and right, with NaN at its edges."""
    parts = [_moved(slice(0, size), one, size) for size, one in zip(image.shape, by, strict=False)]
    return _framed(image[parts[0][0], parts[1][0]], (parts[0][1], parts[1][1]))


def prior_map_lies(before: Sequence[EarlierRun], now: StageRef) -> FieldShift:
    """Return the shift of earlier visits, the newest first, against the present one [px]; compared in cells."""

    def picture(mosaic: StageRef) -> NDArray[np.float32]:
        return open_mosaic(mosaic.path / "mosaic.zarr").brightness(CELL_PX)

    shifts = ([round(by / CELL_PX) for by in one.shift_px] for one in before)
    pictures = (shifted(picture(one.mosaic), by) for one, by in zip(before, shifts, strict=True))
    found = field_shift(picture(now), laid_together(pictures), reach_px=REACH_PX / CELL_PX)
    return replace(found, shift=(CELL_PX * found.shift[0], CELL_PX * found.shift[1]))


def whole_pixels(lies: FieldShift) -> tuple[int, int]:
    """Return the shift of a prior map in rows and columns; 0 within the accuracy of the registration."""
    down, across = lies.shift
    return (0, 0) if math.hypot(down, across) < LEAST_SHIFT_PX else (round(down), round(across))


def _moved(part: slice, by: int, size: int) -> tuple[slice, Gap]:
    """Return the part of an axis of ``size`` before a shift ``by``, and the pixels beyond its ends."""
    start, stop = part.start - by, part.stop - by
    first, last = min(max(start, 0), size), min(max(stop, 0), size)
    whole = stop - start
    before = min(max(-start, 0), whole)
    return slice(first, last), (before, whole - before - (last - first))


def _framed(values: NDArray[np.float32], gaps: tuple[Gap, Gap]) -> NDArray[np.float32]:
    """Return images (y, x, ...) padded with NaN."""
    if not any(map(any, gaps)):
        return values
    return np.pad(values, [*gaps, *[(0, 0)] * (values.ndim - 2)], constant_values=np.nan)
