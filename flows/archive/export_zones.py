"""Export a run's classes as polygons, and as a prescription: cells in a GeoPackage, and ISOXML task data."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from affine import Affine
from numpy.typing import NDArray
from odc.geo import CRS, resxy_
from odc.geo.geobox import GeoBox

from flows.archive.export_layers import ExportedRun, ProductChoice
from flows.publish.receipt import hectares_of_classes
from pipeline.errors import SettingsError
from pipeline.geometry.grid import UNLABELLED, cuts
from pipeline.ground.field_places import M2_PER_HECTARE
from pipeline.ground.georeference import is_in_metres, pixel_side_m
from pipeline.lazy import pyproj, rasterio_features, rasterio_warp, shapely
from storage.arrays.class_maps import ClassNames, legend_of
from storage.arrays.ground_maps import open_image
from storage.export.map_files import (
    DEGREE_DIGITS,
    GEOJSON,
    GEOPACKAGE,
    TaskGrid,
    TaskText,
    write_polygons,
    write_task_data,
)

CELL_M = 3.0  # default of a prescription, if pixels are smaller
MOST_CELLS = 4_000_000
WITHIN = (0.001, 0.5, 0.999)  # places in a pixel or a cell, down and across, at which the two overlap
PIXELS_AT_ONCE = 1_000_000
WGS84 = "EPSG:4326"
IN_DEGREES = {"proj:code": WGS84}
Places = tuple[NDArray[np.integer], ...]  # row and column
Add = Callable[..., None]  # adds a file to the catalogue: key, path, title, media type, roles, STAC fields


@dataclass(frozen=True)
class ClassRaster:
    """A run's whole class map as it is exported."""

    classes: NDArray[np.uint8]  # (y, x)
    legend: ClassNames
    transform: Affine  # from pixel corners to the map; tangents of angles without a CRS
    geobox: GeoBox | None

    @classmethod
    def of(cls, run: ExportedRun) -> ClassRaster:
        """Read the classes of the map's store."""
        stored = open_image(run.path(run.map_product), "classes")
        classes = np.concatenate([rows for _, rows in stored.rows()])
        return cls(classes, legend_of(stored.group), Affine(*stored.about["spatial:transform"]), run.geobox)


def check_zones(run: ExportedRun, choice: ProductChoice) -> None:
    """Refuse a prescription for other classes, or without a place (SettingsError)."""
    names: Sequence[str] = open_image(run.path(run.map_product), "classes").about["class_names"]
    if unknown := sorted(set(choice.doses) - set(names)):
        raise SettingsError(f"--prescription: the run has no class {unknown[0]!r}; its classes are {', '.join(names)}")
    if run.geobox is None and choice.doses:
        raise SettingsError(
            "a prescription is in metres, and the run has no place on the earth; survey with a [pose], or a scene with "
            "a CRS"
        )
    if choice.doses and run.geobox is not None:
        west, south, east, north = _bounds(run.geobox, WGS84)
        if not -80 <= south <= north <= 84:
            raise SettingsError("the map lies beyond 84 degrees north or 80 south, where UTM and a prescription end")
        if west > east or east > 180:
            raise SettingsError("the map lies across 180 degrees of longitude, a prescription cannot: survey each side")


def write_zones(run: ExportedRun, folder: Path, choice: ProductChoice, add: Add) -> None:
    """Write the chosen polygons and prescription into ``folder``, and ``add`` them."""
    if choice.flags.polygons:
        _write_polygons(run, ClassRaster.of(run), folder, add)
    if choice.doses:
        _write_prescription(run, ClassRaster.of(run), folder, choice, add)


def _write_polygons(run: ExportedRun, raster: ClassRaster, folder: Path, add: Add) -> None:
    """Write the outline of each region along the sides of its pixels."""
    crs = None if raster.geobox is None else str(raster.geobox.crs)
    known = raster.classes != UNLABELLED
    found = list(rasterio_features.shapes(raster.classes, mask=known, transform=raster.transform))
    polygons, numbers = [shapely.geometry.shape(outline) for outline, _ in found], [int(one) for _, one in found]
    columns = {
        "class": numbers,
        "name": [raster.legend.names[number] for number in numbers],
        "colour": [f"#{bytes(raster.legend.colours[number].tolist()).hex()}" for number in numbers],
    }
    path = folder / "classes.gpkg"
    write_polygons(path, polygons, columns, crs, layer="classes", when=run.receipt["finished"])
    add("polygons", path, f"Classes as {len(polygons)} polygons", GEOPACKAGE, ["data"])
    if crs is not None:
        path = folder / "classes.geojson"
        write_polygons(path, polygons, columns, crs, layer="classes")
        add("polygons_geojson", path, "Classes as polygons, longitude and latitude", GEOJSON, ["data"], **IN_DEGREES)


