"""Pixels of a grid from the lines of sweeps: tiles of a mosaic, rows of it, and single patches."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.rectify.kernels import Kernel
from pipeline.rectify.mosaic import LocatedSweep, cut_runs, mosaic, read_part
from pipeline.rectify.placed import TAPS, ColumnReach, PixelGrid, Placed, ScanPathReach, member_lines, place
from pipeline.rectify.scan_paths import ScanPath
from pipeline.signal.lines import BLOCK_LINES, LineCache, Raw, ReadWindow, held_samples, line_blocks
from pipeline.source import SweepLines

COPIES = 5  # of a tile in memory at once: values, parts and calibrated lines, rounded, chunks and shard
GROUP_COLUMNS = 32  # tiles are cut between groups of so many columns

Values = NDArray[np.float32]
Counts = NDArray[np.intp]
Reaches = Sequence[Sequence[ColumnReach | None]]  # of each sweep, of each of its tracks


def column_reach(placed: Sequence[Placed], camera: LineCamera, grid: PixelGrid, columns: slice) -> Reaches:
    """Return what every track of every sweep shows of some columns: made once, it serves all tiles of these columns."""
    return [
        [ScanPathReach(one, scan_path, camera, grid).in_columns(columns) for scan_path, _ in one.scan_paths]
        for one in placed
    ]


def mosaic_tile(
    placed: Sequence[Placed],
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

    What comes out for a pixel does not depend on how the grid is cut into tiles, bit for bit. ``cache`` holds raw lines
    that earlier tiles read, None reads what is needed, once; ``reach`` is that of :func:`column_reach` for these
    columns or more, None makes it.

    (y, x, band) float32 with NaN where no line reached, (y, x) how many sweeps did (a sweep that turns may count
    once for each of its runs).
    """
    located = []
    for one, scan_paths in zip(placed, reach or column_reach(placed, camera, grid, columns), strict=True):
        for number, near in enumerate(scan_paths):
            knots = slice(0, 0) if near is None else near.knots(rows)
            if near is None or knots.stop == knots.start:
                continue
            scan_path = one.scan_paths[number][0]
            coordinates = one.coordinates(number, camera, grid, rows, columns)
            located.append(
                LocatedSweep(one, scan_path, coordinates, _reader(one, scan_path, coordinates, cache, near.samples))
            )
    shape = rows.stop - rows.start, columns.stop - columns.start
    bands = placed[0].signal.bands
    values, coverage = np.empty((*shape, bands), np.float32), np.zeros(shape, np.intp)
    if not located:
        values[...] = np.nan
    for run in cut_runs([_column_groups(one.coordinates) for one in located], bands) if located else []:
        part = slice(run.start * GROUP_COLUMNS, min(run.stop * GROUP_COLUMNS, shape[1]))
        seen, counts = _blend([(one, one.coordinates[:, part]) for one in located], camera, kernel)
        values[:, part], coverage[:, part] = seen.reshape(shape[0], -1, bands), counts.reshape(shape[0], -1)
    return values, coverage


def mosaic_rows(
    sweeps: Sequence[SweepLines], camera: LineCamera, grid: SceneGrid, *, rows: int
) -> Iterator[tuple[int, Values, Counts]]:
    """Rectify and blend the sweeps of one pass onto its grid, ``rows`` rows at a time.

    The pass's step says which grid: 1 the scene's pixels, ``grid.factor`` the coarse ones. Yields the first row,
    (row, x, band) float32 with NaN where no line reached, and (row, x) how many sweeps did.
    """
    pixels = PixelGrid.of_scene(grid, sweeps[0].sweep.step)
    placed = [place(lines, camera) for lines in sweeps]
    columns = slice(0, pixels.shape[1])
    reach = column_reach(placed, camera, pixels, columns)
    for first in range(0, pixels.shape[0], rows):
        part = slice(first, min(first + rows, pixels.shape[0]))
        yield first, *mosaic_tile(placed, camera, pixels, part, columns, reach=reach)


