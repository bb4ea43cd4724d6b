"""List the arrays of .npy, .mat, NetCDF, HDF5 and Zarr by their headers; only the array wanted is read.

Python objects, cells and structures are not read, nor links and virtual arrays of HDF5, which may lead to any file.
Codecs of Zarr other than those of numbers are refused.
"""

from __future__ import annotations

import base64
import importlib
import math
import re
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.storage import LocalStore

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.storage.readers.allowed_codecs import CheckedStore, check_filters, outside_links
from spectralzoom.storage.readers.cube_sources import DEFLATE_RATIO, MOST_RATIO, check_claim, check_memory
from spectralzoom.storage.readers.file_numbers import FileNumbers
from spectralzoom.storage.readers.user_files import files_below, is_there

if TYPE_CHECKING:
    import xarray as xr

ARRAY_ENDINGS = (".npy", ".mat")
HDF_ENDINGS = (".nc", ".nc4", ".h5", ".hdf5", ".he5")
METADATA = ("zarr.json", ".zarray", ".zgroup")
_CLASSIC = b"CDF"  # with which NetCDF 3 begins
_MATLAB = {"double": "f8", "single": "f4", "logical": "?"} | {
    f"{u}int{8 * n}": f"{u or 'i'}{n}" for n in (1, 2, 4, 8) for u in ("", "u")
}
_SIZES = (
    *(("nrow", "ncol"), ("nrows", "ncols"), ("rows", "cols"), ("lines", "samples"), ("height", "width")),
    *(("row", "col"), ("nr", "nc"), ("h", "w")),
)
_ONLY_A_DIMENSION = "This is a netCDF dimension but not a netCDF variable"


