"""List the arrays of Zarr stores.

A store is checked before it is opened. Links out of it and codecs other than those of numbers (such as ``pickle``) are
refused, so that reading never runs code of the store.
"""

from __future__ import annotations

import base64
import math
import os
import struct
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from zarr.storage import LocalStore

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.storage.readers.array_cubes import FileArray
from spectralzoom.storage.readers.checked_chunks import CheckedStore
from spectralzoom.storage.readers.own_files import within

METADATA = ("zarr.json", ".zarray", ".zgroup")


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
    node = zarr.open(CheckedStore(LocalStore(path, read_only=True)), mode="r")
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


def _check_store(path: Path) -> None:
    """Refuse links out of the store and special files (SceneError)."""
    for place, folders, files in os.walk(path):
        for entry in (Path(place, name) for name in (*folders, *files)):
            if entry.is_symlink():
                within(path, entry)
            if entry.name in files and not entry.is_file():  # reading a pipe may never end
                raise SceneError(f"{entry} is no file; take it out of the store")
