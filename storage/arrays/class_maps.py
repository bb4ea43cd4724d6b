"""Store class maps and class probabilities on the grid of a mosaic; `ground_maps` stores maps on the ground.

Names of classes are CF flags. Each pixel has log-probabilities of its classes, and age and light of its last capture.
Log-probabilities are packed by CF's rules into one byte of 0.05 nat; all classes less likely than 1 in 1100 have the
same value, and a class that is never drawn has the least one. Ages and light are floats: each visit starts from those
of the one before, and rounding would add up. Confidence is stored as floats in steps of 1/256.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import ShapeError
from spectralzoom.pipeline.geometry.grid import UNLABELLED, cuts
from spectralzoom.storage.arrays import layout
from spectralzoom.storage.arrays.georeference import AngularGrid, create_placed_group

MAP, PROBABILITIES = "class_map.zarr", "class_probabilities.zarr"
CONFIDENCE = {"long_name": "probability of the class given", "units": "1", "valid_range": [0.0, 1.0]}
CONFIDENCE_STEP = 1 / 256
STEP = 0.05  # nats
FAINTEST = -12.7  # nats
NOTHING, NEVER = 255, 0  # unknown, and of a class that is never drawn; 254 is certainty
LEAST, UNLIKELY = -7.0, -11.0  # nats: lower values are stored as their mean, in a tenth of the bytes
# values of the images in unknown pixels
NOT_BELIEVED = {"log_probability": NOTHING, "age": np.nan, "light": 0}
OLD_CLASS = "changed_from"
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class ClassNames:
    """Names and colours of the classes of a map, and their numbers in stored images: those of the label files."""

    names: tuple[str, ...]
    colours: NDArray[np.uint8]  # (class, 3)
    values: tuple[int, ...] = ()  # 0 to 254, by class; empty: 0, 1, 2, ...

    @property
    def numbers(self) -> tuple[int, ...]:
        """Return the number of each class in stored images."""
        return self.values or tuple(range(len(self.names)))

    @property
    def titles(self) -> tuple[str, ...]:
        """Return the names for legends, with the number of the label files if the name lacks it."""
        pairs = zip(self.names, self.values or self.names, strict=True)
        return tuple(
            name if f"{number}" in (name, name.removeprefix("class_")) else f"{name} ({number})"
            for name, number in pairs
        )

    @property
    def attributes(self) -> dict[str, Any]:
        """Return the attributes of a store, as `legend_of` reads them."""
        plain = {"class_names": list(self.names), "class_colours": np.asarray(self.colours).tolist()}
        return plain | ({"class_values": list(self.values)} if self.values else {})

    def stored(self, classes: NDArray[np.integer]) -> NDArray[np.uint8]:
        """Return the stored numbers of class indices, 255 for none (ShapeError: a class has no name)."""
        worst = int(classes.max(initial=0, where=classes != UNLABELLED))
        if worst >= len(self.names) and (classes == worst).any():
            raise ShapeError(f"class {worst} is in the map, but only {len(self.names)} classes have names")
        return _translated(np.asarray(classes, np.uint8), dict(enumerate(self.values)))

    def index(self, stored: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the class indices of stored numbers, 255 for none."""
        return _translated(stored, {number: index for index, number in enumerate(self.values)})


def _translated(image: NDArray[np.uint8], numbers: Mapping[int, int]) -> NDArray[np.uint8]:
    """Return an image with other numbers, 255 for those without; the image itself if there are none."""
    if not numbers:
        return image
    table = bytes(numbers.get(number, UNLABELLED) for number in range(256))
    return np.frombuffer(bytearray(image.tobytes()).translate(table), np.uint8).reshape(image.shape)


