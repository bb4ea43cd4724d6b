"""Cubes out of Zarr stores: those of this project, and arrays of anyone with dims y x and band, or band y x.

What a store says of itself is judged before it is opened: see :mod:`storage.readers.zarr_checks`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numcodecs.errors import UnknownCodecError  # type: ignore[import-untyped]
from numpy.typing import NDArray

from pipeline.errors import SceneError
from storage.arrays.layout import missing_codec
from storage.readers.cf_cubes import ArrayCube, bands_of, dims_of, find_cube, line_reader, placed, spectral_names
from storage.readers.cube_sources import BLOCK_LINES, CubeSource, LineFacts
from storage.readers.zarr_checks import check_array, check_blocks, check_store, open_options

FRAMES = ("dark", "white", "panel", "bad", "flat")
OF_LINES = ("mirror_x", "mirror_y", "valid_line", "time", "exposure_ms", "frame")
METADATA = ("zarr.json", ".zarray", ".zgroup")


def find_zarr_store(path: Path) -> Path | None:
    """The Zarr store at a path, or the ``cube.zarr`` in it; None where there is neither."""
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
        check_store(path)
        node = zarr.open(path, mode="r", **open_options(path))
        attributes = dict(node.attrs) if isinstance(node, zarr.Group) else {}
        arrays: dict[str, Any] = dict(node.arrays()) if isinstance(node, zarr.Group) else {"": node}
        cube = find_cube(arrays, variable, path)
        beside = spectral_names(arrays) | ({*FRAMES, *OF_LINES, *dims_of(cube.array)} & set(arrays))
        for used in [cube.name, *sorted(beside - {cube.name})]:
            check_array(arrays[used], path, used)
        shape = cube.array.shape
        parts = [BLOCK_LINES if axis == cube.order[0] else size for axis, size in enumerate(shape)]
        if cube.moment is not None:
            parts[cube.moment.axis] = 1
        check_blocks(cube.array, path, parts)
        source = _source(path, cube, arrays, attributes)
    return placed(source, cube, arrays, {**attributes, **dict(cube.array.attrs)})


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


def _source(path: Path, cube: ArrayCube, arrays: dict[str, Any], attributes: dict[str, Any]) -> CubeSource:
    lines, samples, bands = cube.shape
    own = "sweep" in attributes or attributes.get("kind") == "ingested cube"
    known = arrays if own else {}
    frame = (samples, bands)
    bad, valid = _small(known, "bad", frame), _column(known, "valid_line", lines)
    by_mirror = attributes.get("by_mirror") is True
    x, y = (_small(arrays, f"mirror_{axis}", (lines,)) if by_mirror else None for axis in "xy")
    position = None if x is None or y is None else np.stack([x, y], axis=-1).astype(np.float64)
    read, kind, fill = line_reader(cube, lambda: _named(path))
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
        bands=bands_of(cube, arrays),
        dark=_small(known, "dark", frame),
        white=_small(known, "white", frame),
        panel=_small(known, "panel", (bands,)),
        bad=None if bad is None else bad.astype(np.bool_),
        flat=_small(known, "flat", frame),
        position=position,
        nodata=void if void is not None else fill,
        bad_bands=tuple(int(band) for band in attributes.get("bad_bands", ())) if own else (),
        root=path,
        notes=cube.notes,
    )


def _column(arrays: Mapping[str, Any], name: str, lines: int) -> NDArray[Any] | None:
    return np.asarray(arrays[name][...]) if name in arrays and arrays[name].shape == (lines,) else None


def _small(arrays: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> NDArray[np.float32] | None:
    if name not in arrays or arrays[name].shape != shape:
        return None
    return np.asarray(arrays[name][...], np.float32)
