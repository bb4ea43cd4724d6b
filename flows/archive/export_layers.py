"""Open a published run for export, parse the flags of its products, and list its images for map programs."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from affine import Affine
from cyclopts import Parameter
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from spectralzoom.flows.publish.receipt import Receipt, load_receipt
from spectralzoom.flows.settings.flags import Switch, split_list
from spectralzoom.flows.settings.load import time_of_visit
from spectralzoom.flows.settings.survey_settings import RIG
from spectralzoom.flows.stages.ground import colours_of
from spectralzoom.pipeline.errors import IncompleteStoreError, SettingsError, ShapeError
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.pipeline.ground.georeference import zoomed_out
from spectralzoom.storage.arrays.class_maps import OLD_CLASS, ClassNames, legend_of
from spectralzoom.storage.arrays.georeference import grid_of, load_geobox
from spectralzoom.storage.arrays.ground_maps import StoredImage, open_image
from spectralzoom.storage.arrays.layout import open_group
from spectralzoom.storage.export.image_files import ANGULAR, CogImage, angular_geobox
from spectralzoom.storage.runs import RECEIPT, read_run
from spectralzoom.storage.store import LATEST, Archive, Ref, is_cleared, read_manifest, uri_of


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ProductFlags:
    """Flags of the products to make of a run."""

    reflectance: Annotated[
        Switch,
        Parameter(help="Also all bands as GeoTIFF: the coarse mosaic, of a raster its pixels, both without noise."),
    ] = False
    indices: Annotated[
        str | None, Parameter(help="Spectral indices to write as GeoTIFF, with commas: NDVI,NDREI,MCARI.")
    ] = None
    polygons: Annotated[
        Switch, Parameter(help="Also the classes as polygons, with hectares: GeoPackage and shapefile.")
    ] = False
    dose: Annotated[
        str | None, Parameter(help="Doses by class, with commas: weed=2.5,grass=1. A column of the polygons.")
    ] = None


NO_PRODUCTS = ProductFlags()


def split_names(flag: str, given: str | None) -> tuple[str, ...]:
    """Return the parts of a flag's list (SettingsError: it has none)."""
    if given is not None and not split_list(given):
        raise SettingsError(f"--{flag} {given!r} names nothing; give names with commas, or leave it out")
    return split_list(given)


def parse_doses(given: str | None) -> dict[str, float]:
    """Return the doses of a flag by class (SettingsError: one is no number, or a class is named twice)."""
    doses: dict[str, float] = {}
    for part in split_names("dose", given):
        name, _, number = part.rpartition("=")
        if not re.fullmatch(r"\s*\d+(\.\d*)?|\s*\.\d+", number) or not name.strip():
            raise SettingsError(
                f"--dose expects classes with numbers, weed=2.5, got {part!r}; numbers are 0 or more, without "
                "an exponent"
            )
        if name.strip() in doses:
            raise SettingsError(f"--dose names {name.strip()} twice; give it one number")
        doses[name.strip()] = float(number)
    return doses


Rows = Iterator[tuple[int, NDArray[Any]]]
CLASS, RGB = ("class",), ("red", "green", "blue")  # names of bands


@dataclass(frozen=True)
class ExportedRun:
    """A published run, opened for export."""

    archive: Archive
    folder: Path
    receipt: Receipt

    @property
    def id(self) -> str:
        return self.folder.name

    @property
    def observed(self) -> tuple[str, str]:
        """Return begin and end of the observation: those of the run, unless its visit is another moment.

        A visit of a rig may be known by its date alone, and captures lines during the run.
        """
        began, ended = self.receipt["started"], self.receipt["finished"]
        visit = time_of_visit(read_run(self.folder)) or began
        known = 10 if self.receipt["source"] == RIG else 19  # characters: to the day, or to the second
        return (began, ended) if visit[:known] == began[:known] else (visit, visit)

    def store(self, product: str) -> Ref | None:
        """Return the store of a product; None if there is none, or if its files were cleared away.

        Raises IncompleteStoreError: the archive has lost the store or a part of it.
        """
        uri = self.receipt["products"].get(product)
        if uri is None:
            return None
        parts = (uri_of(uri) or "stages//").split("/")  # of a damaged receipt: no name, and an error
        stage, key = parts[1], parts[-1]
        ref = self.archive.find(stage, key)
        if ref is None and is_cleared(self.archive.ref(stage, key).path):
            return None
        if ref is None:
            raise IncompleteStoreError(
                f"the {product} of run {self.id} should lie in {uri} of {self.archive.name} and does not; run its "
                "survey again, or restore the store from a copy"
            )
        return ref

    def path(self, product: str) -> Path:
        """Return the path of a product that every finished run has. Raises IncompleteStoreError: this run lacks it."""
        if self.store(product) is None:
            raise IncompleteStoreError(f"the run {self.id} has no {product}: it did not finish; export another run")
        return self.archive.locate(self.receipt["products"][product])

    @cached_property
    def geobox(self) -> GeoBox | None:
        """Return the grid of the run's map by its pose or scene; None if neither has one."""
        return load_geobox(self.path(self.map_product))

    @property
    def map_product(self) -> str:
        """Return the map that is exported: the one on the ground if there is a pose."""
        return "class_map" if self.store("ground_map") is None else "ground_map"


