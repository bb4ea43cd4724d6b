"""Cut a field into regions that the segmenter reads as scenes of their own, which bounds its memory.

A field of up to 640 x 640 px is one region. A larger one is cut; each region is read with a halo of pixels around it,
which is discarded. The four regions of a field of 1280 x 1024 px need 29 % of the memory of a single one, by
`region_bytes`. They take 1 % more multiply-adds if every patch is read in full.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import numpy as np
import scipy
from numpy.typing import NDArray

from spectralzoom.models.network.sizes import (
    PATCHES_AT_ONCE,
    PHOTO_STAGES,
    PLANES,
    TOKEN_PX,
    SegmenterConfig,
    level_widths,
)
from spectralzoom.pipeline.geometry.grid import SceneGrid

REGION_PX = 640  # a side, at most
HALO_PX = TOKEN_PX  # around a region
IMAGE_COPIES, FEATURE_COPIES = 3, 4  # in memory at once
MAP_COPIES = 4  # of logits and probabilities, of this visit and of prior maps
STRIP_COPIES = 3  # of values from a store to spectral columns
STRIP_ROWS = 64  # at once: those of a shard
Scalar = TypeVar("Scalar", bound=np.generic)


@dataclass(frozen=True)
class Box:
    """A rectangle of pixels or patches, ends not included."""

    top: int
    left: int
    bottom: int
    right: int

    @property
    def rows(self) -> slice:
        """Return its rows."""
        return slice(self.top, self.bottom)

    @property
    def columns(self) -> slice:
        """Return its columns."""
        return slice(self.left, self.right)

    @property
    def shape(self) -> tuple[int, int]:
        """Return its height and width."""
        return self.bottom - self.top, self.right - self.left

    def over(self, step: int) -> Box:
        """Return the cells of ``step`` px that overlap it."""
        return Box(self.top // step, self.left // step, -(-self.bottom // step), -(-self.right // step))

    def times(self, step: int, within: Box) -> Box:
        """Return the pixels of cells of ``step`` px within another box."""
        low = max(self.top * step, within.top), max(self.left * step, within.left)
        return Box(*low, min(self.bottom * step, within.bottom), min(self.right * step, within.right))


@dataclass(frozen=True)
class Region:
    """A part of a field: the box that is kept and the larger one that is read, in fine pixels of the field."""

    field: SceneGrid
    kept: Box
    read: Box

    @property
    def grid(self) -> SceneGrid:
        """Return the grid of the box that is read."""
        return SceneGrid(*self.read.shape, self.field.patch)

    @property
    def origin(self) -> tuple[int, int]:
        """Return row and column, in the field, of the first patch that is read."""
        return self.read.top // self.field.patch, self.read.left // self.field.patch

    @property
    def kept_patches(self) -> Box:
        """Return the box of patches that are kept."""
        return self.kept.over(self.field.patch)

    def numbers_here(self, patch_index: NDArray[np.integer]) -> NDArray[np.int64]:
        """Convert patch numbers of the field to those of the region; -1 outside of the kept box.

        The full network reads none of the halo: a patch depends on the overview and its own pixels alone.
        """
        top, left = self.origin
        kept = self.kept_patches
        row, column = np.divmod(np.asarray(patch_index, np.int64), self.field.patch_shape[1])
        inside = (row >= kept.top) & (row < kept.bottom) & (column >= kept.left) & (column < kept.right)
        return np.where(inside, (row - top) * self.grid.patch_shape[1] + column - left, -1)

    def parts(self, patch_index: NDArray[np.integer], halo: int) -> list[Region]:
        """Return regions of whole tokens round those of the field's patches that this region keeps.

        Patches that touch are in one of them; ``halo`` [px] is read around each.
        """
        step = math.lcm(self.field.patch, TOKEN_PX)
        row, column = np.divmod(patch_index[self.numbers_here(patch_index) >= 0], self.field.patch_shape[1])
        there = np.zeros([-(-side // step) for side in (self.kept.bottom, self.kept.right)], np.bool_)
        there[row * self.field.patch // step, column * self.field.patch // step] = True
        groups = scipy.ndimage.find_objects(scipy.ndimage.label(there, np.ones((3, 3)))[0])
        ends = ((y.start, x.start, y.stop, x.stop) for y, x in groups)
        boxes = (Box(top, left, bottom, right) for top, left, bottom, right in ends)
        return [_with_halo(self.field, box.times(step, self.kept), halo) for box in boxes]

    def crop(self, image: NDArray[Scalar]) -> NDArray[Scalar]:
        """Crop a (y, x, ...) image of the box that is read to the box that is kept."""
        return image[self.kept_here]

    @property
    def kept_here(self) -> tuple[slice, slice]:
        """Return rows and columns of the kept box in the box that is read."""
        top, left = self.kept.top - self.read.top, self.kept.left - self.read.left
        return slice(top, top + self.kept.shape[0]), slice(left, left + self.kept.shape[1])

    def crop_patches(self, values: NDArray[Scalar]) -> NDArray[Scalar]:
        """Crop values of all patches that are read, (patch, ...), to the kept ones, (y, x, ...)."""
        top, left = self.origin
        kept = self.kept_patches
        image = values.reshape(*self.grid.patch_shape, *values.shape[1:])
        return image[kept.top - top : kept.bottom - top, kept.left - left : kept.right - left]


def plan_regions(
    field: SceneGrid, shard: tuple[int, int], *, most_px: tuple[int, int] = (REGION_PX, REGION_PX), halo: int = HALO_PX
) -> list[Region]:
    """Cut a field into regions of nearly equal size, row by row; a field within ``most_px`` stays whole.

    ``shard`` is the (y, x) size of the blocks of the store [px]: a region consists of whole shards and tokens.
    ``most_px`` is the (y, x) size of the largest region, at least one shard and one token. ``halo`` [px] is read
    around a region inside the field, rounded up to whole tokens and patches.
    """
    step = math.lcm(field.patch, TOKEN_PX)
    down, across = (
        _cuts(size, math.lcm(step, unit), most)
        for size, unit, most in zip((field.height, field.width), shard, most_px, strict=True)
    )
    return [_with_halo(field, Box(top, left, bottom, right), halo) for top, bottom in down for left, right in across]


def _with_halo(field: SceneGrid, kept: Box, halo: int) -> Region:
    """Return the region of a box, read with a halo of whole tokens and patches inside the field."""
    step = math.lcm(field.patch, TOKEN_PX)
    margin = -(-halo // step) * step
    low = max(kept.top - margin, 0), max(kept.left - margin, 0)
    return Region(
        field, kept, Box(*low, min(kept.bottom + margin, field.height), min(kept.right + margin, field.width))
    )


def _cuts(size: int, unit: int, most: int) -> list[tuple[int, int]]:
    """Return starts and ends of the fewest parts, each of whole units but for the last."""
    if size <= most:
        return [(0, size)]
    units = -(-size // unit)
    count = -(-units // max(most // unit, 1))
    return list(pairwise([part * units // count * unit for part in range(count)] + [size]))


def region_bytes(config: SegmenterConfig, region: Region, patch_index: int, bands: int) -> int:
    """Return an upper bound of the memory to read one region with ``patch_index`` patches in full [bytes].

    It counts the image and its features, those of some patches, all class probabilities, and rows of values from the
    stores.
    """
    y, x = region.grid.padded_shape
    inputs = config.columns + PLANES
    overview, full = (
        FEATURE_COPIES * sum(channels / 4**level for level, channels in enumerate(level_widths(width, size, deep)))
        for width, size, deep in ((config.overview_width, TOKEN_PX, config.deep), (config.width, config.patch, False))
    )
    if config.deep:  # the widest layer of its encoder has a quarter of the pixels
        overview += FEATURE_COPIES * PHOTO_STAGES[1][3] * PHOTO_STAGES[0][0] / 4
    drawn = MAP_COPIES * config.classes
    chunk = min(PATCHES_AT_ONCE, patch_index) * config.patch**2 * (full + inputs + config.overview_width)
    strip = STRIP_COPIES * bands * min(STRIP_ROWS, y) * x
    return int(4 * round(y * x * (IMAGE_COPIES * inputs + overview + drawn) + chunk + strip))


def most_bytes(config: SegmenterConfig, regions: Sequence[Region], patch_index: NDArray[np.integer], bands: int) -> int:
    """Return the largest `region_bytes` of some regions; ``patch_index`` are the patches of the field read in full."""
    return max(
        region_bytes(config, region, int(np.count_nonzero(region.numbers_here(patch_index) >= 0)), bands)
        for region in regions
    )
