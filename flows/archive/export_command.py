"""Export a run's maps and products with a STAC catalogue: the verb `export`."""

from __future__ import annotations

import json
import os
import re
import warnings
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

from rich.console import Console
from rich.markup import escape

from spectralzoom.flows.archive.export_layers import (
    NO_PRODUCTS,
    ExportedRun,
    ProductFlags,
    map_layers,
    open_exported,
    parse_doses,
    split_names,
)
from spectralzoom.flows.archive.export_mosaic import export_mosaic
from spectralzoom.flows.archive.export_values import check_doses, spectral_layers, write_areas, write_polygons
from spectralzoom.flows.archive.merged_maps import export_merged
from spectralzoom.flows.publish.scores import warnings_of
from spectralzoom.flows.settings.flags import ArchiveName, AsJson, OutFile, Switch, check_outside
from spectralzoom.flows.terminal.processes import DONE
from spectralzoom.flows.terminal.progress import print_json, show_warnings, stderr
from spectralzoom.pipeline.errors import ArchiveError, PipelineError, SettingsError
from spectralzoom.pipeline.products.indices import find_index
from spectralzoom.storage.export.image_files import Layer, write_cog
from spectralzoom.storage.store import Archive
from spectralzoom.storage.whole_files import locked, remove_leftovers, to_json, write_whole

COLLECTION = "collection.json"
Assets = dict[str, Any]  # pystac's, by key
COG, CSV = "image/tiff; application=geotiff; profile=cloud-optimized", "text/csv"
RUN_FILES = {
    "receipt.json": ("Receipt", "application/json"),
    "report.html": ("Report", "text/html"),
    "quicklook.png": ("Quicklook", "image/png"),
}


def export(
    archive: ArchiveName,
    run: str | None = None,
    *,
    out: OutFile,
    products: ProductFlags = NO_PRODUCTS,
    merge: Switch = False,
    as_json: AsJson = False,
) -> int:
    """Export a run: maps as GeoTIFF, areas and a STAC catalogue; on request polygons, doses, spectra and indices.

    Parameters
    ----------
    run
        The run's name, a folder's below runs, or `latest`, as without one. The address of a mosaic below stages, from
        `survey --until mosaic`, exports its bands and a picture for labelling.
    out
        Folder to export into; it may have other runs of the same archive.
    merge
        The class maps of the newest run of each georeferenced scene as one GeoTIFF, such as those of tiles.
    """
    if merge and (run is not None or products != NO_PRODUCTS):
        raise SettingsError("--merge takes the class maps of all scenes: leave out RUN and flags of products")
    if merge:
        content = export_merged(archive, out, stderr)
    elif run is not None and run.startswith("stages/"):
        content = export_mosaic(archive, run, out, stderr)
    else:
        content = run_export(archive, run, out, stderr, products)
    if as_json:
        print_json(content)
    return DONE


