"""Stores as xarray hands them to people: a coordinate on every axis, bands found by wavelength, classes as numbers.

Places that a store names itself are taken as they stand; what stores of before lack follows from their transform.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.lazy import deferred
from storage.arrays.layout import damage_named

if TYPE_CHECKING:
    import xarray
else:
    xarray = deferred("xarray")  # a second, which most commands do without

PICTURES = ("quicklook",)  # for viewers, on axes of their own
TANGENT = "tangent of the angle from the undeflected direction"
_AXES = {"y": 5, "x": 2}  # where an affine transform has each axis' first edge, and its step before that


def open_labelled(path: Path) -> xarray.Dataset:
    """Open a store lazily, in dask's blocks of whole shards, with a coordinate on every axis.

    ``y`` and ``x`` are in metres where the store lies on a map (its CRS in ``spatial_ref``), else tangents of the angle
    from the undeflected direction [rad], else pixels; ``band`` and ``wavelength`` are in nm, both an index. Numbers are
    those of the store: no class becomes a float, whatever stands for none. Raises IncompleteStoreError: there is no
    such store, or its metadata is damaged.
    """
    with damage_named(str(path)):
        opened = xarray.open_dataset(
            path, engine="zarr", consolidated=False, mask_and_scale=False, chunks=None, cache=False
        )
        opened = in_shards(opened.drop_vars([name for name in PICTURES if name in opened]))
    return by_wavelength(on_axes(opened, opened.attrs))


def in_shards(opened: xarray.Dataset) -> xarray.Dataset:
    """Arrays as dask's, in blocks of what is one file each; coordinates stay as they are."""

    def split(one: xarray.DataArray) -> xarray.DataArray:
        blocks = one.encoding.get("shards") or one.encoding.get("chunks") or one.shape
        return one.chunk(dict(zip(one.dims, blocks, strict=True)))

    return opened.assign({name: split(one) for name, one in opened.data_vars.items()})


def on_axes(opened: xarray.Dataset, about: Mapping[Hashable, Any]) -> xarray.Dataset:
    """Give each axis without a coordinate one: places by the transform in ``about``, wavelengths, else numbers."""
    if "band" in opened.dims and "band" not in opened.variables and "wavelength" in opened.variables:
        opened = opened.assign_coords(band=("band", opened["wavelength"].values, opened["wavelength"].attrs))
    place = about.get("spatial:transform")
    missing = {str(name): size for name, size in opened.sizes.items() if name not in opened.variables}
    return opened.assign_coords({name: (name, *_labels(name, size, place)) for name, size in missing.items()})


def _labels(name: str, size: int, place: list[float] | None) -> tuple[Any, dict[str, str]]:
    """Values and attributes of one axis."""
    about = {"axis": name.upper()} if name in _AXES else {}
    if place is None or name not in _AXES:
        unit = {"units": "px"} if name in (*_AXES, "sample") else {}
        return np.arange(size), {"long_name": f"number of the {name}" if name not in _AXES else name, **unit, **about}
    last = _AXES[name]
    step, first = place[4 if name == "y" else 0], place[last]
    return first + (np.arange(size) + 0.5) * step, {"long_name": f"{TANGENT}, {name}", "units": "rad", **about}


def by_wavelength(opened: xarray.Dataset) -> xarray.Dataset:
    """Make ``wavelength`` an index of its bands, so that ``.sel(wavelength=660, method="nearest")`` finds one.

    Where wavelengths rise or fall without a break, slices work as well; else (two spectrometers that overlap) only the
    nearest can be asked for.
    """
    if "wavelength" not in opened.coords or opened["wavelength"].ndim != 1:
        return opened
    steps = np.diff(opened["wavelength"].values)
    if (steps > 0).all() or (steps < 0).all():
        return opened.set_xindex("wavelength")
    return opened.set_xindex("wavelength", xarray.indexes.NDPointIndex)
