"""Export a run's maps, products and cubes with a STAC catalogue: the verb `export`."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

from odc.geo.geobox import GeoBox
from rich.console import Console
from rich.markup import escape

from flows.archive.export_layers import (
    NO_PRODUCTS,
    ExportedRun,
    Layer,
    ProductChoice,
    ProductFlags,
    choose_products,
    map_layers,
    open_exported,
    prior_map_layers,
)
from flows.archive.export_values import CSV, spectral_layers, write_areas
from flows.archive.export_zones import check_zones, write_zones
from flows.settings.flags import ArchiveName, AsJson, OutFile, Switch, check_outside
from flows.terminal.processes import DONE
from flows.terminal.progress import print_json, stderr
from pipeline.errors import ArchiveError, PipelineError
from pipeline.ground.georeference import pixel_side_m
from storage.archive.manifests import read_manifest
from storage.archive.staging import take_lock
from storage.archive.whole_files import remove_leftovers
from storage.arrays.georeference import load_geobox
from storage.arrays.signal_cubes import RestoredCube, open_lines
from storage.export.image_files import write_cog, write_recorded_files
from storage.export.stac_items import COG, ZARR, Item, check_owner, clean_id, footprint, projection, write_stac
from storage.readers.recordings import RESTORED
from storage.remote.object_archive import ObjectArchive
from storage.remote.opening import open_archive

COLLECTION_TEXT = "Surveys exported from the archive {}. If no survey has a place, the extent is the whole earth."
ENVI_NUMBERS = "application/octet-stream"
NOT_PLACED = (
    "The survey has no rig pose, and its scene no georeference: its images are on the camera's angular grid "
    "(transforms in radians), without a place on the earth."
)
RUN_FILES = {
    "receipt.json": ("Receipt", "application/json", ["metadata"]),
    "report.html": ("Report", "text/html", ["metadata"]),
    "quicklook.png": ("Quicklook", "image/png", ["overview"]),
}
Asset = dict[str, Any]


def export(
    archive: ArchiveName,
    run: str | None = None,
    *,
    out: OutFile,
    envi: Switch = False,
    products: ProductFlags = NO_PRODUCTS,
    as_json: AsJson = False,
) -> int:
    """Export a run: maps as GeoTIFF, areas and a STAC catalogue; on request polygons, prescriptions and cubes.

    Parameters
    ----------
    run
        The run's name, a folder's below runs, or `latest`, as without one.
    out
        Folder to export into; it may have other runs of the same archive.
    envi
        Also write the raw sweeps as ENVI with a pointing table each, for `survey --sweeps`.
    """
    content = run_export(archive, run, out, envi, stderr, choose_products(products))
    if as_json:
        print_json(content)
    return DONE


def run_export(
    archive: str | Path,
    run: str | None,
    out: Path,
    envi: bool,
    console: Console,
    choice: ProductChoice = choose_products(NO_PRODUCTS),  # noqa: B008 - a value
) -> dict[str, Any]:
    """Export a run (the latest if None) into ``out``, and print the files that were written.

    Returns run, item and collection (paths), placed (whether there is a CRS), and files: every asset's path relative to
    ``out``. Raises SettingsError: there is no such run, ``out`` lies in the archive, or the run lacks a product that
    was asked for; WavelengthError: its cube lacks bands of an index; ArchiveError: ``out`` is another archive's or
    cannot be written; IncompleteStoreError: a store is missing or damaged.
    """
    opened = open_exported(open_archive(archive, create=False, write=False), run)
    out = check_outside(out, opened.archive.root)
    surveys = opened.archive.root.name
    collection_id = clean_id(surveys, "surveys")
    check_zones(opened, choice)
    layers = [*map_layers(opened), *prior_map_layers(opened), *spectral_layers(opened, choice)]
    export = Export(opened, out)
    try:
        with ExitStack() as stack:
            release = take_lock(out / ".export.lock")
            stack.callback(release if release is not None else lambda: None)
            check_owner(out, collection_id)
            for folder in (out, export.folder, export.folder / "sweeps"):
                remove_leftovers(folder)
            _export_images(export, layers, console)
            areas = export.folder / "areas.csv"
            write_areas(opened, areas)
            export.add("areas", areas, "Areas of the classes, with standard errors", CSV, ["data", "metadata"])
            with console.status("drawing polygons"):
                write_zones(opened, export.folder, choice, export.add)
            _add_stores(export)
            if envi:
                _export_sweeps(export, console)
            item, collection = write_stac(out, collection_id, COLLECTION_TEXT.format(surveys), describe_item(export))
    except PipelineError:  # some are OSErrors
        raise
    except OSError as error:
        raise ArchiveError(f"cannot export to {out}: {error.strerror}; choose another --out") from error
    except UnicodeEncodeError as error:  # of GDAL
        raise ArchiveError(f"cannot export to {out}: expected a name in UTF-8; choose another --out") from error
    placed = opened.geobox is not None
    if not placed:
        console.print("[dim]note: neither a rig pose nor the scene has a place on the earth; images have no CRS[/]")
    for path in (*(out / name for name in export.files.values()), item, collection):
        console.print(f"  {escape(str(path))}", soft_wrap=True)
    return {"run": opened.id, "item": str(item), "collection": str(collection), "placed": placed, "files": export.files}


@dataclass
class Export:
    """The export of one run into a folder."""

    run: ExportedRun
    out: Path  # with links resolved, so that the relative address of the archive is right
    assets: dict[str, Asset] = field(default_factory=dict)
    files: dict[str, str] = field(default_factory=dict)  # paths of assets in `out`, relative to it

    @property
    def folder(self) -> Path:
        return self.out / self.run.id

    def projection(self, geobox: GeoBox | None = None) -> Asset:
        """Return the fields of an asset with this grid; a null code for one without a CRS in an item that has one."""
        if self.run.geobox is None:
            return {}
        return {"proj:code": None} if geobox is None or geobox.crs is None else projection(geobox)

    def add(self, key: str, path: Path, title: str, kind: str, roles: list[str], **fields: Any) -> None:
        """Add a file or store to the catalogue, by its address in a bucket, else by that relative to the item."""
        href = quote(Path(os.path.relpath(path.resolve(), self.folder)).as_posix())
        if isinstance(self.run.archive, ObjectArchive) and path.is_relative_to(self.run.archive.root):
            href = self.run.archive.url(path)
        self.assets[key] = {"href": href, "title": title, "type": kind, "roles": roles, **fields}
        if path.resolve().is_relative_to(self.out):
            self.files[key] = path.resolve().relative_to(self.out).as_posix()


def _export_images(export: Export, layers: Sequence[Layer], console: Console) -> None:
    for layer in layers:
        path = export.folder / f"{layer.name}.tif"
        image = layer.image
        with console.status(f"writing {path.name}"):
            write_cog(path, image, layer.rows())
        about: Asset = {"data_type": image.dtype, "nodata": "nan" if math.isnan(image.nodata) else image.nodata}
        about |= {} if layer.unit is None else {"unit": layer.unit}
        bands = [{"name": name, **about} for name in image.bands]
        export.add(layer.name, path, layer.title, COG, [*layer.roles], bands=bands, **export.projection(image.geobox))


def _export_sweeps(export: Export, console: Console) -> None:
    sweeps = export.run.sweeps()
    if not sweeps:
        console.print("[dim]note: --envi writes sweeps, and this run has none[/]")
    for path in sweeps:
        name = path.stem
        with console.status(f"writing {name}.bil"):
            header = write_recorded_files(lines := open_lines(path), export.folder / "sweeps")
        if restored := isinstance(lines, RestoredCube):
            console.print(f'[dim]note: {name}: {RESTORED}; keep = "raw" keeps the lines of the next survey[/]')
        export.add(
            f"{name}_envi",
            header.with_suffix(".bil"),
            f"{'Restored' if restored else 'Raw'} numbers of {name}",
            ENVI_NUMBERS,
            ["data"],
            **export.projection(),
        )
        export.add(f"{name}_envi_header", header, f"{name} as ENVI, header", "text/plain", ["metadata"])
        table = header.with_name(f"{name}.pointing.csv")
        export.add(f"{name}_pointing", table, f"Pointing of the lines of {name}", CSV, ["metadata"])


def _add_stores(export: Export) -> None:
    """Add the archive's own stores and the run's files to the catalogue."""
    run = export.run
    for product, title in {
        "mosaic": "Mosaic of all passes",
        "class_map": "Class map and confidence on the camera's grid",
        "attention": "Score and rank of the patches",
        "ground_map": "Class map, picture and prior map, on the map",
    }.items():
        if run.store(product) is not None and (product != "ground_map" or run.geobox is not None):
            box = None if product == "attention" else load_geobox(run.path(product))
            path = run.archive.root / run.receipt["products"][product]
            export.add(f"{product}_zarr", path, title, ZARR, ["data"], **export.projection(box))
    for sweep in run.sweeps():
        title, roles = ("Raw sweep", ["data", "raw"]) if (sweep / "dn").is_dir() else ("Signal of sweep", ["data"])
        export.add(f"{sweep.stem}_zarr", sweep, f"{title} {sweep.stem}", ZARR, roles, **export.projection())
    for name, (title, kind, roles) in RUN_FILES.items():
        if name in read_manifest(run.folder)["files"]:
            export.add(Path(name).stem, run.folder / name, title, kind, roles)


def describe_item(export: Export) -> Item:
    """Return the run's item with all assets that were added."""
    receipt = export.run.receipt
    where = NOT_PLACED if export.run.geobox is None else "Images lie on a map."
    properties: dict[str, Any] = {
        "title": f"Survey of {receipt['survey']}",
        "description": f"Survey of {receipt['survey']} ({receipt['source']} source). {where}",
        "instruments": [str(receipt["source"])],
        "processing:level": "L4",
        "processing:lineage": ", then ".join(f"{one['name']} {one['key']}" for one in receipt["stages"] if one["key"]),
        "processing:software": dict(receipt["versions"]),
    }
    outline = None
    if export.run.geobox is not None:
        properties |= {"proj:code": projection(export.run.geobox)["proj:code"], "gsd": pixel_side_m(export.run.geobox)}
        outline = footprint(export.run.geobox)
    return Item(export.run.id, *export.run.observed, properties, export.assets, outline)
