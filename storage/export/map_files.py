"""Files for map programs and machines: polygons (by GDAL), QGIS styles beside them and rasters, and ISOXML task data.

Polygons are GeoPackage, GeoJSON and shapefile; styles (.qml) are classes with names and colours, ramps, bands as
colours. Task data (ISO 11783-10, version 4) is TASKDATA.XML and the numbers of its grid, of type 2. Rows begin at the
south-west corner; each cell has the dose as a 32 bit whole number in steps of the dictionary's entity for it.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ArchiveError, SettingsError
from pipeline.lazy import deferred
from storage.archive.whole_files import write_whole, written_aside

if TYPE_CHECKING:
    import geopandas
    import pyogrio
else:
    geopandas = deferred("geopandas")
    pyogrio = deferred("pyogrio")

GEOPACKAGE = "application/geopackage+sqlite3"
GEOJSON = "application/geo+json"
SHAPEFILE = "application/vnd.shp"
SHAPE_PARTS = (".shp", ".shx", ".dbf", ".prj", ".cpg")
DEGREE_DIGITS = 9  # of a degree: 0.1 mm

Columns = Mapping[str, Any]  # one value a polygon, each a sequence or an array
FOLDER, XML, NUMBERS = "TASKDATA", "TASKDATA.XML", "GRD00000.bin"
DESIGNATOR = 32  # letters of a name
MOST_NUMBER = 2**31 - 1
TREATED, UNTREATED = 1, 0  # codes of treatment zones: 0 where there is no cell, no signal, or outside of the field
STYLE = "application/xml"
QGIS_VERSION = "3.34"  # the earliest that these were written for
GREENS = ((120, 70, 20), (240, 230, 150), (20, 110, 30))  # of indices, from low to high
GREYS = ((0, 0, 0), (255, 255, 255))
REDS = ((255, 235, 205), (245, 130, 50), (150, 0, 20))  # of doses above 0
NONE = (215, 215, 215)  # of a dose of 0

Colour = tuple[int, ...]
Entry = tuple[Any, str, Colour]  # value, name, red green blue


def write_polygons(
    path: Path, polygons: Any, columns: Columns, crs: str | None, *, layer: str | None = None, when: str | None = None
) -> None:
    """Write polygons as a GeoPackage, as GeoJSON or as a shapefile, by the ending of ``path``.

    ``polygons`` are shapely's, ``columns`` values of each, ``crs`` WKT, None where there is none. A GeoPackage keeps
    ``when`` (ISO 8601) as its date, so that bytes repeat. GeoJSON is in longitude and latitude, its shells
    anticlockwise (RFC 7946). A shapefile has .shx, .dbf, .prj and .cpg beside it, and names of columns of 10 letters.
    Raises ArchiveError: GDAL or the disk refuses.
    """
    kind = path.suffix
    names = [path.with_suffix(part).name for part in reversed(SHAPE_PARTS)] if kind == ".shp" else [path.name]
    with _writing(path, names, when) as aside, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "'crs' was not provided", UserWarning)  # a missing one has its own message
        frame = geopandas.GeoDataFrame(dict(columns), geometry=list(polygons), crs=crs)
        frame = frame.to_crs(4326) if kind == ".geojson" else frame
        frame.to_file(aside / path.name, layer=layer, engine="pyogrio", **_OPTIONS[kind])


_OPTIONS: Mapping[str, Mapping[str, Any]] = {
    ".gpkg": {"driver": "GPKG"},
    ".geojson": {"driver": "GeoJSON", "RFC7946": "YES", "COORDINATE_PRECISION": DEGREE_DIGITS},
    ".shp": {"driver": "ESRI Shapefile", "encoding": "UTF-8"},
}


@contextmanager
def _writing(path: Path, names: Sequence[str], when: str | None) -> Iterator[Path]:
    """Yield a folder to write into; GDAL's date of now is ``when``, and its refusals become ArchiveError."""
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": when})
    try:
        with written_aside(path.parent, names) as aside:
            yield aside
    except pyogrio.errors.DataSourceError as error:
        raise ArchiveError(f"{path} cannot be written: {error}; is there space on the disk?") from error
    finally:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": None})


@dataclass(frozen=True)
class DoseUnit:
    """A unit of doses, and the entity of the ISO 11783-11 dictionary that carries it."""

    name: str
    ddi: int  # number of the entity
    per_unit: int  # of its steps


