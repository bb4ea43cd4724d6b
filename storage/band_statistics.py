"""Statistics of every band of stored cubes: one part a row of shards, parts merged in any order to the same numbers.

Means and spreads are merged as Chan, Golub and LeVeque do (Am. Stat. 37:242, 1983), about a value of each part's own:
nothing cancels however far from zero a band lies. Percentiles come from counts in bins (``value_bins``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from pipeline.errors import ShapeError
from storage.arrays.layout import damage_named, open_group, read_array, read_bands
from storage.parallel.block_work import run_blocks
from storage.parallel.crew import THREADS, Crew
from storage.value_bins import KEPT, count_bins, merge_bins, percentile

PERCENTILES = (2.0, 50.0, 98.0)
ARRAYS = ("values", "dn")  # of a mosaic or an ingested cube, of a raw sweep

_NONE = np.empty(0, np.int64)

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class BandPart:
    """What is known of some pixels, (band,) each. Merge parts with `merged`."""

    pixels: int  # of each band, finite or not
    count: NDArray[np.int64]  # finite ones
    low: Floats  # inf where there is none
    high: Floats
    about: Floats  # a value of the part, from which the mean is counted
    above: Floats  # mean over `about`
    squares: Floats  # sum of squares from the mean
    bins: NDArray[np.int64]  # (n,) band << 18 | bin, rising
    tally: NDArray[np.int64]  # (n,) how many lie there

    @staticmethod
    def of(values: NDArray[np.generic]) -> BandPart:
        """Count (..., band) values; those that are not finite are left out."""
        bands = values.shape[-1]
        flat = np.ascontiguousarray(values.reshape(-1, bands).T)
        finite = [row if np.isfinite(row).all() else row[np.isfinite(row)] for row in flat]
        moments = np.array([_moments(row) for row in finite], np.float64).reshape(bands, 5).T
        tallies = [count_bins(row) if len(row) else (_NONE, _NONE) for row in finite]
        bins = np.concatenate([_NONE, *(one[0] + (band << KEPT) for band, one in enumerate(tallies))])
        tally = np.concatenate([_NONE, *(one[1] for one in tallies)])
        low, high, about, above, squares = moments
        count = np.array([len(row) for row in finite], np.int64)
        return BandPart(flat.shape[1], count, low, high, about, above, squares, bins, tally)

    def merged(self, other: BandPart) -> BandPart:
        """This and another part together, in either order the same but for the last digit."""
        if len(self.count) != len(other.count):
            raise ShapeError(f"parts of {len(self.count)} and {len(other.count)} bands cannot be merged")
        count = self.count + other.count
        share = other.count / np.maximum(count, 1)
        apart = np.where(
            (self.count > 0) & (other.count > 0), (other.about - self.about) + (other.above - self.above), 0
        )
        mine = self.count > 0
        bins, tally = merge_bins((self.bins, self.tally), (other.bins, other.tally))
        return BandPart(
            self.pixels + other.pixels, count,
            np.minimum(self.low, other.low), np.maximum(self.high, other.high),
            np.where(mine, self.about, other.about), np.where(mine, self.above + apart * share, other.above),
            self.squares + other.squares + apart**2 * self.count * share,
            bins, tally,
        )  # fmt: skip


@dataclass(frozen=True)
class BandTable:
    """Statistics of the bands of one product, (band,) each; NaN where no value is finite."""

    wavelength_nm: Floats  # NaN where nothing says them
    pixels: int
    finite: NDArray[np.int64]
    low: Floats
    high: Floats
    mean: Floats
    std: Floats  # of these pixels, not of a population that they are drawn from
    percentiles: dict[float, Floats]


def tabulate(part: BandPart, wavelength_nm: Floats) -> BandTable:
    """Read statistics off the merged part."""
    none = part.count == 0
    nan = np.where(none, np.nan, 0.0)
    spread = np.sqrt(part.squares / np.maximum(part.count, 1))
    low, high = (np.where(none, np.nan, edge) for edge in (part.low, part.high))
    starts = np.searchsorted(part.bins, np.arange(len(part.count) + 1) << KEPT)
    found = {percent: np.full(len(part.count), np.nan) for percent in PERCENTILES}
    for band in np.flatnonzero(~none):
        within = slice(starts[band], starts[band + 1])
        for percent in PERCENTILES:
            value = percentile(part.bins[within] & ((1 << KEPT) - 1), part.tally[within], percent)
            found[percent][band] = min(max(value, part.low[band]), part.high[band])
    return BandTable(
        wavelength_nm, part.pixels, part.count, low, high, part.about + part.above + nan, spread + nan, found
    )


def product_statistics(
    stores: Sequence[Path],
    crew: Crew = THREADS,
    *,
    array: str | None = None,
    report: Callable[[float], None] = lambda done: None,
) -> BandTable:
    """Statistics of each band over all pixels of some stores, a dask task for each row of shards.

    Parameters
    ----------
    stores
        Mosaics, raw sweeps or ingested cubes with the same bands. Lines that are marked as not valid do not count.
    array
        Name of the (y, x, band) or (line, sample, band) array in them; by default the one that such stores have.

    Returns
    -------
    Percentiles are values at their ranks, none between two, off by at most 1/512; the rest is exact to rounding.

    Raises
    ------
    ShapeError : there is no such array, or the stores' bands differ.
    IncompleteStoreError : a store is missing or damaged.
    """
    if not stores:
        raise ShapeError("expected at least one store with a cube, got none")
    waves = [_wavelengths(path, array) for path in stores]
    for path, wave in zip(stores, waves, strict=True):
        if not np.array_equal(wave, waves[0], equal_nan=True):
            raise ShapeError(f"{path} has other bands than {stores[0]}; ask for them one by one")
    found = [strip for path in stores for strip in plan_strips(path.absolute(), array)]
    strips = [replace(strip, number=number) for number, strip in enumerate(found)]
    merged = _InOrder(len(waves[0]))
    run_blocks(count_strip, strips, crew, keep=False, each=merged.take, report=report, paths=list(stores))
    return tabulate(merged.total, waves[0])


@dataclass(frozen=True)
class Strip:
    """A row of whole shards of one stored array: what one task reads."""

    store: Path
    array: str
    first: int
    stop: int
    number: int = 0  # among all that are counted together


def cube_stores(folder: Path) -> list[Path]:
    """The stores of a published folder that hold a cube, by name.

    Raises
    ------
    IncompleteStoreError : one of its stores is damaged.
    """
    return [path for path in sorted(folder.glob("*.zarr")) if _cube_name(open_group(path)) is not None]


def _cube_name(group: zarr.Group) -> str | None:
    """The array that such a store has."""
    with damage_named(str(group.store_path)):
        found = {name: group.get(name) for name in ARRAYS}
    return next((name for name, one in found.items() if isinstance(one, zarr.Array) and one.ndim == 3), None)


def plan_strips(store: Path, array: str | None = None) -> list[Strip]:
    """Cut a stored cube into rows of whole shards.

    Raises
    ------
    ShapeError : it has no (y, x, band) array of this name.
    """
    name = array or _cube_name(open_group(store)) or ARRAYS[0]
    cube = _cube(store, name)
    step = (cube.shards or cube.chunks)[0]
    return [Strip(store, name, first, min(first + step, cube.shape[0])) for first in range(0, cube.shape[0], step)]


def count_strip(strip: Strip) -> BandPart:
    """Read a strip shard by shard and count it."""
    cube, group = _cube(strip.store, strip.array), open_group(strip.store)
    rows = slice(strip.first, strip.stop)
    valid = None
    if strip.array in ("dn", "values") and "valid_line" in group:
        valid = read_array(group, "valid_line", rows).astype(bool)
    total = None
    for first in range(0, cube.shape[1], (cube.shards or cube.chunks)[1]):
        columns = slice(first, min(first + (cube.shards or cube.chunks)[1], cube.shape[1]))
        values = read_array(group, strip.array, (rows, columns))
        part = BandPart.of(values if valid is None else values[valid])
        if valid is not None:
            part = replace(part, pixels=values.shape[0] * values.shape[1])
        total = part if total is None else total.merged(part)
    return BandPart.of(np.empty((0, cube.shape[2]))) if total is None else total


class _InOrder:
    """Merges strips in their order, whichever ends first: the last digit does not depend on who was faster."""

    def __init__(self, bands: int) -> None:
        self.total = BandPart.of(np.empty((0, bands)))
        self._early: dict[int, BandPart] = {}
        self._next = 0

    def take(self, strip: Strip, part: BandPart) -> None:
        self._early[strip.number] = part
        while self._next in self._early:
            self.total = self.total.merged(self._early.pop(self._next))
            self._next += 1


def _wavelengths(store: Path, array: str | None) -> Floats:
    """(band,) wavelengths [nm], NaN for a cube whose file did not say them."""
    group = open_group(store)
    if "wavelength" in group:
        return read_bands(group)[0]
    return np.full(_cube(store, array or _cube_name(group) or ARRAYS[0]).shape[2], np.nan)


def _cube(store: Path, name: str) -> zarr.Array[Any]:
    group = open_group(store)
    with damage_named(f"{store}/{name}"):
        cube = group.get(name)
    if not isinstance(cube, zarr.Array) or cube.ndim != 3:
        there = ", ".join(sorted(one for one, found in group.arrays() if found.ndim == 3)) or "none"
        raise ShapeError(f"{store} has no array {name!r} of three axes, the last of them bands; there are: {there}")
    return cube


def _moments(finite: NDArray[np.generic]) -> tuple[float, ...]:
    """Lowest, highest, a value, the mean over it, and the sum of squares from the mean."""
    if not len(finite):
        return np.inf, -np.inf, 0.0, 0.0, 0.0
    values = finite.astype(np.float64)
    low, high, about = float(values.min()), float(values.max()), float(values[0])
    values -= about
    above = float(values.mean())
    values -= above
    values *= values
    return low, high, about, above, float(values.sum())
