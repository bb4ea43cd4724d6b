"""A mosaic made ahead: tiles whose lines have all arrived, rectified while the capture goes on.

Nothing rests on it. Tiles are made of lines in the spool, lying as the plan has them; they are taken over only where
each line turned out to lie there, and then they are, byte for byte, what would be made afterwards. Whatever goes wrong
with it leaves the mosaic to be made in its turn.

::

    <folder>/mosaic.zarr    tiles that are ready
    <folder>/seen.npy       what the thumbnail shows of them
    <folder>/ahead.json     which they are and what they were made of; written last

No disk is waited for, so what a machine that was switched off in between left behind is not taken over.
"""

from __future__ import annotations

import io
import json
import logging
import os
import zlib
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.checked_lines import read_checked, with_check
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep
from pipeline.rectify.line_cache import LineCache
from pipeline.rectify.placed import PixelGrid, Placed, place
from pipeline.rectify.tiles import Tile, lines_needed, plan_tiles
from pipeline.source import References
from storage.archive.plain_files import read_plain
from storage.archive.staging import remove_tree
from storage.arrays.lookups import path_digest
from storage.arrays.mosaic_work import MosaicWork
from storage.arrays.mosaics import MosaicWriter
from storage.arrays.spool import read_spooled
from storage.arrays.tile_work import OpenMosaic, Thumbnail, tile_budget
from storage.parallel.crew import Crew

MOSAIC, SEEN, RECORD = "mosaic.zarr", "seen.npy", "ahead.json"
LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class PlannedLines:
    """A sweep's lines where the plan has them, read from its spool while that grows: a `pipeline.source.SweepLines`."""

    spool: Path  # folder
    sweep: Sweep
    references: References
    position: NDArray[np.float64]  # (line, 2)

    @property
    def time_s(self) -> NDArray[np.float64]:
        """(line,) unknown."""
        return np.full(len(self.position), np.nan)

    @property
    def valid_line(self) -> NDArray[np.bool_]:
        """(line,) all of them: else the mosaic is not taken over."""
        return np.ones(len(self.position), np.bool_)

    def read(self, start: int, stop: int) -> NDArray[np.uint16]:
        """Raw numbers of lines that have arrived, (line, sample, band)."""
        return read_spooled(self.spool, self.sweep.name, self.references.dark.shape, slice(start, stop))


@dataclass(frozen=True)
class AheadOf:
    """What a mosaic is made of beside its lines: it is taken over for the same alone."""

    camera: LineCamera
    grid: PixelGrid
    kernel: str
    version: int  # of the stage that it is made for

    def facts(self, paths: Mapping[str, str]) -> dict[str, Any]:
        """The same in plain values, with the digest of each sweep's path and since when this machine is up."""
        told = {**asdict(self), "paths": dict(paths), "up": _boot()}
        plain: dict[str, Any] = json.loads(json.dumps(told))
        return plain


class MosaicAhead:
    """Makes tiles on a thread of its own as lines arrive. Use as a context manager: its end stops the work.

    Parameters
    ----------
    begin
        Makes the writer of the mosaic at a path.
    memory
        What this may take [bytes]; where not even a tile fits SettingsError is raised.
    """

    def __init__(
        self, folder: Path, work: MosaicWork, begin: Callable[[Path], MosaicWriter], seen: Thumbnail, *,
        memory: int, version: int = 0,
    ) -> None:  # fmt: skip
        remove_tree(folder)
        folder.mkdir(parents=True)
        writer = begin(folder / MOSAIC)
        tiles = plan_tiles(work.placed, work.camera, work.grid, writer.tile_shape)
        budget = tile_budget(work, tiles, writer.tile_shape, memory=memory, crew=Crew(workers=1))
        self._folder, self._work, self._seen = folder, work, seen
        self._wanted = AheadOf(work.camera, work.grid, work.kernel, version)
        self._opened = OpenMosaic(work, writer, LineCache(budget.cache), seen.cut)
        self._waiting = [(tile, lines_needed(work.placed, tile)) for tile in tiles]
        self._here = {one.lines.sweep.name: 0 for one in work.placed}
        self._made: list[tuple[int, int]] = []
        self._thread = ThreadPoolExecutor(1, "mosaic-ahead")
        self._begun: list[Future[None]] = []

    def __enter__(self) -> MosaicAhead:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._thread.shutdown(cancel_futures=True)
        ended = [one.exception() for one in self._begun if one.done() and not one.cancelled()]
        failed = next((error for error in ended if error is not None), None)
        if kind is not None or failed is not None:
            LOG.info("the mosaic is made after its lines: %s", failed or "their capture broke off")
            remove_tree(self._folder)
            return
        try:
            self._keep()
        except OSError as error:
            LOG.info("the mosaic is made after its lines: %s", error)
            remove_tree(self._folder)

    def arrived(self, name: str, count: int) -> None:
        """Take note that the first ``count`` lines of a sweep are in its spool."""
        self._here[name] = count
        here, waiting = list(self._here.values()), []
        for tile, needed in self._waiting:
            if all(least <= count for least, count in zip(needed, here, strict=True)):
                self._begun.append(self._thread.submit(self._make, tile))
            else:
                waiting.append((tile, needed))
        self._waiting = waiting

    def _make(self, tile: Tile) -> None:
        part = self._opened.tile(tile)
        if part is not None:
            self._seen.put(tile.rows, tile.columns, part)
        self._made.append((tile.rows.start, tile.columns.start))

    def _keep(self) -> None:
        np.save(self._folder / SEEN, self._seen.image)
        paths = {one.lines.sweep.name: path_digest(one.lines.position) for one in self._work.placed}
        record = {**self._wanted.facts(paths), "tiles": self._made, "seen": zlib.crc32(read_plain(self._folder / SEEN))}
        (self._folder / RECORD).write_bytes(with_check(json.dumps(record).encode()))


def place_as_planned(lines: PlannedLines, camera: LineCamera, grid: PixelGrid) -> Placed:
    """Find where a sweep's lines will lie, with the tables that it will be looked up by."""
    find = partial(place, lines, camera, shift_px=np.zeros_like(lines.position))
    found = find(grid=grid)
    return found if all(table is not None for _, table in found.tracks) else find()


def take_over(
    folder: Path, out: Path, wanted: AheadOf, paths: Mapping[str, str], seen: Thumbnail
) -> Sequence[tuple[int, int]]:
    """Move a mosaic made ahead to ``out``, and what the thumbnail shows of it into that.

    Returns
    -------
    First row and column of each tile that is ready; none, and nothing moved, where there is no such mosaic, or lines
    lie elsewhere than it was made of.
    """
    try:
        (line,) = read_checked(read_plain(folder / RECORD))
        if line.content is None or line.state != "whole":
            raise ValueError(f"{RECORD} has changed")
        record, picture = line.content, read_plain(folder / SEEN)
        if record.pop("seen") != zlib.crc32(picture):
            raise ValueError(f"{SEEN} has changed")
        image = np.load(io.BytesIO(picture))
        tiles = [(int(row), int(column)) for row, column in record.pop("tiles")]
        if record != wanted.facts(paths) or image.shape != seen.image.shape or not tiles:
            return []
        (folder / MOSAIC).rename(out)
    except (OSError, ValueError, TypeError, LookupError, AttributeError) as error:
        LOG.debug("no mosaic was made ahead: %s", error)
        return []
    seen.image[...] = image
    return tiles


def _boot() -> str:
    """What differs once this machine was switched off; where it does not say, once this process has ended."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return f"process {os.getpid()}"
