"""Sources of an export: a run's images for map programs, its cubes for ENVI, its stores for the catalogue."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from affine import Affine
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from flows.publish.receipt import Receipt, check_receipt
from flows.tasks.stages.maps import coarse_colours
from pipeline.errors import IncompleteStoreError, SettingsError, ShapeError
from pipeline.geometry.grid import UNLABELLED
from pipeline.ground.georeference import zoomed_out
from storage.archive.archive import Archive
from storage.archive.keys import StageRef
from storage.archive.records import RECEIPT, read_run, read_store
from storage.arrays.class_maps import OLD_CLASS, ClassNames, legend_of, unpacked_days
from storage.arrays.georeference import load_geobox
from storage.arrays.ground_maps import StoredImage, open_image
from storage.arrays.layout import grid_of, open_group
from storage.arrays.quicklooks import choose_bands
from storage.export.image_files import ANGULAR, CogImage, angular_geobox, value_span
from storage.export.map_files import GREENS, GREYS, write_class_style, write_colour_style, write_ramp_style
from storage.readers.recordings import stores_of_lines

Rows = Iterator[tuple[int, NDArray[Any]]]
RGB = ("red", "green", "blue")
LATEST = "latest"
PROBABILITIES, GROUND = "class_probabilities", "ground_map"


@dataclass(frozen=True)
class ExportedRun:
    """A published run, opened for export."""

    archive: Archive
    folder: Path
    receipt: Receipt

    @property
    def id(self) -> str:
        return self.folder.name

    def store(self, product: str) -> StageRef | None:
        """Return the store of a product; None without one, or where its files were cleared away.

        Raises IncompleteStoreError: the archive has lost it, or a part of it.
        """
        uri = self.receipt["products"].get(product)
        if uri is None:
            return None
        _, stage, key = uri.split("/")[:3]
        ref = self.archive.find(stage, key)
        if ref is None and read_store(self.archive.ref(stage, key)).cleared:
            return None
        if ref is None:
            raise IncompleteStoreError(
                f"the {product} of run {self.id} should lie in {uri} of {self.archive.name} and does not; run its "
                "survey again, or restore the store from a copy"
            )
        return ref

    def path(self, product: str) -> Path:
        """Return the path of a product that every finished run has. Raises IncompleteStoreError: this one has not."""
        if self.store(product) is None:
            raise IncompleteStoreError(f"the run {self.id} has no {product}: it did not finish; export another run")
        return self.archive.locate(self.receipt["products"][product])

    def sweeps(self) -> list[Path]:
        stores = [self.archive.locate(uri) for uri in stores_of_lines(self.receipt["products"], self.archive.is_there)]
        return [path for store in stores for path in sorted(store.glob("*.zarr"))]

    @cached_property
    def geobox(self) -> GeoBox | None:
        """Return the grid of the run's map on the earth, by its pose or its scene's file; None where neither has it."""
        return load_geobox(self.path(self.map_product))

    @property
    def map_product(self) -> str:
        """The map that is exported: the one on the ground, where there is a pose."""
        return "class_map" if self.store("ground_map") is None else "ground_map"


def open_exported(archive: Archive, name: str | None) -> ExportedRun:
    """Return a run by name or address, else the latest.

    Raises SettingsError: there is none. Raises IncompleteStoreError: its receipt cannot be read.
    """
    runs = archive.runs()
    if not runs:
        raise SettingsError(f"{archive.name} has no published run; survey into it first")
    called = LATEST if name is None else name.rstrip("/").removeprefix("runs/")
    folder = runs[-1] if called == LATEST else next((run for run in runs if run.name == called), None)
    if folder is None:
        known = ", ".join(run.name for run in runs[-5:])
        raise SettingsError(f"{archive.name} has no run {name!r}; its latest are {known}")
    run = read_run(folder, {})
    if run.problem is not None:
        raise IncompleteStoreError(f"{folder} is damaged: {run.problem}; run verify on the archive")
    try:
        receipt = check_receipt(run.receipt)
    except ShapeError as error:
        raise IncompleteStoreError(f"{folder / RECEIPT} is no survey's: {error}; export another run") from error
    return ExportedRun(archive, folder, receipt)


@dataclass(frozen=True)
class Layer:
    """One image to export."""

    name: str
    title: str
    roles: tuple[str, ...]
    image: CogImage
    rows: Callable[[], Rows]
    unit: str | None = None


def map_layers(run: ExportedRun) -> list[Layer]:
    """Return the class map, confidence, attention (on its patches) and picture.

    They are on the map where there is one, else on angles.
    """
    product = run.map_product
    about = open_image(run.path(product), "classes").about
    colours = np.array(about.get("class_colours", ()), np.uint8).reshape(-1, 3)
    legend = ClassNames(tuple(about.get("class_names", ())), colours)
    drawn = image_layer(run, product, "classes", ("class",), nodata=UNLABELLED, legend=legend)
    sure = image_layer(run, product, "confidence", ("confidence",), nodata=np.nan)
    seen = _picture(run) if product == "class_map" else image_layer(run, product, "picture", RGB, nodata=0)
    score = patch_layer(run, "attention", "score", ("score",))
    return [
        Layer("class_map", "Class map", ("data",), *drawn),
        Layer("confidence", "Probability of the class given", ("data", "confidence"), *sure, "1"),
        Layer("attention", "Worth of a fine look, by patch", ("data",), *score, "1"),
        Layer("rgb", "Picture of the coarse pass", ("visual", "overview"), *seen),
    ]


def layer_tags(run: ExportedRun, product: str, geobox: GeoBox) -> dict[str, str]:
    """Return the tags of the run, which every image has."""
    return {
        "TIFFTAG_SOFTWARE": f"spectralzoom {run.receipt['versions'].get('spectralzoom', 'of unknown version')}",
        "run": run.id,
        "product": run.receipt["products"][product],
        "surveyed": run.receipt["started"],
        "place": ANGULAR if geobox.crs is None else "map",
    }


def geobox_of(run: ExportedRun, stored: StoredImage) -> GeoBox:
    """Return the grid of a store's images, as the store itself says; in angles without a CRS."""
    if stored.geobox is not None:
        return stored.geobox
    transform = stored.about.get("spatial:transform")
    if transform is None:
        raise IncompleteStoreError(f"the {stored.name} of run {run.id} do not say where they lie; verify the archive")
    return GeoBox((stored.shape[0], stored.shape[1]), Affine(*map(float, transform)), None)


