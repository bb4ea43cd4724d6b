"""Fine patches: (patch, y, x, band) float32, one chunk a patch. What was seen finely stays where it was seen."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from pipeline.errors import ShapeError
from storage.layout import (
    AngularGrid,
    ArraySpec,
    create_array,
    create_group,
    grid_of,
    grid_record,
    open_group,
    read_array,
    read_bands,
    round_bits,
    write_bands,
    write_small,
)

_PATCHES_A_SHARD = 64


@dataclass(frozen=True)
class Patches:
    """Fine patches, one for each seat bought. ``values`` are rounded to 11 bits when stored."""

    seats: NDArray[np.int64]  # (patch,) numbers on the padded grid
    origin_px: NDArray[np.int64]  # (patch, 2) y and x of the first pixel
    values: NDArray[np.float32]  # (patch, y, x, band)
    valid: NDArray[np.bool_]  # (patch, y, x) pixels that were seen and lie on the scene
    wavelength_nm: NDArray[np.float64]
    fwhm_nm: NDArray[np.float64] | None = None
    grid: AngularGrid | None = None


def write_patches(path: Path, patches: Patches) -> None:
    """Store patches, each one chunk. None at all is fine.

    Raises
    ------
    ShapeError : the arrays do not fit each other.
    """
    count, y, x, bands = patches.values.shape
    shapes = (patches.seats.shape, patches.origin_px.shape, patches.valid.shape, patches.wavelength_nm.shape)
    if shapes != ((count,), (count, 2), (count, y, x), (bands,)):
        raise ShapeError(f"patches {patches.values.shape} do not fit seats, origins, valid, wavelengths {shapes}")
    group = create_group(path, "fine patches", grid_record(patches.grid))
    names = write_bands(group, patches.wavelength_nm, patches.fwhm_nm)
    seats = "seat seat_y seat_x"
    for name, values, meaning in (
        ("seat", patches.seats, "number of the seat on the padded grid"),
        ("seat_y", patches.origin_px[:, 0], "row of the patch's first pixel"),
        ("seat_x", patches.origin_px[:, 1], "column of the patch's first pixel"),
    ):
        write_small(group, name, ("patch",), np.asarray(values, np.int64), {"long_name": meaning, "units": "1"})
    about = {"long_name": "scene value", "units": "1", "coordinates": f"{names} {seats}"}
    _write_stack(group, "values", ("patch", "y", "x", "band"), round_bits(patches.values), about)
    about = {"long_name": "pixel was seen and lies on the scene", "coordinates": seats}
    _write_stack(group, "valid", ("patch", "y", "x"), patches.valid, about)


def _write_stack(
    group: zarr.Group, name: str, dims: tuple[str, ...], values: NDArray[Any], about: dict[str, Any]
) -> None:
    """One chunk an entry of the first axis, 64 of them a file."""
    rest = values.shape[1:]
    shard = min(_PATCHES_A_SHARD, max(len(values), 1))
    array = create_array(
        group, name, ArraySpec(dims, values.shape, values.dtype.str, (1, *rest), (shard, *rest)), about
    )
    if len(values):
        array[...] = values


def load_patches(path: Path) -> Patches:
    """Read all patches. Raises IncompleteStoreError where they are missing or damaged."""
    group = open_group(path)
    wavelength, fwhm = read_bands(group)
    return Patches(
        seats=read_array(group, "seat"),
        origin_px=np.stack([read_array(group, "seat_y"), read_array(group, "seat_x")], axis=-1),
        values=read_array(group, "values"),
        valid=read_array(group, "valid"),
        wavelength_nm=wavelength,
        fwhm_nm=fwhm,
        grid=grid_of(dict(group.attrs)),
    )
