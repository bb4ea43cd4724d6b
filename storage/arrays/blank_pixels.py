"""Pixels of which a scene knows nothing, taken out of stored images: no class, no value, no memory."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from pathlib import Path

import numpy as np
import zarr
from numpy.typing import NDArray

from pipeline.geometry.grid import UNLABELLED
from storage.arrays.layout import damage_named, read_array

# of each kind of store: its images, and the number that stands for nothing in them
NO_CLASS = {"classes": UNLABELLED, "confidence": np.nan}
NO_VALUE = {"values": np.nan, "coverage": 0}


def blank_pixels(path: Path, where: NDArray[np.bool_], images: Mapping[str, float]) -> None:
    """Write nothing into the (y, x) pixels ``where`` of a store's images, one shard at a time.

    Raises IncompleteStoreError: an image is missing or damaged.
    """
    with damage_named(str(path)):
        group = zarr.open_group(path, mode="r+", zarr_format=3, use_consolidated=False)
        arrays = {name: array for name in images if isinstance(array := group[name], zarr.Array)}
    for name, array in arrays.items():
        sizes = (array.shards or array.chunks)[:2]
        for top, left in product(*(range(0, size, step) for size, step in zip(where.shape, sizes, strict=True))):
            place = np.s_[top : top + sizes[0], left : left + sizes[1]]
            if (gaps := where[place]).any():
                values = read_array(group, name, place).copy()
                values[gaps] = images[name]
                array[place] = values


def blank_coarse(missing: NDArray[np.bool_], factor: int) -> NDArray[np.bool_]:
    """(y, x) coarse pixels of ``factor`` px a side of which the scene has less than half."""
    starts = [np.arange(0, side, factor) for side in missing.shape]
    gaps = np.add.reduceat(np.add.reduceat(missing.astype(np.int32), starts[0], axis=0), starts[1], axis=1)
    down, across = (np.minimum(factor, side - first) for first, side in zip(starts, missing.shape, strict=True))
    return np.asarray(2 * gaps > down[:, None] * across)
