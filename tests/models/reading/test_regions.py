"""Regions of a field: whole shards, tokens and patches that cover each pixel once."""

from __future__ import annotations

import math

import numpy as np
import pytest

from spectralzoom.models.network.sizes import PLANES, TOKEN_PX, SegmenterConfig
from spectralzoom.models.reading.regions import REGION_PX, Box, plan_regions, region_bytes
from spectralzoom.pipeline.geometry.grid import SceneGrid

SHARD = (64, 640)
FIELDS = [(700, 1300, 16), (2561, 90, 32), (1000, 2000, 8), (64, 641, 16), (300, 1500, 64)]


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("halo", [0, 1, 32, 80])
def test_regions_cover_a_field_once(field: tuple[int, int, int], halo: int):
    """Every pixel and patch is kept by one region; borders inside are those of shards, tokens and patches.

    The area read around a region exceeds it by at least the halo, and begins with a whole token and patch.
    """
    grid = SceneGrid(*field)
    pixels, patch_index = np.zeros((grid.height, grid.width), int), np.zeros(grid.patch_shape, int)
    step = math.lcm(grid.patch, TOKEN_PX)
    for region in plan_regions(grid, SHARD, most_px=(64, 640), halo=halo):
        pixels[region.kept.rows, region.kept.columns] += 1
        patch_index[region.kept_patches.rows, region.kept_patches.columns] += 1
        edges = zip(_edges(region.kept), _edges(region.read), pixels.shape, SHARD, strict=True)
        for (first, last), (top, bottom), size, shard in edges:
            assert first % shard == first % step == 0
            assert last == size or last % shard == last % step == 0
            assert top == 0 or halo <= first - top < halo + step
            assert bottom == size or halo <= bottom - last < halo + step
            assert top % step == 0
    assert (pixels == 1).all()
    assert (patch_index[: -(-grid.height // grid.patch), : -(-grid.width // grid.patch)] == 1).all()


def _edges(box: Box) -> tuple[tuple[int, int], tuple[int, int]]:
    return (box.top, box.bottom), (box.left, box.right)


@pytest.mark.parametrize("field", FIELDS)
def test_patches_of_a_region_keep_their_place_in_the_field(field: tuple[int, int, int]):
    """The first pixel of a patch is the same in the region and the field; only the region that keeps it numbers it."""
    grid = SceneGrid(*field)
    patch_index = np.arange(int(np.prod(grid.patch_shape)))
    times = np.zeros(len(patch_index), int)
    for region in plan_regions(grid, SHARD, most_px=(64, 640), halo=40):
        numbers = region.numbers_here(patch_index)
        inside = numbers >= 0
        kept = np.zeros(grid.patch_shape, np.bool_)
        kept[region.kept_patches.rows, region.kept_patches.columns] = True
        assert (inside == kept.ravel()).all()
        times += inside
        origin = region.grid.patch_origin(numbers[inside]) + np.array([region.read.top, region.read.left])
        assert (origin == grid.patch_origin(patch_index[inside])).all()
    assert (times[grid.every_patch()] == 1).all()


@pytest.mark.parametrize("field", FIELDS)
def test_cropped_regions_make_the_field(field: tuple[int, int, int]):
    """Images and patches that regions keep equal those of the field at the same place."""
    grid = SceneGrid(*field)
    image = np.arange(grid.height * grid.width).reshape(grid.height, grid.width)
    patch_index = np.arange(np.prod(grid.patch_shape)).reshape(grid.patch_shape)
    padded = np.pad(patch_index, (0, 16), constant_values=-1)  # a region's patches may extend beyond the field
    for region in plan_regions(grid, SHARD, most_px=(64, 640), halo=32):
        top, left = region.origin
        rows, columns = region.grid.patch_shape
        kept = region.crop(image[region.read.rows, region.read.columns])
        assert (kept == image[region.kept.rows, region.kept.columns]).all()
        own = region.crop_patches(padded[top : top + rows, left : left + columns].ravel())
        assert (own == patch_index[region.kept_patches.rows, region.kept_patches.columns]).all()


def test_memory_depends_on_the_region_not_on_the_field():
    """Sixteen times the field needs the memory of its largest region; patches add to it."""
    config = SegmenterConfig(classes=3)
    need = [
        max(region_bytes(config, region, 1000, 270) for region in plan_regions(SceneGrid(side, side, 16), SHARD))
        for side in (REGION_PX, 3 * REGION_PX, 12 * REGION_PX)
    ]
    assert need[0] < need[1] == need[2] < 1.2 * need[0]
    (whole,) = plan_regions(SceneGrid(640, 640, 16), SHARD)
    assert region_bytes(config, whole, 500, 270) > region_bytes(config, whole, 0, 270) + 64 * (24 + PLANES) * 4 * 16**2
