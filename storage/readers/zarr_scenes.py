"""Cubes out of Zarr stores: those of this project, and arrays of anyone with dims y x and band, or band y x.

What a store says of itself is judged before it is opened: codecs that only carry numbers, and sizes that fit what lies
on the disk. A codec of another name (``pickle`` is one) is refused, so that reading data never runs what it brings.

Codecs take the memory that a chunk says it unpacks to: that is judged before one is unpacked. Chunks of blosc and zstd
say it at their beginning, and are looked at in files and in shards whose index is plain. gzip and zlib are bounded by
their own ratio. bz2 and lzma say nothing and are bounded by nothing.
"""

from __future__ import annotations

import base64
import json
import math
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import zarr
from numcodecs.errors import UnknownCodecError  # type: ignore[import-untyped]
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.rig.camera.camera_texts import MICROMETRES, NANOMETRES, UNSAID
from storage.arrays.layout import missing_codec
from storage.readers.cube_sources import (
    BLOCK_LINES,
    DEFLATE_RATIO,
    MOST_RATIO,
    Bands,
    CubeSource,
    LineFacts,
    ReadLines,
    check_memory,
)

ROWS = ("y", "line", "lines", "row", "rows", "lat", "latitude", "northing")
COLUMNS = ("x", "sample", "samples", "column", "columns", "col", "lon", "longitude", "easting")
BANDS = ("band", "bands", "wavelength", "wavelengths", "channel", "channels", "spectral")
WAVELENGTHS = ("wavelength", "wavelengths", "radiation_wavelength")
METRES = {"m", "meter", "meters", "metre", "metres"}
FRAMES = ("dark", "white", "panel", "bad", "flat")
OF_LINES = ("mirror_x", "mirror_y", "valid_line", "time", "exposure_ms", "frame")
METADATA = ("zarr.json", ".zarray", ".zgroup")
LARGEST_METADATA = 1 << 24  # bytes
LOOK = 18  # bytes: the longest beginning of a chunk
SLACK = 64  # bytes that filters and checksums add to a chunk
CHECKSUMS = {"crc32", "crc32c", "adler32", "fletcher32", "jenkins_lookup3"}
_PACKERS = {"blosc", "zstd", "gzip", "zlib", "bz2", "lzma", "lz4", "pcodec", "zfpy", "packbits"}
_ORDERS = {"bytes", "transpose", "sharding_indexed", "shuffle"}
_NUMBERS = {"delta", "fixedscaleoffset", "quantize", "bitround", "astype", "cast_value", "scale_offset"}
CODECS = CHECKSUMS | _PACKERS | _ORDERS | _NUMBERS
_ZSTD = b"\x28\xb5\x2f\xfd"
_NOWHERE = (1 << 64) - 1  # in a shard's index: there is no such chunk


def find_zarr_store(path: Path) -> Path | None:
    """The Zarr store at a path, or the ``cube.zarr`` in it; None where there is neither."""
    for folder in (path, path / "cube.zarr"):
        if any((folder / name).is_file() for name in METADATA):
            return folder
    return None


def open_zarr_cube(path: Path, variable: str | None = None) -> CubeSource:
    """Open one array of a store as a cube.

    Of this project: raw cubes (with their references), ingested cubes, mosaics. Of anyone's: the only array with three
    axes of numbers, or the one named; wavelengths come from a coordinate of that name, or of the band axis with a unit.
    Raises SceneError: the store is damaged, holds no such array, has dims that are not known, a codec that is not
    allowed, or claims to hold far more than lies on the disk.
    """
    with _named(path):
        _check_links(path)
        _check_metadata(path)
        node = zarr.open(path, mode="r", **_open_options(path))
        group = node if isinstance(node, zarr.Group) else None
        arrays: dict[str, Any] = dict(node.arrays()) if isinstance(node, zarr.Group) else {"": node}
        name = _chosen(arrays, variable, path)
        array = arrays[name]
        for used in [name, *sorted({"fwhm", *FRAMES, *OF_LINES, *WAVELENGTHS, *_dims(array)} & set(arrays) - {name})]:
            _check_size(arrays[used], path, used)
            _check_packing(arrays[used], path, used)
        order, notes = _axes(array, path)
        _check_blocks(array, path, [BLOCK_LINES if axis == order[0] else size for axis, size in enumerate(array.shape)])
        attributes = {} if group is None else dict(group.attrs)
        return _source(path, array, order, arrays, attributes, notes)


