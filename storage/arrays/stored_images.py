"""One array of a store, read some rows at a time: for what is too large to be in memory as a whole."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from storage.arrays.georeference import GRID_MAPPING
from storage.arrays.layout import SHARD_ROWS, damage_named, open_group, read_array


@dataclass(frozen=True)
class StoredImage:
    """An image or cube of a store, (y, x) or (y, x, band), not yet read."""

    group: zarr.Group
    name: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    @property
    def about(self) -> Mapping[str, Any]:
        """Attributes of the store."""
        return dict(self.group.attrs)

    @property
    def on_map(self) -> bool:
        """Whether the store says where on the earth it lies."""
        return GRID_MAPPING in self.group

    def rows(self) -> Iterator[tuple[int, NDArray[Any]]]:
        """Rows with the number of the first, as many at a time as a shard has.

        Raises
        ------
        IncompleteStoreError : a checksum says that the bytes have changed.
        """
        for first in range(0, self.shape[0], SHARD_ROWS):
            yield first, read_array(self.group, self.name, slice(first, min(first + SHARD_ROWS, self.shape[0])))


def open_image(path: Path, name: str) -> StoredImage:
    """Open one array of the store at ``path``. Raises IncompleteStoreError where it is missing or damaged."""
    group = open_group(path)
    with damage_named(f"{group.store_path}/{name}"):
        array = group[name]
        if not isinstance(array, zarr.Array):
            raise KeyError(f"{name} is no array")
        return StoredImage(group, name, array.shape, array.dtype)


def load_bands(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Wavelengths and widths [nm] of the store at ``path``. Raises IncompleteStoreError where they are damaged."""
    with damage_named(f"{path}/wavelength"):
        group = open_group(path)
        return read_array(group, "wavelength"), read_array(group, "fwhm") if "fwhm" in group else None
