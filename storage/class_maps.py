"""The class map: class, confidence, names and colours, as CF flags."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ShapeError
from pipeline.grid import UNLABELLED
from storage.layout import (
    AngularGrid,
    create_group,
    grid_of,
    grid_record,
    open_group,
    read_array,
    write_image,
)


@dataclass(frozen=True)
class ClassMap:
    """Class of every pixel."""

    classes: NDArray[np.uint8]  # (y, x) index into ``names``, 255 = none
    confidence: NDArray[np.float32]  # (y, x) in 0..1, NaN where there is no class
    names: tuple[str, ...]
    colours: NDArray[np.uint8]  # (class, 3)
    grid: AngularGrid | None = None


def write_class_map(path: Path, found: ClassMap) -> None:
    """Store classes with their names and colours, and the confidence.

    Raises
    ------
    ShapeError : sizes differ, or a pixel has a class without a name.
    """
    used = found.classes[found.classes != UNLABELLED]
    if found.classes.shape != found.confidence.shape or len(found.colours) != len(found.names):
        raise ShapeError(
            f"classes {found.classes.shape} and confidence {found.confidence.shape}, {len(found.names)} names and "
            f"{len(found.colours)} colours do not fit"
        )
    if used.size and used.max() >= len(found.names):
        raise ShapeError(f"class {int(used.max())} is in the map, but only {len(found.names)} classes have names")
    y, x = found.classes.shape
    place = {} if found.grid is None else found.grid.attributes((y, x))
    names = {"class_names": list(found.names), "class_colours": np.asarray(found.colours).tolist()}
    group = create_group(path, "class map", {**place, **grid_record(found.grid), **names})
    write_image(
        group,
        "classes",
        ("y", "x"),
        np.asarray(found.classes, np.uint8),
        {**class_flags(found.names, found.colours), **place},
    )
    about = {"long_name": "probability of the class given", "units": "1", "valid_range": [0.0, 1.0], **place}
    write_image(group, "confidence", ("y", "x"), np.asarray(found.confidence, np.float32), about)


def class_flags(names: Sequence[str], colours: NDArray[np.uint8]) -> dict[str, Any]:
    """CF's flag attributes of an image of class indices."""
    return {
        "long_name": "class",
        "_FillValue": UNLABELLED,
        "flag_values": list(range(len(names))),
        "flag_meanings": " ".join("_".join(name.split()) for name in names),
        "flag_colors": " ".join("#{:02x}{:02x}{:02x}".format(*colour) for colour in colours.tolist()),
    }


def load_class_map(path: Path) -> ClassMap:
    """Read a class map. Raises IncompleteStoreError where it is missing or damaged."""
    group = open_group(path)
    attributes: dict[str, Any] = dict(group.attrs)
    return ClassMap(
        classes=read_array(group, "classes"),
        confidence=read_array(group, "confidence"),
        names=tuple(attributes.get("class_names", ())),
        colours=np.array(attributes.get("class_colours", ()), np.uint8).reshape(-1, 3),
        grid=grid_of(attributes),
    )