@contextmanager
def _named(path: Path) -> Iterator[None]:
    try:
        yield
    except SceneError:
        raise
    except UnknownCodecError as error:
        raise SceneError(missing_codec(str(path), error.codec_id)) from error
    except Exception as error:  # codecs and parsers raise anything at all on damaged bytes
        raise SceneError(f"{path} cannot be read as Zarr: {type(error).__name__}: {error}; is it damaged?") from error


def _chosen(arrays: Mapping[str, zarr.Array[Any]], variable: str | None, path: Path) -> str:
    listing = ", ".join(f"{name} {array.shape}" for name, array in arrays.items()) or "none"
    if variable is not None:
        if variable not in arrays:
            raise SceneError(f"{path} has no array {variable}; it has {listing}")
        return variable
    cubes = [name for name, array in arrays.items() if array.ndim == 3 and array.dtype.kind in "buif"]
    own = [name for name in ("dn", "values") if name in cubes]
    if own or len(cubes) == 1:
        return (own or cubes)[0]
    if cubes:
        raise SceneError(f"{path} has several arrays with three axes; it has {listing}; name one: {path.name}:ARRAY")
    if list(arrays) == [""]:
        return ""
    raise SceneError(f"{path} has no array of numbers with the axes y, x and band; it has {listing}")


def _axes(array: zarr.Array[Any], path: Path) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """Which axes of the array are rows, columns and (where there are some) bands; and notes."""
    named = _dims(array)
    if array.ndim not in (2, 3):
        raise SceneError(f"{path} holds shape {array.shape}; expected y, x and band; store one time or level")
    if not any(named):
        return tuple(range(array.ndim)), ("dims have no names, read as y, x, band",)
    words = [name.lower() for name in named]
    found = [[at for at, word in enumerate(words) if word in known] for known in (ROWS, COLUMNS, BANDS)]
    if any(len(places) != 1 for places in found[: array.ndim]) or (array.ndim == 2 and found[2]):
        raise SceneError(f"{path} has dims {', '.join(named)}; expected y, x, band (or band, y, x); rename them")
    return tuple(places[0] for places in found[: array.ndim]), ()


def _dims(array: zarr.Array[Any]) -> list[str]:
    """Names of the axes as v3 or xarray's v2 keeps them; empty where there are none."""
    named = getattr(array.metadata, "dimension_names", None) or array.attrs.get("_ARRAY_DIMENSIONS")
    return ["" if name is None else str(name) for name in named] if isinstance(named, list | tuple) else []


def _source(
    path: Path,
    array: zarr.Array[Any],
    order: tuple[int, ...],
    arrays: Mapping[str, Any],
    attributes: dict[str, Any],
    notes: tuple[str, ...],
) -> CubeSource:
    lines, samples, bands = tuple(array.shape[axis] for axis in order) + ((1,) if len(order) == 2 else ())
    own = "sweep" in attributes or attributes.get("kind") == "ingested cube"
    known = arrays if own else {}
    frame = (samples, bands)
    bad, valid = _small(known, "bad", frame), _column(known, "valid_line", lines)
    by_mirror = attributes.get("by_mirror") is True
    x, y = (_small(arrays, f"mirror_{axis}", (lines,)) if by_mirror else None for axis in "xy")
    position = None if x is None or y is None else np.stack([x, y], axis=-1).astype(np.float64)
    read, kind, fill = _reader(path, array, order)
    void = attributes.get("nodata") if own else None
    return CubeSource(
        name=path.name,
        shape=(lines, samples, bands),
        dtype=kind,
        read=read,
        files=tuple(sorted(file for file in path.rglob("*") if file.is_file())),
        lines=LineFacts(
            np.ones(lines, np.bool_) if valid is None else valid.astype(np.bool_),
            _column(known, "time", lines),
            _column(known, "exposure_ms", lines),
            _column(known, "frame", lines),
        ),
        bands=_bands(arrays, array, order, bands),
        dark=_small(known, "dark", frame),
        white=_small(known, "white", frame),
        panel=_small(known, "panel", (bands,)),
        bad=None if bad is None else bad.astype(np.bool_),
        flat=_small(known, "flat", frame),
        position=position,
        nodata=void if void is not None else fill,
        root=path,
        notes=notes,
    )


