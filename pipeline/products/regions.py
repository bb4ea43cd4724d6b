"""Regions of a class map: small ones given to a neighbour, classes grown, and their outlines as polygons without gaps.

A region is a set of pixels of one class that hang together by their sides. What has no class (255) is no region: it
is never given to a class, nor takes anything from one, unless a class is grown over it on request.

Outlines go along the sides of pixels. Wherever three regions meet, all three have a vertex there, which
``rasterio.features.shapes`` leaves out of straight sides: that is what makes the outlines a coverage in the words of
shapely, whose simplification draws a border once for both its regions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from affine import Affine
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, depth_first_order

from pipeline.geometry.grid import UNLABELLED
from pipeline.lazy import deferred

if TYPE_CHECKING:
    import shapely
    import skimage.measure as skimage_measure
else:
    shapely = deferred("shapely")
    skimage_measure = deferred("skimage.measure")

MOST_AREA_ERROR = 0.01  # that simplified borders may change a class's area by, as a share of it
SMALL = (1, 32, 128, 512, 2048)  # px: regions smaller than so many squares of the tolerance keep their outlines
OUTSIDE = -1
EAST, SOUTH, WEST, NORTH = range(4)
Classes = NDArray[np.uint8]


@dataclass(frozen=True)
class Coverage:
    """Regions as polygons that touch without gap or overlap."""

    classes: Classes  # (polygon,)
    polygons: NDArray[Any]  # (polygon,) shapely's, x to the right and y down in pixels from the map's corner

    def areas(self, count: int) -> NDArray[np.float64]:
        """(class,) area of the first ``count`` classes [px]."""
        return np.bincount(self.classes, self.polygon_areas(), count)[:count].astype(np.float64)

    def polygon_areas(self) -> NDArray[np.float64]:
        """(polygon,) area of each."""
        area: NDArray[np.float64] = shapely.area(self.polygons)
        return area

    def moved(self, transform: Affine) -> Coverage:
        """The same in x and y of a map, to which ``transform`` leads from pixel corners."""
        a, b, c, d, e, f = transform[:6]
        turn, origin = np.array([[a, d], [b, e]]), np.array([c, f])
        return Coverage(self.classes, shapely.transform(self.polygons, lambda points: points @ turn + origin))

    def of_classes(self) -> Coverage:
        """The same without what has no class."""
        known = self.classes != UNLABELLED
        return Coverage(self.classes[known], self.polygons[known])


def class_polygons(classes: Classes, tolerance_px: float = 1.0) -> Coverage:
    """Outline the regions of a class map (y, x), and simplify their borders by about ``tolerance_px``.

    A region of a few pixels keeps its outline, as its area would be lost with its corners: those below 32 squares of
    the tolerance where a class's area would else be off by more than 1 %, or below 128, 512, 2048, or at last all.
    """
    framed = np.pad(classes, 1, constant_values=UNLABELLED)  # what has no class is simplified with its neighbours
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
    """Outline the regions of a class map (y, x) along the sides of their pixels, those without a class too."""
    padded = np.pad(number_regions(classes), 1, constant_values=OUTSIDE)
    width = padded.shape[1]
    sides = _sides(padded)
    order, ring_starts = _in_rings(_next_sides(padded.ravel(), sides, width), len(sides))
    pixel, heading = np.divmod(sides[order], 4)
    corner = pixel + np.array([0, 1, width + 1, width])[heading]  # where a side begins: its pixel lies on the right
    before = _previous(np.arange(len(order)), ring_starts)
    kept = (heading != heading[before]) | _junctions(padded)[corner]
    ring = np.repeat(np.arange(len(ring_starts)), np.diff([*ring_starts, len(order)]))
    y, x = np.divmod(corner[kept], width)
    points = np.stack([x - 1.0, y - 1.0], axis=-1)
    inner = pixel[ring_starts]  # one of each ring's region
    return _assembled(points, ring[kept], padded.ravel()[inner], np.pad(classes, 1).ravel()[inner])


def _assembled(
    points: NDArray[np.float64], ring: NDArray[np.intp], region: NDArray[np.int32], of_ring: Classes
) -> Coverage:
    """Polygons of (point, 2) rings, (point,) number of the ring, and (ring,) region with its class."""
    rings = shapely.linearrings(points, indices=ring)
    starts = np.flatnonzero(np.diff(ring, prepend=-1))
    after = _next(np.arange(len(ring)), starts)
    turned = points[:, 0] * points[after, 1] - points[after, 0] * points[:, 1]
    is_hole = np.add.reduceat(turned, starts) < 0  # shells go clockwise as seen, which is positive with y down
    order = np.lexsort((is_hole, region))
    _, first, number = np.unique(region[order], return_index=True, return_inverse=True)
    return Coverage(of_ring[order[first]], shapely.polygons(rings[order], indices=number))


def _sides(padded: NDArray[np.int32]) -> NDArray[np.int64]:
    """Sides of pixels where a region ends, ascending: 4 times the pixel's number and 0 to 3 from the top clockwise."""
    inner = padded[1:-1, 1:-1]
    numbers = np.arange(padded.size, dtype=np.int64).reshape(padded.shape)[1:-1, 1:-1]
    found = []
    for heading, across in (
        (EAST, padded[:-2, 1:-1]),
        (SOUTH, padded[1:-1, 2:]),
        (WEST, padded[2:, 1:-1]),
        (NORTH, padded[1:-1, :-2]),
    ):
        found.append(4 * numbers[(inner != OUTSIDE) & (inner != across)] + heading)
    return np.sort(np.concatenate(found))


