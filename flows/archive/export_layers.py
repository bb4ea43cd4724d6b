"""Open a published run for export, parse the flags of its products, and list its images for map programs."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
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
from spectralzoom.flows.settings.survey_settings import BUILT_IN_SCENES, RIG
from spectralzoom.flows.stages.ground import colours_of
from spectralzoom.pipeline.errors import IncompleteStoreError, SettingsError
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.pipeline.ground.georeference import zoomed_out
from spectralzoom.storage.arrays.class_maps import OLD_CLASS, ClassNames, legend_of
from spectralzoom.storage.arrays.georeference import load_geobox
from spectralzoom.storage.arrays.ground_maps import StoredImage, open_image
from spectralzoom.storage.arrays.layout import open_group
from spectralzoom.storage.export.image_files import CogImage
from spectralzoom.storage.runs import has_time, read_run
from spectralzoom.storage.store import LATEST, Archive, read_manifest


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
RGB = ("red", "green", "blue")  # names of bands
ANGULAR = (
    "angular grid of the camera: x and y are tangents of the angle from the undeflected direction [rad], y grows "
    "downwards; there is no CRS"
)


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
        """Return begin and end of the observation: those of the run, unless visit or file state another moment or day.

        A visit of a rig may be known by its date alone, and captures lines during the run.
        """
        began, ended = self.receipt["started"], self.receipt["finished"]
        run = read_run(self.folder)
        moment = time_of_visit(run) or began
        known = 10 if self.receipt["source"] == RIG else 19  # characters: to the day, or to the second
        if moment[:known] == began[:known]:
            return began, ended
        whole_day = run.acquired is not None and not has_time(run.acquired)
        return moment, f"{moment[:10]}T23:59:59+00:00" if whole_day else moment

    @property
    def undated(self) -> bool:
        """Return whether nothing states when the light of a file was captured, so that `observed` is the survey's."""
        run = read_run(self.folder)
        dated = run.acquired is not None or run.settings.get("scene") in BUILT_IN_SCENES
        return not dated and self.receipt["source"] != RIG

    def has(self, product: str) -> bool:
        """Return whether the run made a product."""
        return product in self.receipt["products"]

    def path(self, product: str) -> Path:
        """Return the path of a product. Raises IncompleteStoreError: the run lacks it, or it is missing or damaged."""
        if not self.has(product):
            raise IncompleteStoreError(f"the run {self.id} has no {product}: it did not finish; export another run")
        return self.archive.locate(self.receipt["products"][product])

    @cached_property
    def geobox(self) -> GeoBox | None:
        """Return the grid of the run's map by its pose or scene; None if neither has one."""
        return load_geobox(self.path(self.map_product))

    @property
    def map_product(self) -> str:
        """Return the map that is exported: the one on the ground if there is a pose."""
        return "ground_map" if self.has("ground_map") else "class_map"


def open_exported(archive: Archive, name: str | None) -> ExportedRun:
    """Return a run by name or address, else the latest.

    Raises NoRunError: there is none; IncompleteStoreError, ShapeError: its receipt is damaged, or is no survey's.
    """
    folder = archive.run_folder(name or LATEST)
    return ExportedRun(archive, folder, load_receipt(folder))


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
    """Return class map, confidence, expected gain and picture, and after a prior map the old classes of changes."""
    product = run.map_product
    legend = legend_of(open_group(run.path(product)))
    fraction: dict[str, Any] = {"unit": "1", "roles": ("data", "confidence")}
    layers = [
        image_layer(run, product, "classes", "class_map", "Class map", legend=legend),
        image_layer(run, product, "confidence", "confidence", "Probability of the class given", **fraction),
        _gain_layer(run),
        _picture(run),
    ]
    revisited = product if product == "ground_map" else "class_probabilities"
    if run.has(revisited) and OLD_CLASS in (group := open_group(run.path(revisited))):
        title = "Class of the prior map, where the map is sure of another one"
        layers.append(image_layer(run, revisited, OLD_CLASS, OLD_CLASS, title, legend=legend_of(group)))
    return layers


def cog_image(
    run: ExportedRun, product: str, geobox: GeoBox, dtype: str, bands: tuple[str, ...], **more: Any
) -> CogImage:
    """Return an image with the tags of the run, NaN without a value; ``more`` are fields of `CogImage`."""
    tags = {
        "TIFFTAG_SOFTWARE": f"spectralzoom {run.receipt['versions'].get('spectralzoom', 'of unknown version')}",
        "run": run.id,
        "product": run.receipt["products"][product],
        "surveyed": run.observed[0],
        "processed": run.receipt["finished"],
        "place": ANGULAR if geobox.crs is None else "map",
        **({} if run.undated else {"ACQUISITIONDATETIME": run.observed[0]}),
        **more.pop("tags", {}),
    }
    return CogImage(geobox, dtype, bands, **{"nodata": np.nan, "tags": tags, **more})


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
    unit: str | None = None,
    legend: ClassNames | None = None,
    **more: Any,
) -> Layer:
    """Return an image of a store on the store's own grid; ``more`` are fields of `CogImage`."""
    stored = open_image(run.path(product), array)
    more = (
        {"bands": (array,), **more} if legend is None else {"bands": ("class",), "nodata": UNLABELLED, "legend": legend}
    )
    image = cog_image(run, product, geobox_of(stored), stored.dtype.name, **more)
    return Layer(name, title, roles, image, stored.rows, unit)


def _gain_layer(run: ExportedRun) -> Layer:
    """Return the expected gain with one pixel a patch, from the corner of the class map on."""
    stored, drawn = open_image(run.path("attention"), "score"), run.path("class_map")
    patch = int(read_manifest(drawn.parent)["params"]["gains"]["frame"]["grid"]["patch"])
    y, x = stored.shape
    geobox = zoomed_out(geobox_of(open_image(drawn, "classes")), patch, (y, x))
    tags = {"policy": str(stored.about.get("policy", "")), "patch_px": str(patch)}
    image = cog_image(run, "attention", geobox, stored.dtype.name, ("score",), tags=tags)
    return Layer("attention", "Expected gain of a fine pass, by patch", ("data",), image, stored.rows, "1")


def _picture(run: ExportedRun) -> Layer:
    """Return the picture on the ground, else the coarse mosaic in a photograph's tones: 1 to 255, 0 without a value."""
    title, roles = "Picture of the coarse pass", ("visual", "overview")
    if run.map_product == "ground_map":
        return image_layer(run, "ground_map", "picture", "rgb", title, roles=roles, bands=RGB, nodata=0)
    place = run.path("mosaic")
    image = cog_image(run, "mosaic", geobox_of(open_image(place, "coverage")), "uint8", RGB, nodata=0)

    def rows() -> Rows:
        ref = run.archive.ref(*place.parent.relative_to(run.archive.root / "stages").parts)
        yield 0, np.nan_to_num(np.rint(colours_of(ref))).astype(np.uint8)

    return Layer("rgb", title, roles, image, rows)