def run_export(
    archive: str | Path, run: str | None, out: Path, console: Console, products: ProductFlags = NO_PRODUCTS
) -> dict[str, Any]:
    """Export a run (the latest if None) into ``out``, and print the files that were written.

    Returns warnings, run, item and collection (paths), placed (whether there is a CRS), and files: every asset's path
    relative to ``out``. Raises SettingsError: a flag is wrong, there is no such run, ``out`` lies in the archive, or
    the run lacks a product that was asked for; WavelengthError: its cube lacks bands of an index; ArchiveError: ``out``
    is another archive's or cannot be written; IncompleteStoreError: a store is missing or damaged.
    """
    doses = parse_doses(products.dose)
    indices = tuple(dict.fromkeys(map(find_index, split_names("indices", products.indices))))
    opened = open_exported(Archive.open(archive, create=False, write=False), run)
    out = check_outside(out, opened.archive.root)  # with links resolved: addresses are relative
    check_doses(opened, doses)
    warned = warnings_of(opened.receipt)
    show_warnings(warned, console)
    layers = [*map_layers(opened), *spectral_layers(opened, indices, reflectance=products.reflectance)]
    folder, polygons = out / opened.id, products.polygons or bool(doses)
    try:
        out.mkdir(parents=True, exist_ok=True)
        with locked(out / ".export.lock"):
            _collection_id(out, opened.archive.root.name)
            for one in (out, folder):
                remove_leftovers(one)
            assets = _write_images(folder, layers, console)
            with console.status("writing areas and polygons"):
                assets |= _write_tables(opened, folder, doses, polygons=polygons)
            for name, (title, kind) in RUN_FILES.items():
                assets[Path(name).stem] = _asset(folder, opened.folder / name, title, kind, "metadata")
            written = _write_catalogue(out, opened.archive.root.name, _describe(opened, folder, assets))
    except PipelineError:  # some are OSErrors
        raise
    except (OSError, UnicodeEncodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "expected a name in UTF-8"  # by GDAL
        raise ArchiveError(f"cannot export to {out}: {why}; choose another --out") from error
    placed = opened.geobox is not None
    if not placed:
        console.print("[dim]note: neither a rig pose nor the scene has a place on the earth; images have no CRS[/]")
    if opened.undated:
        console.print("[dim]note: nothing states when the scene was captured: its items have the day of the survey[/]")
    own = {key: unquote(asset.href) for key, asset in assets.items() if not asset.href.startswith("..")}
    files = {key: f"{opened.id}/{name}" for key, name in own.items()}
    for path in (*(out / name for name in files.values()), *written):
        console.print(f"  {escape(str(path))}", soft_wrap=True)
    catalogue = {"item": str(written[0]), "collection": str(written[1])}
    return {"warnings": warned, "run": opened.id, **catalogue, "placed": placed, "files": files}


def _asset(folder: Path, path: Path, title: str, kind: str, *roles: str, **more: Any) -> Any:
    """Return an asset of the item in ``folder``, with its address relative to it."""
    import pystac

    href = quote(Path(os.path.relpath(path.resolve(), folder)).as_posix())
    return pystac.Asset(href, title, media_type=kind, roles=[*roles], extra_fields=more)


def _write_images(folder: Path, layers: Sequence[Layer], console: Console) -> Assets:
    """Write the images, and return their assets."""
    assets = {}
    for layer in layers:
        path = folder / f"{layer.name}.tif"
        with console.status(f"writing {path.name}"):
            write_cog(path, layer)
        unit = {} if layer.unit is None else {"unit": layer.unit}
        bands = [{"name": name, "data_type": layer.dtype, **unit} for name in layer.bands]
        assets[layer.name] = _asset(folder, path, layer.title, COG, *layer.roles, bands=bands)
    return assets


def _write_tables(run: ExportedRun, folder: Path, doses: Mapping[str, float], *, polygons: bool) -> Assets:
    """Write the areas, and the classes as polygons if asked for; return their assets."""
    write_areas(run, folder / "areas.csv")
    title = "Areas of the classes, with standard errors"
    assets = {"areas": _asset(folder, folder / "areas.csv", title, CSV, "data", "metadata")}
    for key, path, kind in write_polygons(run, folder, doses) if polygons else ():
        assets[key] = _asset(folder, path, "Classes as polygons", kind, "data")
    return assets


def _describe(run: ExportedRun, folder: Path, assets: Assets) -> Any:
    """Return the run's item, with the place of its class map, the time of observation and the day of processing."""
    import rio_stac

    receipt = run.receipt
    start, end = (datetime.fromisoformat(text) for text in run.observed)
    about, warned = f"Survey of {receipt['survey']}", warnings_of(receipt)
    words = [*map("Warning: {}".format, warned), f"{about} ({receipt['source']} source)."]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that a file has no CRS: it gets no place
        item = rio_stac.create_stac_item(
            str(folder / "class_map.tif"),
            input_datetime=start,
            id=run.id,
            assets=assets,
            properties={
                "title": about,
                "description": ". ".join(words),
                "spectralzoom:warnings": warned,
                "instruments": [str(receipt["source"])],
                "created": receipt["finished"],
            },
            with_proj=run.geobox is not None,
            geom_densify_pts=21,
        )
    item.common_metadata.start_datetime, item.common_metadata.end_datetime = start, end
    if run.geobox is None:
        item.geometry = item.bbox = None
    return item


def _collection_id(out: Path, archive: str) -> str:
    """Return the identifier of an archive's collection (ArchiveError: ``out`` has another one's)."""
    made = re.sub(r"[^A-Za-z0-9_-]+", "-", archive).strip("-") or "surveys"
    path = out / COLLECTION
    try:
        found = json.loads(path.read_bytes())["id"] if path.exists() else made
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ArchiveError(f"{path} cannot be read as STAC: {error}; remove it and export again") from error
    if found != made:
        raise ArchiveError(
            f"{path} is the collection {found!r} of another archive, expected {made!r}; choose another --out"
        )
    return made


def _write_catalogue(out: Path, archive: str, item: Any) -> tuple[Path, Path]:
    """Write ``ID/ID.json`` and the collection of all items in the folder; return both paths.

    Raises ArchiveError: an item of an earlier export cannot be read.
    """
    import pystac

    items = [item]
    for path in sorted(out.glob("*/*.json")):  # earlier exports, each in the folder of its own name
        if path.stem == path.parent.name and path.stem != item.id:
            try:
                content = json.loads(path.read_bytes())
                items.append(pystac.Item.from_dict(content, href=f"/{path.relative_to(out)}"))
            except (OSError, ValueError, KeyError, TypeError, pystac.STACError, pystac.STACTypeError) as error:
                raise ArchiveError(f"{path} is no STAC item: {error}; remove its folder and export again") from error
    extent = pystac.Extent.from_items(items)
    if all(one.bbox is None for one in items):
        extent.spatial = pystac.SpatialExtent([[-180.0, -90.0, 180.0, 90.0]])
    text = f"Surveys exported from the archive {archive}."
    collection = pystac.Collection(_collection_id(out, archive), text, extent, license="other")
    collection.add_items(sorted(items, key=lambda one: (str(one.datetime), one.id)))
    collection.catalog_type = pystac.CatalogType.SELF_CONTAINED
    collection.normalize_hrefs("/")  # links are relative; a folder's name may have characters of addresses, as # and ?
    written = out / item.self_href.lstrip("/"), out / COLLECTION
    for path, one in zip(written, (item, collection), strict=True):
        write_whole(path, to_json(one.to_dict(include_self_link=False)))
    return written