def _reader(
    path: Path, array: zarr.Array[Any], order: tuple[int, ...]
) -> tuple[ReadLines, np.dtype[Any], float | None]:
    """What reads lines, unpacked by CF's scale and offset, its type, and the number that stands for none yet."""

    def real(value: object) -> float | None:
        return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None

    scale, offset = real(array.attrs.get("scale_factor")), real(array.attrs.get("add_offset"))
    scale, offset = 1.0 if scale is None else scale, 0.0 if offset is None else offset
    stated = array.attrs.get("_FillValue", array.attrs.get("missing_value"))  # wherever xarray has put it
    fill = real(stated)
    if isinstance(stated, str) and array.dtype.kind == "f":  # floats of v3 in base64
        (fill,) = struct.unpack("<d", base64.standard_b64decode(stated))
    elif stated is None and array.dtype.kind in "buif" and array.fill_value is not None:
        fill = float(array.fill_value) if "_ARRAY_DIMENSIONS" in array.attrs else None  # all of v2
    plain = scale == 1.0 and offset == 0.0

    def read(start: int, stop: int) -> NDArray[Any]:
        selection = tuple(slice(start, stop) if axis == order[0] else slice(None) for axis in range(array.ndim))
        with _named(path):
            block = np.transpose(np.asarray(array[selection]), order)
        native = np.ascontiguousarray(block, block.dtype.newbyteorder("="))
        if native.ndim == 2:
            native = native[..., None]
        if plain:
            return native
        values = (native * scale + offset).astype(np.float32)
        if fill is not None:
            values[native == fill] = np.nan
        return values

    return read, np.dtype(array.dtype.newbyteorder("=") if plain else np.float32), fill if plain else None


def _column(arrays: Mapping[str, Any], name: str, lines: int) -> NDArray[Any] | None:
    return np.asarray(arrays[name][...]) if name in arrays and arrays[name].shape == (lines,) else None