def patch_pixels(grid: SceneGrid, patch_index: NDArray[np.integer]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Give the points to look up for whole patches, (patch, p, p, 2), and which of them lie on the scene.

    A pixel beyond the scene's border repeats one inside by reflection within the patch, or the border pixel.
    """
    p = grid.patch
    inside = []
    places = []
    for axis, size in enumerate((grid.height, grid.width)):
        kept, there = _on_the_scene(grid.patch_origin(patch_index)[:, axis, None], p, size)
        inside.append(there)
        places.append(kept - (size - 1) / 2)
    y = np.broadcast_to(places[0][:, :, None], (len(patch_index), p, p))
    x = np.broadcast_to(places[1][:, None, :], (len(patch_index), p, p))
    return np.stack([y, x], axis=-1), inside[0][:, :, None] & inside[1][:, None, :]


def _on_the_scene(first: NDArray[np.integer], patch: int, size: int) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return the pixels of patches along one axis from ``first`` (patch, 1): numbers on the scene, and validity."""
    pixel = first + np.arange(patch)
    mirrored = 2 * (size - 1) - pixel
    return np.where(pixel < size, pixel, np.where(mirrored >= first, mirrored, size - 1)), pixel < size


def read_patches(
    sweeps: Sequence[SweepLines],
    camera: LineCamera,
    grid: SceneGrid,
    patch_index: NDArray[np.integer],
    kernel: Kernel = "catmull-rom",
) -> tuple[Values, NDArray[np.bool_]]:
    """Rectify whole patches from the sweeps that saw them.

    Best in the order in which the sweeps pass the patches: neighbours share what is read and calibrated.

    (patch, p, p, band) float32, NaN where no line reached, and (patch, p, p) pixels that lie on the scene and were
    seen.
    """
    placed = [place(one, camera) for one in sweeps]
    points, on_scene = patch_pixels(grid, patch_index)
    located = []
    for one in placed:
        for scan_path, _ in one.scan_paths:
            coordinates = one.locate_point(scan_path, camera, points)
            if np.isfinite(coordinates[..., 0]).any():
                whole = slice(0, one.signal.samples)
                located.append(
                    LocatedSweep(one, scan_path, coordinates, _reader(one, scan_path, coordinates, None, whole))
                )
    bands = placed[0].signal.bands
    values = np.full((*points.shape[:3], bands), np.nan, np.float32)
    coverage = np.zeros(points.shape[:3], np.intp)
    for run in cut_runs([one.coordinates for one in located], bands) if located else []:
        seen, counts = _blend([(one, one.coordinates[run]) for one in located], camera, kernel)
        values[run], coverage[run] = seen.reshape(values[run].shape), counts.reshape(coverage[run].shape)
    return values, on_scene & (coverage > 0)


def _blend(
    located: Sequence[tuple[LocatedSweep, NDArray[np.float64]]], camera: LineCamera, kernel: Kernel
) -> tuple[Values, Counts]:
    """Read every track that reaches some of the points and blend them, (n, band) and (n,)."""
    read = [read_part(one, coordinates.reshape(-1, 2), camera, kernel) for one, coordinates in located]
    parts = [part for part in read if part is not None]
    if parts:
        return mosaic(parts)
    count, bands = located[0][1].size // 2, located[0][0].placed.signal.bands
    return np.full((count, bands), np.nan, np.float32), np.zeros(count, np.intp)


def _column_groups(coordinates: NDArray[np.float64]) -> NDArray[np.float64]:
    """Group (y, x, 2) by 32 columns, (group, n, 2); the last group is filled with NaN."""
    rows, columns = coordinates.shape[:2]
    groups = -(-columns // GROUP_COLUMNS)
    if groups * GROUP_COLUMNS > columns:
        filled = np.full((rows, groups * GROUP_COLUMNS, 2), np.nan)
        filled[:, :columns] = coordinates
        coordinates = filled
    return coordinates.reshape(rows, groups, GROUP_COLUMNS, 2).swapaxes(0, 1)


def _reader(
    one: Placed, scan_path: ScanPath, coordinates: NDArray[np.float64], cache: LineCache | None, likely: slice
) -> ReadWindow:
    """Return how to read windows of a sweep: from the cache, or from one read of all lines that the points need."""
    if cache is not None:
        return lambda wanted, samples: cache.window(one.lines, wanted, samples, likely=likely)
    knot = coordinates[..., 0]
    if not np.isfinite(knot).any():
        return lambda wanted, samples: one.lines.read(wanted.start, wanted.stop)[:, samples]
    first, last = int(np.floor(np.nanmin(knot))), int(np.ceil(np.nanmax(knot)))
    members = member_lines(scan_path, slice(max(first - TAPS, 0), min(last + TAPS + 1, len(scan_path))))
    origin = int(members.min())
    raw: Raw = one.lines.read(origin, int(members.max()) + 1)
    return lambda wanted, samples: raw[wanted.start - origin : wanted.stop - origin, samples]


@dataclass(frozen=True)
class Tile:
    """A part of a mosaic that is made and written at once. ``reach`` is what each track of each sweep shows there."""

    rows: slice
    columns: slice
    reach: tuple[tuple[ColumnReach | None, ...], ...]


def plan_tiles(
    placed: Sequence[Placed], camera: LineCamera, grid: PixelGrid, tile_shape: tuple[int, int]
) -> list[Tile]:
    """List a grid's tiles in the order to make them: down the columns, so that lines read once serve the next tiles."""
    reaches = [[ScanPathReach(one, scan_path, camera, grid) for scan_path, _ in one.scan_paths] for one in placed]
    tiles = []
    for columns in _cuts(grid.shape[1], tile_shape[1]):
        shown = tuple(tuple(reach.in_columns(columns) for reach in scan_paths) for scan_paths in reaches)
        tiles += [Tile(rows, columns, shown) for rows in _cuts(grid.shape[0], tile_shape[0])]
    return tiles


def _cuts(size: int, step: int) -> Iterator[slice]:
    return (slice(first, min(first + step, size)) for first in range(0, size, step))


def cache_bytes(placed: Sequence[Placed], tiles: Sequence[Tile], at_once: int) -> int:
    """Memory for the raw lines that any ``at_once`` tiles in a row need together [bytes]."""
    needed = [_blocks_of(placed, tile) for tile in tiles]
    runs = (needed[first : first + at_once] for first in range(max(len(needed) - at_once, 0) + 1))
    return max((sum({key: size for part in run for key, size in part.items()}.values()) for run in runs), default=0)


def _blocks_of(placed: Sequence[Placed], tile: Tile) -> dict[tuple[int, int, int, int], int]:
    """Sizes of the blocks of raw lines behind a tile, by sweep, block and samples."""
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
