"""Export values of a run: the table of its classes' areas, and layers of the mosaic's bands and indices."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from odc.geo.geobox import GeoBox

from spectralzoom.flows.archive.export_layers import ExportedRun, Layer, ProductChoice, Rows, geobox_of, layer_tags
from spectralzoom.models.evaluation.metrics import stratified_fractions
from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.pipeline.ground.map_grid import GroundGrid, grid_of_map, image_at, map_blocks
from spectralzoom.pipeline.ground.view import GroundView, RigPose
from spectralzoom.pipeline.products.indices import SpectralIndex, index_values, pick_bands, white_level
from spectralzoom.storage.arrays.georeference import grid_of, load_geobox
from spectralzoom.storage.arrays.ground_maps import open_image
from spectralzoom.storage.arrays.layout import open_group, read_bands
from spectralzoom.storage.arrays.mosaics import Mosaic, open_mosaic
from spectralzoom.storage.export.image_files import CogImage
from spectralzoom.storage.whole_files import write_whole

COLUMNS = (
    *("class", "pixels", "hectares", "fraction", "mean_confidence"),
    *("estimated_fraction", "standard_error"),  # by the labels
)
DIGITS = 6
BYTES_AT_ONCE = 1 << 27
COLUMNS_AT_ONCE = 640
SAMPLED = 4  # step in pixels for finding the white level


def write_areas(run: ExportedRun, path: Path) -> None:
    """Write the table with a row for each class; unknown values are empty."""
    path_of_map = run.path(run.map_product)
    names = tuple(open_image(path_of_map, "classes").about["class_names"])
    counts, sums, sure_pixels = np.zeros(256, np.int64), np.zeros(256), np.zeros(256, np.int64)
    for (_, classes), (_, sure) in zip(
        open_image(path_of_map, "classes").rows(), open_image(path_of_map, "confidence").rows(), strict=True
    ):
        counts += np.bincount(classes.ravel(), minlength=256)
        known = np.isfinite(sure)
        sums += np.bincount(classes[known], sure[known], 256)
        sure_pixels += np.bincount(classes[known], minlength=256)
    confidence = np.where(sure_pixels > 0, sums / np.maximum(sure_pixels, 1), np.nan)
    pixels = counts[: len(names)]
    areas = (run.receipt.get("areas") or {}).get("ha")
    hectares = None if areas is None else np.array([areas.get(name, 0.0) for name in names], np.float64)
    fraction = pixels / max(pixels.sum(), 1) if hectares is None else hectares / (hectares.sum() or 1.0)
    unknown = np.full(len(names), np.nan)
    own = unknown if hectares is None else hectares
    confusion = run.receipt.get("accuracy", {}).get("confusion")
    estimate = (unknown, unknown) if confusion is None else stratified_fractions(fraction, confusion)
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    for number, (name, count) in enumerate(zip(names, pixels.tolist(), strict=True)):
        figures = [column[number] for column in (own, fraction, confidence, *estimate)]
        table.writerow([name, count, *(f"{value:.{DIGITS}g}" if np.isfinite(value) else "" for value in figures)])
    write_whole(path, text.getvalue())


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
        return geobox_of(self.run, open_image(self.run.path("mosaic"), "coverage"))

    @cached_property
    def ground(self) -> GroundGrid | None:
        """Return the map's grid with its rays, by the pose in the map's store; None without one."""
        if self.run.store("ground_map") is None:
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
            first = 0
            for block in self.mosaic.row_blocks():
                yield first, self.mosaic.spectra(block, bands)
                first += len(block)
            return
        height, width = self.ground.shape
        at_once = int(np.clip(BYTES_AT_ONCE // (4 * len(bands) * width), 1, 256))
        for first in range(0, height, at_once):
            last = min(first + at_once, height)
            out = np.full((last - first, width, len(bands)), np.nan, np.float32)
            for _, columns in map_blocks((last - first, width), (last - first, COLUMNS_AT_ONCE)):
                pixels = self.ground.scene_pixels(slice(first, last), columns)
                known = pixels[np.isfinite(pixels).all(axis=-1)]
                if not len(known):
                    continue
                low = np.clip(np.floor(known.min(axis=0)).astype(int) - 2, 0, self.mosaic.shape)
                high = np.clip(np.ceil(known.max(axis=0)).astype(int) + 2, 0, self.mosaic.shape)
                window = self.mosaic.values(slice(low[0], high[0]), slice(low[1], high[1]), bands)  # around the pixels
                out[:, columns] = image_at(np.ascontiguousarray(window), pixels - low)
            yield first, out


def spectral_layers(run: ExportedRun, choice: ProductChoice) -> list[Layer]:
    """Return the reflectance and indices to export.

    Raises WavelengthError: the cube lacks bands of an index; SettingsError: an index needs reflectance, and the cube
    has other values.
    """
    if not (choice.reflectance or choice.indices):
        return []
    view = MosaicView(run)
    picked = [pick_bands(index, view.mosaic.wavelength_nm) for index in choice.indices]
    white = white_level(view.mosaic.thinned(SAMPLED, range(len(view.mosaic.wavelength_nm))).reshape(-1))
    for index in choice.indices:
        if index.wants_reflectance and white != 1.0:
            raise SettingsError(
                f"{index.name} wants reflectance (0 to 1), and the values of run {run.id} reach {white:.3g}; choose "
                "an index of ratios, such as NDVI or PRI, or write the factor to reflectance into the scene.toml "
                "beside the scene (scale = 0.0001 if 10000 is white) and survey it again"
            )
    layers = [_reflectance(view, white)] if choice.reflectance else []
    return layers + [_index(view, index, bands, white) for index, bands in zip(choice.indices, picked, strict=True)]


def _reflectance(view: MosaicView, white: float) -> Layer:
    wave, width = read_bands(open_group(view.run.path("mosaic")))
    image = CogImage(
        view.geobox,
        "float32",
        tuple(f"{centre:.1f} nm" for centre in wave.tolist()),
        np.nan,
        tags={**layer_tags(view.run, "mosaic", view.geobox), "values": _format_value(white)},
        wavelength_nm=wave.tolist(),
        fwhm_nm=None if width is None else width.tolist(),
    )
    title = f"{len(wave)} bands: {_format_value(white)}"
    return Layer("reflectance", title, ("data", "reflectance"), image, lambda: view.rows(range(len(wave))), "1")


def _format_value(white: float) -> str:
    return "reflectance, 0 to 1" if white == 1.0 else "values of the scene, not reflectance"


def _index(view: MosaicView, index: SpectralIndex, bands: Sequence[int], white: float) -> Layer:
    wave = read_bands(open_group(view.run.path("mosaic")))[0][list(bands)].tolist()
    taken = ", ".join(f"{band.symbol} {nm:.1f} nm" for band, nm in zip(index.bands, wave, strict=True))
    tags = {"index": index.name, "bands": taken, "reference": index.reference}
    image = CogImage(
        view.geobox, "float32", (index.name,), np.nan, tags=layer_tags(view.run, "mosaic", view.geobox) | tags
    )

    def rows() -> Rows:
        for first, values in view.rows(bands):
            yield first, index_values(index, values, wave, white=white)

    return Layer(index.name, f"{index.title} of {taken}", ("data",), image, rows, "1")
