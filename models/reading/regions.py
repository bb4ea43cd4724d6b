"""Regions: parts of a field that the segmenter reads as scenes of their own, so that memory has a bound.

Attention is global, so what a token sees has to end somewhere. A field of up to 640 x 640 px is one region and is read
whole. A larger one is cut; each part is read with a halo of coarse cells around it, of which nothing is kept. Attention
takes multiply-adds quadratic in a region: three farms of 1280 x 1024 px, cut, score within .1 points of one region, for
84 % of its multiply-adds (docs/benchmarks.md).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from models.network.sizes import SegmenterConfig, level_widths
from pipeline.geometry.grid import SceneGrid

REGION_PX = 640  # a side, at most
HALO_CELLS = 1  # coarse patches around a region that are read with it; see bench_regions.py for more and for none
CELL_COPIES, PATCH_COPIES = 8, 2  # of a coarse cell's features, and of a patch's columns, in memory at once
MAP_COPIES = 2  # of what is believed of every class: of the look, and of look and memory together
STRIP_COPIES = 3  # of values on their way from a store to spectral columns
STRIP_ROWS, PATCHES_READ = 64, 64  # at once: those of a shard
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
        """Its rows."""
        return slice(self.top, self.bottom)

    @property
    def columns(self) -> slice:
        """Its columns."""
        return slice(self.left, self.right)

    @property
    def shape(self) -> tuple[int, int]:
        """(y, x)."""
        return self.bottom - self.top, self.right - self.left

    def over(self, step: int) -> Box:
        """Give the cells of ``step`` that hold part of it."""
        return Box(self.top // step, self.left // step, -(-self.bottom // step), -(-self.right // step))


@dataclass(frozen=True)
class Region:
    """A part of a field: what is kept of it, and what is read for that, both in fine pixels of the field."""

    field: SceneGrid
    kept: Box
    read: Box

    @property
    def grid(self) -> SceneGrid:
        """The scene that is read."""
        return SceneGrid(*self.read.shape, self.field.patch, self.field.factor)

    @property
    def coarse(self) -> Box:
        """What is read, in pixels of the coarse mosaic."""
        return self.read.over(self.field.factor)

    @property
    def origin(self) -> tuple[int, int]:
        """Row and column of the field's patch in which the scene begins: tokens keep the places of the field."""
        return self.read.top // self.field.patch, self.read.left // self.field.patch

    @property
    def kept_patches(self) -> Box:
        """What is kept, in patches of the field's padded grid."""
        cells = self.kept.over(self.field.patch * self.field.factor)
        s = self.field.factor
        return Box(s * cells.top, s * cells.left, s * cells.bottom, s * cells.right)

    def numbers_here(self, patch_index: NDArray[np.integer]) -> NDArray[np.int64]:
        """Give the scene's numbers of patches of the field; -1 where one lies outside."""
        (rows, columns), (top, left) = self.grid.patch_shape, self.origin
        row, column = np.divmod(np.asarray(patch_index, np.int64), self.field.patch_shape[1])
        row, column = row - top, column - left
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        return np.where(inside, row * columns + column, -1)

    def crop(self, image: NDArray[Scalar]) -> NDArray[Scalar]:
        """Keep of a (y, x, ...) image of the scene what belongs to the region."""
        rows, columns = self.kept_here
        return image[rows, columns]

    @property
    def kept_here(self) -> tuple[slice, slice]:
        """What belongs to the region, in rows and columns of what is read."""
        top, left = self.kept.top - self.read.top, self.kept.left - self.read.left
        return slice(top, top + self.kept.shape[0]), slice(left, left + self.kept.shape[1])

    def crop_coarse(self, image: NDArray[Scalar]) -> NDArray[Scalar]:
        """Keep of a (y, x, ...) image of the scene in coarse pixels what belongs to the region."""
        kept, read = self.kept.over(self.field.factor), self.coarse
        return image[kept.top - read.top : kept.bottom - read.top, kept.left - read.left : kept.right - read.left]

    def crop_patches(self, values: NDArray[Scalar]) -> NDArray[Scalar]:
        """Keep of (patch,) values of the scene's padded grid what belongs to the region, (y, x)."""
        (top, left), kept = self.origin, self.kept_patches
        image = values.reshape(self.grid.patch_shape)
        return image[kept.top - top : kept.bottom - top, kept.left - left : kept.right - left]


