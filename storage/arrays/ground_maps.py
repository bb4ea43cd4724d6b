"""Images on the ground: maps of classes there with a picture and each class's area, and any stored image by its rows.

Images too large for the memory are read some rows at a time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import zarr
from numpy.typing import NDArray

from pipeline.errors import IncompleteStoreError, ShapeError
from storage.arrays.class_maps import CONFIDENCE, ClassNames, check_named, class_flags, legend_of
from storage.arrays.georeference import ON_THE_MAP, geobox_of_group, load_geobox, map_attributes, write_map_coordinates
from storage.arrays.layout import (
    SHARD_COLUMNS,
    SHARD_ROWS,
    create_array,
    create_group,
    damage_named,
    image_spec,
    open_group,
    read_array,
    read_bands,
    whole_shards,
)

if TYPE_CHECKING:
    from odc.geo.geobox import GeoBox

BLOCK = (4 * SHARD_ROWS, 2 * SHARD_COLUMNS)  # (y, x) px to write at a time: whole shards
M2_PER_HECTARE = 10_000.0


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
    def geobox(self) -> GeoBox | None:
        """Where on the earth it lies; None where its store does not say."""
        return geobox_of_group(self.group)

    def rows(self) -> Iterator[tuple[int, NDArray[Any]]]:
        """Rows with the number of the first, as many at a time as a shard has.

        Raises IncompleteStoreError: a checksum says that the bytes have changed.
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
    return read_bands(open_group(path))


@dataclass(frozen=True)
class GroundMap:
    """A stored map, in memory."""

    classes: NDArray[np.uint8]  # (y, x) index into the legend's names, 255 = none or not seen
    confidence: NDArray[np.float32]  # (y, x) in 0..1, NaN where not seen
    picture: NDArray[np.uint8]  # (y, x, 3) red green blue, 0 where not seen
    legend: ClassNames
    geobox: GeoBox
    areas: dict[str, dict[str, float]]  # of each class: m2, ha, share of the classified area


class GroundMapWriter:
    """Write a map block by block, so that it never has to be in memory as a whole."""

    def __init__(self, path: Path, geobox: GeoBox, legend: ClassNames, *, about: Mapping[str, Any]) -> None:
        place = map_attributes(geobox)
        names = {"class_names": list(legend.names), "class_colours": np.asarray(legend.colours).tolist()}
        self._group = create_group(path, "class map on the ground", {**place, **names, **about})
        write_map_coordinates(self._group, geobox)
        self._shape, self._legend = tuple(geobox.shape), legend
        dims, shape = ("y", "x"), self._shape
        about_classes = {**class_flags(legend.names, legend.colours), **place, **ON_THE_MAP}
        self._classes = create_array(self._group, "classes", image_spec(dims, shape, "|u1"), about_classes)
        words = {**CONFIDENCE, **place, **ON_THE_MAP}
        self._confidence = create_array(self._group, "confidence", image_spec(dims, shape, "<f4"), words)
        words = {"long_name": "picture for viewers, red green blue; 0 not seen", **place, **ON_THE_MAP}
        spec = image_spec((*dims, "rgb"), (*shape, 3), "|u1")
        self._picture = create_array(self._group, "picture", spec, words)

    def write_block(
        self,
        rows: slice,
        columns: slice,
        classes: NDArray[np.uint8],
        confidence: NDArray[np.float32],
        picture: NDArray[np.uint8],
    ) -> None:
        """Store one block.

        Raises ShapeError: the block's arrays do not fit its place, or a class has no name. ChunkError: the block splits
        a shard.
        """
        size = (rows.stop - rows.start, columns.stop - columns.start)
        if not (classes.shape == confidence.shape == picture.shape[:2] == size):
            raise ShapeError(
                f"block {size} (y, x) got classes {classes.shape}, confidence {confidence.shape} and picture "
                f"{picture.shape}; give one value a pixel"
            )
        whole_shards("the map", (rows, columns), self._shape, (SHARD_ROWS, SHARD_COLUMNS))
        check_named(classes, len(self._legend.names))
        self._classes[rows, columns] = classes
        self._confidence[rows, columns] = confidence
        self._picture[rows, columns] = picture

    def finish(self, areas_m2: NDArray[np.float64]) -> None:
        """Store the area of each class (class,) beside the map: m2, ha and share of the classified area."""
        total = float(areas_m2.sum()) or 1.0
        self._group.attrs["areas"] = {
            name: {"m2": m2, "ha": m2 / M2_PER_HECTARE, "share": m2 / total}
            for name, m2 in zip(self._legend.names, areas_m2.tolist(), strict=True)
        }


def load_ground_map(path: Path) -> GroundMap:
    """Read a map. Raises IncompleteStoreError where it is missing or damaged."""
    group = open_group(path)
    areas: Any = dict(group.attrs).get("areas", {})
    geobox = load_geobox(path)
    if geobox is None:
        raise IncompleteStoreError(f"{path} has no grid mapping; it is no map of the ground")
    return GroundMap(
        classes=read_array(group, "classes"),
        confidence=read_array(group, "confidence"),
        picture=read_array(group, "picture"),
        legend=legend_of(group),
        geobox=geobox,
        areas=areas,
    )
