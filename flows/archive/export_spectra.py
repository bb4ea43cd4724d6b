"""Layers of the coarse mosaic's values: all bands, and spectral indices, on the map where the run has one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.archive.export_layers import ExportedRun, Layer, Rows, layer_tags
from flows.archive.product_choice import ProductChoice
from pipeline.errors import SettingsError
from pipeline.ground.map_grid import GroundGrid, grid_of_map, image_at, map_blocks
from pipeline.ground.view import GroundView, RigPose
from pipeline.products.indices import SpectralIndex, index_values, pick_bands, white_level
from storage.arrays.georeference import load_geobox
from storage.arrays.ground_maps import load_bands, open_image
from storage.arrays.layout import grid_of, read_array
from storage.export.image_files import CogImage, Place

BYTES_AT_ONCE = 1 << 27
COLUMNS_AT_ONCE = 640
SAMPLED = 4  # every so many pixels a side say what is white
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class MosaicView:
    """A run's mosaic, as an image on the map where the run has a pose, else on its own grid."""

    run: ExportedRun

    @cached_property
    def place(self) -> Place:
        """Where the image lies."""
        if self.ground is not None:
            return Place.on_map(self.ground.geobox)
        geobox = load_geobox(self.run.path("mosaic"))
        if geobox is not None:
            return Place.on_map(geobox)
        return Place(tuple(map(float, open_image(self.run.path("mosaic"), "values").about["spatial:transform"])))

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
    if not (choice.reflectance or choice.indices):
        return []
    view, (wave, _) = MosaicView(run), load_bands(run.path("mosaic"))
    picked = [pick_bands(index, wave) for index in choice.indices]
    white = _white(run)
    for index in choice.indices:
        if index.wants_reflectance and white != 1.0:
            raise SettingsError(
                f"{index.name} wants reflectance (0 to 1), and the values of run {run.id} reach {white:.3g}; choose "
                "an index of ratios, such as NDVI or PRI"
            )
    layers = [_reflectance(view, white)] if choice.reflectance else []
    return layers + [_index(view, index, bands, white) for index, bands in zip(choice.indices, picked, strict=True)]


def _white(run: ExportedRun) -> float:
    blocks = open_image(run.path("mosaic"), "values").rows()
    return white_level(np.concatenate([values[::SAMPLED, ::SAMPLED].reshape(-1) for _, values in blocks]))


def _reflectance(view: MosaicView, white: float) -> Layer:
    wave, width = load_bands(view.run.path("mosaic"))
    image = CogImage(
        view.shape,
        "float32",
        view.place,
        tuple(f"{centre:.1f} nm" for centre in wave.tolist()),
        np.nan,
        tags={**layer_tags(view.run, "mosaic", view.place), "values": _words(white)},
        wavelength_nm=wave.tolist(),
        fwhm_nm=None if width is None else width.tolist(),
    )
    title = f"Coarse mosaic, {len(wave)} bands: {_words(white)}"
    return Layer("reflectance", title, ("data", "reflectance"), image, lambda: view.rows(range(len(wave))), "1")


def _words(white: float) -> str:
    return "reflectance, 0 to 1" if white == 1.0 else "values of the scene, not reflectance"


def _index(view: MosaicView, index: SpectralIndex, bands: Sequence[int], white: float) -> Layer:
    wave = load_bands(view.run.path("mosaic"))[0][list(bands)].tolist()
    taken = ", ".join(f"{band.symbol} {nm:.1f} nm" for band, nm in zip(index.bands, wave, strict=True))
    tags = {"index": index.name, "bands": taken, "reference": index.reference}
    about = layer_tags(view.run, "mosaic", view.place) | tags
    image = CogImage(view.shape, "float32", view.place, (index.name,), np.nan, tags=about)

    def rows() -> Rows:
        for first, values in view.rows(bands):
            yield first, index_values(index, values, wave, white=white)

    return Layer(index.name, f"{index.title} of {taken}", ("data",), image, rows, "1")