def image_layer(
    run: ExportedRun,
    product: str,
    array: str,
    bands: tuple[str, ...],
    *,
    nodata: float,
    legend: ClassNames | None = None,
) -> tuple[CogImage, Callable[[], Rows]]:
    """Return an image of a store on the store's own grid."""
    stored = open_image(run.path(product), array)
    geobox = geobox_of(run, stored)
    image = CogImage(geobox, stored.dtype.name, bands, nodata, legend, layer_tags(run, product, geobox))
    return image, stored.rows


def patch_layer(
    run: ExportedRun, product: str, array: str, bands: tuple[str, ...]
) -> tuple[CogImage, Callable[[], Rows]]:
    """Return a figure of each patch, on the scene's grid by their size in pixels."""
    stored, drawn = open_image(run.path(product), array), run.store("class_map")
    assert drawn is not None
    patch = int(run.archive.manifest(drawn)["params"]["grid"]["patch"])
    scene = grid_of(open_image(run.path("class_map"), "classes").about)
    if scene is None:
        raise IncompleteStoreError(f"the class map of run {run.id} does not say its grid; run its survey again")
    shape = (stored.shape[0], stored.shape[1])
    fine = load_geobox(run.path("class_map"))
    geobox = angular_geobox(replace(scene, factor=patch), shape) if fine is None else zoomed_out(fine, patch, shape)
    policy = {"policy": str(stored.about.get("policy", ""))} if product == "attention" else {}
    tags = {**layer_tags(run, product, geobox), **policy, "patch_px": str(patch)}
    return CogImage(geobox, stored.dtype.name, bands, np.nan, tags=tags), stored.rows


