"""What the catalogue of an export says of a run: its files, the stores behind them, time, place and lineage."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from flows.archive.export_layers import ExportedRun, Layer, seen_rows
from storage.arrays.ground_maps import load_bands
from storage.export.stac_items import (
    ZARR,
    Collection,
    Item,
    angular,
    clean_id,
    footprint,
    projection,
    spectral_bands,
    wavelengths,
)

NOT_PLACED = (
    "The survey has no rig pose: its images lie on the camera's angular grid (transforms in radians), and where on "
    "earth that is is not known."
)
RUN_FILES = {
    "receipt.json": ("Receipt", "application/json", ["metadata"]),
    "report.html": ("Report", "text/html", ["metadata"]),
    "quicklook.png": ("Quicklook", "image/png", ["overview"]),
}
Asset = dict[str, Any]


@dataclass
class Export:
    """One run on its way into a folder."""

    run: ExportedRun
    out: Path  # without links, so that the way from there to the archive is the same for every program
    assets: dict[str, Asset] = field(default_factory=dict)

    @property
    def folder(self) -> Path:
        """Where the run's files go."""
        return self.out / self.run.id

    @property
    def nowhere(self) -> Asset:
        """Fields of an asset that has no CRS, in an item that has one."""
        return {} if self.run.geobox is None else {"proj:code": None}

    def add(self, key: str, path: Path, title: str, kind: str, roles: list[str], **fields: Any) -> None:
        """Name one file or store to the catalogue, by its address seen from the item."""
        href = Path(os.path.relpath(path.resolve(), self.folder)).as_posix()
        self.assets[key] = {"href": href, "title": title, "type": kind, "roles": roles, **fields}


def band_fields(layer: Layer) -> list[Asset]:
    """STAC's words for the bands of an image."""
    nodata: Any = "nan" if layer.image.nodata != layer.image.nodata else layer.image.nodata
    unit = {} if layer.unit is None else {"unit": layer.unit}
    return [{"name": name, "data_type": layer.image.dtype, "nodata": nodata, **unit} for name in layer.image.bands]


def grid_fields(run: ExportedRun, layer: Layer) -> dict[str, Any]:
    """Where an image lies, for surveys that have a place at all."""
    if run.geobox is None:
        return {}
    if layer.image.place.crs_wkt is None:
        return angular(layer.image.place.transform, layer.image.shape)
    return projection(run.geobox)


def name_stores(export: Export) -> None:
    """Name the archive's own stores and the run's files to the catalogue, where they are."""
    run, root = export.run, export.run.archive.root
    nowhere = export.nowhere
    about = {"data_type": "float32", "nodata": "nan", "unit": "1"}
    bands = spectral_bands(*load_bands(run.path("mosaic")), about)
    stores: dict[str, tuple[str, dict[str, Any]]] = {
        "mosaic": ("Coarse mosaic", {**nowhere, **bands}),
        "class_map": ("Class map and confidence on the camera's grid", nowhere),
        "attention": ("Score and rank of the seats", nowhere),
        "patches": ("Fine patches", nowhere),
    }
    if run.geobox is not None:
        stores["ground_map"] = ("Class map, confidence and picture on the map", projection(run.geobox))
    for product, (title, fields) in stores.items():
        if run.store(product) is not None:
            path = root / run.receipt["products"][product]
            export.add(f"{product}_zarr", path, title, ZARR, ["data"], **fields)
    for sweep in run.sweeps():
        export.add(f"{sweep.stem}_zarr", sweep, f"Raw sweep {sweep.stem}", ZARR, ["data", "raw"], **nowhere)
    for name, (title, kind, roles) in RUN_FILES.items():
        if (run.folder / name).is_file():
            export.add(Path(name).stem, run.folder / name, title, kind, roles)


def describe_collection(run: ExportedRun) -> Collection:
    """The collection of an archive's surveys."""
    name = clean_id(run.archive.root.name, "surveys")
    words = (
        f"Surveys exported from the archive {run.archive.root.name}: a coarse look at a whole field, a fine look where "
        "it changes the map. Where no survey says where it was, the extent is the whole earth."
    )
    return Collection(name, f"Surveys of {run.archive.root.name}", words)


def describe_item(export: Export) -> Item:
    """The run's item, with all assets that were added."""
    run, receipt = export.run, export.run.receipt
    placed = run.geobox is not None
    where = "Images lie on a map." if placed else NOT_PLACED
    properties: dict[str, Any] = {
        "title": f"Survey of {receipt['survey']}",
        "description": f"Survey of {receipt['survey']} ({receipt['source']} source). {where}",
        "instruments": [str(receipt["source"])],
        "processing:level": "L4",
        "processing:lineage": _lineage(receipt["stages"]),
        "processing:software": dict(receipt["versions"]),
        **wavelengths(load_bands(run.path("mosaic"))[0]),
    }
    outline = None
    if run.geobox is not None:
        properties["proj:code"] = projection(run.geobox)["proj:code"]
        properties["gsd"] = abs(float(run.geobox.resolution.x))
        outline = footprint(run.geobox, seen_rows(run))
    return Item(run.id, receipt["started"], receipt["finished"], properties, export.assets, outline)


def _lineage(stages: list[dict[str, Any]]) -> str:
    """Stages in order with the keys of their stores."""
    return ", then ".join(f"{stage['name']} {stage['key']}" for stage in stages if stage["key"])
