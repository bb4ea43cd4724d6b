"""Open a published run for export, parse the flags of its products, and list its images for map programs."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

import numpy as np
from affine import Affine
from cyclopts import Parameter
from odc.geo.geobox import GeoBox

from spectralzoom.flows.opening.visit import time_of_visit
from spectralzoom.flows.publish.receipt import Receipt, load_receipt
from spectralzoom.flows.publish.scores import warnings_of
from spectralzoom.flows.settings.flags import Switch, split_list
from spectralzoom.flows.settings.values import BUILT_IN_SCENES, RIG
from spectralzoom.flows.stages.ground import colours_of
from spectralzoom.pipeline.errors import IncompleteStoreError, SettingsError
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.pipeline.ground.georeference import zoomed_out
from spectralzoom.storage.arrays.class_maps import OLD_CLASS, legend_of
from spectralzoom.storage.arrays.georeference import load_geobox
from spectralzoom.storage.arrays.ground_maps import StoredImage, open_image
from spectralzoom.storage.arrays.layout import open_group
from spectralzoom.storage.export.image_files import Layer, Rows
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
        if not re.fullmatch(r"\s*\d+(\.\d*)?|\s*\.\d+", number) or name.strip() in ("", *doses):
            raise SettingsError(
                f"--dose expects each class once with a number, weed=2.5, got {part!r}; numbers are 0 or more, without "
                "an exponent"
            )
        doses[name.strip()] = float(number)
    return doses


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


def map_layers(run: ExportedRun) -> list[Layer]:
    """Return class map, confidence, expected gain and picture, and after a prior map the old classes of changes."""
    product = run.map_product
    legend = legend_of(open_group(run.path(product)))
    fraction: dict[str, Any] = {"unit": "1", "roles": ("data", "confidence")}
    layers = [
        _stored(run, product, "classes", "class_map", "Class map", legend=legend),
        _stored(run, product, "confidence", "confidence", "Probability of the class given", **fraction),
        _gain_layer(run),
        _picture(run),
    ]
    revisited = product if product == "ground_map" else "class_probabilities"
    if run.has(revisited) and OLD_CLASS in (group := open_group(run.path(revisited))):
        title = "Class of the prior map, where the map is sure of another one"
        layers.append(_stored(run, revisited, OLD_CLASS, OLD_CLASS, title, legend=legend_of(group)))
    return layers


def layer_of(run: ExportedRun, product: str, *, tags: Mapping[str, str] = MappingProxyType({}), **more: Any) -> Layer:
    """Return an image with the tags of the run and more ``tags``; ``more`` are the other fields of `Layer`."""
    own = {
        "TIFFTAG_SOFTWARE": f"spectralzoom {run.receipt['versions'].get('spectralzoom', 'of unknown version')}",
        "run": run.id,
        "product": run.receipt["products"][product],
        "surveyed": run.observed[0],
        "processed": run.receipt["finished"],
        "place": ANGULAR if more["geobox"].crs is None else "map",
        **({} if run.undated else {"ACQUISITIONDATETIME": run.observed[0]}),
        **warning_tag(warnings_of(run.receipt)),
    }
    return Layer(tags={**own, **tags}, **more)


def warning_tag(texts: Sequence[str]) -> dict[str, str]:
    """Return the tag of an image with these warnings about its map; none without any."""
    return {"WARNING": "; ".join(texts)} if texts else {}


def geobox_of(stored: StoredImage) -> GeoBox:
    """Return the grid of a store's images; in angles without a CRS."""
    if stored.geobox is not None:
        return stored.geobox
    y, x = stored.shape[:2]
    return GeoBox((y, x), Affine(*map(float, stored.about["spatial:transform"])), None)


def _stored(run: ExportedRun, product: str, array: str, name: str, title: str, **more: Any) -> Layer:
    """Return an image of a store on the store's own grid; ``more`` are fields of `Layer`."""
    stored = open_image(run.path(product), array)
    usual: dict[str, Any] = {"geobox": geobox_of(stored), "dtype": stored.dtype.name, "rows": stored.rows}
    usual |= {"bands": ("class",), "nodata": UNLABELLED} if "legend" in more else {"bands": (array,)}
    return layer_of(run, product, name=name, title=title, **(usual | more))


def _gain_layer(run: ExportedRun) -> Layer:
    """Return the expected gain with one pixel a patch, from the corner of the class map on."""
    drawn = run.path("class_map")
    patch = int(read_manifest(drawn.parent)["params"]["gains"]["frame"]["grid"]["patch"])
    stored = open_image(run.path("attention"), "score")
    y, x = stored.shape
    geobox = zoomed_out(geobox_of(open_image(drawn, "classes")), patch, (y, x))
    tags = {"policy": str(stored.about.get("policy", "")), "patch_px": str(patch)}
    return layer_of(
        run,
        "attention",
        name="attention",
        title="Expected gain of a fine pass, by patch",
        geobox=geobox,
        dtype=stored.dtype.name,
        bands=("score",),
        rows=stored.rows,
        unit="1",
        tags=tags,
    )


def _picture(run: ExportedRun) -> Layer:
    """Return the picture on the ground, else the coarse mosaic in a photograph's tones: 1 to 255, 0 without a value."""
    about: dict[str, Any] = {"roles": ("visual", "overview"), "bands": RGB, "nodata": 0}
    title = "Picture of the coarse pass"
    if run.map_product == "ground_map":
        return _stored(run, "ground_map", "picture", "rgb", title, **about)

    def rows() -> Rows:
        ref = run.archive.ref(*run.path("mosaic").parent.relative_to(run.archive.root / "stages").parts)
        yield 0, np.nan_to_num(np.rint(colours_of(ref))).astype(np.uint8)

    return _stored(run, "mosaic", "coverage", "rgb", title, **about, dtype="uint8", rows=rows)
