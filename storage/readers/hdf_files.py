"""Read cubes from NetCDF and HDF5 files, a few lines at a time, with the products of EMIT, PRISMA and NEON.

EMIT's files follow CF, except for wavelengths and good bands, which lie in a group of their own. NEON has its own names
for scale, no-data value and place. PRISMA has a cube for each of its two spectrometers, and scale, wavelengths and
place as attributes of the file. The layouts are those that the providers publish; no such file was at hand.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.lazy import deferred
from storage.readers.array_cubes import ArrayCube, FileArray, cube_source, find_cube, names_beside, place_or_note
from storage.readers.cube_sources import (
    BLOCK_LINES,
    Bands,
    CubeSource,
    check_claim,
    check_memory,
    read_by_chunks,
    reading,
    unpacked,
)

if TYPE_CHECKING:
    import h5py
    import odc.geo.geobox as odc_geobox
    import xarray as xr
    from odc.geo.geobox import GeoBox
else:
    h5py = deferred("h5py")
    odc_geobox = deferred("odc.geo.geobox")
    xr = deferred("xarray")

KIND = "NetCDF or HDF5"
HDF_ENDINGS = (".nc", ".nc4", ".h5", ".hdf5", ".he5")
GOOD_BANDS = ("good_wavelengths", "good_bands", "bbl")  # 0 marks a bad band
NO_UNIT = ("", "1", "unitless", "none", "dimensionless")
_ONLY_A_DIMENSION = "This is a netCDF dimension but not a netCDF variable"
_PRISMA = "HDFEOS/SWATHS/PRS_L2{}_HCO/Data Fields/{}_Cube"
_PRISMA_TOP = 65535  # the number of the greatest value


def open_hdf_cube(path: Path, variable: str | None = None, *, labels: bool = False) -> CubeSource:
    """Open one array of a NetCDF or HDF5 file as a cube; only attributes and coordinates are read.

    ``variable`` is the array's name, alone or with its groups (``SERC/Reflectance/Reflectance_Data``), and may end in a
    step of time. Raises SceneError: the file is damaged, or has no such array or several, or the axes are not y, x and
    band.
    """
    with reading(path, KIND):
        arrays, attributes = hdf_arrays(path) if h5py.is_hdf5(path) else _classic_arrays(path)
        level = next((one for one in "DCB" if _PRISMA.format(one, "VNIR") in arrays), None)
        if level is not None and variable is None:
            return _prisma_cube(path, level, arrays, attributes)
        if any(name.startswith("HDFEOS/SWATHS/PRS_") for name in arrays):
            raise SceneError(
                f"{path} is no PRISMA product of level 2B, 2C or 2D, or one of its arrays was named; give such a "
                "product by its name alone, and --bands for some of its bands"
            )
        cube = find_cube(arrays, variable, path, labels=labels)
        near = _in_scope(arrays, cube.name)
        for name in names_beside(arrays) | {dim for dim in cube.dims if dim in near}:
            check_array(path, name, (arrays | near)[name])
        chunk = 1 if cube.array.chunks is None else cube.array.chunks[cube.order[0]]
        check_array(path, cube.name, cube.array, lines=(cube.order[0], max(chunk, BLOCK_LINES)))
        about = {**attributes, **cube.array.attrs}
        source = cube_source(path, cube, near, about, lambda: reading(path, KIND))
        unit, (lines, _, count) = str(about.get("units", "")).strip(), source.shape
        notes = () if unit.lower() in NO_UNIT else (f"values are in {unit}",)
        geobox, where = (source.geobox, ()) if source.geobox is not None else _other_place(near, cube, source.shape)
        return replace(
            source,
            read=read_by_chunks(source.read, lines, chunk),
            bad_bands=_bad_bands(near, count),
            geobox=geobox,
            notes=(*notes, *source.notes, *where),
        )


def _bad_bands(arrays: Mapping[str, Any], count: int) -> tuple[int, ...]:
    """Return the bands (from 0) that a list of good bands marks by 0."""
    for name, array in arrays.items():
        if name.rpartition("/")[2].lower() in GOOD_BANDS and array.shape == (count,):
            return tuple(np.flatnonzero(array[...] == 0).tolist())
    return ()


def _other_place(
    arrays: Mapping[str, Any], cube: ArrayCube, shape: tuple[int, int, int]
) -> tuple[GeoBox | None, tuple[str, ...]]:
    """Return the grid by NEON's map info and EPSG code, else a note on a place that is not read."""
    folder = f"{cube.name.rpartition('/')[0]}/Metadata/Coordinate_System"
    if f"{folder}/Map_Info" in arrays and f"{folder}/EPSG Code" in arrays:
        texts = [arrays[f"{folder}/{name}"][()] for name in ("Map_Info", "EPSG Code")]
        info, code = (str(np.asarray(text).astype(np.str_).reshape(-1)[0]) for text in texts)
        return place_or_note(lambda: _place_of_neon(info, code, shape[:2]))
    names = {name.rpartition("/")[2].lower() for name, array in arrays.items() if array.ndim == 2}
    if "glt_x" in names:
        return None, (
            "its pixels are in the sensor's own geometry and have no map grid; for a place on the earth, write it"
            " orthorectified by its geolocation grids (glt_x, glt_y) first",
        )
    if {"lat", "latitude"} & names:
        return None, ("its place is given by a latitude and longitude of each pixel, which are not read",)
    return None, ()


