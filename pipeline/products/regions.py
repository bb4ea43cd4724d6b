"""Process the regions of a class map: merge small ones, grow classes, and outline them as polygons without gaps.

A region is a set of pixels of one class that are connected by their sides. Pixels without a class (255) are no region,
and never change.

Outlines follow the sides of pixels. Three regions that meet have a common vertex. So the outlines are a coverage
as shapely defines it, whose simplification treats a border of two regions once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
import skimage
from affine import Affine
from numpy.typing import NDArray
from rasterio import features
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipeline.geometry.grid import UNLABELLED

MOST_AREA_ERROR = 0.01  # of a class's area, by simplified borders
SMALL = (1, 32, 128, 512, 2048)  # px: regions smaller than so many squares of the tolerance keep their outlines
Classes = NDArray[np.uint8]


@dataclass(frozen=True)
class Coverage:
    """Regions as polygons that touch without gap or overlap."""

    classes: Classes  # (polygon,)
    polygons: NDArray[Any]  # (polygon,) shapely's, x to the right and y down in pixels from the map's corner

    def areas(self, count: int) -> NDArray[np.float64]:
        """Return (class,) areas of the first ``count`` classes [px]."""
        return np.bincount(self.classes, self.polygon_areas(), count)[:count].astype(np.float64)

    def polygon_areas(self) -> NDArray[np.float64]:
        """Return the area of each polygon, (polygon,)."""
        return np.asarray(shapely.area(self.polygons))

    def moved(self, transform: Affine) -> Coverage:
        """Return the coverage in x and y of a map; ``transform`` converts pixel corners to these."""
        a, b, c, d, e, f = transform[:6]
        turn, origin = np.array([[a, d], [b, e]]), np.array([c, f])
        return Coverage(self.classes, shapely.transform(self.polygons, lambda points: points @ turn + origin))

    def of_classes(self) -> Coverage:
        """Return the coverage without the parts that have no class."""
        known = self.classes != UNLABELLED
        return Coverage(self.classes[known], self.polygons[known])


def class_polygons(classes: Classes, tolerance_px: float = 1.0) -> Coverage:
    """Return the outlines of the regions of a class map (y, x), simplified by about ``tolerance_px``.

    Small regions keep their outlines, as simplification would remove their area. The limit is the smallest of 1, 32,
    128, 512 and 2048 squares of the tolerance that changes no class's area by more than 1 %. If all do, no region is
    simplified.
    """
    framed = np.pad(classes, 1, constant_values=UNLABELLED)  # pixels without a class are simplified as a region
    found = outline_regions(framed)
    found = Coverage(found.classes, shapely.transform(found.polygons, lambda points: points - 1))
    counts = np.bincount(classes.ravel(), minlength=UNLABELLED + 1)[:UNLABELLED].astype(np.float64)
    area = shapely.area(found.polygons)
    for least in SMALL if tolerance_px else ():
        large = area >= least * tolerance_px**2
        polygons = found.polygons.copy()
        # small ones are holes to the others, whose borders stay as they are
        polygons[large] = shapely.coverage_simplify(polygons[large], tolerance_px, simplify_boundary=False)
        simple = Coverage(found.classes, polygons).of_classes()
        error = np.abs(simple.areas(UNLABELLED) - counts)
        if (error <= MOST_AREA_ERROR * counts).all():
            return simple
    return found.of_classes()


def outline_regions(classes: Classes) -> Coverage:
    """Return the outlines of the regions of a class map (y, x) along pixel sides, regions without a class included."""
    numbers, graph = find_regions(classes)
    found = sorted(features.shapes(numbers, connectivity=4), key=lambda one: one[1])
    stepped = shapely.segmentize([shapely.geometry.shape(one) for one, _ in found], 1.0)
    corners = shapely.transform(stepped, np.rint)  # a vertex at every corner of a pixel
    return Coverage(graph.classes, shapely.coverage_simplify(corners, 0.0))  # without those on straight sides


@dataclass(frozen=True)
class RegionGraph:
    """Regions of a map and the sides of pixels between them."""

    classes: Classes  # (region,)
    sizes: NDArray[np.int64]  # (region,) px
    pairs: NDArray[np.int64]  # (pair, 2) regions that touch, the lower number first
    sides: NDArray[np.int64]  # (pair,) how many sides of pixels lie between them

    def grouped(self, group: NDArray[np.integer]) -> RegionGraph:
        """Return the graph of groups of regions, (region,) numbers of groups from 0.

        A group has the class of its largest region, or of the first of equally large ones.
        """
        count = int(group.max(initial=-1)) + 1
        sizes = np.bincount(group, self.sizes, count).astype(np.int64)
        classes = np.empty(count, np.uint8)
        order = np.lexsort((-np.arange(len(group)), self.sizes))  # the last one that is written stays
        classes[group[order]] = self.classes[order]
        return RegionGraph(classes, sizes, *_summed(group[self.pairs], self.sides, count))


def _summed(
    pairs: NDArray[np.integer], sides: NDArray[np.int64], count: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return pairs of different regions, each once, with the sum of its sides."""
    apart = pairs[:, 0] != pairs[:, 1]
    low, high = pairs[apart].min(axis=1).astype(np.int64), pairs[apart].max(axis=1).astype(np.int64)
    codes, number = np.unique(low * count + high, return_inverse=True)
    return np.stack([codes // max(count, 1), codes % max(count, 1)], axis=-1), np.bincount(
        number, sides[apart], len(codes)
    ).astype(np.int64)


def find_regions(classes: Classes) -> tuple[NDArray[np.int32], RegionGraph]:
    """Return the number of the region of each pixel of a class map, (y, x), and the graph of the regions."""
    label: Any = skimage.measure.label
    numbers: NDArray[np.int32] = label(classes.astype(np.int16) + 1, connectivity=1, background=0).astype(np.int32) - 1
    count = int(numbers.max(initial=-1)) + 1
    sizes = np.bincount(numbers.ravel(), minlength=count).astype(np.int64)
    of_region = np.empty(count, np.uint8)
    of_region[numbers.ravel()] = classes.ravel()
    found = []
    for here, there in ((numbers[:, :-1], numbers[:, 1:]), (numbers[:-1], numbers[1:])):
        border = here != there
        found.append(np.stack([here[border], there[border]], axis=-1))
    pairs = np.concatenate(found)
    return numbers, RegionGraph(of_region, sizes, *_summed(pairs, np.ones(len(pairs), np.int64), count))


def merge_small(classes: Classes, least_px: float) -> Classes:
    """Return the map with every region of less than ``least_px`` pixels merged into a neighbour.

    It is the neighbour with the longest common border, the first from the upper left if several are equally long. Small
    neighbours are merged to the class of the largest until the whole is large enough. Regions without a neighbour of a
    class stay.
    """
    if least_px <= 1:
        return classes.copy()
    numbers, graph = find_regions(classes)
    group: NDArray[np.integer] = np.arange(len(graph.classes))
    while len(links := _links_of_small(graph, least_px)):
        group_of = _joined(links, len(graph.classes))
        graph, group = graph.grouped(group_of), group_of[group]
        same = graph.pairs[graph.classes[graph.pairs[:, 0]] == graph.classes[graph.pairs[:, 1]]]
        group_of = _joined(same, len(graph.classes))  # neighbours of one class become one region
        graph, group = graph.grouped(group_of), group_of[group]
    return np.asarray(graph.classes[group][numbers])


def _links_of_small(graph: RegionGraph, least_px: float) -> NDArray[np.int64]:
    """Return (link, 2): each small region with its neighbour of the longest border, if it has one."""
    known = (graph.classes[graph.pairs] != UNLABELLED).all(axis=1)
    pairs, sides = graph.pairs[known], np.tile(graph.sides[known], 2)
    ends = np.concatenate([pairs, pairs[:, ::-1]])
    small = graph.sizes[ends[:, 0]] < least_px
    ends, sides = ends[small], sides[small]
    order = np.lexsort((ends[:, 1], -sides, ends[:, 0]))
    first = np.unique(ends[order, 0], return_index=True)[1]
    return np.asarray(ends[order][first])


def _joined(links: NDArray[np.int64], count: int) -> NDArray[np.int32]:
    graph = coo_array((np.ones(len(links), np.int8), (links[:, 0], links[:, 1])), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1])


def grow_class(classes: Classes, number: int, radius_px: float) -> Classes:
    """Return the map with a class grown over pixels whose centres lie within ``radius_px`` of its own.

    Pixels without a class stay so.
    """
    grown = classes.copy()
    if radius_px > 0 and (classes == number).any():
        away = ndimage.distance_transform_edt(classes != number)
        grown[(away <= radius_px) & (classes != UNLABELLED)] = number
    return grown
