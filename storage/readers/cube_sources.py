"""Define a cube whose lines are read on demand, as all readers return it.

The size that a file claims is checked against its bytes and the machine before it is read.
"""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.exposures import Taken
from spectralzoom.pipeline.signal.calibrate import calibrate
from spectralzoom.pipeline.signal.line_faults import DarkLevel
from spectralzoom.pipeline.source import References
from spectralzoom.storage.readers.band_facts import Bands
from spectralzoom.storage.readers.user_files import OpenedFiles

DEFLATE_RATIO = 1100  # bytes that one byte of zlib's can stand for, rounded up: it is 1032
MOST_RATIO = 10_000  # by which any packed numbers may exceed their bytes
ONE_FILE = "survey tiles one by one (spectralzoom survey), or make one file first: rio merge tiles/*.tif field.tif"
SPARE_BYTES = 1 << 20  # that a file may claim whatever its size: numbers that are all alike take none
_GROUP_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))


def machine_bytes() -> int:
    """Return the memory of this machine, or of the part of it that this process may use [bytes]."""
    there = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    for limit in _GROUP_LIMITS:
        with suppress(OSError, ValueError):  # no such file, or "max"
            there = min(there, int(limit.read_text()))
    return there


def check_claim(where: object, claimed: int, stored: int, ratio: int = MOST_RATIO) -> None:
    """Refuse more bytes of numbers than ``stored`` bytes can hold (SceneError)."""
    if claimed > max(stored * ratio, SPARE_BYTES):
        raise SceneError(
            f"{where} claims {claimed} bytes of numbers, and {stored} bytes lie on the disk, so it is damaged or "
            "malicious; copy it again"
        )


def check_memory(where: object, needed: int) -> None:
    """Refuse to read more than the machine's memory (SceneError)."""
    there = machine_bytes()
    if needed > there:
        raise SceneError(
            f"{where}: reading it takes about {needed / 1e9:.1f} GB of memory, this machine has {there / 1e9:.1f}; cut "
            "a part out of it, or store it as ENVI, GeoTIFF in tiles or Zarr, which are read a few lines at a time"
        )


_HEARD: ContextVar[list[logging.LogRecord] | None] = ContextVar("heard", default=None)


class _Listener(logging.Handler):
    """Keep the log of an image library while a reader of this thread uses it; pass on the rest."""

    def emit(self, record: logging.LogRecord) -> None:
        heard = _HEARD.get()
        if heard is None:
            logging.getLogger().handle(record)
        else:
            heard.append(record)


for _library in (logging.getLogger("PIL"), logging.getLogger("rasterio")):
    _library.addHandler(_Listener())
    _library.propagate = False


@contextmanager
def library_log() -> Iterator[list[logging.LogRecord]]:
    """Keep what Pillow and rasterio say off the terminal, and return their log; a call within another adds to it."""
    heard: list[logging.LogRecord] = [] if (outer := _HEARD.get()) is None else outer
    token = _HEARD.set(heard)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module="PIL|rasterio")
            yield heard
    finally:
        _HEARD.reset(token)


@contextmanager
def reading(path: Path, kind: str, cure: str = "copy it again") -> Iterator[None]:
    """Turn any error of a decoder into a SceneError with the file's name and kind."""
    try:
        yield
    except SceneError:
        raise
    except Exception as error:
        why = error.__cause__ or error  # of rasterio, whose own says only that it failed
        raise SceneError(
            f"{path} cannot be read as {kind}: {type(why).__name__}: {why}; is it damaged? {cure}"
        ) from error


BLOCK_LINES = 64
DIMS = ("y", "x", "band")
MOST_MISSING = 1 << 14  # lines that a cube may claim beyond those in its file

ReadLines = Callable[[int, int], NDArray[Any]]


@dataclass(frozen=True)
class LineFacts:
    """Facts of each line; None if not known."""

    valid: NDArray[np.bool_] | None = None  # (line,) the file holds it whole; None where it holds all
    time_s: NDArray[np.float64] | None = None  # (line,) since the first stamp; NaN where not known
    exposure_ms: NDArray[np.float64] | None = None  # (line,)


