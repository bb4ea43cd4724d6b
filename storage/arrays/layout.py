"""Define the layout of stored arrays: Zarr v3 codecs and chunks, bands, components and scores, CF attributes.

Chunks are 32 x 32 px with all bands, in shards of 64 rows, each with its own crc32c. A patch is one range read, and a
flipped bit is an error instead of a wrong number. An image without bands has one chunk in each shard. Scores of
components have chunks of 64 x 64 px.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, lru_cache, wraps
from itertools import product
from pathlib import Path
from threading import Lock
from typing import Any, Literal, NamedTuple, TypeVar, cast

import numpy as np
import zarr
import zarr.codecs as zarr_codecs
import zarr.storage as zarr_storage
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import IncompleteStoreError
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.pipeline.signal.components import Components
from spectralzoom.pipeline.signal.rounding import whole_steps

CHUNK_PX = 32
SHARD_ROWS = 64
SHARD_COLUMNS = 640
SCORE_CHUNK = 64  # rows and columns of a chunk of scores, with all components
LARGEST_SHORT = 32_000  # of scores and residuals in steps; larger ones are stored in 32 bits
Packing = tuple[Literal["zstd", "lz4"], int]
PACKING: Packing = ("zstd", 3)  # by blosc: codec and level
MAP_PACKING: Packing = ("zstd", 5)  # of maps: a tenth shorter than at level 3; 9 takes forty times as long
RAW_PACKING: Packing = ("lz4", 1)  # of raw lines, which are read once: a fifth of the time of zstd, 11 % longer

# images of a class map, and their value for nodata
NO_CLASS = {"classes": UNLABELLED, "confidence": np.nan}


class SmallArray(NamedTuple):
    """An array that is stored in one chunk, such as a coordinate."""

    dims: tuple[str, ...]
    values: NDArray[Any]
    attributes: dict[str, Any]


def create_group(
    path: Path, title: str, attributes: Mapping[str, Any], coordinates: Mapping[str, SmallArray] | None = None
) -> zarr.Group:
    """Create a Zarr v3 store with its coordinates at ``path``, which must not exist."""
    path.parent.mkdir(parents=True, exist_ok=True)
    group = zarr.create_group(path, zarr_format=3, attributes={"Conventions": "CF-1.12", "title": title, **attributes})
    for name, one in (coordinates or {}).items():
        write_small(group, name, *one)
    return group


@dataclass(frozen=True)
class ArraySpec:
    """Shape of one stored array. ``chunk`` is the unit of reading, ``shard`` the unit of writing and of files."""

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    dtype: str
    chunk: tuple[int, ...]
    shard: tuple[int, ...] | None = None


def image_spec(dims: Sequence[str], shape: Sequence[int], dtype: str, *, whole: bool = False) -> ArraySpec:
    """Return the layout of an image: rows and columns first, all bands in one chunk.

    A shard has 64 rows and at most 640 columns. It is one chunk where it is read as a ``whole``, and in images without
    bands.
    """
    rows, columns, *rest = shape
    chunk = (min(CHUNK_PX, max(rows, 1)), min(CHUNK_PX, max(columns, 1)))
    shard = (_whole_chunks(min(SHARD_ROWS, rows), chunk[0]), _whole_chunks(min(SHARD_COLUMNS, columns), chunk[1]))
    chunk = chunk if rest and not whole else shard
    return ArraySpec(tuple(dims), tuple(shape), dtype, (*chunk, *rest), (*shard, *rest))


def _whole_chunks(size: int, chunk: int) -> int:
    return -(-size // chunk) * chunk


def tile_place(origin: Sequence[int], size: Sequence[int]) -> tuple[slice, slice]:
    """Return the rows and columns of a tile of (y, x) ``size`` at ``origin``."""
    return slice(origin[0], origin[0] + size[0]), slice(origin[1], origin[1] + size[1])


_zarr_type = cache(lambda kind: zarr.dtype.parse_dtype(kind, zarr_format=3))  # Zarr tries one type after the other


def create_array(
    group: zarr.Group,
    name: str,
    spec: ArraySpec,
    attributes: Mapping[str, Any],
    *,
    packing: Packing = PACKING,
    flat: bool = False,
) -> zarr.Array[Any]:
    """Add an empty array, filled with NaN where floating, else with ``_FillValue``, ``nodata`` or 0.

    ``packing`` is blosc's codec and its level. Most pixels of a ``flat`` image, such as a map, equal their neighbours.
    Its bytes are packed channel after channel, and its files lie in one folder.
    """
    kind = np.dtype(spec.dtype)
    codec, level = packing
    shuffle = zarr_codecs.BloscShuffle.shuffle if flat else zarr_codecs.BloscShuffle.bitshuffle
    fill: Any = np.nan if kind.kind == "f" else attributes.get("_FillValue", attributes.get("nodata", 0))
    return group.create_array(
        name,
        shape=spec.shape,
        dtype=_zarr_type(kind),
        chunks=tuple(max(size, 1) for size in spec.chunk),
        shards=None if spec.shard is None else tuple(max(size, 1) for size in spec.shard),
        fill_value=bool(fill) if kind.kind == "b" else fill,
        dimension_names=spec.dims,
        attributes=dict(attributes),
        filters=(zarr_codecs.TransposeCodec(order=(2, 0, 1)),) if flat and len(spec.shape) == 3 else None,
        compressors=(
            zarr_codecs.BloscCodec(cname=codec, clevel=level, shuffle=shuffle, typesize=kind.itemsize),
            zarr_codecs.Crc32cCodec(),
        ),
        chunk_key_encoding={"name": "default", "separator": "." if flat else "/"},
        config={"write_empty_chunks": packing == RAW_PACKING},  # spares a comparison of every number with the fill
    )


def write_small(
    group: zarr.Group, name: str, dims: Sequence[str], values: NDArray[Any], attributes: Mapping[str, Any]
) -> None:
    """Store a small array in one chunk."""
    array = create_array(group, name, ArraySpec(tuple(dims), values.shape, values.dtype.str, values.shape), attributes)
    if values.size:
        array[...] = values


def write_counts(group: zarr.Group, **sizes: int) -> None:
    """Store coordinates that count along axes from 0, by the axes' names."""
    for name, size in sizes.items():
        about = {"long_name": f"number of the {name.replace('_', ' ')}, from 0", "units": "1"}
        write_small(group, name, (name,), np.arange(size), about)


