"""The map of a posed survey: class, confidence and picture on a grid of the earth, and each class's area."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import IncompleteStoreError, ShapeError
from pipeline.geometry.grid import UNLABELLED
from storage.arrays.class_maps import ClassNames, class_flags, legend_of
from storage.arrays.georeference import ON_THE_MAP, load_geobox, map_attributes, write_map_coordinates
from storage.arrays.layout import (
    SHARD_COLUMNS,
    SHARD_ROWS,
    create_array,
    create_group,
    image_spec,
    open_group,
    read_array,
    whole_shards,
)

if TYPE_CHECKING:
    from odc.geo.geobox import GeoBox

BLOCK = (4 * SHARD_ROWS, 2 * SHARD_COLUMNS)  # (y, x) px to write at a time: whole shards
M2_PER_HECTARE = 10_000.0


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
        words = {"long_name": "probability of the class given", "units": "1", "valid_range": [0.0, 1.0]}
        words = {**words, **place, **ON_THE_MAP}
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
        worst = int(classes.max(initial=0, where=classes != UNLABELLED))
        if worst >= len(self._legend.names):
            raise ShapeError(f"class {worst} is in the map, but only {len(self._legend.names)} classes have names")
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
