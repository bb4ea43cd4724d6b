"""Tables of pixels and their bands, as programs of unmixing store them: each spectrum a column or a row.

A file that says rows and columns of the picture beside the table is a cube.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from storage.readers.array_cubes import FileArray

MOST_UNEVEN = 16  # times that a picture is longer than wide
SIZES = (("nrow", "ncol"), ("nrows", "ncols"), ("rows", "cols"), ("height", "width"), ("lines", "samples"), ("h", "w"))
CLEARLY = 0.8  # times as rough: an order of pixels that gives a picture so much smoother is the right one
SMOOTHED_BANDS = 8  # from which the order of pixels is found
ORDERS: Mapping[Literal["C", "F"], str] = {
    "F": "down its columns as MATLAB counts pixels",
    "C": "along its rows as numpy counts pixels",
}


def check_picture(shape: tuple[int, ...], where: object) -> None:
    """Raise SceneError where a scene of one band is a table of spectra; the message shows how it becomes a cube."""
    if max(shape) < max(MOST_UNEVEN * min(shape), 1000):
        return
    bands, turned = min(shape), ".T" if shape[0] < shape[1] else ""
    raise SceneError(
        f"{where} is a table of {shape[0]} x {shape[1]} numbers, expected a picture (y, x) or a cube (y, x, band)."
        f" If its {'columns' if turned else 'rows'} are spectra, store variables nRow and nCol beside it, or a cube: "
        f"numpy.reshape(values{turned}, (height, width, {bands}), order='F') where pixels follow each other down the "
        "columns of the picture, as in MATLAB, and order='C' where along its rows. Look at one band: in the wrong "
        "order it is scrambled, or mirrored at its diagonal where height and width are alike"
    )


@dataclass(frozen=True)
class SpectraTable:
    """A table of pixels and their bands, and the picture that it is of as the file says."""

    names: tuple[str, str]  # of the variables that say rows and columns
    rows: int
    columns: int
    pixel_axis: int

    def shaped(self, table: FileArray) -> FileArray:
        """Return the table with the axes of its cube, unread: (y, x, band), or (y, x) for one band."""
        bands = [size for axis, size in enumerate(table.shape) if axis != self.pixel_axis and size > 1]
        return replace(table, shape=(self.rows, self.columns, *bands))

    def folded(self, values: NDArray[Any], usual: Literal["C", "F"]) -> tuple[NDArray[Any], str]:
        """Return (y, x, band) values, and a note of the order that the pixels were taken in.

        The ``usual`` order of the file's kind (F: down the columns) is taken, unless the other one gives the clearly
        smoother picture.
        """
        spectra = np.moveaxis(values, self.pixel_axis, 0).reshape(self.rows * self.columns, -1)
        few = spectra[:, :: max(1, spectra.shape[1] // SMOOTHED_BANDS)]
        rough = {order: _roughness(few.reshape((self.rows, self.columns, -1), order=order)) for order in ORDERS}
        other: Literal["C", "F"] = "C" if usual == "F" else "F"
        order = other if rough[other] < CLEARLY * rough[usual] else usual
        cube = spectra.reshape((self.rows, self.columns, -1), order=order)
        beside = (
            "look at the map: rows and columns may be exchanged"
            if self.rows == self.columns
            else f"neighbours differ by {rough[order]:.0%} of the spread of values, in the other order by "
            f"{rough['C' if order == 'F' else 'F']:.0%}"
        )
        return (
            cube[..., 0] if cube.shape[2] == 1 else cube,
            f"a table of {self.rows * self.columns} pixels is read as {self.rows} x {self.columns} px (y x x), as "
            f"{self.names[0]} and {self.names[1]} say, {ORDERS[order]}; {beside}",
        )


def _roughness(cube: NDArray[Any]) -> float:
    """Return the mean difference of neighbours in (y, x, band) values over their mean difference from the mean."""
    values = np.nan_to_num(cube.astype(np.float64), posinf=0.0, neginf=0.0)
    spread = np.abs(values - values.mean(axis=(0, 1))).mean()
    steps = [np.abs(np.diff(values, axis=axis)).mean() for axis in (0, 1) if values.shape[axis] > 1]
    return float(np.mean(steps) / spread) if steps and spread > 0 else 0.0


def find_tables(arrays: Mapping[str, FileArray]) -> dict[str, SpectraTable]:
    """Find the tables of pixels in a file that says rows and columns of its picture, by their names."""
    single = {name: one for name, one in arrays.items() if math.prod(one.shape) == 1 and one.dtype.kind in "uif"}
    known = {re.sub("[^a-z]", "", name.lower()): name for name in reversed(single)}
    names = next(((known[one], known[two]) for one, two in SIZES if one in known and two in known), None)
    if names is None:
        return {}
    rows, columns = (single[name][...].item() for name in names)
    found = {}
    for name, one in arrays.items():
        axes = [axis for axis, size in enumerate(one.shape) if size == rows * columns]
        if one.ndim in (1, 2) and len(axes) == 1 and name not in single and one.dtype.kind in "buif":
            found[name] = SpectraTable(names, int(rows), int(columns), axes[0])
    return found
