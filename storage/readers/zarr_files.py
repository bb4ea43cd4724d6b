"""List the arrays of Zarr stores, and ingest cubes as such stores.

A store is checked before it is opened. Links out of it and codecs other than those of numbers (such as ``pickle``) are
refused, so that reading never runs code of the store. A cube of files is ingested as one immutable store:

::

    cube.zarr/values          (line, sample, band): uint8, uint16 and int16 as in the file, else float32
    cube.zarr/wavelength      (band,) nm, fwhm beside it, if known
    cube.zarr/valid_line      (line,) false for lines that no file holds whole; time, exposure_ms, frame if known
    cube.zarr/dark, white     (sample, band) reference frames, if there are some

Attributes have file names without folders, sizes, SHA-256, header texts and notes.
"""

from __future__ import annotations

import base64
import json
import math
import os
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from storage.arrays.georeference import GRID_MAPPING, ON_THE_MAP, grid_mapping, map_attributes
from storage.arrays.layout import create_array, create_group, image_spec, write_bands, write_counts, write_small, zarr
from storage.readers.array_cubes import Arrays, FileArray
from storage.readers.cube_sources import BLOCK_LINES, CubeSource, LineFacts

INGESTED = "ingested cube"  # of this project
METADATA = ("zarr.json", ".zarray", ".zgroup")
CODECS = {
    *("crc32", "crc32c", "adler32", "fletcher32", "jenkins_lookup3"),  # checksums
    *("blosc", "zstd", "gzip", "zlib", "bz2", "lzma", "lz4", "pcodec", "zfpy", "packbits"),  # packers
    *("bytes", "transpose", "sharding_indexed", "shuffle"),  # orders
    *("delta", "fixedscaleoffset", "quantize", "bitround", "astype", "cast_value", "scale_offset"),  # of numbers
}
LONGEST_HEADER = 1 << 16  # characters of a header's text that are kept

Report = Callable[[float], None]


def find_zarr_store(path: Path) -> Path | None:
    """Return the Zarr store at a path, or the ``cube.zarr`` in it."""
    for folder in (path, path / "cube.zarr"):
        if any((folder / name).is_file() for name in METADATA):
            return folder
    return None


def zarr_arrays(path: Path) -> tuple[dict[str, FileArray], dict[str, Any]]:
    """Return the arrays of a store by their names, and its attributes.

    Raises SceneError: the store has a codec that is not allowed, links out of it, or is a survey's own product.
    """
    _check_store(path)
    # consolidated metadata of a group are not used: only those of its members were checked
    is_group = (path / ".zgroup").is_file() or (
        (path / "zarr.json").is_file() and _read_json(path / "zarr.json").get("node_type") == "group"
    )
    options: dict[str, Any] = {"use_consolidated": False} if is_group else {}
    node = zarr.open(path, mode="r", **options)
    if not isinstance(node, zarr.Group):
        return {"": _file_array(path, node)}, {}
    if "sweep" in node.attrs:
        raise SceneError(f"{path} holds raw lines of a survey, which are on no map yet; survey them as --sweeps {path}")
    if {"scores", "axes"} <= set(node.array_keys()):
        raise SceneError(
            f"{path} holds components of spectra; `spectralzoom export` writes its reflectance as an image, and "
            "spectralzoom.open(ARCHIVE).latest.cube opens it in Python"
        )
    return {name: _file_array(path / name, array) for name, array in node.arrays()}, dict(node.attrs)


