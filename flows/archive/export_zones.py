"""Export a run's classes as polygons, and as prescriptions in a shapefile and ISOXML task data."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from affine import Affine
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from flows.archive.export_layers import ExportedRun
from flows.archive.product_choice import ProductChoice, class_numbers
from pipeline.errors import SettingsError
from pipeline.geometry.grid import UNLABELLED
from pipeline.ground.field_places import M2_PER_HECTARE, PlacedPicture, areas_by_number
from pipeline.ground.georeference import Places, crs_wkt, degree_m, pixel_side_m, plane_pixel_m, to_degrees, to_plane
from pipeline.lazy import deferred
from pipeline.products.cells import CellGrid, Heading, ToAxes, cell_polygons, covered_fractions, dose_cells, pixel_sides
from pipeline.products.regions import Coverage, class_polygons, grow_class, merge_small, outline_regions
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

if TYPE_CHECKING:
    import shapely
else:
    shapely = deferred("shapely")

FINER = 0.99  # of a pixel's side: smaller cells are finer than pixels
CELL_M = 3.0  # default of a prescription, if pixels are smaller
IN_DEGREES = {"proj:code": "EPSG:4326"}
NEEDS_PLACE = "the run has no place on the earth; survey with a [pose], or a scene with a CRS"
Floats = NDArray[np.float64]
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
        names, colours = stored.about["class_names"], np.array(stored.about["class_colours"], np.uint8)
        classes = np.concatenate([rows for _, rows in stored.rows()])
        legend = ClassNames(tuple(names), colours.reshape(-1, 3))
        return cls(classes, legend, Affine(*stored.about["spatial:transform"]), run.geobox)

    @cached_property
    def pixel_m(self) -> float | None:
        """Return the side of a square as large as the middle pixel; None without a CRS."""
        return None if self.geobox is None else pixel_side_m(self.geobox)

    def shaped(self, choice: ProductChoice) -> ClassRaster:
        """Return the raster with small regions merged into a neighbour, and classes grown by their buffers."""
        if self.pixel_m is None:
            return self
        buffers = class_numbers(self.legend.names, choice.buffers_m, "--buffer")
        least_px = choice.flags.least_area / self.pixel_m**2
        classes = merge_small(self.classes, least_px)
        for number, metres in buffers.items():
            classes = grow_class(classes, number, metres / self.pixel_m)
        return replace(self, classes=merge_small(classes, least_px) if buffers else classes)


def check_zones(run: ExportedRun, choice: ProductChoice) -> None:
    """Refuse products that need other classes or a place (SettingsError)."""
    names = open_image(run.path(run.map_product), "classes").about["class_names"]
    class_numbers(names, choice.buffers_m, "--buffer")
    class_numbers(names, choice.doses, "--prescription")
    flags = choice.flags
    if run.geobox is None and (choice.buffers_m or flags.least_area or flags.simplify is not None):
        raise SettingsError(f"--buffer, --least-area and --simplify are in metres, and {NEEDS_PLACE}")
    if run.geobox is None and choice.doses:
        raise SettingsError(f"a prescription is in metres, and {NEEDS_PLACE}")


def zone_notes(run: ExportedRun, choice: ProductChoice) -> list[str]:
    """Return a note if the cells of a prescription are finer than the map's pixels."""
    if not choice.doses or run.geobox is None or choice.flags.cell is None:
        return []
    cell_m, pixel_m = choice.flags.cell, plane_pixel_m(run.geobox)
    if cell_m > FINER * pixel_m:
        return []
    return [
        f"cells of {cell_m:g} m are finer than the map's pixels of {pixel_m:.3g} m; --cell {pixel_m:.3g} gives fewer"
    ]