def _place_of_neon(info: str, code: str, shape: tuple[int, int]) -> GeoBox:
    fields = [field.strip() for field in info.split(",")]
    x, y, east, north, wide, high = map(float, fields[1:7])
    if any(field.lower().startswith("rotation") and float(field.partition("=")[2]) for field in fields):
        raise ValueError(f"map info {info!r} is turned")
    corner = Affine(wide, 0, east - (x - 1) * wide, 0, -high, north + (y - 1) * high)
    return odc_geobox.GeoBox(shape, corner, f"EPSG:{int(code)}")


def _prisma_cube(path: Path, level: str, arrays: Mapping[str, FileArray], about: Mapping[str, Any]) -> CubeSource:
    """Return both cubes (y, band, x) of a PRISMA product as one, its used bands by ascending wavelength.

    Pixels that are 0 in every band lie outside the swath.
    """
    cubes, lows, scales, known = list[FileArray](), list[float](), list[float](), list[NDArray[np.float64]]()
    for part in ("Vnir", "Swir"):
        array = arrays[_PRISMA.format(level, part.upper())]
        check_array(path, f"{part}_Cube", array, lines=(0, (array.chunks or (1,))[0]))
        lists = [np.asarray(about[f"List_{kind}_{part}"], np.float64).ravel() for kind in ("Cw", "Fwhm")]
        if array.ndim != 3 or any(len(one) != array.shape[1] for one in lists):
            raise SceneError(
                f"{path}: {part}_Cube has the shape {array.shape} and {len(lists[0])} wavelengths, expected "
                "(y, band, x) with one for each band; copy the file again"
            )
        known.append(np.stack(lists))
        low, high = (float(about[f"L2Scale{part}{end}"]) for end in ("Min", "Max"))
        cubes, lows, scales = [*cubes, array], [*lows, low], [*scales, (high - low) / _PRISMA_TOP]
    (centres, widths), (lines, _, samples) = np.concatenate(known, axis=1), cubes[0].shape
    if (cubes[1].shape[0], cubes[1].shape[2]) != (lines, samples):
        raise SceneError(
            f"{path}: the cubes {[array.shape for array in cubes]} (y, band, x) are of two sizes; copy it again"
        )
    used = np.flatnonzero(centres > 0)
    order = used[np.argsort(centres[used], kind="stable")]

    def read(start: int, stop: int) -> NDArray[Any]:
        """Return some lines (line, sample, band)."""
        with reading(path, KIND):
            raw = [np.moveaxis(array[start:stop], 1, 2) for array in cubes]
        values = [unpacked(block, scale, low, None) for block, scale, low in zip(raw, scales, lows, strict=True)]
        found = np.concatenate(values, axis=2)[..., order]
        found[np.logical_and.reduce([(block == 0).all(axis=2) for block in raw])] = np.nan
        return found

    chunk = max((array.chunks or (1,))[0] for array in cubes)
    check_memory(path, max(chunk, BLOCK_LINES) * samples * len(centres) * 8)
    geobox, notes = None, tuple[str, ...](["it has no map grid"])
    if level == "D":
        geobox, notes = place_or_note(lambda: _place_of_prisma(about, (lines, samples)))
    unused = len(centres) - len(order)
    return CubeSource(
        name=path.name,
        shape=(lines, samples, len(order)),
        dtype=np.dtype(np.float32),
        read=read_by_chunks(read, lines, chunk),
        files=(path,),
        bands=Bands(centres[order], widths[order], "wavelengths from List_Cw of the file"),
        geobox=geobox,
        notes=(f"a PRISMA product of level 2{level}; {unused} bands without a wavelength are left out", *notes),
    )


def _place_of_prisma(about: Mapping[str, Any], shape: tuple[int, int]) -> GeoBox:
    """Return the grid between the centres of the upper left and the lower right pixel."""
    (west, north), (east, south) = (
        [float(about[f"Product_{corner}corner_{axis}"]) for axis in ("easting", "northing")] for corner in ("UL", "LR")
    )
    wide, high = (east - west) / (shape[1] - 1), (north - south) / (shape[0] - 1)
    corner = Affine(wide, 0, west - wide / 2, 0, -high, north + high / 2)
    return odc_geobox.GeoBox(shape, corner, f"EPSG:{int(about['Epsg_Code'])}")