def write_image(
    group: zarr.Group, name: str, dims: Sequence[str], values: NDArray[Any], attributes: Mapping[str, Any]
) -> None:
    """Store an image or cube, rows and columns first."""
    create_array(group, name, image_spec(dims, values.shape, values.dtype.str), attributes)[...] = values


def write_bands(group: zarr.Group, wavelength_nm: NDArray[np.float64], fwhm_nm: NDArray[np.float64] | None) -> str:
    """Store the coordinates of ``band`` and return their names for a ``coordinates`` attribute."""
    centre = np.asarray(wavelength_nm, np.float64)
    about = {"standard_name": "radiation_wavelength", "long_name": "wavelength at the band's centre", "units": "nm"}
    write_small(group, "wavelength", ("band",), centre, about)
    # the same under the axis's own name: xarray makes an index of it, so that .sel(band=660, method="nearest") works
    write_small(group, "band", ("band",), centre, about)
    if fwhm_nm is None:
        return "wavelength"
    write_small(
        group, "fwhm", ("band",), np.asarray(fwhm_nm), {"long_name": "full width at half maximum", "units": "nm"}
    )
    return "wavelength fwhm"


def integers_for(largest: float) -> str:
    """Return the type of scores or residuals of at most ``largest`` steps."""
    return "<i2" if largest <= LARGEST_SHORT else "<i4"


def score_spec(dims: tuple[str, str, str], shape: tuple[int, int, int], largest: float) -> ArraySpec:
    """Return the layout of scores (component, row, column) of at most ``largest`` steps."""
    count, rows, columns = shape
    chunk = (max(count, 1), min(SCORE_CHUNK, max(rows, 1)), min(SCORE_CHUNK, max(columns, 1)))
    shard = (_whole_chunks(min(rows, SHARD_ROWS), chunk[1]), _whole_chunks(min(columns, SHARD_COLUMNS), chunk[2]))
    return ArraySpec(dims, shape, integers_for(largest), chunk, (chunk[0], *shard))


def steps_within(scores: NDArray[np.floating], step: float, kind: np.dtype[Any]) -> NDArray[np.floating]:
    """Return scores in whole steps, clipped to the range of an integer type."""
    most = np.iinfo(kind).max & ~127  # a float32
    return np.asarray(np.clip(whole_steps(scores, step), -most, most))


def write_components(group: zarr.Group, components: Components) -> None:
    """Store the components that restore spectra."""
    rows = components.axes * np.nan_to_num(components.noise)
    arrays: dict[str, tuple[tuple[str, ...], NDArray[Any], str]] = {
        "axes": (("component", "band"), rows, "scene value of a score of 1"),
        "mean": (("band",), components.mean, "mean scene value"),
        "noise": (("band",), components.noise, "standard deviation of one spectrum's noise"),
    }
    for name, (dims, values, title) in arrays.items():
        write_small(group, name, dims, values, {"long_name": title, "coordinates": "wavelength", "units": "1"})
    if components.spread is not None:
        spread = {"long_name": "mean square of the scores of the field", "units": "1"}
        write_small(group, "spread", ("component",), components.spread, spread)