@dataclass(frozen=True)
class ClassMap:
    """Class of every pixel."""

    classes: NDArray[np.uint8]  # (y, x) index into the names, 255 = none
    confidence: NDArray[np.float32]  # (y, x) in 0..1, NaN where there is no class
    legend: ClassNames

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the classes."""
        return self.legend.names

    @property
    def colours(self) -> NDArray[np.uint8]:
        """Return the colours (class, 3)."""
        return self.legend.colours


def create_class_map(
    path: Path, shape: tuple[int, ...], legend: ClassNames, *, grid: AngularGrid | None = None
) -> None:
    """Create a class map of (y, x) ``shape`` without classified pixels."""
    group, place = create_placed_group(path, "class map", grid, shape, legend.attributes)
    _create_flat(group, "classes", ("y", "x"), shape, "|u1", {**class_flags(legend), **place})
    _create_flat(group, "confidence", ("y", "x"), shape, "<f4", {**CONFIDENCE, **place})


def _create_flat(
    group: zarr.Group, name: str, dims: tuple[str, ...], shape: tuple[int, ...], dtype: str, about: dict[str, Any]
) -> None:
    layout.create_array(
        group, name, layout.image_spec(dims, shape, dtype, whole=True), about, packing=layout.MAP_PACKING, flat=True
    )


def write_class_tile(
    path: Path, origin: tuple[int, int], classes: NDArray[np.integer], confidence: NDArray[np.floating]
) -> None:
    """Store (y, x) classes and confidence of whole shards; ``origin`` is their first row and column.

    Threads and processes may write different tiles at once. Raises ShapeError: a class has no name;
    IncompleteStoreError: there is no map.
    """
    group = layout.open_group(path, "r+")
    stored = legend_of(group).stored(classes)
    rounded = np.rint(np.asarray(confidence) / CONFIDENCE_STEP) * CONFIDENCE_STEP
    for name, values in (("classes", stored), ("confidence", rounded)):
        array = layout.array_of(group, name)
        array[layout.tile_place(origin, classes.shape)] = np.asarray(values, array.dtype)


def class_flags(legend: ClassNames) -> dict[str, Any]:
    """Return CF's flag attributes of an image of classes."""
    return {
        "long_name": "class",
        "nodata": UNLABELLED,  # no _FillValue: xarray would make fractions of the numbers
        "flag_values": list(legend.numbers),
        "flag_meanings": " ".join("_".join(name.split()) for name in legend.names),
        "flag_colors": " ".join("#{:02x}{:02x}{:02x}".format(*colour) for colour in legend.colours.tolist()),
    }


def legend_of(group: zarr.Group) -> ClassNames:
    """Read names, colours and numbers of the classes from a group's attributes."""
    attributes: dict[str, Any] = dict(group.attrs)
    colours = np.array(attributes.get("class_colours", ()), np.uint8).reshape(-1, 3)
    return ClassNames(tuple(attributes.get("class_names", ())), colours, tuple(attributes.get("class_values", ())))


def load_class_map(path: Path) -> ClassMap:
    """Read a class map. Raises IncompleteStoreError where it is missing or damaged."""
    group = layout.open_group(path)
    classes, confidence = (layout.read_array(group, name) for name in ("classes", "confidence"))
    legend = legend_of(group)
    return ClassMap(legend.index(classes), confidence, legend)


def class_counts(classes: NDArray[np.integer], count: int) -> NDArray[np.int64]:
    """Return the number of pixels of each of the first ``count`` classes, (class,)."""
    return np.array([np.count_nonzero(classes == number) for number in range(count)], np.int64)


def create_probabilities(
    path: Path, shape: tuple[int, int], legend: ClassNames, *, grid: AngularGrid | None = None, goes_on: bool = False
) -> None:
    """Create class probabilities of (y, x) ``shape``, all unknown.

    A store of a later visit (``goes_on``) also has the previous classes of changed pixels: `OLD_CLASS`.
    """
    group, place = create_placed_group(path, "class_probabilities", grid, shape, legend.attributes)
    layout.write_counts(group, **{"class": len(legend.names)})
    about: dict[str, Any] = {
        "long_name": "natural logarithm of the probability of each class",
        "units": "1",
        "scale_factor": STEP,
        "add_offset": FAINTEST,
        "_FillValue": NOTHING,
        **place,
    }
    _create_flat(group, "log_probability", ("y", "x", "class"), (*shape, len(legend.names)), "|u1", about)
    for name, title, units in (
        ("age", "time since the pixel was looked at", "days"),
        ("light", "reference exposures that it rests on", "1"),
    ):
        _create_flat(group, name, ("y", "x"), shape, "<f4", {"long_name": title, "units": units, **place})
    if goes_on:
        _create_flat(group, OLD_CLASS, ("y", "x"), shape, "|u1", {**old_class_flags(legend), **place})