UNITS = {
    "l/ha": DoseUnit("l/ha", 0x0001, 10_000),  # setpoint volume per area, in 0.01 mm3/m2
    "kg/ha": DoseUnit("kg/ha", 0x0006, 100),  # setpoint mass per area, in 1 mg/m2
}


@dataclass(frozen=True)
class TaskGrid:
    """Doses on a grid of degrees (WGS 84)."""

    south_deg: float
    west_deg: float
    north_step_deg: float  # of a cell
    east_step_deg: float
    doses: NDArray[np.float64]  # (row from the south, column from the west), NaN where there is no field
    unit: DoseUnit


@dataclass(frozen=True)
class TaskText:
    """Names of a task, its field and its product."""

    task: str
    field: str
    product: str
    version: str  # of this program
    area_m2: float


def write_task_data(folder: Path, grid: TaskGrid, words: TaskText) -> tuple[Path, Path]:
    """Write ``folder/TASKDATA`` with the task and its grid; gives the paths of both files.

    Raises SettingsError: a dose is larger than the format can hold. ArchiveError: the disk refuses.
    """
    steps = np.rint(np.nan_to_num(grid.doses) * grid.unit.per_unit)
    if steps.max(initial=0) > MOST_NUMBER:
        most = MOST_NUMBER / grid.unit.per_unit
        raise SettingsError(f"task data hold doses up to {most:.0f} {grid.unit.name}, got {np.nanmax(grid.doses):g}")
    numbers = steps.astype("<i4").tobytes()
    place = folder / FOLDER
    with written_aside(place, [NUMBERS, XML]) as aside:
        (aside / NUMBERS).write_bytes(numbers)
        tree = ElementTree.ElementTree(_task_file(grid, words, len(numbers)))
        ElementTree.indent(tree)
        tree.write(aside / XML, encoding="UTF-8", xml_declaration=True)
    return place / XML, place / NUMBERS


def _task_file(grid: TaskGrid, words: TaskText, length: int) -> ElementTree.Element:
    """Return one planned task of one field with two treatment zones, one of them the grid's."""
    root = ElementTree.Element(
        "ISO11783_TaskData",
        VersionMajor="4",
        VersionMinor="3",
        ManagementSoftwareManufacturer="SpectralZoom",
        ManagementSoftwareVersion=words.version[:DESIGNATOR],
        DataTransferOrigin="1",
    )
    field = {"A": "PFD1", "C": words.field[:DESIGNATOR], "D": f"{words.area_m2:.0f}"}
    ElementTree.SubElement(root, "PFD", field)
    ElementTree.SubElement(root, "PDT", {"A": "PDT1", "B": words.product[:DESIGNATOR], "D": "VPN1"})
    zones = {"H": str(UNTREATED), "I": str(UNTREATED), "J": str(UNTREATED)}
    task = ElementTree.SubElement(
        root, "TSK", {"A": "TSK1", "B": words.task[:DESIGNATOR], "E": "PFD1", "G": "1"} | zones
    )
    for code, name in ((UNTREATED, "no treatment"), (TREATED, "by the grid")):
        zone = ElementTree.SubElement(task, "TZN", {"A": str(code), "B": name})
        ElementTree.SubElement(zone, "PDV", {"A": f"{grid.unit.ddi:04X}", "B": "0", "C": "PDT1", "E": "VPN1"})
    rows, columns = grid.doses.shape
    fields = {
        "A": f"{grid.south_deg:.{DEGREE_DIGITS}f}",
        "B": f"{grid.west_deg:.{DEGREE_DIGITS}f}",
        "C": f"{grid.north_step_deg:.{DEGREE_DIGITS}f}",
        "D": f"{grid.east_step_deg:.{DEGREE_DIGITS}f}",
        "E": str(columns),
        "F": str(rows),
        "G": NUMBERS.removesuffix(".bin"),
        "H": str(length),
        "I": "2",
        "J": str(TREATED),
    }
    ElementTree.SubElement(task, "GRD", fields)
    shown = {"A": "VPN1", "B": "0", "C": f"{1 / grid.unit.per_unit:g}", "D": "2", "E": grid.unit.name}
    ElementTree.SubElement(root, "VPN", shown)
    return root