def write_zones(run: ExportedRun, folder: Path, choice: ProductChoice, add: Add) -> None:
    """Write the chosen polygons and prescriptions into ``folder``, each with its style, and ``add`` them."""
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
    numbers = class_numbers(raster.legend.names, choice.doses, "--prescription")
    areas = areas_by_number(PlacedPicture(raster.geobox), raster.classes, len(raster.legend.names))
    assert areas is not None
    text = ", ".join(f"{name} {dose:g} {choice.unit.name}" for name, dose in choice.doses.items())
    assert run.geobox is not None
    side_m = choice.flags.cell or max(CELL_M, round(plane_pixel_m(run.geobox), 3))  # no smaller than a pixel
    field = DosedField(raster, numbers, choice.flags.least_fraction, side_m, float(areas.sum()), text)
    _write_cells(field, folder, choice, add)
    down, across = (round(field.cell_m / metres, DEGREE_DIGITS) for metres in degree_m(raster.geobox))
    grid, _, doses = field.dosed((down, across), to_degrees(raster.geobox))
    survey, version = run.receipt["survey"], str(run.receipt["versions"].get("spectralzoom", "unknown"))
    task = TaskGrid(*grid.corner, *grid.step, doses, choice.unit)
    files = write_task_data(folder, task, TaskText(survey, survey, text, version, field.area_m2))
    title = f"Prescription ({text}) as ISOXML task data, cells along north"
    kinds = (("task_data", "application/xml"), ("task_grid", "application/octet-stream"))
    for (key, kind), file in zip(kinds, files, strict=True):
        add(key, file, title, kind, ["data"], **IN_DEGREES)


def _write_cells(field: DosedField, folder: Path, choice: ProductChoice, add: Add) -> None:
    """Write the shapefile of cells along the heading, clipped to the field, and its style."""
    assert field.raster.geobox is not None
    unit, heading, (plane, to_own) = choice.unit, Heading(choice.flags.heading % 360), to_plane(field.raster.geobox)

    def along_heading(x: Floats, y: Floats) -> Floats:
        place = plane(x, y)
        return heading.to_axes(place[..., 0], place[..., 1])

    grid, covered, doses = field.dosed((field.cell_m, field.cell_m), along_heading)
    outlines, seen = cell_polygons(grid, heading, covered, field.outlines(plane)), covered > 0
    row, column = np.nonzero(seen)
    hectares = covered[seen] * field.area_m2 / covered.sum() / M2_PER_HECTARE  # of the ellipsoid
    columns: dict[str, Any] = {"dose": doses[seen], "unit": [unit.name] * len(row), "row": row, "col": column}
    path = folder / "prescription.shp"
    write_polygons(path, outlines, columns | {"hectares": hectares}, to_own)
    cells = f"in cells of {field.cell_m:g} m along {heading.degrees:g} degrees; .shx, .dbf, .prj and .cpg beside it"
    add("prescription", path, f"Prescription ({field.text}) {cells}", SHAPEFILE, ["data"])
    most, levels = max(choice.doses.values()), np.unique([0.0, *doses[seen]]).tolist()
    shown = [(d, f"{d:g} {unit.name}", ramp_colour(d / most, REDS) if d else NONE) for d in levels]
    _add_style(path, "dose", shown, add)


@dataclass(frozen=True)
class DosedField:
    """A map of classes with doses, and the size of their cells."""

    raster: ClassRaster
    doses: dict[int, float]  # by number of the class
    least_fraction: float
    cell_m: float
    area_m2: float  # of all pixels with a class, on the ellipsoid
    text: str  # of the doses

    def dosed(self, step: tuple[float, float], to_axes: ToAxes) -> tuple[CellGrid, Floats, Floats]:
        """Return the grid of cells over all pixels with a class, the covered fraction of each, and their doses.

        Raises SettingsError: no pixel has a class, or there are too many cells.
        """
        classes, transform = self.raster.classes, self.raster.transform
        known = classes != UNLABELLED
        sides = [part.reshape(-1, 2) for part in pixel_sides(known, transform, to_axes) if len(part)]
        if not sides:
            raise SettingsError("no pixel of the run's map has a class; there is nothing to prescribe")
        low, high = (np.array([at(part, axis=0) for part in sides]) for at in (np.min, np.max))
        grid = CellGrid.around(low.min(axis=0), high.max(axis=0), step)
        covered = covered_fractions(grid, known, transform, to_axes)
        treated = [
            (covered_fractions(grid, classes == number, transform, to_axes), dose)
            for number, dose in self.doses.items()
        ]
        return grid, covered, dose_cells(covered, treated, self.least_fraction)

    def outlines(self, plane: Places) -> NDArray[Any]:
        """Return the outlines of all pixels with a class in metres of a plane, with a vertex at every corner."""
        known = np.where(self.raster.classes == UNLABELLED, UNLABELLED, 0).astype(np.uint8)
        regions = outline_regions(known).of_classes()
        stepped = Coverage(regions.classes, shapely.segmentize(regions.polygons, 1.0)).moved(self.raster.transform)
        found: NDArray[Any] = shapely.transform(stepped.polygons, lambda points: plane(*points.T))
        return found
