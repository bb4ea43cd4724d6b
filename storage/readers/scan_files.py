"""Anything that holds a cube, opened to be read 64 lines at a time: ENVI, Headwall folders, Zarr, images and arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from storage.readers.cube_sources import Bands, CubeSource, LineFacts, check_cube_source
from storage.readers.envi_cubes import DATA_ENDINGS, find_envi_pair, open_envi_cube
from storage.readers.headwall_folders import find_reference, open_envi_source, open_headwall_cube
from storage.readers.labels import find_layout
from storage.readers.raster_files import SCENE_ENDINGS, TIFF_ENDINGS, load_raster, open_tiff_rows, split_variable
from storage.readers.scene_toml import BandWavelengths, SceneSettings, find_scene_settings, settle_wavelengths
from storage.readers.zarr_scenes import find_zarr_store, open_zarr_cube


def is_scan(address: str | Path) -> bool:
    """Whether an address is of a kind that comes in lines: a folder, a Zarr store, an ENVI header or its data file."""
    path, _ = split_variable(address)
    if path.is_dir() or path.suffix.lower() == ".hdr":
        return True
    if path.suffix.lower() in SCENE_ENDINGS or not path.is_file():
        return False
    beside = {path.with_name(path.name + ".hdr").name.lower(), path.with_suffix(".hdr").name.lower()}
    return path.suffix.lower() in DATA_ENDINGS or any(entry.name.lower() in beside for entry in path.parent.iterdir())


def open_cube_source(
    address: str | Path, *, dark: str | Path | None = None, white: str | Path | None = None
) -> CubeSource:
    """Open whatever holds a cube; nothing of its numbers is read yet but small images, .mat and .npz, which are whole.

    Parameters
    ----------
    address
        ENVI header or data file, Headwall folder, Zarr store (``STORE:ARRAY``), or a file that
        :func:`storage.readers.raster_files.load_raster` reads.
    dark, white
        ENVI or .npy files of reference frames, averaged over their lines; they win over those in a Headwall folder.

    Raises
    ------
    SceneError : there is no such thing, it is damaged, or not of a kind or shape that can be used.
    """
    path, variable = split_variable(address)
    stated, found = [("dark", dark), ("white", white)], list[tuple[str, Path | None]]()
    store = find_zarr_store(path)
    if store is not None:
        source = open_zarr_cube(store, variable)
    elif path.is_dir():
        source = open_headwall_cube(path)
        found = [(kind, find_reference(path, kind)) for kind, frame in stated if frame is None]
    elif is_scan(path):
        source = open_envi_source(path)
    else:
        source = _raster_source(address)
    for kind, frame in (*found, *stated):
        if frame is not None:
            source = _with_frame(source, kind, frame)
    check_cube_source(source)
    return source


def with_wavelengths(source: CubeSource, stated: Sequence[float]) -> CubeSource:
    """The same cube with wavelengths as a flag says them [nm], one a band (WavelengthError where they do not fit)."""
    path, count = Path(source.name), source.shape[2]
    found = settle_wavelengths(path, range(count), count, stated=stated, settings=SceneSettings(), assumed_nm=None)
    return replace(source, bands=Bands(found.centre_nm, None, "nm", found.origin))


def known_bands(source: CubeSource) -> BandWavelengths | None:
    """What a scene takes as its file's own wavelengths."""
    bands = source.bands
    if bands.wavelength_nm is None:
        return None
    return BandWavelengths(bands.wavelength_nm, bands.fwhm_nm, bands.origin)


def load_frame(address: str | Path) -> tuple[NDArray[np.float32], tuple[Path, ...]]:
    """Read one reference frame, (sample, band), the mean of its lines, and the files that it stands in.

    Raises SceneError: the file cannot be read or holds no real numbers.
    """
    path, _ = split_variable(address)
    if is_scan(path):
        if path.is_dir():
            raise SceneError(f"{path} is a folder, expected a reference frame (ENVI or .npy); name the file")
        files: tuple[Path, ...] = find_envi_pair(path)
        values = open_envi_cube(path).values
    else:
        values, files = load_raster(address, dims=3).values, (path,)
    if values.dtype.kind not in "uif":
        raise SceneError(f"{path} holds {values.dtype}, expected the real numbers of a reference frame")
    frame = values[None] if values.ndim == 2 else values
    return np.asarray(frame.mean(axis=0, dtype=np.float64), np.float32), files


def _with_frame(source: CubeSource, kind: str, address: str | Path) -> CubeSource:
    """The same cube with its dark or white frame, and a note on where that is from."""
    frame, more = load_frame(address)
    files, notes = (*source.files, *more), (*source.notes, f"{kind} frame from {Path(address).name}")
    if kind == "dark":
        return replace(source, dark=frame, files=files, notes=notes)
    return replace(source, white=frame, files=files, notes=notes)


def _raster_source(address: str | Path) -> CubeSource:
    path, variable = split_variable(address)
    rows = open_tiff_rows(path) if path.suffix.lower() in TIFF_ENDINGS else None
    if rows is not None:
        return CubeSource(
            name=path.name,
            shape=rows.shape,
            dtype=rows.dtype,
            read=rows.read,
            files=(path,),
            lines=LineFacts(np.ones(rows.shape[0], np.bool_)),
            bands=_raster_bands(path, rows.assumed_nm, None, rows.shape[2]),
            nodata=rows.nodata,
            notes=rows.notes,
        )
    layout = find_layout(path, variable)
    raster = layout.raster if layout is not None else load_raster(address, dims=3)
    values = raster.three_axes(path)
    native = values.dtype.newbyteorder("=")
    return CubeSource(
        name=path.name,
        shape=(values.shape[0], values.shape[1], values.shape[2]),
        dtype=native,
        read=lambda start, stop: np.asarray(values[start:stop], native),
        files=tuple(raster.files) or (path,),
        lines=LineFacts(np.ones(values.shape[0], np.bool_)),
        bands=_raster_bands(path, raster.assumed_nm, raster.known, values.shape[2]),
        nodata=raster.nodata,
        notes=raster.notes,
    )


def _raster_bands(path: Path, assumed_nm: Sequence[float] | None, known: BandWavelengths | None, count: int) -> Bands:
    """Wavelengths by ``scene.toml``, the file, or its colours; none where nothing says those of every band."""
    settings = find_scene_settings(path)
    if settings.bands is not None and settings.wavelengths_nm is not None and len(settings.wavelengths_nm) != count:
        settings = SceneSettings()  # stated for some of the bands only
    said = settings.wavelengths_nm is not None or settings.wavelengths_file is not None
    if not said and known is None and (assumed_nm is None or len(assumed_nm) != count):
        return Bands()
    found = settle_wavelengths(
        path, range(count), count, stated=None, settings=settings, assumed_nm=assumed_nm, known=known
    )
    folder = "" if settings.path is None else f"{settings.path.parent}/"
    return Bands(found.centre_nm, found.fwhm_nm, "nm", found.origin.replace(folder, ""))
