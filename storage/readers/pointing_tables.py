"""Read the pointing of recorded lines: a table with a row for each line, or a vector that the mirror played.

A table is CSV (commas, semicolons or tabs) or Parquet. Optional columns are ``line`` (from 0), ``sweep``,
``time`` (of mid exposure since the start of the sweep) [s], ``exposure_ms`` and ``valid`` (0 or 1). A table has exactly
one of these kinds of pointing:

::

    mirror_x, mirror_y         mirror position, -1..1, in the device's axes
    angle_x_deg, angle_y_deg   viewing angle along the line and along the scan
    angle_deg                  viewing angle along the scan, of a scan through the undeflected direction
    position_px                place along a straight scan without a mirror: stage, conveyor, drone
    position_m                 the same in metres

A vector is a TOML file, for a path that the mirror played by its own clock::

    vector = "positions.csv"   # CSV or .npy: two columns X and Y, or all X before all Y in one
    rate_hz = 14.5             # cells a second
    start_s = 0.0              # time of the path at the first line's exposure; 0 by default
"""

from __future__ import annotations

import csv
import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from pipeline.capture.straight_scans import PlayedVector, angles_to_positions, split_vector
from pipeline.errors import PoseError, SceneError
from pipeline.geometry.mirror import RIM_SLACK, STRAIGHT, Mounting, check_reach
from pipeline.lazy import deferred

if TYPE_CHECKING:
    from pyarrow import parquet  # type: ignore[import-untyped]
else:
    parquet = deferred("pyarrow.parquet")

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
TABLE_ENDINGS = (".csv", ".tsv", ".txt", ".parquet")
ENDINGS = (*TABLE_ENDINGS, ".toml")
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
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class PointingTable:
    """The rows of one table as in its file."""

    path: Path
    kind: Kind
    columns: Mapping[str, Floats]  # (row,) each
    sweep: tuple[str, ...] | None  # (row,)
    first_row: int  # number of the first row in the file, as an editor counts them

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
        """Raise SceneError for the first wrong row, with its number in the file and the range of the column."""
        if not wrong.any():
            return
        names = (columns,) if isinstance(columns, str) else tuple(columns)
        first = rows[np.argmax(wrong)]
        came = ", ".join(f"{name} = {self.columns[name][first]:.10g}" for name in names)
        count = int(np.count_nonzero(wrong))
        more = "" if count == 1 else f" (the first of {count} such rows)"
        known = {name: self.columns[name][np.isfinite(self.columns[name])] for name in names}
        spans = [f"{name} goes from {one.min():.6g} to {one.max():.6g}" for name, one in known.items() if len(one)]
        row = first + self.first_row
        raise SceneError(f"{self.path}, row {row}: {came}{more}, {expected}. {'; '.join(spans)}; correct the table")


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
    header: list[str]
    cells: Sequence[Sequence[object]]
    if path.suffix.lower() == ".parquet":
        header, cells, first_row = *_parquet_cells(path), 1
    else:
        header, cells, first_row = *_csv_cells(path), 2  # the header is row 1
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
        name: _numbers(path, name, [row[at] for row in cells], first_row)
        for at, name in enumerate(header)
        if name != "sweep"
    }
    sweep = tuple(str(row[header.index("sweep")]).strip() for row in cells) if "sweep" in header else None
    return PointingTable(path, kinds[0], columns, sweep, first_row)


def _numbers(path: Path, name: str, cells: Sequence[object], first_row: int) -> Floats:
    """Return the cells of a column as numbers, NaN for empty ones, 1 for True."""
    values = np.empty(len(cells))
    for number, cell in enumerate(cells):
        text = str(cell).strip().lower()
        try:
            values[number] = WORDS[text] if text in WORDS else float(text)
        except ValueError:
            raise SceneError(
                f"{path}, row {number + first_row}: {name} = {str(cell)[:40]!r} is no number; write numbers with a "
                "decimal point"
            ) from None
    return values