def _in_scope(arrays: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return all arrays by their paths; those of the array's group, and of groups above it, by their names alone."""
    groups = name.split("/")[:-1]
    heads = ["".join(f"{group}/" for group in groups[:depth]) for depth in range(len(groups) + 1)]
    near = {
        path.removeprefix(head): array
        for head in heads
        for path, array in arrays.items()
        if path.startswith(head) and "/" not in path.removeprefix(head)
    }
    return near | {path: array for path, array in arrays.items() if "/" in path}


def check_array(path: Path, name: str, array: FileArray, *, lines: tuple[int, int] | None = None) -> None:
    """Refuse an array, or a number of ``lines`` of one axis, that file or memory cannot hold (SceneError)."""
    part, chunk = math.prod(array.shape), math.prod(array.chunks or ())
    check_claim(f"{path}:{name}", max(part, chunk) * array.dtype.itemsize, path.stat().st_size)
    if lines is not None and array.shape[lines[0]]:
        part = part // array.shape[lines[0]] * min(lines[1], array.shape[lines[0]])
    check_memory(path, (part + chunk) * array.dtype.itemsize)


def _classic_arrays(path: Path) -> tuple[dict[str, FileArray], dict[str, Any]]:
    """Return the arrays and attributes of a NetCDF file of version 3, which is read whole.

    Reading from memory keeps scipy from allocating more bytes than the file has.
    """
    check_memory(path, 3 * path.stat().st_size)
    data = xr.open_dataset(BytesIO(path.read_bytes()), engine="scipy", decode_cf=False)
    arrays = {
        str(name): FileArray(
            one.shape,
            one.dtype,
            {**_plain(one.attrs), "_ARRAY_DIMENSIONS": [str(dim) for dim in one.dims]},
            lambda part, one=one: np.asarray(one[part].values),  # type: ignore[misc]
        )
        for name, one in data.variables.items()
        if one.dtype.kind in "buif"
    }
    return arrays, _plain(data.attrs)


def hdf_arrays(path: Path) -> tuple[dict[str, FileArray], dict[str, Any]]:
    """Return the arrays of an HDF5 file by their paths, and the attributes of its root.

    Links and virtual arrays are left out: they may lead to any file.
    """
    arrays: dict[str, FileArray] = {}

    def visit(name: str, item: Any) -> None:
        """Add an array of numbers, or a single text such as NEON's map info."""
        if not isinstance(item, h5py.Dataset) or item.external or item.is_virtual or item.shape is None:
            return
        about = _plain(item.attrs)
        is_text = item.dtype.kind in "SO" and not item.ndim
        if (item.dtype.kind in "buif" or is_text) and not str(about.get("NAME", "")).startswith(_ONLY_A_DIMENSION):
            attributes = {**about, **_as_cf(about, item)}
            arrays[name] = FileArray(item.shape, item.dtype, attributes, partial(_read, path, name), item.chunks)

    with h5py.File(path, "r") as file:
        file.visititems(visit)  # follows hard links alone
        return arrays, _plain(file.attrs)


def _read(path: Path, name: str, part: Any) -> NDArray[Any]:
    with h5py.File(path, "r") as file:
        return np.asarray(file[name][part])


def _as_cf(about: Mapping[str, Any], item: Any) -> dict[str, Any]:
    """Return names of axes, and NEON's scale, no-data value and unit, as attributes of CF."""
    dims = [dim[0].name.removeprefix("/") if len(dim) else dim.label for dim in item.dims]
    scale = about.get("Scale_Factor") or about.get("Scale Factor")  # a divisor, unlike CF's scale_factor
    void = about.get("Data_Ignore_Value", about.get("data ignore value"))
    known = {
        "_ARRAY_DIMENSIONS": dims if any(dims) else None,
        "scale_factor": None if scale is None else 1 / float(scale),
        "_FillValue": None if void is None else float(void),
        "units": about.get("units", about.get("Units")),
    }
    return {name: value for name, value in known.items() if value is not None}


def _plain(attributes: Any) -> dict[str, Any]:
    """Return the attributes that can be read as Python's own texts and numbers, lists as arrays."""
    found = {}
    for name in attributes:
        try:
            value = attributes[name]
        except Exception:  # of a type that h5py does not know
            continue
        if isinstance(value, np.ndarray | np.generic) and value.size == 1:
            value = np.asarray(value).reshape(-1)[0]
            value = value.item() if isinstance(value, np.generic) else value
        found[str(name)] = value.decode("utf-8", "replace") if isinstance(value, bytes) else value
    return found
