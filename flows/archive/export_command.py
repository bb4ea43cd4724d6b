"""Export a run's maps and products with a STAC catalogue: the verb `export`."""

from __future__ import annotations

import json
import os
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

from rich.console import Console
from rich.markup import escape

from spectralzoom.flows.archive.export_layers import (
    NO_PRODUCTS,
    ExportedRun,
    Layer,
    ProductFlags,
    map_layers,
    open_exported,
    parse_doses,
    prior_map_layers,
    split_names,
)
from spectralzoom.flows.archive.export_values import check_doses, spectral_layers, write_areas, write_polygons
from spectralzoom.flows.settings.flags import ArchiveName, AsJson, OutFile, check_outside
from spectralzoom.flows.terminal.processes import DONE
from spectralzoom.flows.terminal.progress import print_json, stderr
from spectralzoom.pipeline.errors import ArchiveError, PipelineError
from spectralzoom.pipeline.products.indices import find_index
from spectralzoom.storage.export.image_files import write_cog
from spectralzoom.storage.store import Archive
from spectralzoom.storage.whole_files import locked, remove_leftovers, to_json, write_whole

COLLECTION = "collection.json"
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
    as_json: AsJson = False,
) -> int:
    """Export a run: maps as GeoTIFF, areas and a STAC catalogue; on request polygons, doses, spectra and indices.

    Parameters
    ----------
    run
        The run's name, a folder's below runs, or `latest`, as without one.
    out
        Folder to export into; it may have other runs of the same archive.
    """
    content = run_export(archive, run, out, stderr, products)
    if as_json:
        print_json(content)
    return DONE


