"""Export products on request: the table of areas, polygons of the classes, and layers of bands and indices."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from odc.geo.geobox import GeoBox

from spectralzoom.flows.archive.export_layers import ExportedRun, geobox_of, layer_of, warning_tag
from spectralzoom.flows.publish.scores import warning_column, warnings_of
from spectralzoom.models.evaluation.metrics import stratified_fractions
from spectralzoom.pipeline.errors import ArchiveError, SettingsError
from spectralzoom.pipeline.geometry.grid import UNLABELLED, cuts
from spectralzoom.pipeline.ground.field_places import M2_PER_HECTARE
from spectralzoom.pipeline.ground.map_grid import GroundGrid, grid_of_map, image_at
from spectralzoom.pipeline.ground.view import GroundView, RigPose
from spectralzoom.pipeline.products.indices import (
    SAMPLED,
    SpectralIndex,
    check_white,
    index_values,
    pick_bands,
    white_level,
)
from spectralzoom.storage.arrays.band_order import sort_bands
from spectralzoom.storage.arrays.class_maps import legend_of
from spectralzoom.storage.arrays.georeference import grid_of, load_geobox
from spectralzoom.storage.arrays.ground_maps import open_image
from spectralzoom.storage.arrays.layout import SHARD_ROWS
from spectralzoom.storage.arrays.mosaics import Mosaic, open_mosaic
from spectralzoom.storage.export.csv_tables import csv_table
from spectralzoom.storage.export.image_files import Layer, Rows
from spectralzoom.storage.whole_files import write_whole, written_aside

BYTES_AT_ONCE = 1 << 27
COLUMNS_AT_ONCE = 640
GEOPACKAGE, SHAPEFILE = "application/geopackage+sqlite3", "application/vnd.shp"
PARTS = (".shp", ".shx", ".dbf", ".cpg", ".prj")  # of a shapefile
MOST_TEXT = 254  # bytes of a value in it
EQUAL_AREA = 6933  # EPSG code of a CRS in which areas are true all over the earth


def write_areas(run: ExportedRun, path: Path) -> None:
    """Write the table with a row for each class; unknown values are empty.

    ``estimated_fraction`` and ``standard_error`` follow from the labels.
    """
    classes, confidence = (open_image(run.path(run.map_product), name) for name in ("classes", "confidence"))
    legend = legend_of(classes.group)
    names, numbers = legend.names, list(legend.numbers)
    counts, sure_pixels, sums = np.zeros((3, 256))
    for (_, drawn), (_, sure) in zip(classes.rows(), confidence.rows(), strict=True):
        known = np.isfinite(sure)
        counts += np.bincount(drawn.ravel(), minlength=256)
        sure_pixels += np.bincount(drawn[known], minlength=256)
        sums += np.bincount(drawn[known], sure[known], 256)
    pixels = counts[numbers].astype(int)
    unknown = np.full(len(names), np.nan)
    areas = (run.receipt.get("areas") or {}).get("ha")
    hectares = unknown if areas is None else np.array([areas.get(name, 0.0) for name in names], np.float64)
    measured = pixels if areas is None else hectares
    fraction = measured / (measured.sum() or 1)
    confusion = run.receipt.get("accuracy", {}).get("confusion")
    estimate, error = (unknown, unknown) if confusion is None else stratified_fractions(fraction, confusion)
    columns = {
        "class": names,
        "value": numbers,
        "pixels": pixels,
        "hectares": hectares,
        "fraction": fraction,
        "mean_confidence": np.divide(sums, sure_pixels, np.full(256, np.nan), where=sure_pixels > 0)[numbers],
        "estimated_fraction": estimate,
        "standard_error": error,
    }
    write_whole(path, csv_table(columns | warning_column(warnings_of(run.receipt), len(names))))


@dataclass(frozen=True)
class MosaicView:
    """A run's mosaic as an image, on the map if the run has a pose, else on its own grid."""

    run: ExportedRun

    @cached_property
    def mosaic(self) -> Mosaic:
        """Return the stored mosaic."""
        return open_mosaic(self.run.path("mosaic"))

    @cached_property
    def geobox(self) -> GeoBox:
        """Return the image's grid, in angles without a CRS."""
        if self.ground is not None:
            return self.ground.geobox
        return geobox_of(open_image(self.run.path("mosaic"), "coverage"))

    @cached_property
    def ground(self) -> GroundGrid | None:
        """Return the map's grid with its rays, by the pose in the map's store; None without one."""
        if not self.run.has("ground_map"):
            return None
        path = self.run.path("ground_map")
        scene = grid_of(open_image(self.run.path("class_map"), "classes").about)
        geobox = load_geobox(path)
        assert scene is not None
        assert geobox is not None
        pose = RigPose(**open_image(path, "classes").about["rig_pose"])
        return grid_of_map(GroundView(pose, scene.ifov_rad), scene.scene_shape, geobox)

    def rows(self, bands: Sequence[int]) -> Rows:
        """Yield the first row and the values (row, x, band) of some bands, from the top down."""
        if self.ground is None:
            for rows in cuts(self.mosaic.shape[0], SHARD_ROWS):
                yield rows.start, self.mosaic.spectra(self.mosaic.scores(rows), bands)
            return
        height, width = self.ground.shape
        for rows in cuts(height, int(np.clip(BYTES_AT_ONCE // (4 * len(bands) * width), 1, 256))):
            out = np.full((rows.stop - rows.start, width, len(bands)), np.nan, np.float32)
            for columns in cuts(width, COLUMNS_AT_ONCE):
                pixels = self.ground.scene_pixels(rows, columns)
                known = pixels[np.isfinite(pixels).all(axis=-1)]
                if len(known):
                    low = np.clip(np.floor(known.min(axis=0)).astype(int) - 2, 0, self.mosaic.shape)
                    high = np.clip(np.ceil(known.max(axis=0)).astype(int) + 2, 0, self.mosaic.shape)
                    around = slice(low[0], high[0]), slice(low[1], high[1])
                    window = np.ascontiguousarray(self.mosaic.values(*around, bands))
                    out[:, columns] = image_at(window, pixels - low)
            yield rows.start, out


def spectral_layers(run: ExportedRun, indices: Sequence[SpectralIndex], *, reflectance: bool) -> list[Layer]:
    """Return the reflectance and indices to export.

    Raises WavelengthError: the cube lacks bands of an index; SettingsError: an index needs reflectance, and the cube
    has other values.
    """
    if not (reflectance or indices):
        return []
    view = MosaicView(run)
    picked = [pick_bands(index, view.mosaic.wavelength_nm) for index in indices]
    white = white_level(view.mosaic.thinned(SAMPLED, range(len(view.mosaic.wavelength_nm))).reshape(-1))
    for index in indices:
        check_white(index, white, run.id)
    layers = [_reflectance(view, white)] if reflectance else []
    return layers + [_index(view, index, bands, white) for index, bands in zip(indices, picked, strict=True)]


def _layer(view: MosaicView, rows: Callable[[], Rows], **more: Any) -> Layer:
    return layer_of(view.run, "mosaic", geobox=view.geobox, dtype="float32", rows=rows, unit="1", **more)


def _reflectance(view: MosaicView, white: float) -> Layer:
    """Return all bands by rising wavelength, with the detector of each where some overlap."""
    order, centres, detector = sort_bands(view.mosaic.wavelength_nm)
    width = view.mosaic.fwhm_nm
    values = "reflectance, 0 to 1" if white == 1.0 else "values of the scene, not reflectance"
    several = detector.any()
    called = [f", detector {one}" if several else "" for one in detector]
    return _layer(
        view,
        lambda: view.rows(order.tolist()),
        name="reflectance",
        title=f"{len(order)} bands: {values}",
        roles=("data", "reflectance"),
        bands=tuple(f"{nm:.1f} nm{of}" for nm, of in zip(centres, called, strict=True)),
        wavelength_nm=centres.tolist(),
        fwhm_nm=None if width is None else width[order].tolist(),
        detector=detector.tolist() if several else (),
        tags={"values": values},
    )


def _index(view: MosaicView, index: SpectralIndex, bands: Sequence[int], white: float) -> Layer:
    wave = view.mosaic.wavelength_nm[list(bands)].tolist()
    taken = ", ".join(f"{band.symbol} {nm:.1f} nm" for band, nm in zip(index.bands, wave, strict=True))
    tags = {"index": index.name, "bands": taken, "reference": index.reference}

    def rows() -> Rows:
        for first, values in view.rows(bands):
            yield first, index_values(index, values, wave, white=white)

    return _layer(view, rows, name=index.name, title=f"{index.title} of {taken}", bands=(index.name,), tags=tags)


def check_doses(run: ExportedRun, doses: Mapping[str, float]) -> None:
    """Refuse doses of classes that the run lacks (SettingsError)."""
    names = open_image(run.path(run.map_product), "classes").about["class_names"]
    if unknown := sorted(set(doses) - set(names)):
        raise SettingsError(f"--dose: the run has no class {unknown[0]!r}; its classes are {', '.join(names)}")


def write_polygons(run: ExportedRun, folder: Path, doses: Mapping[str, float]) -> list[tuple[str, Path, str]]:
    """Write a polygon for each region of a class; return key, path and media type of both files.

    Outlines follow the sides of pixels. Columns are class, name and colour, with a place on the earth also hectares,
    and with ``doses`` also dose, 0 for other classes. A shapefile has no metadata: warnings about the map are another
    column of it. Raises ArchiveError: GDAL or the disk refuses.
    """
    import geopandas
    import pyogrio
    import rasterio.features as rasterio_features

    stored = open_image(run.path(run.map_product), "classes")
    classes = np.concatenate([rows for _, rows in stored.rows()])
    legend = legend_of(stored.group)
    place = geobox_of(stored).affine
    found = list(rasterio_features.shapes(classes, mask=classes != UNLABELLED, transform=place))
    names = dict(zip(legend.numbers, legend.names, strict=True))
    colours = {one: f"#{bytes(rgb).hex()}" for one, rgb in zip(legend.numbers, legend.colours.tolist(), strict=True)}
    crs = None if run.geobox is None else str(run.geobox.crs)
    outlines = [shapely.geometry.shape(outline) for outline, _ in found]
    frame = geopandas.GeoDataFrame({"class": [int(number) for _, number in found]}, geometry=outlines, crs=crs)
    frame["name"], frame["colour"] = frame["class"].map(names), frame["class"].map(colours)
    if crs is not None:
        frame["hectares"] = frame.to_crs(EQUAL_AREA).area / M2_PER_HECTARE
    if doses:
        frame["dose"] = frame["name"].map(doses).fillna(0.0)
    package, shapefile = folder / "classes.gpkg", folder / "classes.shp"
    parts = [f"classes{ending}" for ending in (PARTS if crs is not None else PARTS[:-1])]
    day = {"DBF_DATE_LAST_UPDATE": run.receipt["finished"][:10]}  # the same polygons, the same bytes
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": run.receipt["finished"]})
    try:
        with written_aside(folder, [package.name, *parts]) as aside, warnings.catch_warnings():
            warnings.filterwarnings("ignore", "'crs' was not provided", UserWarning)
            about = warning_tag(warned := warnings_of(run.receipt))
            frame.to_file(aside / package.name, layer="classes", driver="GPKG", layer_metadata=about or None)
            for name, texts in warning_column(warned, len(frame)).items():
                frame[name] = [text.encode()[:MOST_TEXT].decode(errors="ignore") for text in texts]
            frame.to_file(aside / shapefile.name, driver="ESRI Shapefile", encoding="utf-8", **day)
    except pyogrio.errors.DataSourceError as error:
        raise ArchiveError(f"{package} cannot be written: {error}; is there space on the disk?") from error
    finally:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": None})
    return [("polygons", package, GEOPACKAGE), ("polygons_shapefile", shapefile, SHAPEFILE)]
