"""Rectify sweeps to pixels of a grid: tiles of a mosaic, rows of it, and single patches.

A maker of tiles opens its sweeps once in every process, and keeps their raw lines from tile to tile.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid, cuts
from spectralzoom.pipeline.kept import kept
from spectralzoom.pipeline.rectify.kernels import Kernel
from spectralzoom.pipeline.rectify.mosaic import LocatedSweep, cut_runs, mosaic, read_part
from spectralzoom.pipeline.rectify.placed import ColumnReach, PixelGrid, PlacedSweep, ScanPathReach, member_lines, place
from spectralzoom.pipeline.signal.lines import BLOCK_LINES, LineCache, held_samples, line_blocks
from spectralzoom.pipeline.source import SweepLines

COPIES = 5  # of a tile in memory at once: values, parts and calibrated lines, rounded, chunks and shard
GROUP_COLUMNS = 32  # tiles are cut between groups of so many columns

Values = NDArray[np.float32]
Counts = NDArray[np.intp]
Place = tuple[slice, slice]  # rows and columns of a mosaic
Reaches = Sequence[Sequence[ColumnReach | None]]  # of each sweep, of each of its scan paths


def column_reach(placed: Sequence[PlacedSweep], camera: LineCamera, grid: PixelGrid, columns: slice) -> Reaches:
    """Return the reach of every scan path of every sweep in some columns, for all tiles of these columns."""
    return [
        [ScanPathReach(one, scan_path, camera, grid).in_columns(columns) for scan_path, _ in one.scan_paths]
        for one in placed
    ]


def mosaic_tile(
    placed: Sequence[PlacedSweep],
    camera: LineCamera,
    grid: PixelGrid,
    rows: slice,
    columns: slice,
    *,
    kernel: Kernel = "catmull-rom",
    cache: LineCache | None = None,
    reach: Reaches | None = None,
) -> tuple[Values, Counts]:
    """Rectify and blend the sweeps on a part of a grid, given by slices with start and stop.

    A pixel's value does not depend on the division into tiles, bit for bit. ``cache`` holds raw lines that earlier
    tiles read; None begins an empty one. ``reach`` is that of :func:`column_reach` for these columns or more;
    None computes it.

    The result is (y, x, band) float32 with NaN where no line reached, and (y, x) how many sweeps did. A sweep that
    turns may count once for each of its runs.
    """
    cache = LineCache(sys.maxsize) if cache is None else cache
    located = []
    for one, scan_paths in zip(placed, reach or column_reach(placed, camera, grid, columns), strict=True):
        for number, ((scan_path, _), near) in enumerate(zip(one.scan_paths, scan_paths, strict=True)):
            knots = slice(0, 0) if near is None else near.knots(rows)
            if near is None or knots.stop == knots.start:
                continue
            window = partial(cache.window, one.lines, likely=near.samples)
            located.append(LocatedSweep(one, scan_path, one.coordinates(number, camera, grid, rows, columns), window))
    bands = placed[0].signal.bands
    values = np.full((rows.stop - rows.start, columns.stop - columns.start, bands), np.nan, np.float32)
    coverage = np.zeros(values.shape[:2], np.intp)
    for run in cut_runs([_column_groups(one.coordinates) for one in located], bands) if located else []:
        part = np.s_[:, run.start * GROUP_COLUMNS : min(run.stop * GROUP_COLUMNS, values.shape[1])]
        read = [read_part(one, one.coordinates[part].reshape(-1, 2), camera, kernel) for one in located]
        parts = [found for found in read if found is not None]
        if parts:
            blended, counts = mosaic(parts)
            values[part] = blended.reshape(values[part].shape)
            coverage[part] = counts.reshape(coverage[part].shape)
    return values, coverage


def mosaic_rows(sweeps: Sequence[SweepLines], camera: LineCamera, grid: SceneGrid, *, rows: int) -> Iterator[Values]:
    """Rectify and blend the sweeps of one pass onto the pixels of the scene, ``rows`` rows at a time.

    Yields (row, x, band) float32 with NaN where no line reached.
    """
    pixels = PixelGrid.of_scene(grid)
    placed = [place(lines, camera) for lines in sweeps]
    columns = slice(0, pixels.shape[1])
    reach = column_reach(placed, camera, pixels, columns)
    for part in cuts(pixels.shape[0], rows):
        yield mosaic_tile(placed, camera, pixels, part, columns, reach=reach)[0]


def _column_groups(coordinates: NDArray[np.float64]) -> NDArray[np.float64]:
    """Group (y, x, 2) by 32 columns, (group, n, 2); the last group is filled with NaN."""
    rows, columns = coordinates.shape[:2]
    beyond = -columns % GROUP_COLUMNS
    padded = np.pad(coordinates, ((0, 0), (0, beyond), (0, 0)), constant_values=np.nan)
    return padded.reshape(rows, (columns + beyond) // GROUP_COLUMNS, GROUP_COLUMNS, 2).swapaxes(0, 1)


@dataclass(frozen=True)
class Tile:
    """A part of a mosaic that is made and written at once. ``reach`` is that of each scan path of each sweep."""

    rows: slice
    columns: slice
    reach: Reaches


def plan_tiles(
    placed: Sequence[PlacedSweep], camera: LineCamera, grid: PixelGrid, tile_shape: tuple[int, int]
) -> list[Tile]:
    """List a grid's tiles down the columns, so that lines are read once for the next tiles."""
    reaches = [[ScanPathReach(one, scan_path, camera, grid) for scan_path, _ in one.scan_paths] for one in placed]
    tiles = []
    for columns in cuts(grid.shape[1], tile_shape[1]):
        shown = [[reach.in_columns(columns) for reach in scan_paths] for scan_paths in reaches]
        tiles += [Tile(rows, columns, shown) for rows in cuts(grid.shape[0], tile_shape[0])]
    return tiles


