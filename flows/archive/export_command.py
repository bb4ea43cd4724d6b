"""What `spectralzoom export` does: a run's maps as GeoTIFF, its cubes as ENVI, and a STAC catalogue of both."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from flows.archive.commands import check_outside
from flows.archive.export_catalogue import (
    NOT_PLACED,
    Export,
    band_fields,
    describe_collection,
    describe_item,
    grid_fields,
    name_stores,
)
from flows.archive.export_layers import map_layers, open_exported
from pipeline.errors import ArchiveError, PipelineError
from storage.archive.staging import take_lock
from storage.archive.whole_files import remove_leftovers
from storage.arrays.cubes import open_raw_cube
from storage.arrays.ground_maps import load_bands, open_image
from storage.arrays.layout import SHARD_ROWS
from storage.export.cog_files import need_rasterio, write_cog
from storage.export.envi_writer import EnviFile, write_envi
from storage.export.stac_items import COG, check_owner, need_pystac, write_stac
from storage.remote.opening import open_archive

ENVI_NUMBERS = "application/octet-stream"


def run_export(archive: str | Path, run: str | None, out: Path, envi: bool, console: Console) -> dict[str, Any]:
    """Export a run (the latest without a name) into ``out``, beside others that lie there, and print what was written.

    Returns
    -------
    run, item and collection (paths), placed (whether there is a CRS), and files: every asset's path seen from ``out``.

    Raises
    ------
    SettingsError : there is no such run, or ``out`` lies in the archive.
    ArchiveError : rasterio or pystac is missing, ``out`` is another archive's or refuses to be written.
    IncompleteStoreError : a store of the run is missing or damaged.
    """
    need_rasterio()
    need_pystac()
    opened = open_exported(open_archive(archive, create=False, write=False), run)
    out = check_outside(out, opened.archive)
    about = describe_collection(opened)
    with _writing(out), _alone_in(out):
        check_owner(out, about.id)
        export = Export(opened, out)
        for folder in (out, export.folder, export.folder / "envi"):
            remove_leftovers(folder)
        _export_images(export, console)
        name_stores(export)
        if envi:
            _export_cubes(export, console)
        item, collection = write_stac(out, about, describe_item(export))
    return _tell(export, item, collection, console)


@contextmanager
def _writing(out: Path) -> Iterator[None]:
    try:
        yield
    except PipelineError:
        raise
    except OSError as error:
        raise ArchiveError(f"cannot export to {out}: {error.strerror}; choose another --out") from error


@contextmanager
def _alone_in(out: Path) -> Iterator[None]:
    """Wait until no other export writes there."""
    release = take_lock(out / ".export.lock")
    try:
        yield
    finally:
        if release is not None:
            release()


def _export_images(export: Export, console: Console) -> None:
    for layer in map_layers(export.run):
        path = export.folder / f"{layer.name}.tif"
        with console.status(f"writing {path.name}"):
            write_cog(path, layer.image, layer.rows())
        fields = {"bands": band_fields(layer), **grid_fields(export.run, layer), **layer.fields}
        export.add(layer.name, path, layer.title, COG, list(layer.roles), **fields)


def _export_cubes(export: Export, console: Console) -> None:
    """The coarse mosaic and the raw sweeps as ENVI files, a block of lines at a time."""
    run = export.run
    mosaic = open_image(run.path("mosaic"), "values")
    rows, columns, bands = mosaic.shape
    wave, width = load_bands(run.path("mosaic"))
    text = f"coarse mosaic of {run.id}, scene values; {NOT_PLACED if run.geobox is None else 'camera grid, no CRS'}"
    file = EnviFile((rows, columns, bands), "<f4", "bil", wave, width, text, nodata=float("nan"))
    with console.status("writing mosaic.img"):
        _name_cube(export, "mosaic", write_envi(_header(export, "mosaic"), file, mosaic.rows()))
    for path in run.sweeps():
        cube = open_raw_cube(path)
        text = f"raw numbers of sweep {cube.sweep.name} of {run.id} (line, sample, band), not calibrated"
        file = EnviFile(cube.shape, "<u2", "bil", cube.wavelength_nm, cube.fwhm_nm, text)
        blocks = ((first, cube.read(first, first + SHARD_ROWS)) for first in range(0, cube.shape[0], SHARD_ROWS))
        with console.status(f"writing {path.stem}.img"):
            _name_cube(export, path.stem, write_envi(_header(export, path.stem), file, blocks))


def _header(export: Export, name: str) -> Path:
    return export.folder / "envi" / f"{name}.hdr"


def _name_cube(export: Export, name: str, data: Path) -> None:
    export.add(f"{name}_envi", data, f"{name} as ENVI, numbers", ENVI_NUMBERS, ["data"], **export.nowhere)
    export.add(f"{name}_envi_header", _header(export, name), f"{name} as ENVI, header", "text/plain", ["metadata"])


def _tell(export: Export, item: Path, collection: Path, console: Console) -> dict[str, Any]:
    files = {
        key: path.relative_to(export.out).as_posix()
        for key, about in export.assets.items()
        if (path := Path(os.path.normpath(export.folder / about["href"]))).is_relative_to(export.out)
    }
    if export.run.geobox is None:
        console.print("[dim]note: no rig pose in this survey, so the images have no CRS[/]", highlight=False)
    for path in (*(export.out / name for name in files.values()), item, collection):
        console.print(f"  {escape(str(path))}", highlight=False, soft_wrap=True)
    placed = export.run.geobox is not None
    return {"run": export.run.id, "item": str(item), "collection": str(collection), "placed": placed, "files": files}
