"""The verb `export`: a run's maps and products, its cubes as ENVI, and a STAC catalogue of them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from flows.archive.export_layers import (
    ExportedRun,
    Layer,
    map_layers,
    open_exported,
    prior_map_layers,
    seen_rows,
    write_layer_style,
)
from flows.archive.export_values import CSV, spectral_layers, write_areas
from flows.archive.export_zones import check_zones, write_zones, zone_notes
from flows.archive.product_choice import NO_PRODUCTS, ProductChoice, ProductFlags, choose_products
from flows.cli.app import ArchiveName, AsJson, OutFile, Switch, check_outside, stderr
from flows.terminal.processes import DONE
from flows.terminal.progress import print_json
from pipeline.errors import ArchiveError, PipelineError
from pipeline.ground.georeference import pixel_side_m
from storage.archive.staging import take_lock
from storage.archive.whole_files import remove_leftovers
from storage.arrays.georeference import load_geobox
from storage.arrays.ground_maps import open_image
from storage.arrays.mosaics import open_mosaic
from storage.arrays.signal_cubes import open_lines
from storage.export.image_files import EnviFile, has_map_info, write_cog, write_envi, write_recorded_files
from storage.export.map_files import STYLE
from storage.export.stac_items import COG, ZARR, Item, check_owner, clean_id, footprint, projection, write_stac
from storage.remote.opening import open_archive

COLLECTION_TEXT = (
    "Surveys exported from the archive {}: a coarse pass at a whole field, a fine look where it changes the map. Where "
    "no survey says where it was, the extent is the whole earth."
)
ENVI_NUMBERS = "application/octet-stream"
NOT_PLACED = (
    "The survey has no rig pose, and its scene no georeference: its images lie on a camera's angular grid (transforms "
    "in radians), and where on earth that is is not known."
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
    """Export a run: maps as GeoTIFF with QGIS styles, areas, a STAC catalogue; on request what a field needs.

    Parameters
    ----------
    run
        The run's name, a folder's below runs, or `latest`, as without one.
    out
        Folder to export into, beside the runs of the same archive that lie there.
    envi
        Also write the coarse mosaic as ENVI, and the raw sweeps as ENVI with a pointing table each: `survey --sweeps`
        reads these.
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
    """Export a run (the latest without a name) into ``out``, beside others that lie there, and print what was written.

    Gives run, item and collection (paths), placed (whether there is a CRS), and files: every asset's path seen from
    ``out``. Raises SettingsError: no such run, ``out`` lies in the archive, or the run does not give what is asked for;
    WavelengthError: its cube lacks bands of an index; ArchiveError: ``out`` is another archive's or cannot be written;
    IncompleteStoreError: a store is missing or damaged.
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
            for folder in (out, export.folder, export.folder / "envi", export.folder / "sweeps"):
                remove_leftovers(folder)
            _export_images(export, layers, console)
            areas = export.folder / "areas.csv"
            write_areas(opened, areas)
            export.add("areas", areas, "Areas of the classes, and how surely they are known", CSV, ["data", "metadata"])
            with console.status("drawing polygons"):
                write_zones(opened, export.folder, choice, export.add)
            name_stores(export)
            if envi:
                _export_cubes(export, console)
            item, collection = write_stac(out, collection_id, COLLECTION_TEXT.format(surveys), describe_item(export))
    except PipelineError:  # which some OSErrors are
        raise
    except OSError as error:
        raise ArchiveError(f"cannot export to {out}: {error.strerror}; choose another --out") from error
    files = {
        key: path.relative_to(out).as_posix()
        for key, asset in export.assets.items()
        if (path := Path(os.path.normpath(export.folder / asset["href"]))).is_relative_to(out)
    }
    placed = opened.geobox is not None
    if not placed:
        console.print("[dim]note: neither a rig pose nor the scene says where this lies, so the images have no CRS[/]")
    for note in zone_notes(opened, choice):
        console.print(f"[dim]note: {note}[/]")
    for path in (*(out / name for name in files.values()), item, collection):
        console.print(f"  {escape(str(path))}", soft_wrap=True)
    return {"run": opened.id, "item": str(item), "collection": str(collection), "placed": placed, "files": files}


def _export_images(export: Export, layers: Sequence[Layer], console: Console) -> None:
    for layer in layers:
        path = export.folder / f"{layer.name}.tif"
        with console.status(f"writing {path.name}"):
            write_cog(path, layer.image, layer.rows())
        nodata = "nan" if layer.image.nodata != layer.image.nodata else layer.image.nodata
        about = {"data_type": layer.image.dtype, "nodata": nodata}
        about |= {} if layer.unit is None else {"unit": layer.unit}
        fields: dict[str, Any] = {"bands": [{"name": name, **about} for name in layer.image.bands]}
        if export.run.geobox is not None:
            fields |= {"proj:code": None} if layer.image.geobox.crs is None else projection(layer.image.geobox)
        export.add(layer.name, path, layer.title, COG, list(layer.roles), **fields)
        style = write_layer_style(layer, path)
        export.add(f"{layer.name}_style", style, f"QGIS style of {path.name}", STYLE, ["metadata", "style"])


def _export_cubes(export: Export, console: Console) -> None:
    run = export.run
    mosaic, image = open_mosaic(run.path("mosaic")), open_image(run.path("mosaic"), "coverage")
    (rows, columns), wave, width = mosaic.shape, mosaic.wavelength_nm, mosaic.fwhm_nm
    geobox = image.geobox if image.geobox is not None and has_map_info(image.geobox) else None
    place = NOT_PLACED if run.geobox is None else "camera grid, no CRS" if geobox is None else "on the scene's map"
    text = f"mosaic of {run.id}, scene values; {place}"
    file = EnviFile((rows, columns, len(wave)), "f4", wave, width, text, float("nan"), geobox)
    header = export.folder / "envi" / "mosaic.hdr"
    with console.status("writing mosaic.img"):
        data = write_envi(header, file, mosaic.rows())
    export.add("mosaic_envi", data, "mosaic as ENVI, numbers", ENVI_NUMBERS, ["data"], **export.nowhere)
    export.add("mosaic_envi_header", header, "mosaic as ENVI, header", "text/plain", ["metadata"])
    for path in run.sweeps():
        name = path.stem
        with console.status(f"writing {name}.bil"):
            header = write_recorded_files(open_lines(path), export.folder / "sweeps")
        data, table = header.with_suffix(".bil"), header.with_name(f"{name}.pointing.csv")
        export.add(f"{name}_envi", data, f"Raw numbers of sweep {name}", ENVI_NUMBERS, ["data"], **export.nowhere)
        export.add(f"{name}_envi_header", header, f"{name} as ENVI, header", "text/plain", ["metadata"])
        export.add(f"{name}_pointing", table, f"Where the lines of {name} looked", CSV, ["metadata"])


@dataclass
class Export:
    """One run on its way into a folder."""

    run: ExportedRun
    out: Path  # without links, so that the way from there to the archive is the same for every program
    assets: dict[str, Asset] = field(default_factory=dict)

    @property
    def folder(self) -> Path:
        return self.out / self.run.id

    @property
    def nowhere(self) -> Asset:
        """Fields of an asset that has no CRS, in an item that has one."""
        return {} if self.run.geobox is None else {"proj:code": None}

    def add(self, key: str, path: Path, title: str, kind: str, roles: list[str], **fields: Any) -> None:
        """Add one file or store to the catalogue, by its address from the item."""
        href = Path(os.path.relpath(path.resolve(), self.folder)).as_posix()
        self.assets[key] = {"href": href, "title": title, "type": kind, "roles": roles, **fields}


def name_stores(export: Export) -> None:
    """Add the archive's own stores and the run's files to the catalogue, where they are."""
    run, root = export.run, export.run.archive.root
    nowhere = export.nowhere
    there = ("mosaic", "class_map", *(("detail",) if run.store("detail") is not None else ()))
    boxes = {product: load_geobox(run.path(product)) for product in there}
    places = {product: nowhere if box is None else projection(box) for product, box in boxes.items()}
    stores: dict[str, tuple[str, dict[str, Any]]] = {
        "mosaic": ("Mosaic of the first pass or of a uniform scan", places["mosaic"]),
        "detail": ("Mosaic of the fine sweeps", places.get("detail", nowhere)),
        "class_map": ("Class map and confidence on the camera's grid", places["class_map"]),
        "attention": ("Score and rank of the patches", nowhere),
    }
    if run.geobox is not None and run.map_product == "ground_map":
        stores["ground_map"] = ("Class map, picture and what is remembered, on the map", projection(run.geobox))
    for product, (title, fields) in stores.items():
        if run.store(product) is not None:
            path = root / run.receipt["products"][product]
            export.add(f"{product}_zarr", path, title, ZARR, ["data"], **fields)
    for sweep in run.sweeps():
        raw = (sweep / "dn").is_dir()  # else condensed
        title, roles = ("Raw sweep", ["data", "raw"]) if raw else ("Signal of sweep", ["data"])
        export.add(f"{sweep.stem}_zarr", sweep, f"{title} {sweep.stem}", ZARR, roles, **nowhere)
    for name, (title, kind, roles) in RUN_FILES.items():
        if (run.folder / name).is_file():
            export.add(Path(name).stem, run.folder / name, title, kind, roles)


def describe_item(export: Export) -> Item:
    """Return the run's item, with all assets that were added."""
    run, receipt = export.run, export.run.receipt
    placed = run.geobox is not None
    where = "Images lie on a map." if placed else NOT_PLACED
    properties: dict[str, Any] = {
        "title": f"Survey of {receipt['survey']}",
        "description": f"Survey of {receipt['survey']} ({receipt['source']} source). {where}",
        "instruments": [str(receipt["source"])],
        "processing:level": "L4",
        "processing:lineage": ", then ".join(f"{one['name']} {one['key']}" for one in receipt["stages"] if one["key"]),
        "processing:software": dict(receipt["versions"]),
    }
    outline = None
    if run.geobox is not None:
        properties["proj:code"] = projection(run.geobox)["proj:code"]
        properties["gsd"] = pixel_side_m(run.geobox)
        outline = footprint(run.geobox, seen_rows(run))
    return Item(run.id, receipt["started"], receipt["finished"], properties, export.assets, outline)