@dataclass(frozen=True)
class CubeSource:
    """An open cube. ``read(start, stop)`` returns lines (line, sample, band) of ``dtype`` in native byte order."""

    name: str
    shape: tuple[int, int, int]
    dtype: np.dtype[Any]
    read: ReadLines
    files: tuple[Path, ...]  # that it was read from
    opened: OpenedFiles = field(default_factory=OpenedFiles)  # these, and headers and metadata
    lines: LineFacts = LineFacts()
    bands: Bands = field(default_factory=Bands)
    dark: NDArray[np.float32] | None = None  # (sample, band)
    white: NDArray[np.float32] | None = None  # (sample, band)
    white_ms: float | None = None  # exposure of the white frame at the gain of the lines; None: that of every line
    taken: Taken = field(default_factory=Taken)
    nodata: float | None = None
    packed_nodata: float | None = None  # no-data value that was compared before the file's scale
    geobox: GeoBox | None = None  # where (line, sample) lie on the earth
    bad_bands: tuple[int, ...] = ()  # that the files mark as bad, from 0
    void: NDArray[np.bool_] | None = None  # (line, sample) transparent or masked: without a value; some, not all
    acquired: str | None = None  # when the light was captured: a day or a moment in UTC, ISO 8601
    scaling: str = ""  # scale and offset that were applied to the file's numbers, for hashes
    notes: tuple[str, ...] = ()

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Return (line,) whether each line is whole in its file."""
        return np.ones(self.shape[0], np.bool_) if self.lines.valid is None else self.lines.valid


def check_cube_source(source: CubeSource) -> None:
    """Refuse a cube without real numbers or without pixels (SceneError)."""
    where = source.name
    if source.dtype.kind not in "buif":
        raise SceneError(f"{where} holds {source.dtype}, expected whole or floating numbers; store numbers of these")
    if min(source.shape) < 1:
        raise SceneError(f"{where} holds an empty cube of shape {source.shape}")


def unpacked(
    raw: NDArray[Any],
    scale: float | NDArray[np.float64],
    offset: float | NDArray[np.float64],
    fill: float | NDArray[Any] | None,
) -> NDArray[np.float32]:
    """Return ``raw * scale + offset`` (..., band) as float32, NaN where raw is ``fill``.

    Scale, offset and fill are one number, or one for each band.
    """
    values = (raw * np.asarray(scale, np.float64) + offset).astype(np.float32)
    if fill is not None:
        values[raw == fill] = np.nan
    return values


def read_by_chunks(read: ReadLines, lines: int, chunk_lines: int) -> ReadLines:
    """Return a reader that reads whole rows of chunks and keeps the last one, so that none is unpacked twice.

    Threads take turns.
    """
    if chunk_lines <= 1:
        return read
    lock = Lock()

    @lru_cache(maxsize=1)
    def chunk(number: int) -> NDArray[Any]:
        return read(number * chunk_lines, min((number + 1) * chunk_lines, lines))

    def read_lines(start: int, stop: int) -> NDArray[Any]:
        """Return some lines (line, sample, band)."""
        numbers = range(start // chunk_lines, -(-stop // chunk_lines))
        with lock:
            parts = [chunk(at)[max(start - at * chunk_lines, 0) : stop - at * chunk_lines] for at in numbers]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    return read_lines


def scene_lines(source: CubeSource, start: int, stop: int) -> NDArray[Any]:
    """Return lines (line, sample, band) as scene values: over the white reference if both frames are known."""
    raw = source.read(start, stop)
    valid = source.valid[start:stop]
    if source.dark is None or source.white is None:
        if valid.all():
            return raw
        values = raw.astype(np.float32)
    else:
        white_reference = np.ones(source.shape[2], np.float32)
        references = References(source.dark, source.white, white_reference, exposure_ms=source.white_ms)
        exposure_ms = np.ones(len(raw)) if source.lines.exposure_ms is None else source.lines.exposure_ms[start:stop]
        values, usable = calibrate(raw, references, saturated_dn=np.inf, exposure_ms=exposure_ms)
        values[~usable] = np.nan
        if source.nodata is not None:
            values[raw == source.nodata] = np.nan
        values[dark_lines(source, raw)] = np.nan
    values[~valid] = np.nan
    return values


def dark_lines(source: CubeSource, raw: NDArray[Any]) -> NDArray[np.bool_]:
    """Return (line,) whether raw lines of a cube are darker than its dark frame; none without one, or without data."""
    if source.dark is None or source.white is None:
        return np.zeros(len(raw), np.bool_)
    level = DarkLevel(source.dark)
    found = np.array([level.is_above(line) for line in raw], np.bool_)
    return found if source.nodata is None else found & ~(raw == source.nodata).all(axis=(1, 2))
