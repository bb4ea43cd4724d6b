"""Scene files opened by whichever reader knows them: whole, or to be read some rows at a time."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from storage.readers.cube_sources import (
    BLOCK_LINES,
    CubeSource,
    Raster,
    check_numbers,
    machine_bytes,
    read_by_chunks,
    scene_lines,
)
from storage.readers.labels import Layout, load_frame_or_raster
from storage.readers.raster_files import ROW_ENDINGS, TiffRows, content_guess, open_tiff_rows, split_variable
from storage.readers.scan_files import known_bands, open_cube_source, reader_of


@dataclass(frozen=True)
class SceneRows:
    """What a reader opened: numbers by rows, and what it says of them."""

    shape: tuple[int, int, int]
    read: Callable[[int, int], NDArray[Any]]
    void: NDArray[np.bool_] | None  # (y, x) pixels that are transparent or masked
    about: Raster | TiffRows  # the file's words
    files: tuple[Path, ...] = ()
    scaling: str = ""  # scale and offset that were applied, for hashes

    @staticmethod
    def of(raster: Raster, cube: NDArray[Any]) -> SceneRows:
        """Take the (y, x, band) numbers of a file that was read whole."""
        shape = (cube.shape[0], cube.shape[1], cube.shape[2])
        return SceneRows(shape, lambda first, last: cube[first:last], raster.void, raster, raster.files, raster.scaling)


def open_rows(path: str | Path) -> tuple[SceneRows, Layout | None]:
    """Open a file to be read by rows where its format lets it be, else read it whole.

    Raises SceneError: there is no such file, it is damaged, or of a kind that is not read.
    """
    file, _ = split_variable(path)
    if reader_of(path) != "raster":
        source = open_cube_source(path)
        about = _scan_raster(source, np.empty((0, *source.shape[1:]), np.float32))
        return SceneRows(
            source.shape, lambda first, last: scene_lines(source, first, last), None, about, source.files
        ), None
    if file.suffix.lower() in ROW_ENDINGS and file.is_file():
        if guess := content_guess(file):
            raise SceneError(f"{file} cannot be read as {file.suffix.lower()}: {guess}")
        rows = open_tiff_rows(file)
        check_numbers(rows.dtype, file)
        scaling = "" if rows.scaling is None else rows.scaling.stated
        read = read_by_chunks(rows.read, rows.shape[0], rows.block_lines)
        return SceneRows(rows.shape, read, _void_of(rows), rows, rows.files, scaling), None
    raster, layout = load_frame_or_raster(path)
    return SceneRows.of(raster, raster.three_axes(file)), layout


def _void_of(rows: TiffRows) -> NDArray[np.bool_] | None:
    """(y, x) pixels of a TIFF that are transparent or masked; None where it knows neither."""
    height = rows.shape[0]
    parts = [rows.void(first, min(first + BLOCK_LINES, height)) for first in range(0, height, BLOCK_LINES)]
    return np.concatenate([part for part in parts if part is not None]) if parts[0] is not None else None


def load_scan(address: str | Path) -> Raster:
    """Read a cube that comes in lines as one array, over the white panel where dark and white frames are known.

    Raises SceneError: the cube cannot be used, or this machine has not the memory for it.
    """
    source = open_cube_source(address)
    needed = 8 * math.prod(source.shape)  # as float32, and once more while the scene is made
    there = machine_bytes()
    if needed > there:
        raise SceneError(
            f"{address} is a cube of {source.shape}: as a scene it takes about {needed / 1e9:.0f} GB of memory, this "
            f"machine has {there / 1e9:.0f}; cut a part out of it, or ingest it"
        )
    starts = range(0, source.shape[0], BLOCK_LINES)
    blocks = [scene_lines(source, start, min(start + BLOCK_LINES, source.shape[0])) for start in starts]
    return _scan_raster(source, np.concatenate(blocks))


def _scan_raster(source: CubeSource, values: NDArray[Any]) -> Raster:
    """Give the values with what the source says of them."""
    over = source.dark is not None and source.white is not None
    notes = (*source.notes, "values are over the white panel") if over else source.notes
    return Raster(
        values,
        None,
        None if over else source.nodata,
        notes,
        known=known_bands(source),
        files=source.files,
        geobox=source.geobox,
        bad_bands=source.bad_bands,
    )
