"""Read the pointing of recorded lines: a table with a row for each line.

A table is CSV (commas, semicolons or tabs). Optional columns are ``line`` (from 0), ``sweep``,
``time`` (of mid exposure since the start of the sweep) [s], ``exposure_ms`` and ``valid`` (0 or 1). A table has exactly
one of these kinds of pointing:

::

    mirror_x, mirror_y         mirror position, -1..1, in the device's axes
    angle_x_deg, angle_y_deg   viewing angle along the line and along the scan
    angle_deg                  viewing angle along the scan, of a scan through the undeflected direction
    position_px                place along a straight scan without a mirror: stage, conveyor, drone
    position_m                 the same in metres
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.capture.straight_scans import angles_to_positions
from pipeline.errors import SceneError
from pipeline.geometry.mirror import RIM_SLACK, STRAIGHT, Mounting

Floats = NDArray[np.float64]
Kind = Literal["mirror", "angles", "angle", "px", "m"]
KINDS: Mapping[Kind, tuple[str, ...]] = {
    "mirror": ("mirror_x", "mirror_y"),
    "angles": ("angle_x_deg", "angle_y_deg"),
    "angle": ("angle_deg",),
    "px": ("position_px",),
    "m": ("position_m",),
}
WITHOUT_MIRROR: tuple[Kind, ...] = ("px", "m")
BESIDE = ("line", "sweep", "time", "exposure_ms", "valid")
ACCEPTED = (*BESIDE, *(name for names in KINDS.values() for name in names))
FIRST_ROW = 2  # the header is row 1
ENDINGS = (".csv", ".tsv", ".txt")
WORDS = {"": math.nan, "none": math.nan, "true": 1.0, "false": 0.0}


@dataclass(frozen=True)
class LinePointing:
    """Mirror positions or places of the lines of one sweep; those of invalid lines are interpolated."""

    kind: Kind
    position: Floats  # (line, 2) mirror X and Y of the model, or (line, 1) place along a scan without a mirror
    valid: NDArray[np.bool_]  # (line,)
    time_s: Floats | None = None  # (line,) of mid exposure
    exposure_ms: Floats | None = None  # (line,)
    part: tuple[str, ...] | None = None  # (line,) names of the sweeps, if a table cuts one cube into several


@dataclass(frozen=True)
class PointingTable:
    """The rows of one table as in its file."""

    path: Path
    kind: Kind
    columns: Mapping[str, Floats]  # (row,) each
    sweep: tuple[str, ...] | None  # (row,)

    def of_cube(self, name: str, lines: int, mounting: Mounting = STRAIGHT, *, alone: bool = False) -> LinePointing:
        """Return the pointing of a cube: the rows whose ``sweep`` is its name, or all without that column.

        If the cube is ``alone`` and no row has its name, the column cuts it into sweeps. ``mounting`` transforms the
        device's positions to the model's. Raises SceneError: the cube has another number of rows or no valid one; a
        value is no number, out of range or beyond the mirror; or times do not rise.
        """
        rows, sweeps = np.arange(len(self.columns[KINDS[self.kind][0]])), tuple(dict.fromkeys(self.sweep or ()))
        cut = self.sweep is not None and alone and name not in sweeps
        if self.sweep is not None and not cut:
            rows = np.array([row for row in rows if self.sweep[row] == name], np.intp)
            if not len(rows):
                raise SceneError(
                    f"{self.path} has no row for the cube {name!r}; its column 'sweep' names {', '.join(sweeps[:8])}"
                )
        if len(rows) != lines:
            way = "fewer" if len(rows) < lines else "more"
            raise SceneError(
                f"{self.path} has {len(rows)} rows for {name}, {way} than its {lines} lines; give one row for each "
                "line, with valid = 0 for those to be left out"
            )
        if "line" in self.columns:
            order = np.argsort(self.columns["line"][rows], kind="stable")
            wrong = self.columns["line"][rows][order] != np.arange(lines)
            rows = rows[order]
            self._refuse(rows, wrong, "line", f"expected each of 0 to {lines - 1} once")
        valid = np.ones(lines, np.bool_)
        if "valid" in self.columns:
            flags = self.columns["valid"][rows]
            self._refuse(rows, ~np.isin(flags, (0, 1)), "valid", "expected 0 or 1")
            valid = flags == 1
        if not valid.any():
            raise SceneError(f"{self.path} calls no line of {name} valid; set valid = 1 for lines that can be used")
        for column in {*KINDS[self.kind], "time", "exposure_ms"} & set(self.columns):
            unknown = valid & ~np.isfinite(self.columns[column][rows])
            self._refuse(rows, unknown, column, "expected a number; set valid = 0 where it is not known")
        time_s = exposure_ms = None
        if "time" in self.columns:  # may be NaN for invalid lines
            time_s = self.columns["time"][rows]
            known = np.flatnonzero(np.isfinite(time_s))
            stuck = np.zeros(lines, np.bool_)
            stuck[known[1:]] = np.diff(time_s[known]) <= 0
            self._refuse(rows, stuck, "time", "expected a time after that of the line before [s]")
        if "exposure_ms" in self.columns:
            exposure_ms = _filled(self.columns["exposure_ms"][rows], valid)
            self._refuse(rows, exposure_ms <= 0, "exposure_ms", "expected a time above 0 ms")
        part = tuple(self.sweep[row] for row in rows) if self.sweep is not None and cut else None
        return LinePointing(self.kind, self._positions(rows, valid, mounting), valid, time_s, exposure_ms, part)

    def _positions(self, rows: NDArray[np.intp], valid: NDArray[np.bool_], mounting: Mounting) -> Floats:
        """Return (line, 2) positions of the model, or (line, 1) places, interpolated for invalid lines."""
        values = np.stack([self.columns[name][rows] for name in KINDS[self.kind]], axis=-1)
        values = np.stack([_filled(column, valid) for column in values.T], axis=-1)
        if self.kind in WITHOUT_MIRROR:
            return values
        if self.kind == "mirror":
            position = mounting.to_model(values)
            beyond = ~(np.hypot(*position.T) <= 1 + RIM_SLACK["float64"])
            reach = "beyond the mirror, which reaches X^2 + Y^2 <= 1"
        else:
            angles = values if self.kind == "angles" else np.concatenate([np.zeros_like(values), values], axis=1)
            position, reached = angles_to_positions(angles)
            beyond = ~reached
            reach = "beyond the mirror, which turns the view by up to 50 deg along the scan and 35.6 deg across it"
        self._refuse(rows, beyond, KINDS[self.kind], reach)
        return position

    def _refuse(
        self, rows: NDArray[np.intp], wrong: NDArray[np.bool_], columns: str | Sequence[str], expected: str
    ) -> None:
        """Raise SceneError for the first wrong row, with its number in the file."""
        if not wrong.any():
            return
        names = (columns,) if isinstance(columns, str) else tuple(columns)
        first = rows[np.argmax(wrong)]
        came = ", ".join(f"{name} = {self.columns[name][first]:.10g}" for name in names)
        count = int(np.count_nonzero(wrong))
        more = "" if count == 1 else f" (the first of {count} such rows)"
        raise SceneError(f"{self.path}, row {first + FIRST_ROW}: {came}{more}, {expected}; correct the table")


def _filled(values: Floats, valid: NDArray[np.bool_]) -> Floats:
    """Return the values, with unknown ones of invalid lines interpolated."""
    known = valid | np.isfinite(values)
    at = np.arange(len(values))
    return values if known.all() else np.interp(at, at[known], values[known])


def load_pointing_table(path: Path) -> PointingTable:
    """Read a table with a row for each line.

    Raises SceneError: it cannot be read, has no row, an unknown column, a cell that is no number, or not exactly one
    kind of pointing.
    """
    header, cells = _csv_cells(path)
    unknown = [name for name in header if name not in ACCEPTED]
    if unknown or len(set(header)) < len(header):
        twice = next((name for name in header if header.count(name) > 1), None)
        what = f"the column {unknown[0]!r}, which is not known" if unknown else f"the column {twice!r} twice"
        raise SceneError(f"{path} has {what}; accepted are {', '.join(ACCEPTED)}")
    kinds = [kind for kind, names in KINDS.items() if set(names) & set(header)]
    missing = [name for kind in kinds for name in KINDS[kind] if name not in header]
    if len(kinds) != 1 or missing:
        came = f"{missing[0]} is missing" if missing else f"it has {len(kinds)} kinds" if kinds else "it has none"
        wanted = "; or ".join(", ".join(names) for names in KINDS.values())
        raise SceneError(f"{path} must have one kind of pointing, but {came}; give {wanted}")
    if not cells:
        raise SceneError(f"{path} has no row below its header; give a row for each line")
    columns = {
        name: _numbers(path, name, [row[at] for row in cells]) for at, name in enumerate(header) if name != "sweep"
    }
    sweep = tuple(row[header.index("sweep")] for row in cells) if "sweep" in header else None
    return PointingTable(path, kinds[0], columns, sweep)


def _numbers(path: Path, name: str, cells: Sequence[str]) -> Floats:
    """Return the cells of a column as numbers, NaN for empty ones, 1 for True."""
    values = np.empty(len(cells))
    for number, cell in enumerate(cells):
        try:
            values[number] = WORDS[cell.lower()] if cell.lower() in WORDS else float(cell)
        except ValueError:
            raise SceneError(
                f"{path}, row {number + FIRST_ROW}: {name} = {cell[:40]!r} is no number; write numbers with a decimal"
                " point"
            ) from None
    return values


def _csv_cells(path: Path) -> tuple[list[str], list[list[str]]]:
    """Return the names of the columns and the cells of all rows, by the delimiter of the header."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"{path} cannot be read as a pointing table: {error}; name a text file (CSV)") from error
    header = lines[0] if lines else ""
    delimiter = max((",", ";", "\t"), key=header.count)
    rows = [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=delimiter)]
    if not rows:
        raise SceneError(f"{path} is empty; give a header and a row for each line")
    names = [name.lower() for name in rows[0]]
    cells = [row for row in rows[1:] if any(row)]
    for number, row in enumerate(rows[1:], 2):
        if any(row) and len(row) != len(names):
            raise SceneError(
                f"{path}, row {number} has {len(row)} cells, its header {len(names)}; give each row one cell a column"
            )
    return names, cells


def find_pointing(folder: Path, stem: str) -> Path | None:
    """Return the file ``STEM.pointing.csv`` (or .tsv, .txt) of a cube in a folder."""
    names = [f"{stem}.pointing{ending}" for ending in ENDINGS]
    return next((folder / name for name in names if (folder / name).is_file()), None)