def ramp_colour(fraction: float, ramp: Sequence[Colour]) -> Colour:
    """Return the colour at a fraction, 0 to 1, of a ramp of colours evenly apart."""
    place = min(max(fraction, 0.0), 1.0) * (len(ramp) - 1)
    low = min(int(place), len(ramp) - 2)
    return tuple(round(a + (place - low) * (b - a)) for a, b in zip(ramp[low], ramp[low + 1], strict=True))


def write_class_style(path: Path, classes: Sequence[Entry]) -> None:
    """Write the style of a raster of class numbers."""
    root, renderer = _raster({"type": "paletted", "band": "1", "opacity": "1", "alphaBand": "-1"})
    palette = SubElement(renderer, "colorPalette")
    for number, name, colour in classes:
        SubElement(palette, "paletteEntry", value=str(number), label=name, color=_hex(colour), alpha="255")
    _write(path, root)


def write_ramp_style(path: Path, low: float, high: float, ramp: Sequence[Colour]) -> None:
    """Write the style of a raster of one band: a ramp of colours from ``low`` to ``high``."""
    span = {"classificationMin": f"{low:g}", "classificationMax": f"{high:g}"}
    root, renderer = _raster({"type": "singlebandpseudocolor", "band": "1", "opacity": "1", "alphaBand": "-1", **span})
    kind = {"colorRampType": "INTERPOLATED", "classificationMode": "2", "clip": "0"}
    scale = {"minimumValue": f"{low:g}", "maximumValue": f"{high:g}"}
    shader = SubElement(SubElement(renderer, "rastershader"), "colorrampshader", {**kind, **scale})
    for number, colour in enumerate(ramp):
        value = f"{low + (high - low) * number / (len(ramp) - 1):g}"
        SubElement(shader, "item", value=value, label=value, color=_hex(colour), alpha="255")
    _write(path, root)


def write_colour_style(path: Path, bands: Sequence[int], low: float, high: float) -> None:
    """Write the style of a raster that shows three of its bands, counted from 1, as red, green and blue.

    Each goes from ``low`` to ``high``.
    """
    named = dict(zip(("redBand", "greenBand", "blueBand"), map(str, bands), strict=True))
    root, renderer = _raster({"type": "multibandcolor", "opacity": "1", "alphaBand": "-1", **named})
    for colour in ("red", "green", "blue"):
        stretch = SubElement(renderer, f"{colour}ContrastEnhancement")
        for name, text in (
            ("minValue", f"{low:g}"),
            ("maxValue", f"{high:g}"),
            ("algorithm", "StretchToMinimumMaximum"),
        ):
            SubElement(stretch, name).text = text
    _write(path, root)


def write_polygon_style(path: Path, column: str, entries: Sequence[Entry]) -> None:
    """Write the style of polygons by the values of one column."""
    root = Element("qgis", version=QGIS_VERSION, styleCategories="Symbology")
    about = {"type": "categorizedSymbol", "attr": column, "symbollevels": "0", "enableorderby": "0"}
    renderer = SubElement(root, "renderer-v2", about)
    categories, symbols = SubElement(renderer, "categories"), SubElement(renderer, "symbols")
    for number, (value, name, colour) in enumerate(entries):
        kind = "string" if isinstance(value, str) else "double"
        words = {"symbol": str(number), "value": str(value), "label": name, "type": kind, "render": "true"}
        SubElement(categories, "category", words)
        symbol = SubElement(symbols, "symbol", {"name": str(number), "type": "fill", "alpha": "0.8"})
        options = SubElement(SubElement(symbol, "layer", {"class": "SimpleFill", "enabled": "1"}), "Option", type="Map")
        fill = ",".join(map(str, (*colour, 255)))
        for key, text in (
            ("color", fill),
            ("style", "solid"),
            ("outline_color", "60,60,60,255"),
            ("outline_width", "0.1"),
        ):
            SubElement(options, "Option", {"name": key, "type": "QString", "value": text})
    SubElement(root, "layerGeometryType").text = "2"
    _write(path, root)


def _raster(renderer: dict[str, str]) -> tuple[Element, Element]:
    root = Element("qgis", version=QGIS_VERSION, styleCategories="Symbology")
    return root, SubElement(SubElement(root, "pipe"), "rasterrenderer", renderer)


def _hex(colour: Colour) -> str:
    return "#{:02x}{:02x}{:02x}".format(*colour)


def _write(path: Path, root: Element) -> None:
    ElementTree.indent(root, " ")
    text = ElementTree.tostring(root, encoding="unicode")
    write_whole(path, f"<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n{text}\n")
