"""Export a run's classes as polygons, with hectares and doses: GeoPackage and shapefile."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import shapely
from affine import Affine

from spectralzoom.flows.archive.export_layers import ExportedRun, ProductChoice
from spectralzoom.pipeline.errors import ArchiveError, SettingsError
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.storage.arrays.class_maps import legend_of
from spectralzoom.storage.arrays.ground_maps import open_image
from spectralzoom.storage.whole_files import written_aside

GEOPACKAGE, SHAPEFILE = "application/geopackage+sqlite3", "application/vnd.shp"
PARTS = (".shp", ".shx", ".dbf", ".cpg", ".prj")  # of a shapefile
EQUAL_AREA = 6933  # EPSG code of a CRS in which areas are true all over the earth
M2_PER_HECTARE = 1e4


def check_doses(run: ExportedRun, choice: ProductChoice) -> None:
    """Refuse doses of classes that the run lacks (SettingsError)."""
    names = open_image(run.path(run.map_product), "classes").about["class_names"]
    if unknown := sorted(set(choice.doses) - set(names)):
        raise SettingsError(f"--dose: the run has no class {unknown[0]!r}; its classes are {', '.join(names)}")


def write_polygons(run: ExportedRun, folder: Path, doses: Mapping[str, float]) -> list[tuple[str, Path, str]]:
    """Write a polygon for each region of a class; return key, path and media type of both files.

    Outlines follow the sides of pixels. Columns are class, name and colour, with a place on the earth also hectares,
    and with ``doses`` also dose, 0 for other classes. Raises ArchiveError: GDAL or the disk refuses.
    """
    import geopandas
    import pyogrio
    import rasterio.features as rasterio_features

    stored = open_image(run.path(run.map_product), "classes")
    classes = np.concatenate([rows for _, rows in stored.rows()])
    legend = legend_of(stored.group)
    place = Affine(*stored.about["spatial:transform"])
    found = list(rasterio_features.shapes(classes, mask=classes != UNLABELLED, transform=place))
    numbers = [int(number) for _, number in found]
    names = [legend.names[number] for number in numbers]
    columns = {
        "class": numbers,
        "name": names,
        "colour": [f"#{bytes(legend.colours[number].tolist()).hex()}" for number in numbers],
    }
    crs = None if run.geobox is None else str(run.geobox.crs)
    outlines = [shapely.geometry.shape(outline) for outline, _ in found]
    frame = geopandas.GeoDataFrame(columns, geometry=outlines, crs=crs)
    if crs is not None:
        frame["hectares"] = frame.to_crs(EQUAL_AREA).area / M2_PER_HECTARE
    if doses:
        frame["dose"] = [doses.get(name, 0.0) for name in names]
    package, shapefile = folder / "classes.gpkg", folder / "classes.shp"
    parts = [f"classes{ending}" for ending in (PARTS if crs is not None else PARTS[:-1])]
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": run.receipt["finished"]})  # the same polygons, the same bytes
    try:
        with written_aside(folder, [package.name, *parts]) as aside, warnings.catch_warnings():
            warnings.filterwarnings("ignore", "'crs' was not provided", UserWarning)
            frame.to_file(aside / package.name, layer="classes", driver="GPKG", engine="pyogrio")
            date = run.receipt["finished"][:10]
            frame.to_file(
                aside / shapefile.name,
                driver="ESRI Shapefile",
                engine="pyogrio",
                encoding="utf-8",
                DBF_DATE_LAST_UPDATE=date,
            )
    except pyogrio.errors.DataSourceError as error:
        raise ArchiveError(f"{package} cannot be written: {error}; is there space on the disk?") from error
    finally:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": None})
    return [("polygons", package, GEOPACKAGE), ("polygons_shapefile", shapefile, SHAPEFILE)]