def _next_sides(flat: NDArray[np.int32], sides: NDArray[np.int64], width: int) -> NDArray[np.int32]:
    """Place of the side that follows each in its ring.

    Where a region's pixels meet in a corner alone the ring turns left, so that no ring touches itself.
    """
    pixel, heading = np.divmod(sides, 4)
    step = np.array([1, width, -1, -width])
    ahead = pixel + step[heading]
    left = ahead + step[heading - 1]
    turns_left, goes_on = flat[left] == flat[pixel], flat[ahead] == flat[pixel]
    code = np.where(goes_on, 4 * ahead + heading, 4 * pixel + (heading + 1) % 4)
    code = np.where(turns_left, 4 * left + (heading - 1) % 4, code)
    found: NDArray[np.int32] = np.searchsorted(sides, code).astype(np.int32)
    return found


def _in_rings(after: NDArray[np.int32], count: int) -> tuple[NDArray[np.int32], NDArray[np.intp]]:
    """Sides ring by ring, each in order, and where in that list rings begin."""
    rows = np.arange(count + 1)
    ring = connected_components(csr_array((np.ones(count, np.int8), after, rows), shape=(count, count)))[1]
    heads = np.unique(ring, return_index=True)[1].astype(np.int32)
    # from one more node, which leads to the first side of each ring, the search in depth goes ring by ring
    targets, starts = np.concatenate([after, heads]), np.append(rows, count + len(heads))
    graph = csr_array((np.ones(len(targets), np.int8), targets, starts), shape=(count + 1, count + 1))
    order = depth_first_order(graph, count, return_predecessors=False)[1:]
    return order, np.flatnonzero(np.diff(ring[order], prepend=-1))


def _previous(places: NDArray[np.intp], starts: NDArray[np.intp]) -> NDArray[np.intp]:
    before = places - 1
    before[starts] = np.append(starts[1:], len(places)) - 1
    return before


def _next(places: NDArray[np.intp], starts: NDArray[np.intp]) -> NDArray[np.intp]:
    after = places + 1
    after[np.append(starts[1:], len(places)) - 1] = starts
    return after


