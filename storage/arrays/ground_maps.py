"""Store class maps on the ground with a picture and the area of each class; read any stored image by rows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from spectralzoom.pipeline.errors import IncompleteStoreError, ShapeError
from spectralzoom.pipeline.ground.field_places import M2_PER_HECTARE
from spectralzoom.storage.arrays import class_maps, georeference, layout

PICTURE = "picture"
NUMBERED = {"classes", class_maps.OLD_CLASS}
BLOCK = (4 * layout.SHARD_ROWS, 2 * layout.SHARD_COLUMNS)  # (y, x) px to write at a time: whole shards


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
        """Return the image's grid on the earth; None where its store has none."""
        return georeference.geobox_of_group(self.group)

    def rows(self) -> Iterator[tuple[int, NDArray[Any]]]:
        """Yield the number of the first row and the rows of each shard.

        Raises IncompleteStoreError: a checksum says that the bytes have changed.
        """
        for first in range(0, self.shape[0], layout.SHARD_ROWS):
            yield (
                first,
                layout.read_array(self.group, self.name, slice(first, min(first + layout.SHARD_ROWS, self.shape[0]))),
            )


def open_image(path: Path, name: str) -> StoredImage:
    """Open one array of the store at ``path``. Raises IncompleteStoreError where it is missing or damaged."""
    group = layout.open_group(path)
    array = layout.array_of(group, name)
    return StoredImage(group, name, array.shape, array.dtype)


@dataclass(frozen=True)
class GroundMap:
    """Grid of a stored map, and the areas in it."""

    geobox: GeoBox
    areas: dict[str, dict[str, float]]  # of each class: m2, ha, fraction of the classified area


class GroundMapWriter:
    """Write a map block by block, so that it need not fit into memory."""

    def __init__(
        self,
        path: Path,
        geobox: GeoBox,
        legend: class_maps.ClassNames,
        *,
        about: Mapping[str, Any],
        goes_on: bool = False,
    ) -> None:
        """Create a map; one of a later visit (``goes_on``) also has the previous classes."""
        place = georeference.map_attributes(geobox)
        facts = {**place, **legend.attributes, **about}
        self._group = layout.create_group(path, "class map on the ground", facts, georeference.map_coordinates(geobox))
        self._legend = legend
        images: dict[str, tuple[str, Mapping[str, Any]]] = {
            "classes": ("|u1", class_maps.class_flags(legend)),
            "confidence": ("<f4", class_maps.CONFIDENCE),
            PICTURE: ("|u1", {"long_name": "picture for viewers, red green blue; 0 not seen"}),
        }
        if goes_on:
            images[class_maps.OLD_CLASS] = ("|u1", class_maps.old_class_flags(legend))
        self._images: dict[str, zarr.Array[Any]] = {}
        for name, (kind, attributes) in images.items():
            rest = {"rgb": 3} if name == PICTURE else {}
            spec = layout.image_spec(("y", "x", *rest), (*geobox.shape, *rest.values()), kind)
            self._images[name] = layout.create_array(
                self._group, name, spec, {**attributes, **place, **georeference.ON_THE_MAP}
            )

    def write_block(self, rows: slice, columns: slice, images: Mapping[str, NDArray[np.generic]]) -> None:
        """Store one block of all images, by name (ShapeError: an image lacks, or a class has no name)."""
        if set(images) != set(self._images):
            raise ShapeError(f"a block got {', '.join(images)}; give {', '.join(self._images)}, one value a pixel")
        for name, image in images.items():
            stored = self._legend.stored(np.asarray(image, np.uint8)) if name in NUMBERED else image
            self._images[name][rows, columns] = stored

    def finish(self, areas_m2: NDArray[np.float64]) -> None:
        """Store the area of each class (class,) beside the map: m2, ha and fraction of the classified area."""
        total = float(areas_m2.sum()) or 1.0
        self._group.attrs["areas"] = {
            name: {"m2": m2, "ha": m2 / M2_PER_HECTARE, "fraction": m2 / total}
            for name, m2 in zip(self._legend.names, areas_m2.tolist(), strict=True)
        }


def load_ground_map(path: Path) -> GroundMap:
    """Read grid and areas of a map. Raises IncompleteStoreError where it is missing or damaged."""
    areas: Any = dict(layout.open_group(path).attrs).get("areas", {})
    geobox = georeference.load_geobox(path)
    if geobox is None:
        raise IncompleteStoreError(f"{path} has no grid mapping; it is no map of the ground")
    return GroundMap(geobox, areas)
