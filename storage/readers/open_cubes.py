"""Open any file or folder that holds a cube, by the reader of its kind."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.exposures import all_alike, match_exposures, span_text
from spectralzoom.pipeline.signal.calibrate import check_frames
from spectralzoom.storage.addresses import split_variable
from spectralzoom.storage.readers.array_cubes import open_arrays
from spectralzoom.storage.readers.array_files import ARRAY_ENDINGS, HDF_ENDINGS, find_zarr_store
from spectralzoom.storage.readers.band_facts import Bands
from spectralzoom.storage.readers.cube_sources import CubeSource, check_cube_source
from spectralzoom.storage.readers.envi_files import DATA_ENDINGS, open_envi_source, open_headwall_cube
from spectralzoom.storage.readers.frames import find_reference, load_frame, taken_of
from spectralzoom.storage.readers.image_files import IMAGE_ENDINGS, open_image
from spectralzoom.storage.readers.scene_toml import SceneSettings, find_scene_settings, settle_wavelengths
from spectralzoom.storage.readers.user_files import is_there, reading_files

if TYPE_CHECKING:
    import xarray as xr

CUBE_ENDINGS = (*IMAGE_ENDINGS, *ARRAY_ENDINGS, ".hdr", *HDF_ENDINGS)


def reader_of(address: str | Path) -> Literal["zarr", "headwall", "envi", "image", "array", "none"]:
    """Return the reader of an address; "none" if there is no such file, or none reads its kind.

    A folder is a Zarr store or a Headwall camera's; an ENVI cube is named by its header or its data file.
    """
    path, _ = split_variable(address)
    ending = path.suffix.lower()
    if path.is_dir():
        return "headwall" if find_zarr_store(path) is None else "zarr"
    if ending == ".hdr":
        return "envi"
    if not path.is_file():
        return "none"
    if ending in CUBE_ENDINGS:
        return "image" if ending in IMAGE_ENDINGS else "array"
    beside = {path.with_name(path.name + ".hdr").name.lower(), path.with_suffix(".hdr").name.lower()}
    of_envi = ending in DATA_ENDINGS or any(one.name.lower() in beside for one in path.parent.iterdir())
    return "envi" if of_envi else "none"


def open_cube(address: str | Path) -> xr.DataArray:
    """Open a cube (y, x, band); values are read when they are needed.

    ``address`` is an image, .npy, .mat, ENVI, NetCDF or HDF5 file, a Zarr store or the folder of a Headwall camera; it
    may name an array: ``FILE.mat:ARRAY``. Scale and offset of the file are applied. Bands that all have a wavelength
    are sorted by it, for ``.sel(wavelength=660, method="nearest")``. Coordinates, where the file has them:
    ``wavelength``, ``fwhm`` [nm], ``file_band``, ``detector`` and ``bad_band`` of bands; ``x``, ``y`` and
    ``spatial_ref`` of the place; ``valid``, ``time_s`` and ``exposure_ms`` of each line; ``void`` of transparent and
    masked pixels; the frames ``dark`` and ``white`` (x, band). Attributes: ``notes`` on what was assumed or left out,
    ``files``, ``wavelengths_from``, ``acquired`` (a day or a moment in UTC, ISO 8601) and ``_FillValue``. Raises
    SceneError: there is no such file, it is damaged, or its kind or shape cannot be used.
    """
    source = open_cube_source(address)
    from spectralzoom.storage.readers.data_arrays import data_array

    return data_array(with_wavelengths(source, address, None))


def open_cube_source(address: str | Path, *, labels: bool = False) -> CubeSource:
    """Open a cube; only headers, and coordinates of arrays, are read.

    ``address`` may name an array: ``STORE:ARRAY``. A Headwall folder's reference frames are
    averaged over their lines. ``labels`` are read without scale, and an array with two axes is preferred. Raises
    SceneError: there is no such file, it is damaged, or its kind or shape cannot be used; FileChangedError, also as its
    lines are read: one of its files changed since it was opened.
    """
    path, variable = split_variable(address)
    with reading_files() as opened:
        if not is_there(path):
            raise SceneError(f"there is no file {path}; check the name (seen from {Path.cwd()})")
        match reader_of(address):
            case "zarr":
                source = open_arrays(find_zarr_store(path) or path, variable, labels=labels)
            case "headwall":
                source = _with_frames(open_headwall_cube(path), path)
            case "envi":
                source = open_envi_source(path, scaled=not labels)
            case "image":
                source = open_image(path, scaled=not labels)
            case "array":
                source = open_arrays(path, variable, labels=labels)
            case "none":
                ending = path.suffix.lower() or "nothing"
                raise SceneError(f"{path} ends in {ending}, which is not read; use {', '.join(CUBE_ENDINGS)}")
    check_cube_source(source)
    return replace(source, opened=opened, read=opened.guarded(source.read))


def _with_frames(source: CubeSource, folder: Path) -> CubeSource:
    """Return a Headwall cube with the dark and white frames of its folder, if there are some."""
    found = {kind: find_reference(folder, kind) for kind in ("dark", "white")}
    frames = {
        kind: load_frame(file, kind, source.shape[1:], source.bands) for kind, file in found.items() if file is not None
    }
    stated_ms = source.lines.exposure_ms
    lines_ms = np.ones(1) if stated_ms is None else stated_ms
    notes = [f"{kind} frame from {frame.files[0].name}" for kind, frame in frames.items()]
    white_ms = None
    if len(frames) == 2:
        white_ms, more = match_exposures(taken_of(frames), source.taken, lines_ms, stated=stated_ms is not None)
        notes += [*more, *check_frames(f"{source.name}: ", frames["dark"].values, frames["white"].values)]
    else:
        notes = [f"{note} is not used: values over white need a dark and a white frame" for note in notes]
        notes += [] if all_alike(lines_ms) else [f"numbers of {span_text(lines_ms)} are not scaled to one exposure"]
    return replace(
        source,
        **{kind: frame.values for kind, frame in frames.items()},  # type: ignore[arg-type]
        white_ms=white_ms,
        files=(*source.files, *(file for frame in frames.values() for file in frame.files)),
        notes=(*source.notes, *notes),
    )


def load_labels_array(address: str | Path) -> NDArray[Any]:
    """Read a file of labels or a mask without its scale, (y, x, band) (SceneError)."""
    source = open_cube_source(address, labels=True)
    return source.read(0, source.shape[0])


def with_wavelengths(source: CubeSource, address: str | Path, stated: Sequence[float] | None) -> CubeSource:
    """Return the cube with the ``stated`` wavelengths [nm], one a band, else with those of ``scene.toml``, if any.

    Raises WavelengthError: they do not fit.
    """
    path, _ = split_variable(address)
    count = source.shape[2]
    settings = SceneSettings() if stated is not None else find_scene_settings(path)
    if settings.bands is not None and settings.wavelengths_nm is not None and len(settings.wavelengths_nm) != count:
        settings = SceneSettings()  # of some bands only
    if stated is None and settings.wavelengths_nm is None and settings.wavelengths_file is None:
        return source
    found = settle_wavelengths(
        path, range(count), count, stated=stated, settings=settings, known=Bands(), shape=source.shape
    )
    folder = "" if settings.path is None else f"{settings.path.parent}/"
    return replace(source, bands=replace(found, origin=found.origin.replace(folder, "")))