def read_components(group: zarr.Group) -> Components:
    """Read what `write_components` stored."""
    rows, mean, noise = (read_array(group, name).astype(np.float64) for name in ("axes", "mean", "noise"))
    lit = np.isfinite(noise)
    axes = np.where(lit, rows / np.where(lit, noise, 1), 0) if len(rows) else rows
    return Components(mean, axes, noise, spread=read_array(group, "spread") if "spread" in group else None)


def step_of(group: zarr.Group, attribute: str = "scale_factor") -> float:
    """Return the step of a store's scores, or another numeric attribute (IncompleteStoreError: damaged)."""
    with damage_named(str(group.store_path)):
        return float(array_of(group, "scores").attrs[attribute])  # type: ignore[arg-type]


_FILTERING = Lock()


def consolidate_stores(folder: Path) -> None:
    """Consolidate the metadata of each store in a folder; afterwards the stores' attributes may not change."""
    for path in sorted(folder.glob("*.zarr")):
        if (path / "zarr.json").is_file():
            with _FILTERING, warnings.catch_warnings():  # filters are of the process, not of a thread
                warnings.filterwarnings("ignore", "Consolidated metadata is currently not part")  # zarr's, of its v3
                zarr.consolidate_metadata(path)


def open_group(path: Path, mode: Literal["r", "r+"] = "r") -> zarr.Group:
    """Open a store (IncompleteStoreError: there is none, or its metadata is damaged)."""
    with damage_named(str(path)):
        return zarr.open_group(path, mode=mode, zarr_format=3, use_consolidated=False)


Opener = TypeVar("Opener", bound=Callable[[Any], Any])


def opened_once(open_store: Opener) -> Opener:
    """Decorate a function that opens a store: the result is kept while the metadata of the store stay as they are.

    Published stores never change, and opening one reads a dozen arrays. Stores in memory are opened each time.
    """
    kept = lru_cache(16)(lambda path, *stamp: open_store(path))

    @wraps(open_store)
    def open_if_changed(path: Path) -> Any:
        if not (file := path / "zarr.json").is_file():
            return open_store(path)
        return kept(path, file.stat().st_ino, file.stat().st_mtime_ns)

    return cast(Opener, open_if_changed)


def array_of(group: zarr.Group, name: str) -> zarr.Array[Any]:
    """Return one array of a store, unread (IncompleteStoreError: there is none)."""
    with damage_named(f"{group.store_path}/{name}"):
        array = group[name]
        if not isinstance(array, zarr.Array):
            raise KeyError(f"{name} is no array")
        return array


def read_array(group: zarr.Group, name: str, selection: Any = ...) -> NDArray[Any]:
    """Read (part of) one array.

    Raises IncompleteStoreError: there is no such array, or a checksum says that its bytes have changed.
    """
    with damage_named(f"{group.store_path}/{name}"):
        return np.asarray(array_of(group, name)[selection])


def read_bands(group: zarr.Group) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Return the wavelengths and widths [nm] of a store."""
    return read_array(group, "wavelength"), read_array(group, "fwhm") if "fwhm" in group else None


@contextmanager
def damage_named(where: str) -> Iterator[None]:
    """Turn the errors of decoders on damaged bytes into an IncompleteStoreError that names the array."""
    try:
        yield
    except (OSError, ValueError, KeyError, TypeError, RuntimeError, IndexError) as error:
        raise IncompleteStoreError(f"{where} cannot be read: {error}; run verify on the archive") from error


def packed_size(values: NDArray[Any]) -> int:
    """Return the bytes of integers (line, sample, band), packed in chunks as those of raw lines."""
    held: dict[str, Any] = {}
    spec = image_spec(("line", "sample", "band"), values.shape, values.dtype.str)
    array = create_array(zarr.create_group(zarr_storage.MemoryStore(store_dict=held), zarr_format=3), "dn", spec, {})
    array[...] = values
    return sum(len(part) for key, part in held.items() if not key.endswith("zarr.json"))


def blank_pixels(path: Path, where: NDArray[np.bool_], images: Mapping[str, float]) -> None:
    """Set the (y, x) pixels ``where`` of a store's images to their nodata value, one shard at a time.

    Raises IncompleteStoreError: an image is missing or damaged.
    """
    group = open_group(path, "r+")
    for name in images:
        array = array_of(group, name)
        cubes = array.ndim - 2 if array.metadata.dimension_names[-1] == "x" else 0  # type: ignore[union-attr, index]
        sizes = (array.shards or array.chunks)[cubes : cubes + 2]
        for top, left in product(*(range(0, size, step) for size, step in zip(where.shape, sizes, strict=True))):
            here = np.s_[top : top + sizes[0], left : left + sizes[1]]
            if (gaps := where[here]).any():
                place = (slice(None),) * cubes + here
                values = read_array(group, name, place).copy()
                values[(slice(None),) * cubes + (gaps,)] = images[name]
                array[place] = values
