"""Open any file or folder that holds a cube, by the reader of its kind."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.storage.readers.array_cubes import (
    UNNAMED,
    check_picture,
    cube_source,
    find_cube,
    in_scope,
    marked_bands,
)
from spectralzoom.storage.readers.array_files import ARRAY_ENDINGS, HDF_ENDINGS, find_zarr_store, list_arrays, load_npy
from spectralzoom.storage.readers.cube_sources import Bands, CubeSource, check_cube_source, reading
from spectralzoom.storage.readers.envi_files import (
    DATA_ENDINGS,
    find_envi_pair,
    find_reference,
    open_envi_cube,
    open_envi_source,
    open_headwall_cube,
)
from spectralzoom.storage.readers.image_files import IMAGE_ENDINGS, open_image
from spectralzoom.storage.readers.scene_toml import SceneSettings, find_scene_settings, settle_wavelengths

CUBE_ENDINGS = (*IMAGE_ENDINGS, *ARRAY_ENDINGS, ".hdr", *HDF_ENDINGS)
NO_UNIT = ("", "1", "unitless", "none", "dimensionless")
_WITH_VARIABLE = re.compile(
    r"^(?P<path>.+\.(?:mat|zarr|npy)):(?P<variable>[^/\\:]+)$"
    r"|^(?P<path2>.+\.(?:nc4?|h5|hdf5|he5)):(?P<variable2>[^:]+)$",
    re.IGNORECASE | re.DOTALL,
)


def split_variable(address: str | Path) -> tuple[Path, str | None]:
    """Return path and variable of ``scene.mat:cube``."""
    found = _WITH_VARIABLE.match(str(address))
    if found is None:
        return Path(address), None
    return Path(found["path"] or found["path2"]), found["variable"] or found["variable2"]


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
    may name an array: ``FILE.mat:ARRAY``. Scale and offset of the file are applied. Coordinates, where the file has
    them: ``wavelength`` and ``fwhm`` [nm] and ``bad_band`` along band; ``x``, ``y`` and ``spatial_ref`` of the place;
    ``valid``, ``time_s`` and ``exposure_ms`` of each line; ``void`` of transparent and masked pixels; the frames
    ``dark`` and ``white`` (x, band). Attributes: ``notes`` on what was assumed or left out, ``files``,
    ``wavelengths_from`` and ``_FillValue``. Raises SceneError: there is no such file, it is damaged, or its kind or
    shape cannot be used.
    """
    source = open_cube_source(address)
    return with_wavelengths(source, address, None).data_array()


def open_cube_source(address: str | Path, *, labels: bool = False) -> CubeSource:
    """Open a cube; only headers, and coordinates of arrays, are read.

    ``address`` may name an array: ``STORE:ARRAY``. A Headwall folder's reference frames are
    averaged over their lines. ``labels`` are read without scale, and an array with two axes is preferred. Raises
    SceneError: there is no such file, it is damaged, or its kind or shape cannot be used.
    """
    path, variable = split_variable(address)
    match reader_of(address):
        case "zarr":
            source = _open_arrays(find_zarr_store(path) or path, variable, labels=labels)
        case "headwall":
            source = _with_frames(open_headwall_cube(path), path)
        case "envi":
            source = open_envi_source(path, scaled=not labels)
        case "image":
            source = open_image(path, scaled=not labels)
        case "array":
            source = _open_arrays(path, variable, labels=labels)
            if path.suffix.lower() in ARRAY_ENDINGS and source.shape[2] == 1 and not labels and min(source.shape):
                check_picture(source.shape[:2], address)
        case "none" if not path.exists():
            raise SceneError(f"there is no file {path}; check the name (seen from {Path.cwd()})")
        case "none":
            ending = path.suffix.lower() or "nothing"
            raise SceneError(f"{path} ends in {ending}, which is not read; use {', '.join(CUBE_ENDINGS)}")
    check_cube_source(source)
    return source


def _with_frames(source: CubeSource, folder: Path) -> CubeSource:
    """Return a Headwall cube with the dark and white frames of its folder, if there are some."""
    for kind in ("dark", "white"):
        if (named := find_reference(folder, kind)) is not None:
            values, more = load_frame(named)
            notes = (*source.notes, f"{kind} frame from {named.name}")
            source = replace(source, **{kind: values}, files=(*source.files, *more), notes=notes)  # type: ignore[arg-type]
    return source


def _open_arrays(path: Path, variable: str | None, *, labels: bool) -> CubeSource:
    """Open an array of a file or Zarr store as a cube; only attributes and coordinates are read.

    ``variable`` is its name, alone or with its groups (``SERC/Reflectance/Reflectance_Data``). Raises SceneError: the
    file is damaged, or claims far more than it can hold; it has no such array or several; or the axes are not y, x and
    band.
    """
    ending = path.suffix.lower()
    guard = partial(reading, path, "Zarr" if path.is_dir() else "NetCDF or HDF5" if ending in HDF_ENDINGS else ending)
    with guard():
        arrays, about = list_arrays(path)
        cube = find_cube(arrays, variable, path, labels=labels)
        near = in_scope(arrays, cube.name)
        source = cube_source(path, cube, near, {**about, **cube.array.attrs}, guard)
        unit = str(cube.array.attrs.get("units", "")).strip()
        notes = [] if unit.lower() in NO_UNIT else [f"values are in {unit}"]
        plain = tuple(note for note in source.notes if ending not in ARRAY_ENDINGS or note != UNNAMED)
        source = replace(source, bad_bands=marked_bands(near, source.shape[2]), notes=(*notes, *plain))
        if path.is_dir():
            source = replace(source, files=tuple(sorted(file for file in path.rglob("*") if file.is_file())))
        return source


def load_labels_array(address: str | Path) -> NDArray[Any]:
    """Read a file of labels or a mask without its scale, (y, x, band) (SceneError)."""
    source = open_cube_source(address, labels=True)
    return source.read(0, source.shape[0])


def load_frame(address: str | Path) -> tuple[NDArray[np.float32], tuple[Path, ...]]:
    """Read one reference frame, (sample, band), as the mean of its lines, and return its files too.

    Raises SceneError: the file cannot be read or holds no real numbers.
    """
    path, _ = split_variable(address)
    kind = reader_of(address)
    if kind in ("zarr", "headwall"):
        raise SceneError(f"{path} is a folder, expected a reference frame (ENVI or .npy); name the file")
    files: tuple[Path, ...] = (path,)
    if path.suffix.lower() == ".npy":
        with reading(path, ".npy"):
            values = load_npy(path)
    elif kind == "envi":
        files = find_envi_pair(path)
        values = open_envi_cube(path).values
    else:
        source = open_cube_source(address)
        values = source.read(0, source.shape[0])
    values = values.astype(np.uint8) if values.dtype.kind == "b" else values  # of a bad frame
    if values.dtype.kind not in "uif":
        raise SceneError(f"{path} holds {values.dtype}, expected the real numbers of a reference frame")
    frame = values[None] if values.ndim == 2 else values
    return np.asarray(frame.mean(axis=0, dtype=np.float64), np.float32), files


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
    found = settle_wavelengths(path, range(count), count, stated=stated, settings=settings, known=Bands())
    folder = "" if settings.path is None else f"{settings.path.parent}/"
    return replace(source, bands=replace(found, origin=found.origin.replace(folder, "")))