def lost_chunks(array: zarr.Array[Any]) -> tuple[int, int]:
    """Return how many chunks, or shards of chunks, have no file, of how many: zarr reads its fill value for them."""
    shard = array.shards or array.chunks
    count = math.prod(-(-size // one) for size, one in zip(array.shape, shard, strict=True))
    return count - array.nchunks_initialized * math.prod(array.chunks) // math.prod(shard), count


def _file_array(path: Path, array: zarr.Array[Any]) -> FileArray:
    """Return an array of a store, with its no-data value as CF, xarray or Zarr has it."""
    about = dict(array.attrs)
    fill = about.get("_FillValue")
    kind = array.dtype.kind
    if isinstance(fill, str) and kind == "f":  # of Zarr v3
        about["_FillValue"] = float(struct.unpack("<d", base64.standard_b64decode(fill))[0])
    elif fill is None and "_ARRAY_DIMENSIONS" in about and kind in "buif" and array.fill_value is not None:
        about["_FillValue"] = float(array.fill_value)  # xarray's of v2
    named = getattr(array.metadata, "dimension_names", None)
    if named is not None:
        about["_ARRAY_DIMENSIONS"] = list(named)
    held = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
    lost, count = lost_chunks(array)
    note = f"{lost} of {count} chunks have no file, and are read as {array.fill_value}" if lost else ""
    return FileArray(
        str(path), array.shape, array.dtype, about, lambda part: np.asarray(array[part]), array.chunks, held, lost=note
    )


def with_ingested(source: CubeSource, arrays: Arrays, attributes: Mapping[str, Any]) -> CubeSource:
    """Return a cube with the lines, reference frames and bad bands of an ingested one."""
    lines, samples, bands = source.shape

    def known(name: str, *shape: int) -> NDArray[Any] | None:
        return np.asarray(arrays[name][...]) if name in arrays and arrays[name].shape == shape else None

    valid = known("valid_line", lines)
    valid = None if valid is None else valid.astype(np.bool_)
    return replace(
        source,
        lines=LineFacts(valid, known("time", lines), known("exposure_ms", lines), known("frame", lines)),
        dark=known("dark", samples, bands),
        white=known("white", samples, bands),
        nodata=attributes.get("nodata", source.nodata),
        bad_bands=tuple(int(band) for band in attributes.get("bad_bands", ())),
    )


def _check_store(path: Path) -> None:
    """Refuse links out of the store, special files, and unknown codecs (SceneError)."""
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
    content = json.loads(path.read_bytes())
    if not isinstance(content, dict):
        raise SceneError(f"{path} holds no table; copy the store again")
    return content


def _codecs(content: object) -> Iterator[str]:
    """Yield the names of all codecs in an array's metadata, nested ones too."""
    if isinstance(content, dict):
        for key in ("codecs", "index_codecs", "filters", "compressor", "compressors"):
            listed = content.get(key) or []
            for codec in listed if isinstance(listed, list) else [listed]:
                yield str(codec.get("name", codec.get("id"))) if isinstance(codec, dict) else str(codec)
                yield from _codecs(codec.get("configuration") if isinstance(codec, dict) else None)


@dataclass(frozen=True)
class SourceFile:
    """A file of a cube."""

    name: str  # relative to the store, else without folders
    size: int
    sha256: str


def write_ingested_cube(
    folder: Path, source: CubeSource, files: Sequence[SourceFile], *, name: str, report: Report = lambda done: None
) -> None:
    """Write a cube as ``cube.zarr`` into a folder, 64 lines at a time.

    ``report`` is called with the progress, 0..1. Raises SceneError: lines cannot be read.
    """
    kind = source.dtype if source.dtype in (np.uint8, np.uint16, np.int16) else np.dtype(np.float32)
    group = create_group(folder / "cube.zarr", f"{INGESTED} {name}", _attributes(source, files, name))
    about: dict[str, Any] = {"long_name": "numbers of the file", "units": "1", **_write_coordinates(group, source)}
    array = create_array(group, "values", image_spec(("line", "sample", "band"), source.shape, kind.str), about)
    for start in range(0, source.shape[0], BLOCK_LINES):
        stop = min(start + BLOCK_LINES, source.shape[0])
        lines = source.read(start, stop)
        valid = source.valid[start:stop]
        with np.errstate(over="ignore"):  # values beyond float32 become infinite: missing
            block = lines.astype(kind)
        if not valid.all():
            block[~valid] = np.nan if kind.kind == "f" else 0
        array[start:stop] = block
        report(stop / source.shape[0])


def _attributes(source: CubeSource, files: Sequence[SourceFile], name: str) -> dict[str, Any]:
    facts: dict[str, Any] = {
        "kind": INGESTED,
        "name": name,
        "files": [asdict(file) for file in files],
        "headers": {file: text[:LONGEST_HEADER] for file, text in source.headers.items()},
        "source_dtype": source.dtype.str,
        "lost_lines": source.lost_lines,
        "notes": list(source.notes),
        "wavelength_origin": source.bands.origin or "nothing says the wavelengths",
    }
    if source.nodata is not None and np.isfinite(source.nodata):
        facts["nodata"] = source.nodata
    if source.bad_bands:
        facts["bad_bands"] = list(source.bad_bands)
    if source.geobox is not None:
        facts |= {**map_attributes(source.geobox), "spatial:dimensions": ["line", "sample"]}
    return facts


def _write_coordinates(group: zarr.Group, source: CubeSource) -> dict[str, str]:
    """Write lines, bands, place and reference frames; return the attributes of the values that name them."""
    write_counts(group, line=source.shape[0], sample=source.shape[1])
    names: list[str] = []
    if source.bands.wavelength_nm is not None:
        names.append(write_bands(group, source.bands.wavelength_nm, source.bands.fwhm_nm))
    columns: Mapping[str, tuple[NDArray[Any] | None, dict[str, Any]]] = {
        "time": (source.lines.time_s, {"long_name": "since the first stamp of a frame", "units": "s"}),
        "exposure_ms": (source.lines.exposure_ms, {"units": "ms"}),
        "frame": (source.lines.frame, {"long_name": "number that the camera gave, -1 where not known", "units": "1"}),
        "valid_line": (source.valid, {"long_name": "line is whole in its file"}),
    }
    for name, (values, about) in columns.items():
        if values is not None:
            write_small(group, name, ("line",), np.asarray(values), about)
            names.append(name)
    frames: Mapping[str, tuple[NDArray[Any] | None, str]] = {
        "dark": (source.dark, "dark reference frame"),
        "white": (source.white, "white reference frame"),
    }
    for name, (frame, title) in frames.items():
        if frame is not None:
            write_small(group, name, ("sample", "band"), np.asarray(frame), {"long_name": title, "units": "1"})
    placed = {} if source.geobox is None else ON_THE_MAP
    if source.geobox is not None:
        write_small(group, GRID_MAPPING, *grid_mapping(source.geobox))
        names.append(GRID_MAPPING)
    return {**placed, **({"coordinates": " ".join(names)} if names else {})}
