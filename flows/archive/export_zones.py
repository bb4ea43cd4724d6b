"""Products of a run's classes that are no images: polygons, and prescriptions as shapefile and task data."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from affine import Affine
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from flows.archive.export_layers import ExportedRun
from flows.archive.product_choice import ProductChoice, class_numbers
from pipeline.errors import SettingsError
from pipeline.geometry.grid import UNLABELLED
from pipeline.ground.georeference import crs_wkt, degree_m, pixel_side_m, to_degrees, to_plane
from pipeline.products.areas import CellGrid, Heading, ToAxes, cell_polygons, count_classes, dose_cells, pixel_axes
from pipeline.products.regions import class_polygons, grow_class, merge_small
from storage.arrays.class_maps import ClassNames
from storage.arrays.ground_maps import open_image
from storage.export.map_files import (
    DEGREE_DIGITS,
    GEOJSON,
    GEOPACKAGE,
    NONE,
    REDS,
    SHAPEFILE,
    STYLE,
    Entry,
    TaskGrid,
    TaskText,
    ramp_colour,
    write_polygon_style,
    write_polygons,
    write_task_data,
)

IN_DEGREES = {"proj:code": "EPSG:4326"}
NEEDS_PLACE = "the run does not say where on earth it was; survey with a [pose], or a scene with a CRS"
Add = Callable[..., None]  # names a file to the catalogue: key, path, title, media type, roles, fields of STAC's


@dataclass(frozen=True)
class ClassRaster:
    """A run's classes as they are exported, whole."""

    classes: NDArray[np.uint8]  # (y, x)
    legend: ClassNames
    transform: Affine  # from pixel corners to the map; tangents of angles without a CRS
    geobox: GeoBox | None

    @classmethod
    def of(cls, run: ExportedRun) -> ClassRaster:
        """Read them from the map's store."""
        stored = open_image(run.path(run.map_product), "classes")
        names, colours = stored.about["class_names"], np.array(stored.about["class_colours"], np.uint8)
        classes = np.concatenate([rows for _, rows in stored.rows()])
        legend = ClassNames(tuple(names), colours.reshape(-1, 3))
        return cls(classes, legend, Affine(*stored.about["spatial:transform"]), run.geobox)

    @cached_property
    def pixel_m(self) -> float | None:
        """Side of a square as large as the middle pixel; None without a CRS."""
        return None if self.geobox is None else pixel_side_m(self.geobox)

    def shaped(self, choice: ProductChoice) -> ClassRaster:
        """Small regions given to a neighbour, classes grown in their order, and what that cut off given away again."""
        if self.pixel_m is None:
            return self
        buffers = class_numbers(self.legend.names, choice.buffers_m, "--buffer")
        least_px = choice.flags.least_area / self.pixel_m**2
        classes = merge_small(self.classes, least_px)
        for number, metres in buffers.items():
            classes = grow_class(classes, number, metres / self.pixel_m)
        return replace(self, classes=merge_small(classes, least_px) if buffers else classes)


def check_zones(run: ExportedRun, choice: ProductChoice) -> None:
    """Refuse what the run's classes or its place do not give (SettingsError)."""
    names = open_image(run.path(run.map_product), "classes").about["class_names"]
    class_numbers(names, choice.buffers_m, "--buffer")
    class_numbers(names, choice.doses, "--prescription")
    flags = choice.flags
    if run.geobox is None and (choice.buffers_m or flags.least_area or flags.simplify is not None):
        raise SettingsError(f"--buffer, --least-area and --simplify are in metres, and {NEEDS_PLACE}")
    if run.geobox is None and choice.doses:
        raise SettingsError(f"a prescription is in metres, and {NEEDS_PLACE}")


def write_zones(run: ExportedRun, folder: Path, choice: ProductChoice, add: Add) -> None:
    """Write polygons and prescriptions that were asked for into ``folder``, each with its style, and ``add`` them."""
    if choice.flags.polygons or choice.doses:
        raster = ClassRaster.of(run).shaped(choice)
        if choice.flags.polygons:
            _write_polygons(run, raster, folder, choice.flags.simplify, add)
        if choice.doses:
            _write_prescription(run, raster, folder, choice, add)


