"""Export a stored mosaic without a run, for labelling: all bands, and a picture of them on the same pixels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape

from spectralzoom.flows.archive.export_layers import RGB, geobox_of
from spectralzoom.flows.settings.flags import check_outside
from spectralzoom.flows.stages.ground import colours_of
from spectralzoom.flows.terminal.processes import writing
from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.pipeline.geometry.grid import cuts
from spectralzoom.storage.arrays.band_order import sort_bands
from spectralzoom.storage.arrays.ground_maps import open_image
from spectralzoom.storage.arrays.layout import SHARD_ROWS
from spectralzoom.storage.arrays.mosaics import open_mosaic
from spectralzoom.storage.export.image_files import Layer, Rows, write_cog
from spectralzoom.storage.store import Archive, uri_of

PICTURES = "pictures"  # no folder of images for `train`


def export_mosaic(archive: str | Path, address: str, out: Path, console: Console) -> dict[str, Any]:
    """Write ``KEY.tif`` with all bands of the mosaic at an address, and ``pictures/KEY.tif`` in three colours.

    Raises SettingsError: the store has no mosaic, or ``out`` lies in the archive; IncompleteStoreError: it is missing
    or damaged; ArchiveError: a file cannot be written.
    """
    opened = Archive.open(archive, create=False, write=False)
    uri = uri_of(address.rstrip("/")) or address
    folder, store = check_outside(out, opened.root), opened.locate(uri) / "mosaic.zarr"
    if not store.is_dir():
        raise SettingsError(f"{uri} has no mosaic; give the address that survey --until mosaic prints, or a run")
    mosaic = open_mosaic(store)
    order, centres, _ = sort_bands(mosaic.wavelength_nm)
    place: dict[str, Any] = {"geobox": geobox_of(open_image(store, "coverage")), "tags": {"product": uri}}

    def spectra() -> Rows:
        for rows in cuts(mosaic.shape[0], SHARD_ROWS):
            yield rows.start, mosaic.spectra(mosaic.scores(rows), order.tolist())

    def colours() -> Rows:
        yield 0, np.nan_to_num(np.rint(colours_of(opened.ref(*uri.split("/")[1:])))).astype(np.uint8)

    layers = {
        folder / f"{store.parent.name}.tif": Layer(
            name="mosaic",
            title="All bands of the mosaic",
            dtype="float32",
            bands=tuple(f"{nm:.1f} nm" for nm in centres),
            rows=spectra,
            wavelength_nm=centres.tolist(),
            fwhm_nm=None if mosaic.fwhm_nm is None else mosaic.fwhm_nm[order].tolist(),
            **place,
        ),
        folder / PICTURES / f"{store.parent.name}.tif": Layer(
            name="rgb", title="Picture of the mosaic", dtype="uint8", bands=RGB, rows=colours, nodata=0, **place
        ),
    }
    for path, layer in layers.items():
        with writing(out), console.status(f"writing {path.name}"):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_cog(path, layer)
        console.print(f"  {escape(str(path))}", soft_wrap=True)
    return {"store": uri, "files": list(map(str, layers))}