def whole_field(field: SceneGrid) -> Region:
    """Give the one region that is the field itself."""
    box = Box(0, 0, field.height, field.width)
    return Region(field, box, box)


def plan_regions(
    field: SceneGrid,
    shard: tuple[int, int],
    *,
    most_px: tuple[int, int] = (REGION_PX, REGION_PX),
    halo: int = HALO_CELLS,
) -> list[Region]:
    """Cut a field into regions of nearly equal size, row by row; one that is no larger than ``most_px`` stays whole.

    ``shard``: (y, x) of what is written at once [px]: regions hold whole ones, and whole coarse patches. ``most_px``:
    (y, x) of the largest region, as far as one shard and one coarse patch allow. ``halo``: Coarse patches that are read
    around a region where the field goes on.
    """
    cell = field.patch * field.factor
    margin = halo * cell
    down, across = (
        _cuts(size, math.lcm(cell, unit), most)
        for size, unit, most in zip((field.height, field.width), shard, most_px, strict=True)
    )
    kept = [Box(top, left, bottom, right) for top, bottom in down for left, right in across]
    return [
        Region(
            field,
            box,
            Box(
                max(box.top - margin, 0),
                max(box.left - margin, 0),
                min(box.bottom + margin, field.height),
                min(box.right + margin, field.width),
            ),
        )
        for box in kept
    ]


def _cuts(size: int, unit: int, most: int) -> list[tuple[int, int]]:
    """Starts and ends of as few parts as possible, of whole units but for the last."""
    if size <= most:
        return [(0, size)]
    units = -(-size // unit)
    count = -(-units // max(most // unit, 1))
    edges = [part * units // count * unit for part in range(count)] + [size]
    return list(pairwise(edges))


def region_bytes(config: SegmenterConfig, region: Region, patch_index: int, bands: int) -> int:
    """Memory that reading one region takes at most, ``patch_index`` fine patches of it in use [bytes].

    Counted: features of coarse patches and of fine ones, what their tokens keep of each layer, columns of the patches,
    the map with every class's probability (a memory takes the room of the columns), and values on their way from the
    stores, some rows or patches at a time.
    """
    p, s = config.patch, config.factor
    coarse, features = (  # of one patch, at all levels
        4 * sum(channels * (p >> level) ** 2 for level, channels in enumerate(level_widths(width, p)))
        for width in (config.coarse_width, config.width)
    )
    rows, columns = region.grid.patch_shape
    cells = rows * columns // s**2
    memory = 2 * 4 * config.layers * config.dim * config.token_side**2  # keys and values of a patch's tokens
    patch = features + memory + (PATCH_COPIES * 4 * config.columns + 16) * p**2
    believed = MAP_COPIES * 4 * config.classes * rows * columns * p**2
    strip = max(min(STRIP_ROWS, region.coarse.shape[0]) * region.coarse.shape[1], min(PATCHES_READ, patch_index) * p**2)
    read = (CELL_COPIES * coarse + memory) * cells + patch * patch_index
    return read + believed + STRIP_COPIES * 4 * bands * strip


def most_bytes(config: SegmenterConfig, regions: Sequence[Region], patch_index: NDArray[np.integer], bands: int) -> int:
    """Memory that the most expensive of several regions takes at most, ``patch_index`` of the field in use [bytes]."""
    return max(
        region_bytes(config, region, int(np.count_nonzero(region.numbers_here(patch_index) >= 0)), bands)
        for region in regions
    )