def open_exported(archive: Archive, name: str | None) -> ExportedRun:
    """Return a run by name or address, else the latest.

    Raises NoRunError: there is none. Raises IncompleteStoreError: its receipt cannot be read.
    """
    folder = archive.run_folder(name or LATEST)
    try:
        return ExportedRun(archive, folder, load_receipt(folder))
    except ShapeError as error:
        raise IncompleteStoreError(f"{folder / RECEIPT} is no survey's: {error}; export another run") from error


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
    """Return the class map, its confidence, the expected gain of the patches, and a picture."""
    product = run.map_product
    legend = legend_of(open_group(run.path(product)))
    roles = ("data", "confidence")
    return [
        image_layer(run, product, "classes", "class_map", "Class map", bands=CLASS, nodata=UNLABELLED, legend=legend),
        image_layer(run, product, "confidence", "confidence", "Probability of the class given", roles=roles, unit="1"),
        _gain_layer(run),
        _picture(run),
    ]


def layer_tags(run: ExportedRun, product: str, geobox: GeoBox) -> dict[str, str]:
    """Return the tags of the run, which every image has."""
    return {
        "TIFFTAG_SOFTWARE": f"spectralzoom {run.receipt['versions'].get('spectralzoom', 'of unknown version')}",
        "run": run.id,
        "product": run.receipt["products"][product],
        "surveyed": run.observed[0],
        "place": ANGULAR if geobox.crs is None else "map",
    }


def geobox_of(stored: StoredImage) -> GeoBox:
    """Return the grid of a store's images; in angles without a CRS."""
    if stored.geobox is not None:
        return stored.geobox
    y, x = stored.shape[:2]
    return GeoBox((y, x), Affine(*map(float, stored.about["spatial:transform"])), None)


def image_layer(
    run: ExportedRun,
    product: str,
    array: str,
    name: str,
    title: str,
    *,
    roles: tuple[str, ...] = ("data",),
    bands: tuple[str, ...] | None = None,
    nodata: float = np.nan,
    unit: str | None = None,
    legend: ClassNames | None = None,
) -> Layer:
    """Return an image of a store on the store's own grid."""
    stored = open_image(run.path(product), array)
    geobox = geobox_of(stored)
    image = CogImage(geobox, stored.dtype.name, bands or (array,), nodata, legend, layer_tags(run, product, geobox))
    return Layer(name, title, roles, image, stored.rows, unit)


def _gain_layer(run: ExportedRun) -> Layer:
    """Return the expected gain with one pixel a patch, on the grid of the class map."""
    stored = open_image(run.path("attention"), "score")
    class_map = run.store("class_map")
    assert class_map is not None
    patch = int(read_manifest(class_map.path)["params"]["gains"]["frame"]["grid"]["patch"])
    scene = grid_of(open_image(run.path("class_map"), "classes").about)
    assert scene is not None
    shape = (stored.shape[0], stored.shape[1])
    fine = load_geobox(run.path("class_map"))
    geobox = angular_geobox(replace(scene, factor=patch), shape) if fine is None else zoomed_out(fine, patch, shape)
    policy = str(stored.about.get("policy", ""))
    tags = {**layer_tags(run, "attention", geobox), "policy": policy, "patch_px": str(patch)}
    image = CogImage(geobox, stored.dtype.name, ("score",), np.nan, tags=tags)
    return Layer("attention", "Expected gain of a fine pass, by patch", ("data",), image, stored.rows, "1")


def _picture(run: ExportedRun) -> Layer:
    """Return the picture on the ground, else the coarse mosaic in a photograph's tones: 1 to 255, 0 without a value."""
    title = "Picture of the coarse pass"
    roles = ("visual", "overview")
    if run.map_product == "ground_map":
        return image_layer(run, "ground_map", "picture", "rgb", title, roles=roles, bands=RGB, nodata=0)
    geobox = geobox_of(open_image(run.path("mosaic"), "coverage"))
    ref = run.store("mosaic")
    assert ref is not None

    def rows() -> Rows:
        yield 0, np.nan_to_num(np.rint(colours_of(ref))).astype(np.uint8)

    return Layer("rgb", title, roles, CogImage(geobox, "uint8", RGB, 0, tags=layer_tags(run, "mosaic", geobox)), rows)


def prior_map_layers(run: ExportedRun) -> list[Layer]:
    """Return what a prior map adds: the previous classes of changed pixels."""
    product = "ground_map" if run.map_product == "ground_map" else "class_probabilities"
    if run.store(product) is None or OLD_CLASS not in (group := open_group(run.path(product))):
        return []
    title = "Class of the prior map, where the map is sure of another one"
    legend = legend_of(group)
    return [image_layer(run, product, OLD_CLASS, OLD_CLASS, title, bands=CLASS, nodata=UNLABELLED, legend=legend)]
