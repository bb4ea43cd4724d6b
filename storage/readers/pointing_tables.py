"""Read the pointing of lines: a table with a row for each line, as CSV (columns: docs/reference/recordings.md)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spectralzoom.pipeline.capture.straight_scans import angles_to_positions
from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.exposures import WILD_RATIO
from spectralzoom.pipeline.geometry.mirror import RIM_SLACK, STRAIGHT, Mounting
from spectralzoom.pipeline.geometry.scan import Floats
from spectralzoom.pipeline.signal.line_faults import leave_out, wild_exposures
from spectralzoom.storage.readers.user_files import first_there, is_there

if TYPE_CHECKING:
    import pandas as pd

Kind = Literal["mirror", "angles", "angle", "px", "m"]
KINDS: Mapping[Kind, tuple[str, ...]] = {
    "mirror": ("mirror_x", "mirror_y"),
    "angles": ("angle_x_deg", "angle_y_deg"),
    "angle": ("angle_deg",),
    "px": ("position_px",),
    "m": ("position_m",),
}
WITHOUT_MIRROR: tuple[Kind, ...] = ("px", "m")
ACCEPTED = ("line", "sweep", "time", "exposure_ms", "valid", *(name for names in KINDS.values() for name in names))
ENDINGS = (".csv", ".tsv", ".txt")
_OF_ANGLES = "beyond the mirror, which turns the view by up to 50 deg along the scan and 35.6 deg across it"
REACH = {"mirror": "beyond the mirror, which reaches X^2 + Y^2 <= 1", "angles": _OF_ANGLES, "angle": _OF_ANGLES}
POSSIBLE = f"expected a time above 0 ms, less than {WILD_RATIO:g} times off the median"


@dataclass(frozen=True)
class LinePointing:
    """Mirror positions or places of the lines of one cube; those of invalid lines are interpolated."""

    kind: Kind
    position: Floats  # (line, 2) mirror X and Y of the model, or (line, 1) place along a scan without a mirror
    valid: NDArray[np.bool_]  # (line,)
    time_s: Floats | None = None  # (line,) of mid exposure
    exposure_ms: Floats | None = None  # (line,)
    part: tuple[str, ...] | None = None  # (line,) names of the sweeps, if a table cuts one cube into several
    notes: tuple[str, ...] = ()  # on lines that are left out


def find_pointing(folder: Path, stem: str, marks: Sequence[str] = (".pointing",)) -> Path | None:
    """Return the file ``STEM.pointing.csv`` (or .tsv, .txt) of a cube in a folder."""
    names = [f"{stem}{mark}{ending}" for mark in marks for ending in ENDINGS]
    return first_there(folder / name for name in names)


def load_pointing(
    path: Path, name: str, lines: int, mounting: Mounting = STRAIGHT, *, alone: bool = False
) -> LinePointing:
    """Read the pointing of the cube ``name``: the rows whose ``sweep`` is its name, or all without that column.

    If the cube is ``alone`` and no row has its name, the column cuts it into sweeps. ``mounting`` transforms the
    device's positions to the model's. Lines that cannot be are not valid. Raises SceneError: the table cannot be read,
    or does not describe the cube, or more than a tenth of the lines cannot be.
    """
    is_there(path)
    table = _read_table(path)
    kind = _kind_of(path, list(table.columns))
    rows = table
    cut = "sweep" in table and alone and name not in set(table["sweep"])
    if "sweep" in table and not cut:
        rows = table[table["sweep"] == name]
        if rows.empty:
            named = ", ".join(list(dict.fromkeys(table["sweep"]))[:8])
            raise SceneError(f"{path} has no row for the cube {name!r}; its column 'sweep' names {named}")
    if len(rows) != lines:
        way = "fewer" if len(rows) < lines else "more"
        raise SceneError(
            f"{path} has {len(rows)} rows for {name}, {way} than its {lines} lines; give one row for each line, with "
            "valid = 0 for those to be left out"
        )
    if "line" in rows:
        rows = rows.sort_values("line", kind="stable")
        _refuse(path, rows, ["line"], rows["line"] != np.arange(lines), f"expected each of 0 to {lines - 1} once")
    valid = np.ones(lines, np.bool_)
    if "valid" in rows:
        _refuse(path, rows, ["valid"], ~rows["valid"].isin((0, 1)), "expected 0 or 1")
        valid = rows["valid"].to_numpy() == 1
    if not valid.any():
        raise SceneError(f"{path} calls no line of {name} valid; set valid = 1 for lines that can be used")
    if "time" in rows:
        unknown = valid & ~np.isfinite(rows["time"])
        _refuse(path, rows, ["time"], unknown, "expected a number; set valid = 0 where it is not known")
    valid, position, exposure_ms, notes = _possible(path, rows, kind, valid, mounting)
    time_s = _times(path, rows, valid) if "time" in rows else None
    part = tuple(rows["sweep"]) if cut else None
    return LinePointing(kind, position, valid, time_s, exposure_ms, part, tuple(notes))


def _possible(
    path: Path, rows: pd.DataFrame, kind: Kind, valid: NDArray[np.bool_], mounting: Mounting
) -> tuple[NDArray[np.bool_], Floats, Floats | None, list[str]]:
    """Return valid lines, positions and exposures, and notes; lines that cannot be are not valid, and interpolated.

    Raises SceneError: more than a tenth of the lines cannot be.
    """
    given = rows[list(KINDS[kind])].to_numpy()
    exposure_ms = rows["exposure_ms"].to_numpy() if "exposure_ms" in rows else None
    wild = np.zeros(len(rows), np.bool_) if exposure_ms is None else wild_exposures(exposure_ms, valid)
    unknown = ~np.isfinite(given).all(axis=1)
    lost = ~np.isfinite(_positions(kind, given, mounting)).all(axis=1)
    checks = (
        (valid & unknown, KINDS[kind], "expected a number"),
        (valid & lost & ~unknown, KINDS[kind], REACH.get(kind, "")),
        (valid & wild & ~lost, ("exposure_ms",), POSSIBLE),
    )
    faults = {_row_text(rows[wrong], names, expected): wrong for wrong, names, expected in checks if wrong.any()}
    valid, notes = leave_out(str(path), valid, faults, "correct the table")
    if exposure_ms is not None:
        exposure_ms = _filled(np.where(wild, np.nan, exposure_ms), valid)
    every = [_filled(np.where(lost, np.nan, values), valid) for values in given.T]
    return valid, _positions(kind, np.stack(every, axis=-1), mounting), exposure_ms, notes


def _read_table(path: Path) -> pd.DataFrame:
    """Return the rows that are not blank, by their numbers in the file: ``sweep`` as text, others as float64."""
    import pandas as pd

    try:
        text = path.read_text(encoding="utf-8-sig")
        separator = max((",", ";", "\t"), key=text.partition("\n")[0].count)
        options = {"dtype": str, "keep_default_na": False, "skip_blank_lines": False}  # numbers of rows stay
        cells = pd.read_csv(StringIO(text), sep=separator, header=None, **options).map(str.strip)
    except (OSError, ValueError) as error:  # also of pandas
        why = str(error).replace("Error tokenizing data. C error: E", "e").strip()
        raise SceneError(f"{path} cannot be read as a pointing table: {why}; name a text file (CSV)") from error
    cells.columns, cells.index = cells.iloc[0].str.lower(), cells.index + 1
    cells = cells[(cells != "").any(axis=1)].iloc[1:]
    wrong = [name for name in cells.columns if name not in ACCEPTED] or list(cells.columns[cells.columns.duplicated()])
    if wrong or cells.empty:
        what = f"the column {wrong[0]!r}, unknown or twice" if wrong else "no row below its header"
        raise SceneError(f"{path} has {what}; give a row for each line, with columns of {', '.join(ACCEPTED)}")
    for name in cells.columns.drop("sweep", errors="ignore"):
        texts = cells[name].mask(cells[name] == "", "nan")
        cells[name] = pd.to_numeric(texts, errors="coerce").astype(np.float64)
        bad = texts[cells[name].isna() & (texts.str.lower() != "nan")]
        if len(bad):
            raise SceneError(
                f"{path}, row {bad.index[0]}: {name} = {bad.iloc[0][:40]!r} is no number; write numbers with a "
                "decimal point, and 1 or 0 for valid"
            )
    return cells


def _kind_of(path: Path, columns: Sequence[str]) -> Kind:
    """Return the one kind of pointing that a table has."""
    kinds = [kind for kind, names in KINDS.items() if set(names) & set(columns)]
    missing = [name for kind in kinds for name in KINDS[kind] if name not in columns]
    if len(kinds) != 1 or missing:
        came = f"{missing[0]} is missing" if missing else f"it has {len(kinds)} kinds" if kinds else "it has none"
        wanted = "; or ".join(", ".join(names) for names in KINDS.values())
        raise SceneError(f"{path} must have one kind of pointing, but {came}; give {wanted}")
    return kinds[0]


def _times(path: Path, rows: pd.DataFrame, valid: NDArray[np.bool_]) -> Floats:
    """Return (line,) times; NaN for invalid lines unless they lie between those of their neighbours."""
    time_s = rows["time"].to_numpy()
    known = np.flatnonzero(valid)
    part = (rows["sweep"] if "sweep" in rows else rows["time"] * 0).to_numpy()[known]
    stuck = np.zeros(len(rows), np.bool_)
    stuck[known[1:]] = (np.diff(time_s[known]) <= 0) & (part[1:] == part[:-1])
    _refuse(path, rows, ["time"], stuck, "expected a time after that of the line before [s]")
    before = np.maximum.accumulate(np.where(valid, time_s, -np.inf))
    after = np.minimum.accumulate(np.where(valid, time_s, np.inf)[::-1])[::-1]
    return np.where(valid | ((before < time_s) & (time_s < after)), time_s, np.nan)


def _positions(kind: Kind, values: Floats, mounting: Mounting) -> Floats:
    """Return (line, 2) positions of the model, or (line, 1) places; NaN beyond the mirror."""
    if kind in WITHOUT_MIRROR:
        return values
    if kind == "mirror":
        position = mounting.to_model(values)
        return np.where(np.hypot(*position.T)[:, None] <= 1 + RIM_SLACK["float64"], position, np.nan)
    return angles_to_positions(values if kind == "angles" else np.concatenate([values * 0, values], axis=1))[0]


def _refuse(path: Path, rows: pd.DataFrame, columns: Sequence[str], wrong: ArrayLike, expected: str) -> None:
    """Raise SceneError for the first wrong row, with its number in the file."""
    found = rows[np.asarray(wrong)]
    if not found.empty:
        raise SceneError(f"{path}, {_row_text(found, columns, expected)}; correct the table")


def _row_text(found: pd.DataFrame, columns: Sequence[str], expected: str) -> str:
    """Return the number and the values of the first of some rows."""
    came = ", ".join(f"{name} = {found[name].iloc[0]:.10g}" for name in columns)
    more = "" if len(found) == 1 else f" (the first of {len(found)} such rows)"
    return f"row {found.index[0]}: {came}{more}, {expected}"


def _filled(values: Floats, valid: NDArray[np.bool_]) -> Floats:
    """Return the values; those of invalid lines that are unknown, or far beyond those of valid lines, interpolated."""
    low, high = values[valid].min(), values[valid].max()
    at = np.arange(len(values))
    beyond = (high - low) / valid.sum() * (1 + (~valid).sum())  # lines before the first valid one lie so far off
    known = valid | ((values >= low - beyond) & (values <= high + beyond))
    return values if known.all() else np.interp(at, at[known], values[known])
