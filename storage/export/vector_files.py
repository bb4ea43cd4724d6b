"""Polygons for map programs and machines: GeoPackage, GeoJSON and shapefile, written by GDAL."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.errors import ArchiveError
from pipeline.lazy import deferred
from storage.archive.whole_files import written_aside

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


def write_geopackage(path: Path, layer: str, polygons: Any, columns: Columns, crs: str | None, when: str) -> None:
    """Write polygons as a GeoPackage of one layer. ``when`` (ISO 8601) is kept as its date, so that bytes repeat.

    ``polygons`` are shapely's, ``columns`` values of each, ``crs`` WKT, None where there is none. Raises ArchiveError:
    GDAL or the disk refuses.
    """
    with _writing(path, [path.name], when) as aside, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "'crs' was not provided", UserWarning)  # that is told where it is missing
        _frame(polygons, columns, crs).to_file(aside / path.name, layer=layer, driver="GPKG", engine="pyogrio")


def write_geojson(path: Path, layer: str, polygons: Any, columns: Columns, crs: str) -> None:
    """Write polygons as GeoJSON in longitude and latitude, shells anticlockwise (RFC 7946); otherwise as above."""
    with _writing(path, [path.name], None) as aside:
        _frame(polygons, columns, crs).to_crs(4326).to_file(
            aside / path.name,
            layer=layer,
            driver="GeoJSON",
            engine="pyogrio",
            RFC7946="YES",
            COORDINATE_PRECISION=DEGREE_DIGITS,
        )


def write_shapefile(path: Path, polygons: Any, columns: Columns, crs: str) -> None:
    """Write polygons as a shapefile: ``path`` and beside it .shx, .dbf, .prj and .cpg. Names of columns: 10 letters."""
    with _writing(path, [path.with_suffix(part).name for part in reversed(SHAPE_PARTS)], None) as aside:
        _frame(polygons, columns, crs).to_file(
            aside / path.name, driver="ESRI Shapefile", engine="pyogrio", encoding="UTF-8"
        )


def _frame(polygons: Any, columns: Columns, crs: str | None) -> Any:
    return geopandas.GeoDataFrame(dict(columns), geometry=list(polygons), crs=crs)


@contextmanager
def _writing(path: Path, names: Sequence[str], when: str | None) -> Iterator[Path]:
    """A folder to write into; GDAL's date of now is ``when``, what it refuses an ArchiveError."""
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": when})
    try:
        with written_aside(path.parent, names) as aside:
            yield aside
    except pyogrio.errors.DataSourceError as error:
        raise ArchiveError(f"{path} cannot be written: {error}; is there space on the disk?") from error
    finally:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": None})