def _write_polygons(run: ExportedRun, raster: ClassRaster, folder: Path, simplify_m: float | None, add: Add) -> None:
    side, crs = raster.pixel_m, None if raster.geobox is None else crs_wkt(raster.geobox)
    tolerance = 1.0 if side is None or simplify_m is None else simplify_m / side
    found = class_polygons(raster.classes, tolerance).moved(raster.transform)
    unit = "area_rad2" if side is None else "area_m2"
    area = found.polygon_areas() * (1.0 if side is None else side**2 / abs(raster.transform.determinant))
    names = [raster.legend.names[number] for number in found.classes]
    columns = {"class": found.classes.astype(np.int32), "name": names, unit: area}
    path = folder / "classes.gpkg"
    write_polygons(path, found.polygons, columns, crs, layer="classes", when=run.receipt["finished"])
    add("polygons", path, f"Classes as {len(names)} polygons", GEOPACKAGE, ["data"])
    colours = map(tuple, raster.legend.colours.tolist())
    _add_style(path, "name", [(name, name, one) for name, one in zip(raster.legend.names, colours, strict=True)], add)
    if crs is not None:
        path = folder / "classes.geojson"
        write_polygons(path, found.polygons, columns, crs, layer="classes")
        add("polygons_geojson", path, "Classes as polygons, longitude and latitude", GEOJSON, ["data"], **IN_DEGREES)


def _add_style(path: Path, column: str, entries: Sequence[Entry], add: Add) -> None:
    style = path.with_suffix(".qml")
    write_polygon_style(style, column, entries)
    add(f"{path.stem}_polygon_style", style, f"QGIS style of {path.name}", STYLE, ["metadata", "style"])


def _write_prescription(run: ExportedRun, raster: ClassRaster, folder: Path, choice: ProductChoice, add: Add) -> None:
    assert raster.geobox is not None
    assert raster.pixel_m is not None
    flags, unit, heading = choice.flags, choice.unit, Heading(choice.flags.heading % 360)
    doses = class_numbers(raster.legend.names, choice.doses, "--prescription")
    plane, to_own = to_plane(raster.geobox)

    def along_heading(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        place = plane(x, y)
        return heading.to_axes(place[..., 0], place[..., 1])

    grid, found = _dosed(raster, doses, flags.least_fraction, (flags.cell, flags.cell), along_heading)
    seen = np.isfinite(found)
    row, column = np.nonzero(seen)
    columns: dict[str, Any] = {"dose": found[seen], "unit": [unit.name] * len(row), "row": row, "col": column}
    path = folder / "prescription.shp"
    write_polygons(path, cell_polygons(grid, heading)[seen], columns, to_own)
    words = ", ".join(f"{name} {dose:g} {unit.name}" for name, dose in choice.doses.items())
    title = f"Prescription ({words})"
    cells = f"in cells of {flags.cell:g} m along {heading.degrees:g} degrees; .shx, .dbf, .prj and .cpg beside it"
    add("prescription", path, f"{title} {cells}", SHAPEFILE, ["data"])
    most = max(doses.values())
    levels = sorted({0.0, *found[seen].tolist()})
    shown = [(d, f"{d:g} {unit.name}", ramp_colour(d / most, REDS) if d else NONE) for d in levels]
    _add_style(path, "dose", shown, add)
    down, across = (round(flags.cell / metres, DEGREE_DIGITS) for metres in degree_m(raster.geobox))
    grid, found = _dosed(raster, doses, flags.least_fraction, (down, across), to_degrees(raster.geobox))
    known_m2 = int((raster.classes != UNLABELLED).sum()) * raster.pixel_m**2
    survey, version = run.receipt["survey"], str(run.receipt["versions"].get("spectralzoom", "unknown"))
    task = TaskGrid(*grid.corner, *grid.step, found, unit)
    files = write_task_data(folder, task, TaskText(survey, survey, words, version, known_m2))
    kinds = (("task_data", "application/xml"), ("task_grid", "application/octet-stream"))
    for (key, kind), file in zip(kinds, files, strict=True):
        add(key, file, f"{title} as ISOXML task data, cells along north", kind, ["data"], **IN_DEGREES)


def _dosed(
    raster: ClassRaster, doses: dict[int, float], least_fraction: float, step: tuple[float, float], to_axes: ToAxes
) -> tuple[CellGrid, NDArray[np.float64]]:
    """Cells around all that has a class, and their doses."""
    known = raster.classes != UNLABELLED
    rows, columns = (np.flatnonzero(known.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        raise SettingsError("no pixel of the run's map has a class; there is nothing to prescribe")
    width = raster.classes.shape[1]
    edges = [pixel_axes(raster.transform, slice(r, r + 1), width, to_axes)[0] for r in (rows[0], rows[-1])]
    sides = pixel_axes(raster.transform, slice(rows[0], rows[-1] + 1), width, to_axes)[:, [columns[0], columns[-1]]]
    around = np.concatenate([*(edge[columns[0] : columns[-1] + 1] for edge in edges), sides.reshape(-1, 2)])
    grid = CellGrid.around(around, step)
    counts = count_classes(grid, raster.classes, raster.transform, to_axes, len(raster.legend.names))
    return grid, dose_cells(counts, doses, least_fraction)