def _small(arrays: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> NDArray[np.float32] | None:
    if name not in arrays or arrays[name].shape != shape:
        return None
    return np.asarray(arrays[name][...], np.float32)


def _bands(arrays: Mapping[str, Any], array: zarr.Array[Any], order: tuple[int, ...], count: int) -> Bands:
    """Wavelengths and widths of the coordinates that say them, in nm; none in another unit than one of length."""
    named = _dims(array)
    axis = named[order[2]] if len(order) == 3 and len(named) == 3 else ""
    found = next((name for name in WAVELENGTHS if _is_line(arrays, name, count)), None)
    if found is None and _is_line(arrays, axis, count):
        about = arrays[axis].attrs
        known = about.get("standard_name") in WAVELENGTHS or _unit(about) in NANOMETRES | MICROMETRES
        found = axis if known else None
    if found is None:
        return Bands()
    centres = np.asarray(arrays[found][...], np.float64)
    unit = _unit(arrays[found].attrs)
    scale = _scale(unit, float(centres.max()))
    if scale is None or not (np.isfinite(centres) & (centres > 0)).all():
        return Bands(units=unit)
    said = f"in {unit}" if unit not in UNSAID else "without a unit, read by their size"
    widths = np.asarray(arrays["fwhm"][...], np.float64) if _is_line(arrays, "fwhm", count) else None
    if widths is not None:
        own = _unit(arrays["fwhm"].attrs)
        widths = widths * (scale if own in UNSAID else _scale(own, 0.0) or np.nan)
        widths = widths if (widths > 0).all() else None
    return Bands(centres * scale, widths, unit, f"wavelengths from the array {found}, {said}")


def _scale(unit: str, largest: float) -> float | None:
    """What one of the unit is in nm; where none is said, micrometres or nm by the size; None of other units."""
    if unit in UNSAID:
        return 1000.0 if largest <= 20 else 1.0
    return 1.0 if unit in NANOMETRES else 1000.0 if unit in MICROMETRES else 1e9 if unit in METRES else None


def _is_line(arrays: Mapping[str, Any], name: str, count: int) -> bool:
    return name in arrays and arrays[name].shape == (count,) and arrays[name].dtype.kind in "uif"


def _unit(attributes: Mapping[str, Any]) -> str:
    return str(attributes.get("units", attributes.get("unit", ""))).strip().lower()


# --- what a store says of itself --------------------------------------------------------------------------------------


def _check_metadata(path: Path) -> None:
    """Refuse codecs that do not just carry numbers, in the store and its members (SceneError)."""
    for folder in (path, *(entry for entry in sorted(path.iterdir()) if entry.is_dir())):
        for file in (folder / "zarr.json", folder / ".zarray"):
            for codec in _codecs(_read_json(file)) if file.is_file() else ():
                if codec.lower().removeprefix("numcodecs.") not in CODECS:
                    raise SceneError(
                        f"{file} asks for the codec {codec!r}, which is not read; store plain numbers with blosc, zstd "
                        "or gzip"
                    )


def _read_json(path: Path) -> dict[str, Any]:
    if path.stat().st_size > LARGEST_METADATA:
        raise SceneError(f"{path} has {path.stat().st_size} bytes, too many for metadata")
    content = json.loads(path.read_bytes())
    if not isinstance(content, dict):
        raise SceneError(f"{path} holds no table")
    return content


def _codecs(content: object) -> Iterator[str]:
    """Names of all codecs in an array's metadata, those within others too."""
    if isinstance(content, dict):
        for key in ("codecs", "index_codecs", "filters", "compressor", "compressors"):
            listed = content.get(key) or []
            for codec in listed if isinstance(listed, list) else [listed]:
                yield str(codec.get("name", codec.get("id"))) if isinstance(codec, dict) else str(codec)
                yield from _codecs(codec.get("configuration") if isinstance(codec, dict) else None)


def _check_links(path: Path) -> None:
    """Refuse what leads out of the store, or is neither file nor folder (SceneError): reading it may never end."""
    home = path.resolve()
    for place, folders, files in os.walk(path):
        for name in (*folders, *files):
            entry = Path(place, name)
            if entry.is_symlink() and not entry.resolve().is_relative_to(home):
                raise SceneError(f"{entry} is a link out of the store, which is not followed; copy what it leads to")
        odd = next((name for name in files if not Path(place, name).is_file()), None)
        if odd is not None:
            raise SceneError(f"{Path(place, odd)} is no file; take it out of the store")


def _check_size(array: zarr.Array[Any], path: Path, name: str) -> None:
    """Refuse an array that claims more than its bytes can mean, before any of it is asked for (SceneError)."""
    folder = path / name
    stored = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    claimed, chunk = (array.dtype.itemsize * math.prod(sizes) for sizes in (array.shape, array.chunks))
    if max(claimed, chunk) > max(stored, 1) * MOST_RATIO:
        raise SceneError(
            f"{folder} claims {array.shape} of {array.dtype} in chunks of {array.chunks}, and {stored} bytes lie on "
            "the disk; copy it again"
        )


def _check_blocks(array: zarr.Array[Any], path: Path, parts: Sequence[int]) -> None:
    """Refuse an array of which ``parts`` of each axis, in whole chunks, do not fit the memory (SceneError)."""
    numbers = 1
    for size, chunk, part in zip(array.shape, array.chunks, parts, strict=True):
        numbers *= min(-(-part // chunk) + 1, -(-size // chunk)) * chunk
    check_memory(path, numbers * array.dtype.itemsize)


def _open_options(path: Path) -> dict[str, Any]:
    """Options to open a store with: groups are read from their members, whose metadata alone were judged."""
    is_group = (path / ".zgroup").is_file() or (
        (path / "zarr.json").is_file() and _read_json(path / "zarr.json").get("node_type") == "group"
    )
    return {"use_consolidated": False} if is_group else {}


def _check_packing(array: zarr.Array[Any], path: Path, name: str) -> None:
    """Refuse an array with a chunk that would unpack to more than a chunk's numbers (SceneError)."""
    folder, shape = path / name, array.chunks
    about = _read_json(next(file for file in (folder / "zarr.json", folder / ".zarray") if file.is_file()))
    allowed = math.prod(shape) * array.dtype.itemsize + SLACK
    of_v2 = [codec for codec in (*(about.get("filters") or []), about.get("compressor")) if codec]
    codecs = about["codecs"] or [] if "codecs" in about else of_v2
    sharding = next((codec for codec in codecs if _codec_name(codec) == "sharding_indexed"), None)
    inner = codecs if sharding is None else sharding.get("configuration", {}).get("codecs", [])
    packer = next((_codec_name(codec) for codec in reversed(inner) if _codec_name(codec) not in CHECKSUMS), "")
    for file in sorted(folder.rglob("*")):
        if file.name in ("zarr.json", ".zarray", ".zattrs", ".zgroup", ".zmetadata") or not file.is_file():
            continue
        if packer in ("gzip", "zlib") and sharding is None:
            check_memory(file, file.stat().st_size * DEFLATE_RATIO)
        elif packer in ("blosc", "zstd"):
            with file.open("rb") as stream:
                for place in [0] if sharding is None else _places(stream, sharding, about, shape):
                    stream.seek(place)
                    said = _unpacked_size(stream.read(LOOK), packer)
                    if said is not None and said > allowed:
                        raise SceneError(
                            f"{file} would unpack to {said} bytes, a chunk has {allowed - SLACK}; it is damaged"
                        )


def _codec_name(codec: object) -> str:
    found = codec.get("name", codec.get("id", "")) if isinstance(codec, Mapping) else codec
    return str(found).lower().removeprefix("numcodecs.")


def _unpacked_size(head: bytes, packer: str) -> int | None:
    """Bytes that a chunk says it unpacks to; None where it says nothing."""
    if packer == "blosc":
        return int(struct.unpack("<I", head[4:8])[0]) if len(head) >= 8 else None
    if len(head) < 6 or head[:4] != _ZSTD:
        return None
    flags = head[4]
    single = bool(flags & 0x20)
    width = (1 if single else 0, 2, 4, 8)[flags >> 6]
    start = 5 + (not single) + (0, 1, 2, 4)[flags & 3]
    if width == 0 or len(head) < start + width:
        return None
    return int.from_bytes(head[start : start + width], "little") + (256 if width == 2 else 0)


def _places(
    stream: BinaryIO, sharding: Mapping[str, Any], about: Mapping[str, Any], shape: Sequence[int]
) -> Iterator[int]:
    """Where the chunks of a shard begin, by its index; none where that is packed itself."""
    setting = sharding.get("configuration", {})
    names = [_codec_name(codec) for codec in setting.get("index_codecs", [])]
    if names not in (["bytes"], ["bytes", "crc32c"]) or setting.get("index_location", "end") != "end":
        return
    outer = about["chunk_grid"]["configuration"]["chunk_shape"]
    count = math.prod(large // small for large, small in zip(outer, shape, strict=True))
    end = stream.seek(0, 2)
    begin = end - 16 * count - (4 if "crc32c" in names else 0)
    if begin < 0:
        raise SceneError(f"{stream.name} is shorter than its index; it is cut off")
    stream.seek(begin)
    index = stream.read(16 * count)
    for offset, _ in struct.iter_unpack("<QQ", index):
        if offset != _NOWHERE and offset < end:
            yield offset
