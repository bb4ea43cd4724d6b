"""Regions and their outlines: laws of merging and growing, and polygons that are a coverage with the raster's areas."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from numpy.typing import NDArray
from scipy import ndimage

from pipeline.geometry.grid import UNLABELLED
from pipeline.products.regions import class_polygons, find_regions, grow_class, merge_small, outline_regions

Classes = NDArray[np.uint8]
maps = arrays(np.uint8, array_shapes(min_dims=2, max_dims=2, max_side=14), elements=st.sampled_from([0, 1, 2, 255]))


def field_map(shape: tuple[int, int] = (200, 260), seed: int = 0) -> Classes:
    """Fields, rows, specks of a weed, single wrong pixels and a corner without a class."""
    rng = np.random.default_rng(seed)
    ground = ndimage.gaussian_filter(rng.normal(size=shape), 25)
    rows = np.sin(np.arange(shape[1]) / 4 + 3 * ground / ground.std()) > 0.2
    classes = np.where(ground > 0.7 * ground.std(), 3, np.where(rows, 1, 0)).astype(np.uint8)
    specks = ndimage.gaussian_filter(rng.normal(size=shape), 1.5)
    classes[specks > 2.5 * specks.std()] = 2
    wrong = rng.random(shape) < 0.01
    classes[wrong] = rng.integers(0, 4, wrong.sum())
    classes[np.add.outer(np.arange(shape[0]), np.arange(shape[1])) < 60] = UNLABELLED
    return classes


@given(maps, st.integers(2, 12))
def test_no_small_region_is_left_that_has_a_neighbour(classes: Classes, least: int) -> None:
    """What has no class keeps its pixels, and large regions that no small one joined are as before."""
    merged = merge_small(classes, least)
    np.testing.assert_array_equal(merged == UNLABELLED, classes == UNLABELLED)
    _, graph = find_regions(merged)
    known = (graph.classes[graph.pairs] != UNLABELLED).all(axis=1)
    assert (graph.sizes[graph.pairs[known]] >= least).all()
    assert set(np.unique(merged)) <= set(np.unique(classes))


def test_a_small_region_goes_to_the_longest_border() -> None:
    """Not to the largest neighbour; where only one is small, the others stay as they are."""
    classes = np.zeros((6, 9), np.uint8)
    classes[:, 5:] = 1
    classes[2:4, 4] = 2  # two sides to the 1, four to the 0
    merged = merge_small(classes, 3)
    assert (merged[2:4, 4] == 0).all()
    classes[:, 4] = 1
    classes[2:4, 4] = 2  # four sides to the 1, two to the 0
    assert (merge_small(classes, 3)[2:4, 4] == 1).all()
    np.testing.assert_array_equal(merge_small(classes, 1), classes)


@given(maps, st.floats(0.5, 4))
def test_a_class_grows_by_a_distance(classes: Classes, radius: float) -> None:
    """Exactly the pixels with one of the class within the radius, by brute force; nothing over what has no class."""
    grown = grow_class(classes, 1, radius)
    own = np.argwhere(classes == 1)
    for place in np.ndindex(*classes.shape):
        near = len(own) > 0 and (np.hypot(*(own - place).T) <= radius).any()
        assert grown[place] == (1 if near and classes[place] != UNLABELLED else classes[place])


@given(maps)
def test_outlines_are_the_regions(classes: Classes) -> None:
    """Valid polygons and a coverage, each region one polygon whose area is its pixels."""
    found = outline_regions(classes)
    _, graph = find_regions(classes)
    assert shapely.is_valid(found.polygons).all()
    assert shapely.coverage_is_valid(found.polygons)
    assert sorted(shapely.area(found.polygons)) == sorted(graph.sizes)
    assert shapely.area(shapely.union_all(found.polygons)) == pytest.approx(classes.size)


@given(maps, st.floats(0.3, 3))
def test_simplified_polygons_keep_areas_and_leave_no_gap(classes: Classes, tolerance: float) -> None:
    """Each class to 1 % of the raster's, no overlap, and a union as large as the sum."""
    found = class_polygons(classes, tolerance)
    counts = np.bincount(classes.ravel(), minlength=256)[:3]
    np.testing.assert_allclose(found.areas(3), counts, rtol=0.01)
    assert UNLABELLED not in found.classes
    assert shapely.coverage_is_valid(found.polygons)
    union = shapely.area(shapely.union_all(found.polygons)) if len(found.polygons) else 0.0
    assert union == pytest.approx(found.areas(3).sum())


def test_a_field_is_simplified_without_losing_its_weeds() -> None:
    """A third of the vertices go, every class keeps its area to 1 %, and neighbours share their borders."""
    classes = merge_small(field_map(), 4)
    found, plain = class_polygons(classes), outline_regions(classes).of_classes()
    counts = np.bincount(classes.ravel(), minlength=256)[:4]
    assert (counts > 0).all()
    np.testing.assert_allclose(found.areas(4), counts, rtol=0.01)
    assert len(found.polygons) == len(plain.polygons)
    assert _vertices(found.polygons) < 0.67 * _vertices(plain.polygons)
    assert shapely.coverage_is_valid(found.polygons)


def _vertices(polygons: NDArray[Any]) -> int:
    return int(shapely.get_num_coordinates(polygons).sum())