def _csv_cells(path: Path) -> tuple[list[str], list[list[str]]]:
    """Return the names of the columns and the cells of all rows, by the delimiter of the header."""
    text = _text(path)
    lines = text.splitlines()
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


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"{path} cannot be read as a pointing table: {error}; name a text file (CSV)") from error


def _parquet_cells(path: Path) -> tuple[list[str], list[list[object]]]:
    try:
        table = parquet.read_table(path)
    except ImportError as error:
        raise SceneError(
            f"{path} is Parquet, and pyarrow is not installed; install spectralzoom[parquet], or write the table as CSV"
        ) from error
    except (OSError, ValueError) as error:  # pyarrow's errors are of these
        raise SceneError(f"{path} cannot be read as Parquet: {error}; write the table anew, or as CSV") from error
    columns = table.to_pydict()
    return [name.lower() for name in columns], [list(row) for row in zip(*columns.values(), strict=True)]


class _Recipe(BaseModel):
    """TOML file of a played vector."""

    model_config = ConfigDict(extra="forbid", strict=True)

    vector: str
    rate_hz: float = Field(gt=0, allow_inf_nan=False)
    start_s: float = Field(0.0, allow_inf_nan=False)


def load_played_vector(path: Path, mounting: Mounting = STRAIGHT) -> PlayedVector:
    """Read the TOML file of a played vector, and the file of positions that it names.

    Raises SceneError: either cannot be read, the TOML file has other keys than vector, rate_hz and start_s, or a
    position is beyond the mirror.
    """
    try:
        stated = _Recipe.model_validate(tomllib.loads(_text(path)))
    except tomllib.TOMLDecodeError as error:
        raise SceneError(f"{path} cannot be read as TOML: {error}; write vector, rate_hz and start_s") from error
    except ValidationError as error:
        first = error.errors()[0]
        raise SceneError(
            f'{path}: {first["loc"][0]}: {first["msg"]}; write vector = "positions.csv", rate_hz above 0 and start_s'
        ) from None
    file = path.parent / stated.vector
    try:
        if file.suffix == ".npy":
            values = np.load(file, allow_pickle=False)
        else:  # without a header, (row, column)
            values = np.loadtxt(re.sub(r"[;\t]", ",", _text(file)).splitlines(), delimiter=",", ndmin=2)
        if values.dtype.kind not in "iuf":
            raise ValueError(f"it holds {values.dtype}")
        positions = mounting.to_model(split_vector(values.astype(np.float64), str(file)))
        check_reach(positions)
    except SceneError:
        raise
    except PoseError as error:
        raise SceneError(f"{file}: {error}") from error
    except (OSError, ValueError, EOFError) as error:
        raise SceneError(f"{file} cannot be read as a vector: {error}; give CSV or .npy with numbers") from error
    return PlayedVector(positions, stated.rate_hz, stated.start_s)


def follow_vector(vector: PlayedVector, middle_s: Floats, where: str) -> LinePointing:
    """Return the pointing of lines by a played vector and the times of their mid exposures (line,) [s].

    Times count from the start of the first exposure. Lines without a time, or outside of the path's time, are not
    valid. Raises SceneError: no line lies within the path's time.
    """
    known = np.isfinite(middle_s)
    position, played = vector.at(np.where(known, middle_s, 0.0))
    valid = known & played
    if not valid.any():
        seconds = len(vector.position) / vector.rate_hz
        raise SceneError(
            f"{where}: no line was taken while the path of {seconds:g} s was played; correct start_s or rate_hz"
        )
    note = (
        "positions are those of the played vector, by the clocks of camera and mirror; an error of start_s shifts all"
    )
    lost = int(np.count_nonzero(~valid))
    outside = (f"{lost} lines lie outside of the path's time and are not valid",) if lost else ()
    return LinePointing("mirror", position, valid, middle_s, notes=(note, *outside))


def find_pointing(folder: Path, stem: str) -> Path | None:
    """Return the file ``STEM.pointing.csv``, ``.parquet`` or ``.toml`` of a cube in a folder."""
    names = [f"{stem}.pointing{ending}" for ending in ENDINGS]
    return next((folder / name for name in names if (folder / name).is_file()), None)
