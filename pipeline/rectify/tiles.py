"""Tiles of a mosaic: their order, and the memory that making them takes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from pipeline.geometry.camera import LineCamera
from pipeline.rectify.line_cache import BLOCK_LINES, held_samples, line_blocks
from pipeline.rectify.placed import PixelGrid, Placed
from pipeline.rectify.reach import ColumnReach, TrackReach, member_lines

COPIES = 5  # of a tile in memory at once: values, parts and calibrated lines, rounded, chunks and shard


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
    reaches = [[TrackReach(one, track, camera, grid) for track, _ in one.tracks] for one in placed]
    tiles = []
    for columns in _cuts(grid.shape[1], tile_shape[1]):
        shown = tuple(tuple(reach.in_columns(columns) for reach in tracks) for tracks in reaches)
        tiles += [Tile(rows, columns, shown) for rows in _cuts(grid.shape[0], tile_shape[0])]
    return tiles


def _cuts(size: int, step: int) -> Iterator[slice]:
    return (slice(first, min(first + step, size)) for first in range(0, size, step))


def tile_bytes(tile_shape: tuple[int, int], bands: int) -> int:
    """Memory that one tile takes while it is made and written, raw lines not counted [bytes]."""
    return COPIES * tile_shape[0] * tile_shape[1] * bands * 4


def cache_bytes(placed: Sequence[Placed], tiles: Sequence[Tile], at_once: int) -> int:
    """Memory for the raw lines that any ``at_once`` tiles in a row need together [bytes]."""
    needed = [_blocks_of(placed, tile) for tile in tiles]
    runs = (needed[first : first + at_once] for first in range(max(len(needed) - at_once, 0) + 1))
    return max((sum({key: size for part in run for key, size in part.items()}.values()) for run in runs), default=0)


def _blocks_of(placed: Sequence[Placed], tile: Tile) -> dict[tuple[int, int, int, int], int]:
    """Sizes of the blocks of raw lines behind a tile, by sweep, block and samples."""
    blocks = {}
    for sweep, (one, tracks) in enumerate(zip(placed, tile.reach, strict=True)):
        bands = len(one.lines.references.panel)
        for (track, _), near in zip(one.tracks, tracks, strict=True):
            knots = slice(0, 0) if near is None else near.knots(tile.rows)
            if near is None or knots.start == knots.stop:
                continue
            members = member_lines(track, knots)
            held = held_samples(one.lines, near.samples)
            for number in line_blocks(slice(int(members.min()), int(members.max()) + 1)):
                blocks[sweep, number, held.start, held.stop] = BLOCK_LINES * (held.stop - held.start) * bands * 2
    return blocks