def _picture(run: ExportedRun) -> tuple[CogImage, Callable[[], Rows]]:
    """Yield the coarse mosaic in a photograph's tones, 1 to 255, and 0 where nothing was captured."""
    stored, ref = open_image(run.path("mosaic"), "coverage"), run.store("mosaic")
    assert ref is not None
    geobox = geobox_of(run, stored)
    image = CogImage(geobox, "uint8", RGB, 0, tags=layer_tags(run, "mosaic", geobox))

    def rows() -> Rows:
        yield 0, np.nan_to_num(np.rint(coarse_colours(ref, None))).astype(np.uint8)

    return image, rows


def seen_rows(run: ExportedRun) -> Iterator[tuple[int, NDArray[np.bool_]]]:
    """Yield where a run's map shows anything, some rows at a time."""
    if run.map_product == "class_map":
        yield from (
            (first, found != UNLABELLED) for first, found in open_image(run.path("class_map"), "classes").rows()
        )
        return
    found, pictures = (open_image(run.path("ground_map"), name).rows() for name in ("classes", "picture"))
    for (first, numbers), (_, picture) in zip(found, pictures, strict=True):
        yield first, (numbers != UNLABELLED) | (picture.max(axis=2) > 0)


def prior_map_layers(run: ExportedRun) -> list[Layer]:
    """Return the days since each pixel was captured; for a run with a prior map also the changes and earlier classes.

    On the map where there is a pose.
    """
    layers = []
    if (product := _product_with(run, "age")) is not None:
        seen = _ages(run) if product == PROBABILITIES else image_layer(run, product, "age", ("age",), nodata=np.nan)
        layers.append(Layer("age", "Days since the pixel was looked at", ("data",), *seen, "days"))
    if (product := _product_with(run, "changed")) is not None:
        title = "Fraction of the patch's pixels with another class than remembered"
        if product == PROBABILITIES:
            changed = patch_layer(run, PROBABILITIES, "changed", ("changed",))
        else:
            changed = image_layer(run, product, "changed", ("changed",), nodata=np.nan)
        layers.append(Layer("changed", title, ("data",), *changed, "1"))
    if (product := _product_with(run, OLD_CLASS)) is not None:
        legend = legend_of(open_group(run.path(product)))
        was = image_layer(run, product, OLD_CLASS, ("class",), nodata=UNLABELLED, legend=legend)
        title = "Class remembered, where the map is sure of another one"
        layers.append(Layer(OLD_CLASS, title, ("data",), *was))
    return layers


def _product_with(run: ExportedRun, array: str) -> str | None:
    """Return the product that holds an image: the map on the ground, else class probabilities, else None."""
    products = (name for name in (GROUND, PROBABILITIES) if run.store(name) is not None)
    return next((name for name in products if array in open_group(run.path(name))), None)


def _ages(run: ExportedRun) -> tuple[CogImage, Callable[[], Rows]]:
    """Return the ages of the field's own pixels, unpacked: few readers of GeoTIFF know of scales."""
    image, packed = image_layer(run, PROBABILITIES, "age", ("age",), nodata=np.nan)
    return replace(image, dtype="float32"), lambda: ((first, unpacked_days(rows)) for first, rows in packed())


def write_layer_style(layer: Layer, image: Path) -> Path:
    """Write the style of a layer beside its image, which is there already; gives its path."""
    path, about = image.with_suffix(".qml"), layer.image
    if about.legend is not None:
        named = zip(about.legend.names, about.legend.colours.tolist(), strict=True)
        write_class_style(path, [(number, name, tuple(colour)) for number, (name, colour) in enumerate(named)])
    elif about.bands == RGB:
        write_colour_style(path, (1, 2, 3), 1, 255)
    elif about.wavelength_nm is not None:
        red_green_blue = [band + 1 for band in choose_bands(np.array(about.wavelength_nm))[0]]
        write_colour_style(path, red_green_blue, *value_span(image, red_green_blue))
    else:
        ramp = GREENS if "index" in about.tags else GREYS
        write_ramp_style(path, *value_span(image, [1]), ramp)
    return path
