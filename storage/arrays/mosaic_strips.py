"""Parts of a stored mosaic, some rows at a time: what is made of all of it never needs all of it in memory."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from storage.arrays.layout import SHARD_ROWS, damage_named, open_group, read_array, read_bands


def mosaic_strips(path: Path, rows: slice = slice(None), columns: slice = slice(None)) -> Iterator[NDArray[np.float32]]:
    """Read a window of a mosaic from the top down, (y, x, band) strips that end where shards do.

    Raises
    ------
    IncompleteStoreError : the mosaic is missing or damaged.
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
    return np.concatenate([strip.mean(axis=-1) for strip in mosaic_strips(path)])
