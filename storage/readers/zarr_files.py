"""Cubes out of Zarr stores: those of this project, and arrays of anyone with dims y x and band, or band y x.

A store is checked before it is opened: links may not lead out of it, and its codecs may only carry numbers. A codec of
another name (``pickle`` is one) is refused, so that reading data never runs what it brings.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numcodecs.errors import UnknownCodecError  # type: ignore[import-untyped]
from numpy.typing import NDArray

from pipeline.errors import SceneError
from storage.arrays.layout import missing_codec
from storage.readers.array_cubes import cube_source, dims_of, find_cube, names_beside
from storage.readers.cube_sources import BLOCK_LINES, MOST_RATIO, CubeSource, LineFacts, check_memory

FRAMES = ("dark", "white", "white_reference", "bad", "flat")
OF_LINES = ("mirror_x", "mirror_y", "valid_line", "time", "exposure_ms", "frame")
METADATA = ("zarr.json", ".zarray", ".zgroup")
LARGEST_METADATA = 1 << 24  # bytes
_CHECKSUMS = {"crc32", "crc32c", "adler32", "fletcher32", "jenkins_lookup3"}
_PACKERS = {"blosc", "zstd", "gzip", "zlib", "bz2", "lzma", "lz4", "pcodec", "zfpy", "packbits"}
_ORDERS = {"bytes", "transpose", "sharding_indexed", "shuffle"}
_NUMBERS = {"delta", "fixedscaleoffset", "quantize", "bitround", "astype", "cast_value", "scale_offset"}
CODECS = _CHECKSUMS | _PACKERS | _ORDERS | _NUMBERS


def find_zarr_store(path: Path) -> Path | None:
    """Return the Zarr store at a path, or the ``cube.zarr`` in it; None where there is neither."""
    for folder in (path, path / "cube.zarr"):
        if any((folder / name).is_file() for name in METADATA):
            return folder
    return None


def open_zarr_cube(path: Path, variable: str | None = None) -> CubeSource:
    """Open one array of a store, or of the ``cube.zarr`` in a folder, as a cube.

    Of this project: raw cubes (with their references), ingested cubes, mosaics. Of anyone's: the only array with three
    axes of numbers, or the one named, at the step of time named (``values:3`` or ``3``); wavelengths come from a
    coordinate of that name, or of the band axis with a unit.
    Raises SceneError: the store is damaged, holds no such array, has dims that are not known, a codec that is not
    allowed, or claims to hold far more than lies on the disk.
    """
    path = find_zarr_store(path) or path
    with _named(path):
        _check_store(path)
        # a group is read from its members: only their metadata were checked
        is_group = (path / ".zgroup").is_file() or (
            (path / "zarr.json").is_file() and _read_json(path / "zarr.json").get("node_type") == "group"
        )
        options: dict[str, Any] = {"use_consolidated": False} if is_group else {}
        node = zarr.open(path, mode="r", **options)
        attributes = dict(node.attrs) if isinstance(node, zarr.Group) else {}
        arrays: dict[str, Any] = dict(node.arrays()) if isinstance(node, zarr.Group) else {"": node}
        cube = find_cube(arrays, variable, path)
        for used in {cube.name, *names_beside(arrays), *({*FRAMES, *OF_LINES, *dims_of(cube.array)} & set(arrays))}:
            _check_size(arrays[used], path / used)
        parts = [BLOCK_LINES if axis == cube.order[0] else size for axis, size in enumerate(cube.array.shape)]
        if cube.moment is not None:
            parts[cube.moment[0]] = 1
        numbers = 1
        for size, chunk, part in zip(cube.array.shape, cube.array.chunks, parts, strict=True):
            numbers *= min(-(-part // chunk) + 1, -(-size // chunk)) * chunk
        check_memory(path, numbers * cube.array.dtype.itemsize)
        source = cube_source(path, cube, arrays, {**attributes, **dict(cube.array.attrs)}, lambda: _named(path))
        source = replace(source, root=path, files=tuple(sorted(file for file in path.rglob("*") if file.is_file())))
        own = "sweep" in attributes or attributes.get("kind") == "ingested cube"
        return _with_own(source, arrays, attributes) if own else source


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


def _with_own(source: CubeSource, arrays: dict[str, Any], attributes: dict[str, Any]) -> CubeSource:
    """Add what stores of this project say of lines, reference frames and bad bands."""
    lines, samples, bands = source.shape

    def column(name: str) -> NDArray[Any] | None:
        return np.asarray(arrays[name][...]) if name in arrays and arrays[name].shape == (lines,) else None

    def frame(name: str, *shape: int) -> NDArray[np.float32] | None:
        known = name in arrays and arrays[name].shape == shape
        return np.asarray(arrays[name][...], np.float32) if known else None

    bad, valid = frame("bad", samples, bands), column("valid_line")
    x, y = (frame(f"mirror_{axis}", lines) if attributes.get("by_mirror") is True else None for axis in "xy")
    return replace(
        source,
        lines=LineFacts(
            None if valid is None else valid.astype(np.bool_), column("time"), column("exposure_ms"), column("frame")
        ),
        dark=frame("dark", samples, bands),
        white=frame("white", samples, bands),
        white_reference=frame("white_reference", bands),
        bad=None if bad is None else bad.astype(np.bool_),
        flat=frame("flat", samples, bands),
        position=None if x is None or y is None else np.stack([x, y], axis=-1).astype(np.float64),
        nodata=attributes.get("nodata", source.nodata),
        bad_bands=tuple(int(band) for band in attributes.get("bad_bands", ())),
    )


def _check_store(path: Path) -> None:
    """Refuse links out of the store, entries that are neither file nor folder, and codecs not known (SceneError)."""
    home = path.resolve()
    for place, folders, files in os.walk(path):
        for entry in (Path(place, name) for name in (*folders, *files)):
            if entry.is_symlink() and not entry.resolve().is_relative_to(home):
                raise SceneError(f"{entry} is a link out of the store, which is not followed; copy what it leads to")
            if entry.name in files and not entry.is_file():  # reading a pipe may never end
                raise SceneError(f"{entry} is no file; take it out of the store")
    for folder in (path, *(entry for entry in sorted(path.iterdir()) if entry.is_dir())):
        for file in (folder / "zarr.json", folder / ".zarray"):
            for codec in _codecs(_read_json(file)) if file.is_file() else ():
                if codec.lower().removeprefix("numcodecs.") not in CODECS:
                    raise SceneError(
                        f"{file} asks for the codec {codec!r}, which is not read; store plain numbers with blosc, zstd "
                        "or gzip"
                    )


def _read_json(path: Path) -> Mapping[str, Any]:
    if path.stat().st_size > LARGEST_METADATA:
        raise SceneError(f"{path} has {path.stat().st_size} bytes, too many for metadata; copy the store again")
    content = json.loads(path.read_bytes())
    if not isinstance(content, dict):
        raise SceneError(f"{path} holds no table; copy the store again")
    return content


def _codecs(content: object) -> Iterator[str]:
    """Give names of all codecs in an array's metadata, those within others too."""
    if isinstance(content, dict):
        for key in ("codecs", "index_codecs", "filters", "compressor", "compressors"):
            listed = content.get(key) or []
            for codec in listed if isinstance(listed, list) else [listed]:
                yield str(codec.get("name", codec.get("id"))) if isinstance(codec, dict) else str(codec)
                yield from _codecs(codec.get("configuration") if isinstance(codec, dict) else None)


def _check_size(array: zarr.Array[Any], folder: Path) -> None:
    """Refuse an array that claims more than its bytes can mean, before any of it is asked for (SceneError)."""
    stored = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    claimed, chunk = (array.dtype.itemsize * math.prod(sizes) for sizes in (array.shape, array.chunks))
    if max(claimed, chunk) > max(stored, 1) * MOST_RATIO:
        raise SceneError(
            f"{folder} claims {array.shape} of {array.dtype} in chunks of {array.chunks}, and {stored} bytes lie on "
            "the disk; copy it again"
        )
