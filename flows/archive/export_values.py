"""What is exported of a run's values: the table of its classes' areas, and layers of the mosaic's bands and indices.

Areas say how surely they are known. Layers lie on the map where the run has one.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.archive.export_layers import ExportedRun, Layer, Rows, layer_tags, place_of
from flows.archive.product_choice import ProductChoice
from flows.settings.survey_settings import RASTER
from pipeline.errors import SettingsError
from pipeline.geometry.grid import UNLABELLED, SceneGrid
from pipeline.ground.map_grid import GroundGrid, grid_of_map, image_at, map_blocks
from pipeline.ground.view import GroundView, RigPose
from pipeline.products.areas import FractionEstimate, probable_fractions, stratified_fractions
from pipeline.products.indices import SpectralIndex, index_values, pick_bands, white_level
from storage.archive.whole_files import write_whole
from storage.arrays.class_maps import ProbabilityStore
from storage.arrays.georeference import load_geobox
from storage.arrays.ground_maps import load_bands, open_image
from storage.arrays.layout import grid_of, read_array
from storage.arrays.mosaics import PatchStore, open_patches
from storage.export.image_files import CogImage, Place

CSV = "text/csv"
COLUMNS = (
    *("class", "pixels", "hectares", "fraction", "mean_confidence", "estimated_fraction"),
    *("estimated_hectares", "standard_error_fraction", "standard_error_hectares", "estimated_from"),
)
DIGITS = 6
BYTES_AT_ONCE = 1 << 27
COLUMNS_AT_ONCE = 640
SAMPLED = 4  # every so many pixels a side say what is white
Floats = NDArray[np.float32]


def write_areas(run: ExportedRun, path: Path) -> None:
    """Write the table, a row a class; empty where something is not known, as hectares where there is no CRS."""
    path_of_map = run.path(run.map_product)
    names = tuple(open_image(path_of_map, "classes").about["class_names"])
    pixels, confidence = _counted(path_of_map, len(names))
    hectares = None  # where nothing says where the field lies
    if "ground" in run.receipt:
        areas = run.receipt["ground"]["areas_ha"]
        hectares = np.array([areas.get(name, 0.0) for name in names], np.float64)
    fraction = pixels / max(pixels.sum(), 1) if hectares is None else hectares / (hectares.sum() or 1.0)
    estimate, source = _estimate(run, fraction)
    total = np.nan if hectares is None else hectares.sum()
    own = np.full(len(names), np.nan) if hectares is None else hectares
    figures = (own, fraction, confidence, estimate.fractions, estimate.fractions * total, estimate.errors)
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    for number, (name, count) in enumerate(zip(names, pixels.tolist(), strict=True)):
        own_figures = [figure[number] for figure in (*figures, estimate.errors * total)]
        cells = [f"{value:.{DIGITS}g}" if np.isfinite(value) else "" for value in own_figures]
        table.writerow([name, count, *cells, source])
    write_whole(path, text.getvalue())


def _counted(path: Path, count: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """(class,) pixels and mean confidence of the exported map; NaN for a class of which no pixel has one."""
    pixels, sums, sure_pixels = np.zeros(256, np.int64), np.zeros(256), np.zeros(256, np.int64)
    for (_, classes), (_, sure) in zip(
        open_image(path, "classes").rows(), open_image(path, "confidence").rows(), strict=True
    ):
        pixels += np.bincount(classes.ravel(), minlength=256)
        known = np.isfinite(sure)
        sums += np.bincount(classes[known], sure[known], 256)
        sure_pixels += np.bincount(classes[known], minlength=256)
    return pixels[:count], np.where(sure_pixels > 0, sums / np.maximum(sure_pixels, 1), np.nan)[:count]


def _estimate(run: ExportedRun, fraction: NDArray[np.float64]) -> tuple[FractionEstimate, str]:
    """Shares with their errors: by the confusion matrix of the receipt where there is one, else by probabilities."""
    confusion = run.receipt.get("accuracy", {}).get("confusion")
    if confusion is not None:
        return stratified_fractions(fraction, confusion), "labels"
    if run.store("class_probabilities") is None:
        unknown = np.full(len(fraction), np.nan)
        return FractionEstimate(unknown, unknown), ""
    return probable_fractions(_probabilities(run, len(fraction)), len(fraction)), "probabilities"


def _probabilities(run: ExportedRun, count: int) -> Iterator[NDArray[np.float32]]:
    """What is believed of the pixels with a class, (y, x, class); of those called unknown that they are, for sure."""
    store = ProbabilityStore(run.path("class_probabilities"))
    for first, drawn in open_image(run.path("class_map"), "classes").rows():
        values = np.exp(store.read(slice(first, first + len(drawn)))[0])
        known = values.shape[-1]
        values = np.pad(values, [(0, 0), (0, 0), (0, count - known)])
        values[drawn == UNLABELLED] = np.nan
        unknown = (drawn >= known) & (drawn != UNLABELLED)
        values[unknown] = np.arange(count) == drawn[unknown, None]
        yield values


@dataclass(frozen=True)
class MosaicView:
    """A run's mosaic, as an image on the map where the run has a pose, else on its own grid."""

    run: ExportedRun
    words = "Coarse mosaic"

    @cached_property
    def place(self) -> Place:
        """Where the image lies."""
        if self.ground is not None:
            return Place.on_map(self.ground.geobox)
        return place_of(self.run, open_image(self.run.path("mosaic"), "values"))

    @cached_property
    def shape(self) -> tuple[int, int]:
        """(y, x) of the image [px]."""
        if self.ground is not None:
            return self.ground.shape
        rows, columns, _ = open_image(self.run.path("mosaic"), "values").shape
        return rows, columns

    @cached_property
    def ground(self) -> GroundGrid | None:
        """The map's grid in coarse pixels, with its rays, from what the map's store says of its pose; None without."""
        if self.run.store("ground_map") is None:
            return None
        path, scene = self.run.path("ground_map"), grid_of(open_image(self.run.path("class_map"), "classes").about)
        geobox = load_geobox(path)
        assert scene is not None
        assert geobox is not None
        pose = RigPose(**open_image(path, "classes").about["rig_pose"])
        coarse = geobox.zoom_out(self.factor)  # finer the mosaic knows nothing
        return grid_of_map(GroundView(pose, scene.ifov_rad), scene.scene_shape, coarse)

    @cached_property
    def factor(self) -> int:
        """Fine pixels to a side of the mosaic's."""
        grid = grid_of(open_image(self.run.path("mosaic"), "values").about)
        assert grid is not None
        return grid.factor

    def rows(self, bands: Sequence[int]) -> Rows:
        """Values (row, x, band) of some bands with the number of the first row, from the top down."""
        group = open_image(self.run.path("mosaic"), "values").group
        if self.ground is None:
            for first, values in open_image(self.run.path("mosaic"), "values").rows():
                yield first, values[..., list(bands)]
            return
        factor = self.factor
        at_once = int(np.clip(BYTES_AT_ONCE // (4 * len(bands) * self.shape[1]), 1, 256))
        for first in range(0, self.shape[0], at_once):
            last = min(first + at_once, self.shape[0])
            out = np.full((last - first, self.shape[1], len(bands)), np.nan, np.float32)
            for _, columns in map_blocks((last - first, self.shape[1]), (last - first, COLUMNS_AT_ONCE)):
                pixels = self.ground.scene_pixels(slice(first, last), columns)
                out[:, columns] = _window_at(group, pixels, factor, bands)
            yield first, out


@dataclass(frozen=True)
class RasterView:
    """A raster's values on its own pixels: patches where the run kept them, elsewhere the coarse means."""

    run: ExportedRun

    @cached_property
    def place(self) -> Place:
        """Where the image lies."""
        return place_of(self.run, open_image(self.run.path("class_map"), "classes"))

    @cached_property
    def shape(self) -> tuple[int, int]:
        """(y, x) of the image [px]."""
        rows, columns = open_image(self.run.path("class_map"), "classes").shape
        return rows, columns

    @cached_property
    def grid(self) -> SceneGrid:
        """The raster's grid, by the parameters of its map."""
        drawn = self.run.store("class_map")
        assert drawn is not None
        return SceneGrid(**self.run.archive.manifest(drawn)["params"]["grid"])

    @cached_property
    def patches(self) -> PatchStore | None:
        """The patches that the run kept; None where they were cleared away."""
        ref = self.run.store("patches")
        return None if ref is None else open_patches(self.run.path("patches"))

    @property
    def words(self) -> str:
        """How much of the image is the raster's own pixels."""
        kept, every = 0 if self.patches is None else len(self.patches.patch_index), len(self.grid.valid_patches())
        s = self.grid.factor
        if kept == every:
            return "Pixels of the raster"
        return f"Pixels of the raster in {kept} of {every} patches, means of {s} x {s} px elsewhere"

    def rows(self, bands: Sequence[int]) -> Rows:
        """Values (row, x, band) of some bands with the number of the first row, from the top down."""
        grid, chosen = self.grid, list(bands)
        p, s, (_, across) = grid.patch, grid.factor, grid.patch_shape
        means = open_image(self.run.path("mosaic"), "values")
        patch_index = np.empty(0, np.int64) if self.patches is None else self.patches.patch_index
        for first in range(0, grid.height, p * s):  # rows that hold whole patches and whole means
            coarse = read_array(means.group, "values", slice(first // s, first // s + p))[..., chosen]
            rows = np.repeat(np.repeat(coarse, s, axis=0), s, axis=1)[: grid.height - first, : grid.width].copy()
            entries = np.flatnonzero(patch_index // across // s == first // (p * s))
            if self.patches is not None and len(entries):
                for patch, (y, x) in zip(
                    self.patches.pick(entries), grid.patch_origin(patch_index[entries]), strict=True
                ):
                    place = rows[y - first : y - first + p, x : x + p]
                    place[...] = patch[: place.shape[0], : place.shape[1], chosen]
            yield first, rows


def _window_at(group: Any, pixels: NDArray[np.float64], factor: int, bands: Sequence[int]) -> Floats:
    """Values at scene places (row, column, 2), of which only the rows and columns around them are read."""
    known = pixels[np.isfinite(pixels).all(axis=-1)]
    if not len(known):
        return np.full((*pixels.shape[:2], len(bands)), np.nan, np.float32)
    size = group["values"].shape[:2]
    first = np.clip(np.floor(known.min(axis=0) / factor).astype(int) - 2, 0, size)
    last = np.clip(np.ceil(known.max(axis=0) / factor).astype(int) + 2, 0, size)
    window = read_array(group, "values", np.s_[first[0] : last[0], first[1] : last[1]])[..., list(bands)]
    return image_at(np.ascontiguousarray(window), pixels - factor * first, factor=factor)


def spectral_layers(run: ExportedRun, choice: ProductChoice) -> list[Layer]:
    """Reflectance and indices that were asked for.

    Raises WavelengthError: the cube lacks bands of an index. SettingsError: an index wants reflectance, and the cube's
    values are none.
    """
    if not (choice.flags.reflectance or choice.indices):
        return []
    # a raster's own pixels, unless its map is drawn on the ground by a pose; else the coarse mosaic
    own = run.receipt["source"] == RASTER and run.store("ground_map") is None
    view: MosaicView | RasterView = RasterView(run) if own else MosaicView(run)
    wave, _ = load_bands(run.path("mosaic"))
    picked = [pick_bands(index, wave) for index in choice.indices]
    blocks = open_image(run.path("mosaic"), "values").rows()
    white = white_level(np.concatenate([values[::SAMPLED, ::SAMPLED].reshape(-1) for _, values in blocks]))
    for index in choice.indices:
        if index.wants_reflectance and white != 1.0:
            raise SettingsError(
                f"{index.name} wants reflectance (0 to 1), and the values of run {run.id} reach {white:.3g}; choose "
                "an index of ratios, such as NDVI or PRI"
            )
    layers = [_reflectance(view, white)] if choice.flags.reflectance else []
    return layers + [_index(view, index, bands, white) for index, bands in zip(choice.indices, picked, strict=True)]


def _reflectance(view: MosaicView | RasterView, white: float) -> Layer:
    wave, width = load_bands(view.run.path("mosaic"))
    image = CogImage(
        view.shape,
        "float32",
        view.place,
        tuple(f"{centre:.1f} nm" for centre in wave.tolist()),
        np.nan,
        tags={**layer_tags(view.run, "mosaic", view.place), "values": _format_value(white), "pixels": view.words},
        wavelength_nm=wave.tolist(),
        fwhm_nm=None if width is None else width.tolist(),
    )
    title = f"{view.words}, {len(wave)} bands: {_format_value(white)}"
    return Layer("reflectance", title, ("data", "reflectance"), image, lambda: view.rows(range(len(wave))), "1")


def _format_value(white: float) -> str:
    return "reflectance, 0 to 1" if white == 1.0 else "values of the scene, not reflectance"


def _index(view: MosaicView | RasterView, index: SpectralIndex, bands: Sequence[int], white: float) -> Layer:
    wave = load_bands(view.run.path("mosaic"))[0][list(bands)].tolist()
    taken = ", ".join(f"{band.symbol} {nm:.1f} nm" for band, nm in zip(index.bands, wave, strict=True))
    tags = {"index": index.name, "bands": taken, "reference": index.reference, "pixels": view.words}
    about = layer_tags(view.run, "mosaic", view.place) | tags
    image = CogImage(view.shape, "float32", view.place, (index.name,), np.nan, tags=about)

    def rows() -> Rows:
        for first, values in view.rows(bands):
            yield first, index_values(index, values, wave, white=white)

    return Layer(index.name, f"{index.title} of {taken}", ("data",), image, rows, "1")
