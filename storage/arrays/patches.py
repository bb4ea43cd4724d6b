"""Fine patches: (patch, y, x, band) float32, one chunk a patch. What was seen finely stays where it was seen."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from pipeline.errors import ChunkError, ShapeError
from storage.arrays.layout import (
    AngularGrid,
    ArraySpec,
    create_array,
    create_group,
    grid_record,
    open_group,
    read_array,
    read_bands,
    round_bits,
    write_bands,
    write_image,
    write_small,
)

PATCHES_A_SHARD = 64


class PatchWriter:
    """Write patches a few at a time, so that they never have to be in memory together.

    Values are rounded to 11 bits.
    """

    def __init__(
        self,
        path: Path,
        seats: NDArray[np.integer],
        origin_px: NDArray[np.integer],
        patch_px: int,
        wavelength_nm: NDArray[np.float64],
        *,
        fwhm_nm: NDArray[np.float64] | None = None,
        grid: AngularGrid | None = None,
    ) -> None:
        count, bands = len(seats), len(wavelength_nm)
        if seats.shape != (count,) or origin_px.shape != (count, 2):
            raise ShapeError(f"seats {seats.shape} and origins {origin_px.shape} must be (patch,) and (patch, 2)")
        group = create_group(path, "fine patches", grid_record(grid))
        names = write_bands(group, wavelength_nm, fwhm_nm)
        for name, values, meaning in (
            ("seat", seats, "number of the seat on the padded grid"),
            ("seat_y", origin_px[:, 0], "row of the patch's first pixel"),
            ("seat_x", origin_px[:, 1], "column of the patch's first pixel"),
        ):
            write_small(group, name, ("patch",), np.asarray(values, np.int64), {"long_name": meaning, "units": "1"})
        coordinates = "seat seat_y seat_x"
        self._count = count
        shape = (count, patch_px, patch_px)
        about = {"long_name": "scene value", "units": "1", "coordinates": f"{names} {coordinates}"}
        self._values = _create_stack(group, "values", ("patch", "y", "x", "band"), (*shape, bands), "<f4", about)
        about = {"long_name": "pixel was seen and lies on the scene", "coordinates": coordinates}
        self._valid = _create_stack(group, "valid", ("patch", "y", "x"), shape, "|b1", about)

    def write(self, first: int, values: NDArray[np.floating], valid: NDArray[np.bool_]) -> None:
        """Store (patch, y, x, band) values and (patch, y, x) validity from patch ``first`` on.

        Raises ChunkError: the patches split a shard of 64. ShapeError: they do not fit the store.
        """
        last = first + len(values)
        if values.shape[1:] != self._values.shape[1:] or valid.shape != values.shape[:3] or last > self._count:
            raise ShapeError(f"patches {first}:{last} are {values.shape} and {valid.shape} in {self._values.shape}")
        if first % PATCHES_A_SHARD or (last % PATCHES_A_SHARD and last != self._count):
            raise ChunkError(
                f"patches {first}:{last} split shards of {PATCHES_A_SHARD}; start and end at their multiples"
            )
        if len(values):
            self._values[first:last] = round_bits(values)
            self._valid[first:last] = valid


def _create_stack(
    group: zarr.Group, name: str, dims: tuple[str, ...], shape: tuple[int, ...], dtype: str, about: dict[str, Any]
) -> zarr.Array[Any]:
    """One chunk an entry of the first axis, 64 of them a file."""
    shard = min(PATCHES_A_SHARD, max(shape[0], 1))
    return create_array(group, name, ArraySpec(dims, shape, dtype, (1, *shape[1:]), (shard, *shape[1:])), about)


@dataclass(frozen=True)
class PatchStore:
    """Stored patches, opened; values are read when asked for."""

    seats: NDArray[np.int64]  # (patch,)
    group: zarr.Group

    def read(self, start: int, stop: int) -> NDArray[np.float32]:
        """Values of some patches, (patch, y, x, band) float32."""
        return read_array(self.group, "values", slice(start, stop))

    def pick(self, entries: NDArray[np.integer]) -> NDArray[np.float32]:
        """Values of the patches with these numbers in the store, ascending, (patch, y, x, band) float32."""
        runs = np.split(entries, np.flatnonzero(np.diff(entries) != 1) + 1) if len(entries) else []
        parts = [self.read(int(run[0]), int(run[-1]) + 1) for run in runs]
        return np.concatenate(parts) if parts else self.read(0, 0)

    @property
    def wavelength_nm(self) -> NDArray[np.float64]:
        """(band,) wavelengths of the values."""
        return read_bands(self.group)[0]


def open_patches(path: Path) -> PatchStore:
    """Open stored patches. Raises IncompleteStoreError where they are missing or damaged."""
    group = open_group(path)
    return PatchStore(read_array(group, "seat"), group)


@dataclass(frozen=True)
class Attention:
    """Scores of all seats and the order in which seats were chosen."""

    score: NDArray[np.float64]  # (seat_y, seat_x), NaN where there is none
    rank: NDArray[np.int32]  # (seat_y, seat_x), 0 = chosen first, -1 = not chosen
    policy: str


def write_attention(path: Path, attention: Attention) -> None:
    """Store scores and ranks (ShapeError: they have different shapes)."""
    if attention.score.shape != attention.rank.shape or attention.score.ndim != 2:
        raise ShapeError(f"score {attention.score.shape} and rank {attention.rank.shape} must both be (seat_y, seat_x)")
    group = create_group(path, "attention", {"policy": attention.policy})
    dims = ("seat_y", "seat_x")
    about = {"long_name": f"worth of a fine look, policy {attention.policy}", "units": "1"}
    write_image(group, "score", dims, np.asarray(attention.score, np.float64), about)
    about = {"long_name": "order in which the seat was chosen, from 0; -1 where it was not", "units": "1"}
    write_image(group, "rank", dims, np.asarray(attention.rank, np.int32), about)


def load_attention(path: Path) -> Attention:
    """Read scores and ranks. Raises IncompleteStoreError where they are missing or damaged."""
    group = open_group(path)
    return Attention(read_array(group, "score"), read_array(group, "rank"), str(group.attrs.get("policy", "")))
