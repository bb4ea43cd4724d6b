"""Compute figures of opened runs: spectral indices, spectra of classes, and changes of class between two runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import xarray
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import ShapeError
from spectralzoom.pipeline.geometry.grid import UNLABELLED, cuts
from spectralzoom.pipeline.ground.field_places import M2_PER_HECTARE
from spectralzoom.pipeline.ground.georeference import pixel_rows_m2
from spectralzoom.pipeline.products.indices import (
    SAMPLED,
    check_white,
    find_index,
    index_values,
    pick_bands,
    white_level,
)
from spectralzoom.spectra import open_lazy_mosaic
from spectralzoom.storage.arrays.band_order import by_wavelength
from spectralzoom.storage.arrays.georeference import load_geobox
from spectralzoom.storage.arrays.layout import SHARD_ROWS
from spectralzoom.storage.arrays.mosaics import open_mosaic

if TYPE_CHECKING:
    from spectralzoom.opened import OpenedRun

Numbers = NDArray[np.integer]


def index_map(mosaic: Path, run: str, name: str) -> xarray.DataArray:
    """Return an index of a mosaic; raises as `OpenedRun.index`."""
    index, stored, opened = find_index(name), open_mosaic(mosaic), open_lazy_mosaic(mosaic)
    white = white_level(stored.thinned(SAMPLED, range(len(stored.wavelength_nm))).reshape(-1))
    check_white(index, white, run)
    bands = opened.isel(band=list(pick_bands(index, opened["wavelength"].values)))
    nm = bands["wavelength"].values.tolist()
    found: xarray.DataArray = xarray.apply_ufunc(
        lambda values: index_values(index, values, nm, white=white),
        bands.drop_vars(["band", "wavelength"]),
        input_core_dims=[["band"]],
        dask="parallelized",
        output_dtypes=[np.float32],
    )
    return found.rename(index.name).assign_attrs(long_name=index.title, reference=index.reference, units="1")


def class_spectra(mosaic: Path, classes: Numbers, about: Mapping[str, Any], names: Sequence[str]) -> xarray.Dataset:
    """Return mean and standard deviation of the spectra of each class; see `OpenedRun.spectra`."""
    stored = open_mosaic(mosaic)
    number = _positions(classes, about)
    bands = range(len(stored.wavelength_nm))
    count, total, squares = np.zeros(len(names)), *np.zeros((2, len(names), len(bands)))
    for rows in cuts(stored.shape[0], SHARD_ROWS):
        values = stored.spectra(stored.scores(rows), bands).astype(np.float64)
        used = np.isfinite(values).all(axis=-1) & (number[rows] < len(names))
        chosen, of = values[used], np.eye(len(names))[number[rows][used]]
        count += of.sum(axis=0)
        total += of.T @ chosen
        squares += of.T @ chosen**2
    known = np.where(count, count, np.nan)[:, None]
    mean = total / known
    std = np.sqrt(np.maximum(squares / known - mean**2, 0))
    dims = ("class_name", "band")
    found = xarray.Dataset(
        {"mean": (dims, mean), "std": (dims, std), "pixels": ("class_name", count.astype(np.int64))},
        {"class_name": list(names), "wavelength": ("band", stored.wavelength_nm, {"units": "nm"})},
    )
    return by_wavelength(found)


def class_changes(earlier: OpenedRun, later: OpenedRun) -> pd.DataFrame:
    """Return the areas of pairs of classes; see `OpenedArchive.compare`. Raises ShapeError: the grids differ."""
    product = "ground_map" if all("ground_map" in run.products for run in (earlier, later)) else "class_map"
    images = [run.dataset(product)["classes"] for run in (earlier, later)]
    grids = [load_geobox(run.folder.parents[1] / run.receipt["products"][product]) for run in (earlier, later)]
    if grids[0] != grids[1] or not all(np.array_equal(images[0][axis], images[1][axis]) for axis in ("y", "x")):
        shapes = [" x ".join(map(str, one.shape)) for one in images]
        raise ShapeError(
            f"the maps of {earlier.name} ({shapes[0]} px) and {later.name} ({shapes[1]} px) are on two grids; compare "
            "runs of one field with the same size and place"
        )
    facts = [run.receipt.get("field") or {} for run in (earlier, later)]
    side_m, other_m = (one.get("ground_pixel_m") for one in facts)
    posed = any(run.receipt["settings"].get("pose") is not None for run in (earlier, later))
    weights = np.ones(images[0].shape)
    unit = "px"
    if grids[0] is not None:
        weights, unit = np.stack(list(pixel_rows_m2(grids[0]))) / M2_PER_HECTARE, "ha"
    elif side_m is not None and side_m == other_m and not posed:  # with a pose, pixels differ in size
        weights, unit = weights * side_m**2 / M2_PER_HECTARE, "ha"
    before, after = (_positions(one.values, one.attrs) for one in images)
    names = earlier.class_names, later.class_names
    used = (before < len(names[0])) & (after < len(names[1]))
    pairs = before[used].astype(np.intp) * len(names[1]) + after[used]
    table = np.bincount(pairs, weights[used], len(names[0]) * len(names[1])).reshape(len(names[0]), len(names[1]))
    found = pd.DataFrame(table, pd.Index(names[0], name=earlier.name), pd.Index(names[1], name=later.name))
    found.attrs["unit"] = unit
    return found if unit == "ha" else found.astype(np.int64)


def _positions(classes: Numbers, about: Mapping[str, Any]) -> NDArray[np.uint8]:
    """Return the place of each pixel's class in the list of names, 255 without a class."""
    place = np.full(256, UNLABELLED, np.uint8)
    place[np.asarray(about["flag_values"])] = np.arange(len(about["flag_values"]))
    return place[classes]
