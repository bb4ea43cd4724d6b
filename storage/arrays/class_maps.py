"""Maps of classes on the grid of a mosaic, their names as CF flags; those on the ground are in `ground_maps`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from pipeline.errors import ShapeError
from pipeline.geometry.grid import UNLABELLED
from storage.arrays.georeference import create_placed_group
from storage.arrays.layout import (
    AngularGrid,
    create_array,
    damage_named,
    grid_of,
    image_spec,
    open_group,
    read_array,
    whole_shards,
)

CONFIDENCE = {"long_name": "probability of the class given", "units": "1", "valid_range": [0.0, 1.0]}


@dataclass(frozen=True)
class ClassMap:
    """Class of every pixel."""

    classes: NDArray[np.uint8]  # (y, x) index into ``names``, 255 = none
    confidence: NDArray[np.float32]  # (y, x) in 0..1, NaN where there is no class
    names: tuple[str, ...]
    colours: NDArray[np.uint8]  # (class, 3)
    grid: AngularGrid | None = None


@dataclass(frozen=True)
class ClassNames:
    """What the classes of a map are called, and how they are drawn."""

    names: tuple[str, ...]
    colours: NDArray[np.uint8]  # (class, 3)


def write_class_map(path: Path, found: ClassMap) -> None:
    """Store classes with their names and colours, and the confidence.

    Raises ShapeError: sizes differ, or a pixel has a class without a name.
    """
    create_class_map(path, found.classes.shape, ClassNames(found.names, found.colours), grid=found.grid)
    write_class_tile(path, (0, 0), found.classes, found.confidence)


def create_class_map(
    path: Path, shape: tuple[int, ...], legend: ClassNames, *, grid: AngularGrid | None = None
) -> None:
    """Begin a class map of (y, x) ``shape`` in which no pixel has a class yet.

    Raises ShapeError: there are not as many colours as names.
    """
    if len(legend.colours) != len(legend.names):
        raise ShapeError(
            f"{len(legend.names)} names and {len(legend.colours)} colours do not fit; give each class both"
        )
    names = {"class_names": list(legend.names), "class_colours": np.asarray(legend.colours).tolist()}
    group, place = create_placed_group(path, "class map", grid, shape, names)
    about = {**class_flags(legend.names, legend.colours), **place}
    create_array(group, "classes", image_spec(("y", "x"), shape, "|u1"), about)
    create_array(group, "confidence", image_spec(("y", "x"), shape, "<f4"), {**CONFIDENCE, **place})


def write_class_tile(
    path: Path, origin: tuple[int, int], classes: NDArray[np.integer], confidence: NDArray[np.floating]
) -> None:
    """Store (y, x) classes and confidence of whole shards from row and column ``origin`` on.

    Threads and processes may write different tiles of one map at once. Raises ShapeError: sizes differ, the tile does
    not fit the map, or a pixel has a class without a name. ChunkError: the tile splits a shard. IncompleteStoreError:
    there is no map.
    """
    with damage_named(str(path)):
        group = zarr.open_group(path, mode="r+", zarr_format=3, use_consolidated=False)
        arrays = [array for name in ("classes", "confidence") if isinstance(array := group[name], zarr.Array)]
        count = len(group.attrs["class_names"])  # type: ignore[arg-type]
    check_named(classes, count)
    place = tuple(slice(first, first + size) for first, size in zip(origin, classes.shape, strict=True))
    for word, part, size in zip(("rows", "columns"), place, arrays[0].shape, strict=True):
        if part.start < 0 or part.stop > size:
            raise ShapeError(
                f"{word} {part.start}:{part.stop} are not all in the class map of {arrays[0].shape} (y, x)"
            )
    whole_shards("the class map", place, arrays[0].shape, arrays[0].shards or ())
    if classes.shape != confidence.shape:
        raise ShapeError(
            f"classes {classes.shape} and confidence {confidence.shape} do not fit; give both of each pixel"
        )
    for array, values in zip(arrays, (classes, confidence), strict=True):
        array[place] = np.asarray(values, array.dtype)


def check_named(classes: NDArray[np.integer], count: int) -> None:
    """Refuse (y, x) classes with an index for which there is no name (ShapeError)."""
    worst = int(classes.max(initial=0, where=classes != UNLABELLED))
    if worst >= count and (classes == worst).any():
        raise ShapeError(f"class {worst} is in the map, but only {count} classes have names")


def class_flags(names: Sequence[str], colours: NDArray[np.uint8]) -> dict[str, Any]:
    """CF's flag attributes of an image of class indices."""
    return {
        "long_name": "class",
        "nodata": UNLABELLED,  # no _FillValue: xarray would make fractions of the numbers
        "flag_values": list(range(len(names))),
        "flag_meanings": " ".join("_".join(name.split()) for name in names),
        "flag_colors": " ".join("#{:02x}{:02x}{:02x}".format(*colour) for colour in colours.tolist()),
    }


def load_class_names(path: Path) -> ClassNames:
    """Read what the classes of a map are called, and their colours. Raises IncompleteStoreError where there is none."""
    return legend_of(open_group(path))


def legend_of(group: zarr.Group) -> ClassNames:
    """The classes that a group's attributes name."""
    attributes: dict[str, Any] = dict(group.attrs)
    colours = np.array(attributes.get("class_colours", ()), np.uint8).reshape(-1, 3)
    return ClassNames(tuple(attributes.get("class_names", ())), colours)


def load_class_map(path: Path) -> ClassMap:
    """Read a class map. Raises IncompleteStoreError where it is missing or damaged."""
    group = open_group(path)
    classes, confidence, legend = read_array(group, "classes"), read_array(group, "confidence"), legend_of(group)
    return ClassMap(classes, confidence, legend.names, legend.colours, grid_of(dict(group.attrs)))