@dataclass(frozen=True)
class FileArray:
    """One array of a file: its axes, attributes, and the function that reads a part of it."""

    where: str  # address, for messages
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    attrs: Mapping[str, Any]
    get: Callable[[Any], NDArray[Any]] = field(repr=False)
    chunks: tuple[int, ...]  # numbers along each axis that are read at a time
    stored: int  # bytes on the disk that it may take
    dims: tuple[str, ...] = ()  # names of the axes; empty if there are none
    ratio: int = MOST_RATIO  # bytes of numbers that one of them can be
    notes: tuple[str, ...] = ()

    @property
    def ndim(self) -> int:
        return len(self.shape)

    def __getitem__(self, part: Any) -> NDArray[Any]:
        if part is ...:
            self.check(self.shape)
        return self.get(part)

    def check(self, part: Sequence[int]) -> None:
        """Refuse an array that its file, or a ``part`` of it that the memory, cannot hold (SceneError)."""
        claimed = max(math.prod(self.shape), math.prod(self.chunks)) * self.dtype.itemsize
        check_claim(self.where, claimed, self.stored, self.ratio)
        needed = self.dtype.itemsize
        for size, chunk, wanted in zip(self.shape, self.chunks, part, strict=True):
            needed *= min(-(-wanted // chunk) + 1, -(-size // chunk)) * chunk
        check_memory(self.where, needed)


Arrays = Mapping[str, FileArray]  # by name, or by path within a file; "" is an array without a name


def list_arrays(path: Path) -> tuple[dict[str, FileArray], dict[str, Any]]:
    """Return the arrays of a file or Zarr store by their names or paths, and the attributes of the file.

    Raises SceneError: as the readers of each kind; other errors are those of the libraries.
    """
    ending = path.suffix.lower()
    if path.is_dir():
        return _zarr_arrays(path)
    if ending == ".npy":
        values = load_npy(path)
        each, stored = (1,) * len(values.shape), path.stat().st_size
        return {"": FileArray(str(path), values.shape, values.dtype, {}, values.__getitem__, each, stored)}, {}
    if h5py.is_hdf5(path):
        arrays, attributes = _hdf_arrays(path)
        return (_matlab_order(arrays), {}) if ending == ".mat" else (arrays, attributes)
    if ending == ".mat":
        return as_pictures(_mat_arrays(path)), {}
    with path.open("rb") as file:
        if file.read(len(_CLASSIC)) == _CLASSIC:
            return _classic_arrays(path)
    raise SceneError(f"{path} cannot be read as NetCDF or HDF5: it begins as neither; copy it again")


def load_npy(path: Path) -> FileNumbers:
    """Return the array of a .npy file, which is read part by part."""
    is_there(path)
    mapped = np.load(path, mmap_mode="r", allow_pickle=False)
    return FileNumbers(path, mapped.offset, mapped.shape, mapped.dtype, mapped.strides)


def _whole(
    where: str, shape: tuple[int, ...], kind: np.dtype[Any], load: Callable[[], NDArray[Any]], stored: int, ratio: int
) -> FileArray:
    """Return an array that is always read whole."""
    chunks = tuple(max(size, 1) for size in shape)
    return FileArray(where, shape, kind, {}, lambda part: load()[part], chunks, stored, ratio=ratio)


def _mat_arrays(path: Path) -> dict[str, FileArray]:
    """List the arrays of numbers of a .mat file of versions 4 to 7."""
    scipy_io = importlib.import_module("scipy.io")

    def load(name: str, kind: str) -> NDArray[Any]:
        values = np.asarray(scipy_io.loadmat(BytesIO(path.read_bytes()), variable_names=[name])[name])
        if np.iscomplexobj(values):
            raise SceneError(f"{path}:{name} holds complex numbers, expected real ones; write their absolute values")
        return values.astype(_MATLAB[kind], copy=False)  # whole doubles may be stored as bytes

    listed = scipy_io.whosmat(BytesIO(path.read_bytes()))
    size, most = path.stat().st_size, 8 * DEFLATE_RATIO  # a double may be one byte
    return {
        name: _whole(f"{path}:{name}", shape, np.dtype(_MATLAB[kind]), partial(load, name, kind), size, most)
        for name, shape, kind in listed
        if kind in _MATLAB
    }


def _matlab_order(arrays: Arrays) -> dict[str, FileArray]:
    """Return the arrays of numbers of a .mat file of version 7.3 with the axes in MATLAB's order."""
    numbers = {name: one for name, one in arrays.items() if "/" not in name and one.dtype.kind in "buif"}
    plain = {name: one for name, one in numbers.items() if one.attrs.get("MATLAB_class") != "char"}

    def turned(one: FileArray) -> FileArray:
        return _whole(one.where, one.shape[::-1], one.dtype, lambda: one[...].T, one.stored, one.ratio)

    return as_pictures({name: turned(one) for name, one in plain.items()})


def as_pictures(arrays: dict[str, FileArray]) -> dict[str, FileArray]:
    """Return the arrays with tables (band, pixel) or (pixel, band) as cubes, where nRow and nCol stand beside them.

    Pixels go down the columns, as MATLAB stores them. Arrays of one pixel a band are turned too: labels (1, pixel).
    """
    words = {name.lower().replace("_", ""): one for name, one in arrays.items() if math.prod(one.shape) == 1}
    pair = next((names for names in _SIZES if set(names) <= set(words)), None)
    sides = () if pair is None else tuple(float(words[name][...].item()) for name in pair)
    if not sides or not all(side.is_integer() and side > 0 for side in sides):
        return arrays
    height, width = map(int, sides)

    def turned(table: FileArray) -> FileArray:
        bands_first = table.shape[1] == height * width
        bands = table.shape[0 if bands_first else 1]

        def load() -> NDArray[Any]:
            values = table[...].T if bands_first else table[...]
            return values.reshape(height, width, bands, order="F")

        cube = _whole(table.where, (height, width, bands), table.dtype, load, table.stored, table.ratio)
        order = "(band, pixel)" if bands_first else "(pixel, band)"
        of_sizes = f"{height} x {width} px (y x x), as the sizes beside it say; pixels go down columns"
        return replace(cube, notes=(f"a table {order} of {of_sizes}",))

    tables = {name: one for name, one in arrays.items() if one.ndim == 2 and height * width in one.shape}
    return {**arrays, **{name: turned(one) for name, one in tables.items() if one.shape != (height, width)}}


def _classic_arrays(path: Path) -> tuple[dict[str, FileArray], dict[str, Any]]:
    """List the arrays of a NetCDF file of version 3."""
    import xarray as xr

    opened = partial(xr.open_dataset, path, engine="scipy", decode_cf=False, cache=False)

    def read(name: str, part: Any) -> NDArray[Any]:
        with opened() as file:
            return np.asarray(file.variables[name][part].values)

    def array(name: str, one: xr.Variable) -> FileArray:
        shape, size = one.shape, path.stat().st_size
        get = partial(read, name)
        return FileArray(
            f"{path}:{name}", shape, one.dtype, one.attrs, get, (1,) * one.ndim, size, tuple(map(str, one.dims))
        )

    with opened() as file:
        return {str(name): array(str(name), one) for name, one in file.variables.items()}, dict(file.attrs)


def _hdf_arrays(path: Path) -> tuple[dict[str, FileArray], dict[str, Any]]:
    """List the arrays of an HDF5 file by their paths."""
    arrays: dict[str, FileArray] = {}
    stored = path.stat().st_size

    def read(name: str, part: Any) -> NDArray[Any]:
        with h5py.File(path, "r") as file:
            check_filters(file[name])
            return np.asarray(file[name][part])

    def visit(name: str, item: Any) -> None:
        """Add an array of numbers, a single text such as GDAL's grid mapping, or a list of texts such as band names."""
        if not isinstance(item, h5py.Dataset) or item.external or item.is_virtual or item.shape is None:
            return
        about = _plain(item.attrs)
        is_text = item.dtype.kind in "SO" and item.ndim < 2
        if (item.dtype.kind in "buif" or is_text) and not str(about.get("NAME", "")).startswith(_ONLY_A_DIMENSION):
            dims = tuple(dim[0].name.removeprefix("/") if len(dim) else dim.label for dim in item.dims)
            chunks = item.chunks or (1,) * item.ndim
            named = dims if any(dims) else ()
            where = f"{path}:{name}"
            arrays[name] = FileArray(where, item.shape, item.dtype, about, partial(read, name), chunks, stored, named)

    with h5py.File(path, "r") as file:
        file.visititems(visit)  # follows hard links alone
        if not any(one.ndim > 1 for one in arrays.values()) and (led := outside_links(file)):
            raise SceneError(f"{path}: {led[0]}, which is not followed; copy what it leads to into the file (h5copy)")
        return arrays, _plain(file.attrs)


def _plain(attributes: Any) -> dict[str, Any]:
    """Return the attributes that can be read, texts as str, lists of texts as lists, single numbers without an axis."""
    found = {}
    for name in attributes:
        try:
            value = attributes[name]
        except Exception:  # of a type that h5py does not know
            continue
        if isinstance(value, np.ndarray) and value.size == 1:
            value = value.reshape(-1)[0]
        texts = value.ravel().tolist() if isinstance(value, np.ndarray) and value.dtype.kind in "SO" else [value]
        texts = [one.decode("utf-8", "replace") if isinstance(one, bytes) else one for one in texts]
        found[str(name)] = texts if len(texts) > 1 else texts[0]
    return found


def find_zarr_store(path: Path) -> Path | None:
    """Return the Zarr store at a path, or the ``cube.zarr`` in it."""
    for folder in (path, path / "cube.zarr"):
        if any((folder / name).is_file() for name in METADATA):
            return folder
    return None


def _zarr_arrays(path: Path) -> tuple[dict[str, FileArray], dict[str, Any]]:
    """List the arrays of a store (SceneError: a codec is not allowed, or it is a survey's own)."""
    node = zarr.open(CheckedStore(LocalStore(path, read_only=True)), mode="r")
    if not isinstance(node, zarr.Group):
        return {"": _zarr_array(path, node)}, {}
    if "sweep" in node.attrs:
        raise SceneError(f"{path} holds raw lines of a survey, which are on no map yet; survey them as --sweeps {path}")
    if {"scores", "axes"} <= set(node.array_keys()):
        raise SceneError(
            f"{path} holds components of spectra; `spectralzoom export` writes its reflectance as an image, and "
            "spectralzoom.open(ARCHIVE).latest.cube opens it in Python"
        )
    return {name: _zarr_array(path / name, array) for name, array in node.arrays()}, dict(node.attrs)


def lost_chunks(array: zarr.Array[Any]) -> tuple[int, int]:
    """Return how many chunks, or shards of chunks, have no file, of how many: zarr reads its fill value for them."""
    shard = array.shards or array.chunks
    count = math.prod(-(-size // one) for size, one in zip(array.shape, shard, strict=True))
    return count - array.nchunks_initialized * math.prod(array.chunks) // math.prod(shard), count


def _zarr_array(path: Path, array: zarr.Array[Any]) -> FileArray:
    """Return an array of a store, with its no-data value as CF, xarray or Zarr has it."""
    about = dict(array.attrs)
    named: Any = getattr(array.metadata, "dimension_names", None) or about.pop("_ARRAY_DIMENSIONS", ())
    fill = about.get("_FillValue")
    kind = array.dtype.kind
    if kind == "f" and isinstance(fill, str) and re.fullmatch("[A-Za-z0-9+/]{11}=", fill):  # a double of xarray
        about["_FillValue"] = float(struct.unpack("<d", base64.standard_b64decode(fill))[0])
    elif fill is None and array.metadata.zarr_format == 2 and named and kind in "buif" and array.fill_value is not None:
        about["_FillValue"] = float(array.fill_value)  # xarray's of v2
    held = sum(file.stat().st_size for file in files_below(path))
    lost, count = lost_chunks(array)
    note = f"{path.name}: {lost} of {count} chunks have no file, and are read as {array.fill_value}"
    dims = tuple("" if one is None else str(one) for one in named)
    return FileArray(
        str(path),
        array.shape,
        array.dtype,
        about,
        lambda part: np.asarray(array[part]),
        array.chunks,
        held,
        dims,
        notes=(note,) if lost else (),
    )
