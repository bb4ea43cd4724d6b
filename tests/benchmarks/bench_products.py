"""Polygons of a map of 10 million pixels: time, memory, areas, gaps; beside GDAL's outlines simplified one by one."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import rasterio.features
import rasterio.plot
import shapely
from measure import Row, alone, peak_bytes
from numpy.typing import NDArray
from scipy import ndimage

from pipeline.geometry.grid import UNLABELLED
from pipeline.products.regions import class_polygons, merge_small

SIDES = (3000, 3400)
LEAST_PX = {"regions of 8 px and more": 8, "every region": 1}
CLASSES = 5
MOST_S, MOST_GIB, MOST_ERROR = 60.0, 2.0, 0.01


@dataclass(frozen=True)
class Drawn:
    """What became of one map."""

    seconds: float  # of the processor
    gib: float
    polygons: int
    vertices: int
    area_error: float
    misfit_px: float  # area that polygons show twice, or that is between them
    is_coverage: bool | None


def field_map(shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Fields with crop rows, weeds as small spots, one pixel in fifty wrong, and a corner that was not seen."""
    rng = np.random.default_rng(0)
    small = ndimage.gaussian_filter(rng.normal(size=(shape[0] // 8, shape[1] // 8)), 12)
    ground = ndimage.zoom(small / small.std(), (shape[0] / (shape[0] // 8), shape[1] / (shape[1] // 8)), order=1)
    rows = np.sin(np.arange(shape[1]) / 10 + 0.3 * ground) > 0.3
    classes = np.where(ground > 0.8, 3, np.where(ground < -1, 4, np.where(rows, 1, 0))).astype(np.uint8)
    spots = ndimage.gaussian_filter(rng.normal(size=shape).astype(np.float32), 1.5)
    classes[spots > 3.2 * spots.std()] = 2
    wrong = rng.random(shape, np.float32) < 0.02
    classes[wrong] = rng.integers(0, CLASSES, int(wrong.sum()))
    classes[np.add.outer(np.arange(shape[0]), np.arange(shape[1])) < shape[0] // 3] = UNLABELLED
    return classes


def draw(least_px: int, ours: bool) -> Drawn:
    """Merge small regions and draw the map, in a process of its own."""
    classes = field_map(SIDES)
    start = time.process_time()
    merged = merge_small(classes, least_px)
    if ours:
        found = class_polygons(merged)
        numbers, polygons = found.classes, found.polygons
    else:
        shapes = list(rasterio.features.shapes(merged, merged != UNLABELLED, connectivity=4))
        numbers = np.array([int(number) for _, number in shapes], np.uint8)
        rings = [shapely.Polygon(one["coordinates"][0], one["coordinates"][1:]) for one, _ in shapes]
        polygons = shapely.simplify(np.array(rings), 1.0)
    seconds, gib = time.process_time() - start, peak_bytes() / 2**30
    counts = np.bincount(merged.ravel(), minlength=256)[:CLASSES]
    areas = np.bincount(numbers, shapely.area(polygons), CLASSES)
    shown = np.where(counts > 0, np.abs(areas / np.maximum(counts, 1) - 1), 0)
    # the check is quadratic in holes, so that it is made of the map with the few regions
    few = least_px > 1
    misfit = abs(float(shapely.area(shapely.union_all(polygons))) - float(areas.sum())) if few else float("nan")
    valid = bool(shapely.coverage_is_valid(polygons)) if few else None
    vertices = int(shapely.get_num_coordinates(polygons).sum())
    return Drawn(seconds, gib, len(polygons), vertices, float(shown.max()), misfit, valid)


def rows() -> list[Row]:
    """Processor time and memory of both maps, their areas, and whether borders are closed."""
    found = []
    for words, least in LEAST_PX.items():
        own, peer = (alone(draw, least, ours) for ours in (True, False))
        name = f"polygons of 10 Mpx, {words}"
        size = f"{own.polygons} polygons, {own.vertices} vertices"
        beside = f"rasterio.features.shapes, shapely.simplify: {peer.seconds:.1f} s, {peer.gib:.2f} GiB"
        met = own.seconds <= MOST_S
        found.append(Row(f"{name}: processor time", f"{own.seconds:.1f} s, {size}", f"<= {MOST_S:g} s", met, beside))
        found.append(Row(f"{name}: memory", f"{own.gib:.2f} GiB", f"<= {MOST_GIB:g} GiB", own.gib <= MOST_GIB))
        error, theirs = f"{own.area_error:.2%}", f"the same: {peer.area_error:.2%}"
        met = own.area_error <= MOST_ERROR
        found.append(Row(f"{name}: area of the worst class", error, f"<= {MOST_ERROR:.0%}", met, theirs))
        if own.is_coverage is not None:
            figure = f"{own.misfit_px:.3f} px, coverage {'valid' if own.is_coverage else 'NOT valid'}"
            theirs = f"the same: {peer.misfit_px:.0f} px, coverage {'valid' if peer.is_coverage else 'not valid'}"
            met = own.is_coverage and own.misfit_px < 1
            found.append(Row(f"{name}: shown twice or not at all", figure, "< 1 px, valid", met, theirs))
    return found
