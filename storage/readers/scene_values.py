"""Numbers of a scene file as float32 with NaN; what is missing, or is no reading, is counted from the top down."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.readings import MOST_STEPS, MOST_VALUE, Beyond, beyond_range, find_beyond
from pipeline.simulator.scenes.scene import BRIGHT_PERCENTILE
from storage.readers.scene_toml import SETTINGS_NAME

_SAMPLED = 1 << 20  # values, evenly spread, by which the range of a scene is told


def as_values(
    rows: NDArray[Any], chosen: Sequence[int], nodata: float | None, void: NDArray[np.bool_] | None
) -> NDArray[np.float32]:
    """Return the chosen bands of (y, x, band) rows as float32; ``void`` (y, x), no data and infinities are NaN."""
    _, values, _ = _converted(rows, chosen, nodata, void)
    values[np.isinf(values)] = np.nan
    return values


def _converted(
    rows: NDArray[Any], chosen: Sequence[int], nodata: float | None, void: NDArray[np.bool_] | None
) -> tuple[NDArray[Any], NDArray[np.float32], NDArray[np.bool_] | None]:
    """Return the chosen bands in the file's numbers and as float32 with NaN, and which of them are no data."""
    picked = rows if list(chosen) == list(range(rows.shape[2])) else rows[..., list(chosen)]
    if void is not None:
        picked = np.where(void[..., None], picked.dtype.type(0), picked)  # whatever lies under gaps is no value
    with np.errstate(over="ignore"):
        values = np.array(picked, np.float32, order="C")
    if void is not None:
        values[void] = np.nan
    if nodata is None:
        return picked, values, None
    # Compared as numbers: -9999 in the numbers of the file would wrap to 55537 where they are uint16.
    with np.errstate(over="ignore"):
        empty = np.asarray(picked == nodata if np.isfinite(nodata) else np.isnan(values), np.bool_)
    values[empty] = np.nan
    return picked, values, empty


class ValueCount:
    """Count what is missing or no reading among the values of a file, given from the top down."""

    def __init__(self, path: Path, chosen: Sequence[int], nodata: float | None, shape: tuple[int, int]) -> None:
        self.missing = np.zeros(shape, np.bool_)  # (y, x) pixels without a value in more than half of their bands
        self.filled_px = 0  # pixels without a value in a band
        self._path, self._chosen, self._nodata = path, list(chosen), nodata
        self._every = max(1, shape[0] * shape[1] * len(chosen) // _SAMPLED)
        self._seen = np.zeros(len(chosen), np.bool_)  # bands with a value somewhere
        self._void = self._infinite = self._absent = self._size = self._row = self._beyond = 0
        self._first_beyond: Beyond | None = None
        self._first_infinite = ""
        self._lit: list[NDArray[np.float32]] = []

    def take(self, rows: NDArray[Any], void: NDArray[np.bool_] | None = None) -> NDArray[np.float32]:
        """Count the next (y, x, band) rows of the file, and return what `as_values` does."""
        picked, values, empty = _converted(rows, self._chosen, self._nodata, void)
        if (out_of_range := beyond_range(picked)) is not None and empty is not None:
            picked = np.where(empty, picked.dtype.type(0), picked)
        self._void += 0 if empty is None else int(np.count_nonzero(empty))
        if out_of_range is not None:
            self._note_out_of_range(picked, values)
        values[np.isinf(values)] = np.nan
        known = np.isfinite(values)
        if not known.all():
            count = known.sum(axis=2)
            self._absent += values.size - int(count.sum())
            self.missing[self._row : self._row + len(values)] = 2 * count < values.shape[2]
            self.filled_px += int(np.count_nonzero(count < values.shape[2]))
        self._seen |= known.any(axis=(0, 1))
        some = values.reshape(-1)[-self._size % self._every :: self._every]
        self._lit.append(some[some > 0])  # no NaN
        self._size += values.size
        self._row += len(values)
        return values

    def _note_out_of_range(self, picked: NDArray[Any], values: NDArray[np.float32]) -> None:
        infinite = np.isinf(values)
        if infinite.any() and not self._infinite:
            place = [int(at) for at in np.unravel_index(int(infinite.argmax()), infinite.shape)]
            self._first_infinite = f"y {self._row + place[0]}, x {place[1]}, band {self._chosen[place[2]]}"
        self._infinite += int(np.count_nonzero(infinite))
        if (found := find_beyond(picked)) is not None:
            self._beyond += found.count
            if self._first_beyond is None:
                y, x, band = found.place
                self._first_beyond = Beyond(found.count, (self._row + y, x, band), found.value)

    def notes(self) -> tuple[str, ...]:
        """Return a sentence for each thing that is missing, once all rows were taken.

        Raises SceneError: a value is no reading, a band has no value anywhere, or no value is finite.
        """
        path, first, notes = self._path, self._first_beyond, list[str]()
        if first is not None:
            found = Beyond(self._beyond, first.place, first.value)
            raise SceneError(
                f"{path} has {found.words(np.array(self._chosen))}, beyond the {MOST_VALUE:g} that readings reach; if "
                f"it stands for no data, write nodata = {found.value!s} into a {SETTINGS_NAME} beside the file, else "
                "leave the band out with --bands, or give the values in a larger unit"
            )
        if self._nodata is not None:
            notes.append(f"{self._void} samples have the file's no-data value {self._nodata:g}")
        if self._infinite:
            notes.append(f"{self._infinite} infinite samples count as missing, the first at {self._first_infinite}")
        if self._absent == self._size:
            raise SceneError(f"{path} holds no finite number in the bands used; choose others")
        empty = [band for band, seen in zip(self._chosen, self._seen, strict=True) if not seen]
        if empty:
            rest = bands_text([band for band in self._chosen if band not in set(empty)])
            raise SceneError(
                f"{path} has no value anywhere in bands {bands_text(empty)} (from 0); take the others: --bands {rest}"
            )
        if self._absent:
            notes.append(f"{self._absent} of {self._size} samples are missing")
        return (*notes, *self._dark_note())

    def _dark_note(self) -> tuple[str, ...]:
        """Say where the bright end is so far above all else that hardly any light is left for it."""
        lit = np.concatenate(self._lit) if self._lit else np.empty(0, np.float32)
        if not lit.size:
            return ()
        middle, bright = (float(value) for value in np.percentile(lit, (50, BRIGHT_PERCENTILE)))
        if bright <= MOST_STEPS * middle:
            return ()
        return (
            f"the brightest values, {bright:.3g}, are more than {MOST_STEPS} times the middle one, {middle:.3g}, and "
            f"all else is dark beside them; if they stand for no data, write nodata = {float(lit.max())!r} into a"
            f" {SETTINGS_NAME}",
        )


def bands_text(bands: Sequence[int]) -> str:
    """Band numbers as ``--bands`` takes them: ``0-3,7``."""
    runs: list[list[int]] = []
    for band in bands:
        if runs and band == runs[-1][1] + 1:
            runs[-1][1] = band
        else:
            runs.append([band, band])
    return ",".join(str(first) if first == last else f"{first}-{last}" for first, last in runs)