def run_export(
    archive: str | Path, run: str | None, out: Path, console: Console, products: ProductFlags = NO_PRODUCTS
) -> dict[str, Any]:
    """Export a run (the latest if None) into ``out``, and print the files that were written.

    Returns run, item and collection (paths), placed (whether there is a CRS), and files: every asset's path relative to
    ``out``. Raises SettingsError: a flag is wrong, there is no such run, ``out`` lies in the archive, or the run lacks
    a product that was asked for; WavelengthError: its cube lacks bands of an index; ArchiveError: ``out`` is another
    archive's or cannot be written; IncompleteStoreError: a store is missing or damaged.
    """
    doses = parse_doses(products.dose)
    indices = tuple(dict.fromkeys(map(find_index, split_names("indices", products.indices))))
    opened = open_exported(Archive.open(archive, create=False, write=False), run)
    out = check_outside(out, opened.archive.root)
    check_doses(opened, doses)
    layers = [*map_layers(opened), *prior_map_layers(opened)]
    layers += spectral_layers(opened, indices, reflectance=products.reflectance)
    export = Export(opened, out)
    try:
        out.mkdir(parents=True, exist_ok=True)
        with locked(out / ".export.lock"):
            check_owner(export)
            for folder in (out, export.folder):
                remove_leftovers(folder)
            _write_images(export, layers, console)
            _write_tables(export, doses, console, polygons=products.polygons or bool(doses))
            for name, (title, kind) in RUN_FILES.items():
                export.add(Path(name).stem, opened.folder / name, title, kind, ["metadata"])
            item, collection = write_catalogue(export)
    except PipelineError:  # some are OSErrors
        raise
    except (OSError, UnicodeEncodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "expected a name in UTF-8"  # by GDAL
        raise ArchiveError(f"cannot export to {out}: {why}; choose another --out") from error
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
    assets: dict[str, Any] = field(default_factory=dict)  # pystac's, by key
    files: dict[str, str] = field(default_factory=dict)  # paths of assets in `out`, relative to it

    @property
    def folder(self) -> Path:
        return self.out / self.run.id

    @property
    def collection_id(self) -> str:
        return re.sub(r"[^A-Za-z0-9_-]+", "-", self.run.archive.root.name).strip("-") or "surveys"

    def add(self, key: str, path: Path, title: str, kind: str, roles: Sequence[str], **more: Any) -> None:
        """Add a file to the catalogue, by its address relative to the item."""
        import pystac

        href = quote(Path(os.path.relpath(path.resolve(), self.folder)).as_posix())
        self.assets[key] = pystac.Asset(href, title, media_type=kind, roles=[*roles], extra_fields=more)
        if path.resolve().is_relative_to(self.out):
            self.files[key] = path.resolve().relative_to(self.out).as_posix()


def _write_images(export: Export, layers: Sequence[Layer], console: Console) -> None:
    for layer in layers:
        path = export.folder / f"{layer.name}.tif"
        with console.status(f"writing {path.name}"):
            write_cog(path, layer.image, layer.rows())
        unit = {} if layer.unit is None else {"unit": layer.unit}
        bands = [{"name": name, "data_type": layer.image.dtype, **unit} for name in layer.image.bands]
        export.add(layer.name, path, layer.title, COG, layer.roles, bands=bands)


def _write_tables(export: Export, doses: Mapping[str, float], console: Console, *, polygons: bool) -> None:
    areas = export.folder / "areas.csv"
    write_areas(export.run, areas)
    export.add("areas", areas, "Areas of the classes, with standard errors", CSV, ["data", "metadata"])
    if polygons:
        with console.status("drawing polygons"):
            for key, path, kind in write_polygons(export.run, export.folder, doses):
                export.add(key, path, "Classes as polygons", kind, ["data"])


def check_owner(export: Export) -> None:
    """Refuse a folder whose collection is another archive's (ArchiveError)."""
    path = export.out / COLLECTION
    if not path.exists():
        return
    try:
        found = json.loads(path.read_bytes())["id"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ArchiveError(f"{path} cannot be read as STAC: {error}; remove it and export again") from error
    if found != export.collection_id:
        raise ArchiveError(
            f"{path} is the collection {found!r} of another archive, expected {export.collection_id!r}; choose another "
            "--out"
        )


def write_catalogue(export: Export) -> tuple[Path, Path]:
    """Write ``ID/ID.json`` and the collection of all items in the folder; return both paths.

    Raises ArchiveError: an item of an earlier export cannot be read.
    """
    import pystac

    items = [_describe(export)]
    for path in sorted(export.out.glob("*/*.json")):  # earlier exports, each in the folder of its own name
        if path.stem == path.parent.name and path.stem != export.run.id:
            try:
                content = json.loads(path.read_bytes())
                items.append(pystac.Item.from_dict(content, href=f"/{path.relative_to(export.out)}"))
            except (OSError, ValueError, KeyError, TypeError, pystac.STACError, pystac.STACTypeError) as error:
                raise ArchiveError(f"{path} is no STAC item: {error}; remove its folder and export again") from error
    items.sort(key=lambda one: (str(one.datetime), one.id))
    text = f"Surveys exported from the archive {export.run.archive.root.name}."
    made = pystac.Collection(export.collection_id, text, _extent(items), license="other")
    made.add_items(items)
    made.catalog_type = pystac.CatalogType.SELF_CONTAINED
    made.normalize_hrefs("/")  # links are relative; a folder's name may have characters of addresses, as # and ?
    written = []
    for one in (next(one for one in items if one.id == export.run.id), made):
        written.append(export.out / one.self_href.lstrip("/"))
        write_whole(written[-1], to_json(one.to_dict(include_self_link=False)))
    return written[0], written[1]


def _describe(export: Export) -> Any:
    """Return the run's item, with the place of its class map."""
    import rio_stac

    receipt = export.run.receipt
    start, end = (datetime.fromisoformat(text) for text in export.run.observed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that a file has no CRS: it gets no place
        item = rio_stac.create_stac_item(
            str(export.folder / "class_map.tif"),
            input_datetime=start,
            id=export.run.id,
            assets=export.assets,
            properties={
                "title": f"Survey of {receipt['survey']}",
                "description": f"Survey of {receipt['survey']} ({receipt['source']} source).",
                "instruments": [str(receipt["source"])],
            },
            with_proj=export.run.geobox is not None,
            geom_densify_pts=21,
        )
    item.common_metadata.start_datetime, item.common_metadata.end_datetime = start, end
    if export.run.geobox is None:
        item.geometry = item.bbox = None
    return item


def _extent(items: Sequence[Any]) -> Any:
    """Return the extent of all items; the whole earth if none has a place."""
    import pystac

    found = pystac.Extent.from_items(items)
    if all(one.bbox is None for one in items):
        found.spatial = pystac.SpatialExtent([[-180.0, -90.0, 180.0, 90.0]])
    return found