def old_class_flags(legend: ClassNames) -> dict[str, Any]:
    """Return CF's flag attributes of an image of the previous classes."""
    return {
        **class_flags(legend),
        "long_name": f"class remembered, where the map is sure of another one; {UNLABELLED} everywhere else",
    }


def packed_probabilities(log_probability: Floats) -> NDArray[np.uint8]:
    """Return (y, x, class) log-probabilities in stored bytes.

    NaN is unknown, minus infinity is `NEVER`, other values below `LEAST` are `UNLIKELY`.
    """
    packed = np.empty(log_probability.shape, np.uint8)
    for rows in cuts(len(packed), layout.SHARD_ROWS):  # so that temporary floats are few
        part = log_probability[rows]
        steps = np.rint((np.where(part < LEAST, UNLIKELY, np.minimum(part, 0)) - FAINTEST) / STEP)
        packed[rows] = np.where(np.isnan(part), NOTHING, np.minimum(steps, NOTHING - 1))
        packed[rows][np.isneginf(part)] = NEVER
    return packed


def write_probabilities_tile(
    path: Path,
    origin: tuple[int, int],
    packed: NDArray[np.uint8],
    age_days: Floats,
    light: Floats,
    old_class: NDArray[np.uint8] | None = None,
) -> None:
    """Store `packed_probabilities` (y, x, class), (y, x) ages and light of whole shards, the first pixel at ``origin``.

    A later visit has previous classes (y, x) too, 255 where unchanged.
    Raises IncompleteStoreError: the store is missing, or has no place for previous classes.
    """
    group = layout.open_group(path, "r+")
    images: dict[str, NDArray[Any] | None] = {
        "log_probability": packed,
        "age": age_days,
        "light": light,
        OLD_CLASS: None if old_class is None else legend_of(group).stored(old_class),
    }
    for name, values in images.items():
        if values is not None:
            layout.array_of(group, name)[layout.tile_place(origin, age_days.shape)] = values


class ProbabilityStore:
    """Stored class probabilities, read in parts (IncompleteStoreError: they are missing or damaged)."""

    def __init__(self, path: Path) -> None:
        self._group = layout.open_group(path)
        array = self._group.get("age")
        self.shape = (array.shape[0], array.shape[1]) if isinstance(array, zarr.Array) else (0, 0)

    @property
    def legend(self) -> ClassNames:
        """Its classes, in the order of the probabilities."""
        return legend_of(self._group)

    def read(self, rows: slice = slice(None), columns: slice = slice(None)) -> tuple[Floats, Floats, Floats]:
        """Return log-probabilities (y, x, class), ages in days (y, x) and light (y, x).

        The exponentials of the log-probabilities sum to 1; a class that is never drawn has minus infinity. Unknown
        pixels are NaN; without light, light is 0.
        """
        packed = layout.read_array(self._group, "log_probability", np.s_[rows, columns])
        values = (packed * np.float32(STEP) + np.float32(FAINTEST)).astype(np.float32)
        values[packed == NEVER] = -np.inf
        values -= np.log(np.exp(values).sum(axis=-1, keepdims=True))
        values[packed == NOTHING] = np.nan
        age, light = (layout.read_array(self._group, name, np.s_[rows, columns]) for name in ("age", "light"))
        return values, age, np.nan_to_num(light)

    def old_class(self) -> NDArray[np.uint8] | None:
        """Return the previous (y, x) classes of changed pixels, else 255; None for a first visit."""
        if OLD_CLASS not in self._group:
            return None
        return self.legend.index(layout.read_array(self._group, OLD_CLASS))
