"""The mosaic, (y, x, band) float32 on the scene grid; fine patches, and the scores that chose them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from pipeline.errors import ShapeError
from storage.arrays.georeference import create_placed_group, write_corners
from storage.arrays.layout import (
    QUICK_PACKING,
    SHARD_ROWS,
    AngularGrid,
    ArraySpec,
    create_array,
    create_group,
    damage_named,
    grid_of,
    image_spec,
    open_group,
    read_array,
    read_bands,
    round_bits,
    whole_shards,
    write_bands,
    write_counts,
    write_image,
    write_small,
)
from storage.arrays.quicklooks import Quicklook, Thumbnail, ThumbnailCut, write_quicklook
from storage.parallel.pool import WorkerPool, run_blocks


@dataclass(frozen=True)
class Mosaic:
    """A stored mosaic, in memory."""

    values: NDArray[np.float32]  # (y, x, band), NaN where no line reached
    coverage: NDArray[np.float32]  # (y, x) weight of what was seen, 0 where nothing
    wavelength_nm: NDArray[np.float64]
    fwhm_nm: NDArray[np.float64] | None = None
    grid: AngularGrid | None = None
    quicklook: NDArray[np.uint8] | None = None  # (y, x, 3) at any smaller size, for viewers


class MosaicWriter:
    """Write a mosaic in tiles of whole shards, so that it never has to be in memory as a whole.

    Values are rounded to 11 bits.
    """

    def __init__(
        self,
        path: Path,
        shape: tuple[int, int],
        wavelength_nm: NDArray[np.float64],
        *,
        fwhm_nm: NDArray[np.float64] | None = None,
        grid: AngularGrid | None = None,
        simulation: Mapping[str, Any] | None = None,
    ) -> None:
        simulated = {} if simulation is None else {"simulation": dict(simulation)}
        self.path = path
        self.group, place = create_placed_group(path, "mosaic", grid, shape, simulated)
        bands = " ".join(filter(None, [write_bands(self.group, wavelength_nm, fwhm_nm), place.get("coordinates")]))
        self._shape = (*shape, len(wavelength_nm))
        about = {"long_name": "scene value", "units": "1", **place, "coordinates": bands}
        self._values = create_array(self.group, "values", image_spec(("y", "x", "band"), self._shape, "<f4"), about)
        about = {"long_name": "weight of the samples seen", "units": "1", **place}
        self._coverage = create_array(self.group, "coverage", image_spec(("y", "x"), shape, "<f4"), about)

    @classmethod
    def reopen(cls, path: Path) -> MosaicWriter:
        """Go on writing tiles of a mosaic that another writer has begun, in this process or another.

        Raises IncompleteStoreError: no mosaic has been begun there.
        """
        writer = cls.__new__(cls)
        writer.path = path
        with damage_named(str(path)):
            writer.group = zarr.open_group(path, mode="r+", zarr_format=3, use_consolidated=False)
            values, coverage = (writer.group[name] for name in ("values", "coverage"))
            if not isinstance(values, zarr.Array) or not isinstance(coverage, zarr.Array):
                raise KeyError("values and coverage are no arrays")
            y, x, bands = values.shape
        writer._values, writer._coverage, writer._shape = values, coverage, (y, x, bands)
        return writer

    @property
    def tile_shape(self) -> tuple[int, int]:
        """(y, x) of a shard, the least that can be written by itself: 64 rows of at most 640 columns."""
        rows, columns = image_spec(("y", "x"), self._shape[:2], "<f4").shard or self._shape[:2]
        return rows, columns

    def write_tile(
        self, first_row: int, first_column: int, values: NDArray[np.floating], coverage: NDArray[np.generic]
    ) -> None:
        """Store (y, x, band) values and (y, x) coverage of whole shards; threads may write different ones at once.

        Raises ChunkError: the tile splits a shard. ShapeError: the tile does not fit the mosaic.
        """
        rows = slice(first_row, first_row + values.shape[0])
        columns = slice(first_column, first_column + values.shape[1])
        beyond = rows.stop > self._shape[0] or columns.stop > self._shape[1]
        if values.shape[2:] != self._shape[2:] or coverage.shape != values.shape[:2] or beyond:
            raise ShapeError(
                f"the tile at row {first_row}, column {first_column} has shapes {values.shape} and {coverage.shape}; "
                f"the mosaic is {self._shape}"
            )
        whole_shards("the mosaic", (rows, columns), self._shape[:2], self.tile_shape)
        self._values[rows, columns] = round_bits(values)
        self._coverage[rows, columns] = coverage.astype(np.float32)

    def write_quicklook(self, image: NDArray[np.uint8]) -> None:
        """Store a small colour picture, (y, x, 3) uint8, beside the mosaic."""
        write_quicklook(self.group, Quicklook(image))


MakeTile = Callable[[slice, slice], tuple[NDArray[np.float32], NDArray[np.generic]]]  # (rows, columns) of a mosaic


def write_tiles(
    writer: MosaicWriter,
    make: MakeTile,
    places: Sequence[tuple[slice, slice]],
    pool: WorkerPool,
    *,
    paths: Sequence[Path] = (),
    seen: Thumbnail | None = None,
    report: Callable[[float], None] = lambda done: None,
) -> None:
    """Store what ``make`` gives for the rows and columns of ``places``, each in a task of its own.

    Whoever makes the tiles, the same bytes come out. ``seen`` is filled with the pixels that it shows; see `run_blocks`
    for the others and for what is raised.
    """
    task = _TileTask(make, writer.path.absolute(), None if seen is None else seen.cut)
    if pool.shares_memory:
        _reopened(task.out)  # before several threads ask for it
    run_blocks(
        task,
        places,
        pool,
        keep=False,
        report=report,
        paths=[*paths, task.out],
        each=lambda place, part: None if seen is None or part is None else seen.put(*place, part),
    )
    _reopened.cache_clear()


@dataclass(frozen=True)
class _TileTask:
    """Makes and stores a tile in any process: a shard of its own, whose files nothing else touches."""

    make: MakeTile
    out: Path  # the mosaic, begun
    cut: ThumbnailCut | None

    def __call__(self, place: tuple[slice, slice]) -> NDArray[np.float32] | None:
        """Make and write the tile of some rows and columns; return what a thumbnail shows of it."""
        (rows, columns), (values, coverage) = place, self.make(*place)
        part = None if self.cut is None else self.cut(rows, columns, values).copy()
        _reopened(self.out).write_tile(rows.start, columns.start, values, coverage)
        return part


@lru_cache(maxsize=1)
def _reopened(path: Path) -> MosaicWriter:
    return MosaicWriter.reopen(path)


def load_mosaic(path: Path) -> Mosaic:
    """Read a mosaic. Raises IncompleteStoreError where it is missing or damaged."""
    group = open_group(path)
    wavelength, fwhm = read_bands(group)
    return Mosaic(
        values=read_array(group, "values"),
        coverage=read_array(group, "coverage"),
        wavelength_nm=wavelength,
        fwhm_nm=fwhm,
        grid=grid_of(dict(group.attrs)),
        quicklook=read_array(group, "quicklook") if "quicklook" in group else None,
    )


def mosaic_rows(path: Path, rows: slice = slice(None), columns: slice = slice(None)) -> Iterator[NDArray[np.float32]]:
    """Read a window of a mosaic from the top down, (y, x, band) strips that end where shards do.

    Raises IncompleteStoreError: the mosaic is missing or damaged.
    """
    group = open_group(path)
    with damage_named(f"{path}/values"):
        first, last, _ = rows.indices(group["values"].shape[0])  # type: ignore[union-attr]
    while first < last:
        below = min((first // SHARD_ROWS + 1) * SHARD_ROWS, last)
        yield read_array(group, "values", (slice(first, below), columns))
        first = below


def mosaic_wavelengths(path: Path) -> NDArray[np.float64]:
    """(band,) wavelengths of a mosaic [nm]. Raises IncompleteStoreError where it is missing or damaged."""
    return read_bands(open_group(path))[0]


def mosaic_brightness(path: Path) -> NDArray[np.float32]:
    """Mean over the bands, (y, x). Raises IncompleteStoreError where the mosaic is missing or damaged."""
    return np.concatenate([strip.mean(axis=-1) for strip in mosaic_rows(path)])


PATCHES_A_SHARD = 64
CHUNK_BYTES = 1 << 22  # smaller ones cost more calls than they save in reading single patches


class PatchWriter:
    """Write patches in order, a few at a time, so that they never have to be in memory together.

    Values are rounded to 11 bits.
    """

    def __init__(
        self,
        path: Path,
        patch_index: NDArray[np.integer],
        origin_px: NDArray[np.integer],
        patch_px: int,
        wavelength_nm: NDArray[np.float64],
        *,
        fwhm_nm: NDArray[np.float64] | None = None,
        grid: AngularGrid | None = None,
    ) -> None:
        count, bands = len(patch_index), len(wavelength_nm)
        if patch_index.shape != (count,) or origin_px.shape != (count, 2):
            raise ShapeError(
                f"patches {patch_index.shape} and origins {origin_px.shape} must be (patch,) and (patch, 2)"
            )
        group = create_group(path, "fine patches", {} if grid is None else {"angular_grid": grid.record()})
        names = write_bands(group, wavelength_nm, fwhm_nm)
        for name, values, meaning in (
            ("patch_index", patch_index, "number of the patch on the padded grid"),
            ("patch_y", origin_px[:, 0], "row of the patch's first pixel"),
            ("patch_x", origin_px[:, 1], "column of the patch's first pixel"),
        ):
            write_small(group, name, ("patch",), np.asarray(values, np.int64), {"long_name": meaning, "units": "1"})
        write_counts(group, patch=count, y=patch_px, x=patch_px)
        coordinates = " ".join(["patch_index patch_y patch_x", *write_corners(group, grid, origin_px)])
        self._count = count
        shape = (count, patch_px, patch_px)
        about = {"long_name": "scene value", "units": "1", "coordinates": f"{names} {coordinates}"}
        self._values = _create_stack(group, "values", ("patch", "y", "x", "band"), (*shape, bands), "<f4", about)
        about = {"long_name": "pixel was seen and lies on the scene", "coordinates": coordinates}
        self._valid = _create_stack(group, "valid", ("patch", "y", "x"), shape, "|b1", about)
        self._next = 0  # patch that comes
        shard = min(PATCHES_A_SHARD, max(count, 1))
        # the shard that it lies in: memory that was used before, where fresh memory would cost more than the rounding
        self._held = np.empty((shard, *shape[1:], bands), np.float32), np.empty((shard, *shape[1:]), np.bool_)

    def write(self, values: NDArray[np.floating], valid: NDArray[np.bool_]) -> None:
        """Store the next (patch, y, x, band) values and (patch, y, x) validity, any number of patches.

        A shard of 64 is written once it is full, the last one once all patches are there. Raises ShapeError: they do
        not fit the store.
        """
        count, (rounded, seen) = len(values), self._held
        last = self._next + count
        if values.shape[1:] != self._values.shape[1:] or valid.shape != values.shape[:3] or last > self._count:
            raise ShapeError(
                f"patches {self._next}:{last} are {values.shape} and {valid.shape} in {self._values.shape}"
            )
        taken = 0
        while taken < count:
            at = self._next % PATCHES_A_SHARD
            some = slice(taken, min(taken + PATCHES_A_SHARD - at, count))
            end = at + some.stop - some.start
            round_bits(values[some], out=rounded[at:end])
            seen[at:end] = valid[some]
            first, taken, self._next = self._next - at, some.stop, self._next - at + end
            if end == PATCHES_A_SHARD or self._next == self._count:
                self._values[first : self._next], self._valid[first : self._next] = rounded[:end], seen[:end]


def _create_stack(
    group: zarr.Group, name: str, dims: tuple[str, ...], shape: tuple[int, ...], dtype: str, about: dict[str, Any]
) -> zarr.Array[Any]:
    """64 entries of the first axis a file, in equal chunks of up to 4 MB."""
    shard = min(PATCHES_A_SHARD, max(shape[0], 1))
    fits = CHUNK_BYTES // max(math.prod(shape[1:]) * np.dtype(dtype).itemsize, 1)
    chunk = max(count for count in range(1, shard + 1) if shard % count == 0 and count <= max(fits, 1))
    spec = ArraySpec(dims, shape, dtype, (chunk, *shape[1:]), (shard, *shape[1:]))
    return create_array(group, name, spec, about, packing=QUICK_PACKING)


@dataclass(frozen=True)
class PatchStore:
    """Stored patches, opened; values are read when asked for."""

    patch_index: NDArray[np.int64]  # (patch,)
    group: zarr.Group

    def read(self, start: int, stop: int) -> NDArray[np.float32]:
        """Values of some patches, (patch, y, x, band) float32."""
        return read_array(self.group, "values", slice(start, stop))

    def pick(self, entries: NDArray[np.integer]) -> NDArray[np.float32]:
        """Values of the patches with these numbers in the store, ascending, (patch, y, x, band) float32."""
        runs = np.split(entries, np.flatnonzero(np.diff(entries) != 1) + 1) if len(entries) else []
        parts = [self.read(int(run[0]), int(run[-1]) + 1) for run in runs]
        if len(parts) == 1:
            return parts[0]
        return np.concatenate(parts) if parts else self.read(0, 0)

    @property
    def wavelength_nm(self) -> NDArray[np.float64]:
        """(band,) wavelengths of the values."""
        return read_bands(self.group)[0]


def open_patches(path: Path) -> PatchStore:
    """Open stored patches. Raises IncompleteStoreError where they are missing or damaged."""
    group = open_group(path)
    return PatchStore(read_array(group, "patch_index"), group)


@dataclass(frozen=True)
class Attention:
    """Scores of all patches and the order in which patches were chosen."""

    score: NDArray[np.float64]  # (patch_y, patch_x), NaN where there is none
    rank: NDArray[np.int32]  # (patch_y, patch_x), 0 = chosen first, -1 = not chosen
    policy: str


def write_attention(path: Path, attention: Attention) -> None:
    """Store scores and ranks (ShapeError: they have different shapes)."""
    if attention.score.shape != attention.rank.shape or attention.score.ndim != 2:
        raise ShapeError(
            f"score {attention.score.shape} and rank {attention.rank.shape} must both be (patch_y, patch_x)"
        )
    group = create_group(path, "attention", {"policy": attention.policy})
    write_counts(group, patch_y=attention.score.shape[0], patch_x=attention.score.shape[1])
    dims = ("patch_y", "patch_x")
    about = {"long_name": f"worth of a fine look, policy {attention.policy}", "units": "1"}
    write_image(group, "score", dims, np.asarray(attention.score, np.float64), about)
    about = {"long_name": "order in which the patch was chosen, from 0; -1 where it was not", "units": "1"}
    write_image(group, "rank", dims, np.asarray(attention.rank, np.int32), about)


def load_attention(path: Path) -> Attention:
    """Read scores and ranks. Raises IncompleteStoreError where they are missing or damaged."""
    group = open_group(path)
    return Attention(read_array(group, "score"), read_array(group, "rank"), str(group.attrs.get("policy", "")))


def mosaic_shape(path: Path) -> tuple[int, int]:
    """(y, x) of a stored mosaic. Raises IncompleteStoreError where there is none, or it is damaged."""
    group = open_group(path)
    with damage_named(str(path)):
        array = group["coverage"]
        if not isinstance(array, zarr.Array):
            raise KeyError("coverage is no array")
        return int(array.shape[0]), int(array.shape[1])
