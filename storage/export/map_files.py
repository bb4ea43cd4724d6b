"""Write vector files for map programs and machines: polygons, and ISOXML task data.

Polygons are GeoPackage and GeoJSON, by GDAL. Task data (ISO 11783-10, version 4) is TASKDATA.XML and a binary grid of
type 2. Its rows begin at the south-west corner. Each cell has the dose as a 32 bit integer in the steps of its data
dictionary entity.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ArchiveError, SettingsError
from pipeline.lazy import geopandas, pyogrio
from storage.archive.whole_files import written_aside

GEOPACKAGE = "application/geopackage+sqlite3"
GEOJSON = "application/geo+json"
DEGREE_DIGITS = 9  # of a degree: 0.1 mm

Columns = Mapping[str, Any]  # one value a polygon, each a sequence or an array
FOLDER, XML, NUMBERS = "TASKDATA", "TASKDATA.XML", "GRD00000.bin"
DESIGNATOR = 32  # letters of a name
MOST_NUMBER = 2**31 - 1
TREATED, UNTREATED = 1, 0  # codes of treatment zones; UNTREATED also without a signal and outside the field


def write_polygons(
    path: Path, polygons: Any, columns: Columns, crs: str | None, *, layer: str | None = None, when: str | None = None
) -> None:
    """Write polygons as a GeoPackage or as GeoJSON, by the ending of ``path``.

    ``polygons`` are shapely's, ``columns`` values of each, ``crs`` WKT or None. A GeoPackage has ``when`` (ISO 8601) as
    its date, so that the same polygons give the same bytes. GeoJSON is in longitude and latitude (RFC 7946). Raises
    ArchiveError: GDAL or the disk refuses.
    """
    kind = path.suffix
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": when})
    try:
        with written_aside(path.parent, [path.name]) as aside, warnings.catch_warnings():
            warnings.filterwarnings("ignore", "'crs' was not provided", UserWarning)
            frame = geopandas.GeoDataFrame(dict(columns), geometry=list(polygons), crs=crs)
            frame = frame.to_crs(4326) if kind == ".geojson" else frame
            frame.to_file(aside / path.name, layer=layer, engine="pyogrio", **_OPTIONS[kind])
    except pyogrio.errors.DataSourceError as error:
        raise ArchiveError(f"{path} cannot be written: {error}; is there space on the disk?") from error
    finally:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": None})


_OPTIONS: Mapping[str, Mapping[str, Any]] = {
    ".gpkg": {"driver": "GPKG"},
    ".geojson": {"driver": "GeoJSON", "RFC7946": "YES", "COORDINATE_PRECISION": DEGREE_DIGITS},
}


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


def write_task_data(folder: Path, grid: TaskGrid, text: TaskText) -> tuple[Path, Path]:
    """Write ``folder/TASKDATA`` with the task and its grid; return the paths of both files.

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
        tree = ElementTree.ElementTree(_task_file(grid, text, len(numbers)))
        ElementTree.indent(tree)
        tree.write(aside / XML, encoding="UTF-8", xml_declaration=True)
    return place / XML, place / NUMBERS


def _task_file(grid: TaskGrid, text: TaskText, length: int) -> ElementTree.Element:
    """Return one planned task of one field with two treatment zones, one of them the grid's."""
    root = ElementTree.Element(
        "ISO11783_TaskData",
        VersionMajor="4",
        VersionMinor="3",
        ManagementSoftwareManufacturer="SpectralZoom",
        ManagementSoftwareVersion=text.version[:DESIGNATOR],
        DataTransferOrigin="1",
    )
    ElementTree.SubElement(root, "PFD", {"A": "PFD1", "C": text.field[:DESIGNATOR], "D": f"{text.area_m2:.0f}"})
    ElementTree.SubElement(root, "PDT", {"A": "PDT1", "B": text.product[:DESIGNATOR], "D": "VPN1"})
    zones = {"H": str(UNTREATED), "I": str(UNTREATED), "J": str(UNTREATED)}
    task = ElementTree.SubElement(
        root, "TSK", {"A": "TSK1", "B": text.task[:DESIGNATOR], "E": "PFD1", "G": "1"} | zones
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