def _write_prescription(run: ExportedRun, raster: ClassRaster, folder: Path, choice: ProductChoice, add: Add) -> None:
    """Write cells along the north of the map in metres as polygons, and cells in degrees as task data."""
    assert raster.geobox is not None
    assert raster.geobox.crs is not None
    west, south, east, north = _bounds(raster.geobox, WGS84)
    in_metres = is_in_metres(raster.geobox)
    plane = raster.geobox.crs if in_metres else CRS.utm((west + east) / 2, (south + north) / 2)
    side = abs(raster.geobox.affine.determinant) ** 0.5 if in_metres else pixel_side_m(raster.geobox)
    cell_m = choice.flags.cell or max(CELL_M, round(side, 3))  # no smaller than a pixel
    cells = GeoBox.from_bbox(_bounds(raster.geobox, plane), crs=plane, resolution=cell_m)
    dose = dose_cells(raster, choice.doses, cells)
    row, column = np.nonzero(np.isfinite(dose))
    left, top = cells.affine * (0, 0)
    x, y = left + column * cells.resolution.x, top + row * cells.resolution.y
    outlines = shapely.box(x, y + cells.resolution.y, x + cells.resolution.x, y)
    columns = {"dose": dose[row, column], "unit": [choice.unit.name] * len(row)}
    path = folder / "prescription.gpkg"
    text = ", ".join(f"{name} {one:g} {choice.unit.name}" for name, one in choice.doses.items())
    write_polygons(path, outlines, columns, str(plane), layer="prescription", when=run.receipt["finished"])
    add("prescription", path, f"Prescription ({text}) in cells of {cell_m:g} m", GEOPACKAGE, ["data"])
    middle = (south + north) / 2
    length = pyproj.Geod(ellps="WGS84").line_length
    metres = length([west, west], [middle - 0.5, middle + 0.5]), length([west - 0.5, west + 0.5], [middle, middle])
    down, across = (round(cell_m / one, DEGREE_DIGITS) for one in metres)
    cells = GeoBox.from_bbox((west, south, east, north), crs=WGS84, resolution=resxy_(across, -down))
    box = cells.boundingbox
    task = TaskGrid(box.bottom, box.left, down, across, dose_cells(raster, choice.doses, cells)[::-1], choice.unit)
    version = str(run.receipt["versions"].get("spectralzoom", "unknown"))
    m2 = M2_PER_HECTARE * sum((hectares_of_classes(run.receipt) or {}).values())
    files = write_task_data(folder, task, TaskText(run.receipt["survey"], run.receipt["survey"], text, version, m2))
    kinds = (("task_data", "application/xml"), ("task_grid", "application/octet-stream"))
    for (key, kind), file in zip(kinds, files, strict=True):
        add(key, file, f"Prescription ({text}) as ISOXML task data", kind, ["data"], **IN_DEGREES)


def _bounds(geobox: GeoBox, crs: object) -> tuple[float, float, float, float]:
    """Return the box around a map in another CRS: left, bottom, right, top."""
    found = rasterio_warp.transform_bounds(str(geobox.crs), str(crs), *geobox.boundingbox.bbox)
    return found[0], found[1], found[2], found[3]


def dose_cells(raster: ClassRaster, doses: Mapping[str, float], cells: GeoBox) -> NDArray[np.float64]:
    """Return the dose of each cell, (row, column): the greatest of the classes in it, NaN without a class.

    ``doses`` are by name of the class; other classes have a dose of 0. Raises SettingsError: too many cells.
    """
    assert raster.geobox is not None
    if np.prod(cells.shape) > MOST_CELLS:
        raise SettingsError(f"the cells would be {cells.shape.y} x {cells.shape.x}, more than {MOST_CELLS}; use larger")
    levels = np.array([np.nan, *sorted({0.0, *doses.values()})])  # 0 is no class, so that the greatest number wins
    of_class = np.ones(UNLABELLED + 1, np.uint8)
    of_class[UNLABELLED] = 0
    for name, dose in doses.items():
        of_class[raster.legend.names.index(name)] = np.searchsorted(levels[1:], dose) + 1
    found = np.zeros(cells.shape, np.uint8)
    level = of_class[raster.classes]
    rasterio_warp.reproject(
        level,
        found,
        src_transform=raster.geobox.affine,
        src_crs=str(raster.geobox.crs),
        src_nodata=0,
        dst_transform=cells.affine,
        dst_crs=str(cells.crs),
        dst_nodata=0,
        resampling=rasterio_warp.Resampling.max,
    )
    # each cell gets the dose of every pixel in it: GDAL misses pixels of rotated maps
    for pixel, cell in _overlaps(np.nonzero(level > 1), raster.geobox, cells):
        np.maximum.at(found, cell, level[pixel])
    for cell, pixel in _overlaps(tuple(np.indices(found.shape).reshape(2, -1)), cells, raster.geobox):
        np.maximum.at(found, cell, level[pixel])
    return np.asarray(levels[found])


def _overlaps(places: Places, grid: GeoBox, other: GeoBox) -> Iterator[tuple[Places, Places]]:
    """Yield pixels (row, column) of a grid, and the pixels of another one that nine points within each meet."""
    between = pyproj.Transformer.from_crs(str(grid.crs), str(other.crs), always_xy=True)
    to_ground: Any = grid.affine
    to_other: Any = ~other.affine
    for some in cuts(len(places[0]), PIXELS_AT_ONCE):
        rows, columns = (one[some] for one in places)
        for down, across in itertools.product(WITHIN, WITHIN):
            point: Any = between.transform(*(to_ground * (columns + across, rows + down)))
            column, row = (np.floor(one).astype(np.int64) for one in to_other * point)
            inside = (row >= 0) & (row < other.shape[0]) & (column >= 0) & (column < other.shape[1])
            yield (rows[inside], columns[inside]), (row[inside], column[inside])