def cache_bytes(placed: Sequence[PlacedSweep], tiles: Sequence[Tile], at_once: int) -> int:
    """Return the memory for the raw lines that any ``at_once`` tiles in a row need together [bytes]."""
    needed = [_blocks_of(placed, tile) for tile in tiles]
    runs = (needed[first : first + at_once] for first in range(max(len(needed) - at_once, 0) + 1))
    return max((sum({key: size for part in run for key, size in part.items()}.values()) for run in runs), default=0)


def _blocks_of(placed: Sequence[PlacedSweep], tile: Tile) -> dict[tuple[int, int, int, int], int]:
    """Return the sizes of the blocks of raw lines of a tile, by sweep, block and samples."""
    blocks = {}
    for sweep, (one, scan_paths) in enumerate(zip(placed, tile.reach, strict=True)):
        bands = one.signal.bands
        for (scan_path, _), near in zip(one.scan_paths, scan_paths, strict=True):
            knots = slice(0, 0) if near is None else near.knots(tile.rows)
            if near is None or knots.start == knots.stop:
                continue
            members = member_lines(scan_path, knots)
            held = held_samples(one.lines, near.samples)
            for number in line_blocks(slice(int(members.min()), int(members.max()) + 1)):
                blocks[sweep, number, held.start, held.stop] = BLOCK_LINES * (held.stop - held.start) * bands * 2
    return blocks


@dataclass(frozen=True)
class MosaicWork:
    """Placed sweeps, camera and grid of a mosaic."""

    placed: Sequence[PlacedSweep]
    camera: LineCamera
    grid: PixelGrid
    kernel: Kernel = "catmull-rom"


OpenWork = Callable[[], MosaicWork]  # hashable, and picklable for worker processes: it holds paths


@dataclass(frozen=True)
class TileMaker:
    """Makes tiles in any process, with ``cache`` bytes of raw lines kept from tile to tile."""

    open: OpenWork
    cache: int

    def __call__(self, place: Place) -> tuple[Values, Counts]:
        """Return the (y, x, component) scores and (y, x) coverage of a part, NaN and 0 where nothing is seen."""
        rows, columns = place
        work, lines, reach = opened_tiles(self)
        shown = reach(columns.start, columns.stop)
        return mosaic_tile(
            work.placed, work.camera, work.grid, rows, columns, kernel=work.kernel, cache=lines, reach=shown
        )


@kept
def opened_work(open_work: OpenWork) -> MosaicWork:
    """Open work once in this process."""
    return open_work()


@kept
def opened_tiles(maker: TileMaker) -> tuple[MosaicWork, LineCache, Callable[[int, int], Reaches]]:
    """Return the work, the cache of lines and the reach of columns; only those of the last maker are kept."""
    work = opened_work(maker.open)
    reach = lru_cache(maxsize=2)(
        lambda start, stop: column_reach(work.placed, work.camera, work.grid, slice(start, stop))
    )
    return work, LineCache(maker.cache), reach