def _junctions(padded: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Whether three sides or more meet in the upper left corner of each pixel of the padded map, flat."""
    meeting = np.zeros(padded.shape, np.uint8)
    above, left = padded[:-1, :-1] != padded[:-1, 1:], padded[:-1, :-1] != padded[1:, :-1]
    below, right = padded[1:, :-1] != padded[1:, 1:], padded[:-1, 1:] != padded[1:, 1:]
    meeting[1:, 1:] = above.astype(np.uint8) + left + below + right
    found: NDArray[np.bool_] = meeting.ravel() >= 3
    return found


@dataclass(frozen=True)
class RegionGraph:
    """Regions of a map and the sides of pixels between them."""

    classes: Classes  # (region,)
    sizes: NDArray[np.int64]  # (region,) px
    pairs: NDArray[np.int64]  # (pair, 2) regions that touch, the lower number first
    sides: NDArray[np.int64]  # (pair,) how many sides of pixels lie between them

    def grouped(self, group: NDArray[np.integer]) -> RegionGraph:
        """The graph of groups of regions, (region,) numbers of groups from 0; a group has its largest region's class.

        Of equally large ones the first gives the class.
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
    """Pairs of different regions, each once, with the sum of its sides."""
    apart = pairs[:, 0] != pairs[:, 1]
    low, high = pairs[apart].min(axis=1).astype(np.int64), pairs[apart].max(axis=1).astype(np.int64)
    codes, number = np.unique(low * count + high, return_inverse=True)
    return np.stack([codes // max(count, 1), codes % max(count, 1)], axis=-1), np.bincount(
        number, sides[apart], len(codes)
    ).astype(np.int64)


def number_regions(classes: Classes) -> NDArray[np.int32]:
    """Number the regions of a class map from 0, (y, x); what has no class is numbered too."""
    label: Any = skimage_measure.label
    found: NDArray[np.int32] = label(classes.astype(np.int16) + 1, connectivity=1, background=0).astype(np.int32)
    return found - 1


def find_regions(classes: Classes) -> tuple[NDArray[np.int32], RegionGraph]:
    """Number the regions of a class map, (y, x), and give their graph."""
    numbers = number_regions(classes)
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
    """Give every region of less than ``least_px`` pixels to the neighbour that it shares the longest border with.

    Neighbours that are small as well go on together, as the class of the largest, until the whole is large enough.
    What has no neighbour with a class stays, however small. Of borders equally long the neighbour numbered first (from
    the upper left) is taken.
    """
    if least_px <= 1:
        return classes.copy()
    numbers, graph = find_regions(classes)
    group: NDArray[np.integer] = np.arange(len(graph.classes))
    while len(links := _links_of_small(graph, least_px)):
        group_of = _joined(links, len(graph.classes))
        graph, group = graph.grouped(group_of), group_of[group]
        same = graph.pairs[graph.classes[graph.pairs[:, 0]] == graph.classes[graph.pairs[:, 1]]]
        group_of = _joined(same, len(graph.classes))  # what became the class next to it is one region with it
        graph, group = graph.grouped(group_of), group_of[group]
    merged: Classes = graph.classes[group][numbers]
    return merged


def _links_of_small(graph: RegionGraph, least_px: float) -> NDArray[np.int64]:
    """(link, 2): each small region with its neighbour of the longest border; none for those without a neighbour."""
    known = (graph.classes[graph.pairs] != UNLABELLED).all(axis=1)
    pairs, sides = graph.pairs[known], np.tile(graph.sides[known], 2)
    ends = np.concatenate([pairs, pairs[:, ::-1]])
    small = graph.sizes[ends[:, 0]] < least_px
    ends, sides = ends[small], sides[small]
    order = np.lexsort((ends[:, 1], -sides, ends[:, 0]))
    first = np.unique(ends[order, 0], return_index=True)[1]
    links: NDArray[np.int64] = ends[order][first]
    return links


def _joined(links: NDArray[np.int64], count: int) -> NDArray[np.int32]:
    graph = coo_array((np.ones(len(links), np.int8), (links[:, 0], links[:, 1])), shape=(count, count))
    groups: NDArray[np.int32] = connected_components(graph, directed=False)[1]
    return groups


def grow_class(classes: Classes, number: int, radius_px: float) -> Classes:
    """Give a class all pixels whose centres lie within ``radius_px`` of one of its own; what has no class stays so."""
    grown = classes.copy()
    if radius_px > 0 and (classes == number).any():
        away = ndimage.distance_transform_edt(classes != number)
        grown[(away <= radius_px) & (classes != UNLABELLED)] = number
    return grown
