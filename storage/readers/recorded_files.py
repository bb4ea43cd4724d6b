"""Find the cubes of recordings, their dark and white frames, and the pointing of their lines.

Pointing is a table with a row for each line: CSV (commas, semicolons or tabs). Optional columns are ``line`` (from 0),
``sweep``, ``time`` (of mid exposure since the start of the sweep) [s], ``exposure_ms`` and ``valid`` (0 or 1). A table
has exactly one of these kinds of pointing:

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
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.capture.straight_scans import angles_to_positions
from spectralzoom.pipeline.envi_headers import listed_numbers
from spectralzoom.pipeline.errors import SceneError, WavelengthError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.mirror import RIM_SLACK, STRAIGHT, Mounting
from spectralzoom.pipeline.signal.calibrate import Floats, find_bad_elements, full_scale_notes
from spectralzoom.pipeline.source import References
from spectralzoom.storage.readers.array_files import find_zarr_store
from spectralzoom.storage.readers.cube_sources import CubeSource
from spectralzoom.storage.readers.envi_files import DATA_ENDINGS, find_envi_pair, find_reference, load_envi_header
from spectralzoom.storage.readers.open_cubes import load_frame, open_cube_source, reader_of, with_wavelengths
from spectralzoom.storage.readers.own_files import within
from spectralzoom.storage.readers.scene_files import bands_text

FRAMES = ("dark", "white", "bad")  # behind the name of a cube in those of its frames
SAMPLED_LINES = 64  # for bits


@dataclass(frozen=True)
class RecordedFile:
    """One cube of a recording."""

    name: str
    path: Path
    source: CubeSource

    @property
    def folder(self) -> Path:
        """Return the folder of its pointing and frames."""
        return self.path if self.path.is_dir() and find_zarr_store(self.path) is None else self.path.parent


def find_cubes(path: Path) -> list[Path]:
    """Return the cubes of an address: itself, or the ENVI cubes or Zarr stores of a folder (SceneError: none)."""
    if not path.is_dir() or find_zarr_store(path) is not None:
        return [path]
    headers = sorted(entry for entry in path.iterdir() if entry.suffix.lower() == ".hdr" and entry.is_file())
    if any(entry.name.lower().startswith("raw_") for entry in headers):
        return [path]  # parts of a Headwall camera's cube
    stems = [(entry, _stem(entry).lower()) for entry in headers]
    cubes = [
        entry
        for entry, stem in stems
        if not stem.startswith(("dark", "white")) and stem.rpartition(".")[2] not in FRAMES
    ]
    stores = sorted(entry for entry in path.iterdir() if entry.is_dir() and find_zarr_store(entry) == entry)
    known = {stem for _, stem in stems}
    for table in sorted(path.glob("*.pointing.*")):
        stem = table.name.partition(".pointing.")[0]
        for data in (path / f"{stem}{ending}" for ending in DATA_ENDINGS):
            if stem.lower() not in known and data.is_file():
                raise SceneError(f"{data} has no header {stem}.hdr; copy the header, or move {data.name} elsewhere")
    if not cubes and not stores:
        raise SceneError(f"{path} holds no cube; expected ENVI headers (.hdr), raw_<frame> files or Zarr stores in it")
    if cubes and stores:
        raise SceneError(f"{path} holds ENVI cubes and the Zarr store {stores[0].name}; name one, or move either kind")
    return [within(path, one) for one in cubes or stores]


def _stem(path: Path) -> str:
    """Return the name of a cube without the endings of its files."""
    stem = path.name.removesuffix(path.suffix) if path.suffix.lower() == ".hdr" else path.name
    ending = Path(stem).suffix
    return stem.removesuffix(ending) if ending.lower() in (*filter(None, DATA_ENDINGS), ".zarr") else stem


def open_recorded_cube(path: Path, wavelengths: Sequence[float] | None) -> RecordedFile:
    """Open one cube of whole numbers with wavelengths."""
    source = open_cube_source(path)
    if source.dtype not in (np.uint8, np.uint16, np.int16):
        raise SceneError(
            f"{path} holds {source.dtype}{' by the scale or offset in its header' if source.scaling else ''}, expected "
            "a camera's own numbers (whole, 8 or 16 bits); a cube of reflectance or radiance is no recording: give it "
            "as --scene"
        )
    if wavelengths is not None:
        source = with_wavelengths(source, path, wavelengths)
    if source.bands.wavelength_nm is None:
        raise WavelengthError(
            f"{path} has {source.shape[2]} bands and nothing says their wavelengths; give --wavelengths in nm"
            + (", or write a list 'wavelength' into its header" if reader_of(path) == "envi" else "")
        )
    return RecordedFile(_stem(path), path, source)


def with_bits(
    camera: LineCamera, cubes: Sequence[RecordedFile], stated: Mapping[str, Path | None], notes: list[str]
) -> LineCamera:
    """Return the camera with as many bits as the white frame and some lines of each cube need; 8 for cubes of bytes."""
    if camera.bits > 8 and all(cube.source.dtype == np.uint8 for cube in cubes):
        camera = replace(camera, bits=8, dark_dn=camera.dark_dn * 255 / camera.full_scale_dn)  # the same fraction
        notes.append("the files hold bytes, so 8 bits are taken for camera.bits")
    bits = camera.bits
    for cube in cubes:
        valid = np.flatnonzero(cube.source.valid)
        chosen = np.unique(valid[np.linspace(0, len(valid) - 1, SAMPLED_LINES).astype(int)])
        lines = np.concatenate([cube.source.read(int(line), int(line) + 1) for line in chosen])
        good = ~_marked(cube.source)
        void = np.nan if cube.source.nodata is None else cube.source.nodata
        most = int(lines.max(initial=0, where=good & (lines != void)))
        file = reference_files(cube.folder / cube.name, stated)["white"]
        white = cube.source.white if file is None else load_frame(file)[0]
        if white is not None and white.shape == cube.source.shape[1:]:  # `find_references` refuses others
            most = max(most, int(white[np.isfinite(white) & good].max(initial=0)))
        full = camera.full_scale_dn * max(camera.samples // cube.source.shape[1], 1)
        needed = (most * camera.full_scale_dn // full).bit_length()
        if most > full and needed > bits:
            bits = needed
            notes.append(
                f"{cube.name}: numbers reach {most}, so {bits} bits are taken for camera.bits; if the camera has"
                " fewer, correct the byte order in the header"
            )
    return replace(camera, bits=bits)


def _marked(source: CubeSource) -> NDArray[np.bool_]:
    """Return (band,) whether the file marks a band as bad; no band where it marks all."""
    count = source.shape[2]
    return np.isin(np.arange(count), source.bad_bands if len(source.bad_bands) < count else ())


def reference_files(stem: Path, stated: Mapping[str, Path | None]) -> dict[str, Path | None]:
    """Return the file of each kind of frame: ``stated``, else beside the cube ``stem``, else of the folder, or None."""
    files: dict[str, Path | None] = {}
    for kind in FRAMES:
        beside = [stem.with_name(f"{stem.name}.{kind}{ending}") for ending in (".hdr", ".npy")]
        if (file := stated.get(kind)) is not None and not file.exists():
            raise SceneError(f"there is no file {file}; check the name (seen from {Path.cwd()})")
        file = file or next((within(stem.parent, one) for one in beside if one.is_file()), None)
        files[kind] = find_reference(stem.parent, kind) if file is None and kind in ("dark", "white") else file
    return files


def find_references(
    source: CubeSource,
    stem: Path,
    camera: LineCamera,
    notes: list[str],
    *,
    stated: Mapping[str, Path | None],
    white_reference: NDArray[np.float32],
) -> References:
    """Return the reference frames of a cube: ``stated``, else ``stem.dark.hdr`` etc., else those of the folder.

    ``white_reference`` is the default value of the white reference, one or (band,). Raises SceneError: a frame has
    other samples or bands than the cube, or white is not brighter than dark.
    """
    name = stem.name
    frame = source.shape[1:]
    white_dn = camera.full_scale_dn * max(camera.samples // frame[0], 1)
    files = reference_files(stem, stated)
    found: dict[str, NDArray[np.float32]] = {}
    for kind, file in files.items():
        if file is not None:
            found[kind] = load_frame(file)[0]
            notes.append(f"{kind} frame from {file.name}")
            if found[kind].shape != frame:
                raise SceneError(
                    f"the {kind} frame {file} is {found[kind].shape} (sample, band), the cube {frame}; give one taken "
                    "with the cube's own samples and bands"
                )
    dark, white = found.get("dark", source.dark), found.get("white", source.white)
    measured = dark is not None and white is not None
    if dark is None:
        dark = np.zeros(frame, np.float32)
        notes.append(f"{name} has no dark frame: a dark level of 0 is assumed; give --dark")
    if white is None:
        white = np.full(frame, white_dn, np.float32)
        notes.append(
            f"{name} has no white frame: full scale ({white_dn} DN) is assumed to be white, and values are relative; "
            "give --white"
        )
    if not (white > dark).any():
        raise SceneError(
            f"the white frame of {name} is nowhere brighter than its dark frame; exchange them, or give others with "
            "--dark and --white"
        )
    bad: NDArray[Any] | None = found.get("bad")
    if bad is None and measured and files["bad"] is None:
        bad = find_bad_elements(dark, white)
        notes += full_scale_notes(white, white_dn)
    bands = frame[1]
    if white_reference.shape not in ((), (bands,)):
        raise SceneError(
            f"the white reference has {white_reference.shape} values, the cube {bands} bands; give one or one a band"
        )
    file = files["white"]
    fields = load_envi_header(find_envi_pair(file)[0]).fields if file is not None and reader_of(file) == "envi" else {}
    listed = listed_numbers(fields, "white_reference", bands, [])
    white_reference = white_reference if listed is None else listed.astype(np.float32)
    by_mirror = fields.get("mirror at rest", "0").strip() == "1"
    marked = _marked(source)
    left_out = f"bands {bands_text(np.flatnonzero(marked).tolist())} are left out: the file marks them as bad"
    notes += [f"{name}: {left_out}"] if marked.any() else []
    notes += [] if source.nodata is None else [f"{name}: the number {source.nodata:g} is no data, as the file says"]
    bad = np.broadcast_to(marked | np.asarray(bad if bad is not None else False, np.bool_), frame).copy()
    white_reference = np.broadcast_to(white_reference, bands).copy()
    return References(dark, white, white_reference, bad if bad.any() else None, by_mirror)


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
    numbers: tuple[int, ...]  # (row,) of the rows in the file, where some may be blank

    def of_cube(self, name: str, lines: int, mounting: Mounting = STRAIGHT, *, alone: bool = False) -> LinePointing:
        """Return the pointing of a cube: the rows whose ``sweep`` is its name, or all without that column.

        If the cube is ``alone`` and no row has its name, the column cuts it into sweeps. ``mounting`` transforms the
        device's positions to the model's. Raises SceneError: the cube has another number of rows or no valid one; a
        value is no number, out of range or beyond the mirror; or times do not rise.
        """
        rows = np.arange(len(self.columns[KINDS[self.kind][0]]))
        sweeps = tuple(dict.fromkeys(self.sweep or ()))
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
            rows = rows[np.argsort(self.columns["line"][rows], kind="stable")]
            wrong = self.columns["line"][rows] != np.arange(lines)
            self._refuse(rows, wrong, ["line"], f"expected each of 0 to {lines - 1} once")
        valid = np.ones(lines, np.bool_)
        if "valid" in self.columns:
            flags = self.columns["valid"][rows]
            self._refuse(rows, ~np.isin(flags, (0, 1)), ["valid"], "expected 0 or 1")
            valid = flags == 1
        if not valid.any():
            raise SceneError(f"{self.path} calls no line of {name} valid; set valid = 1 for lines that can be used")
        for column in {*KINDS[self.kind], "time", "exposure_ms"} & set(self.columns):
            unknown = valid & ~np.isfinite(self.columns[column][rows])
            self._refuse(rows, unknown, [column], "expected a number; set valid = 0 where it is not known")
        time_s = exposure_ms = None
        if "time" in self.columns:  # may be NaN for invalid lines
            time_s = self.columns["time"][rows]
            known = np.flatnonzero(valid)
            stuck = np.zeros(lines, np.bool_)
            part_of = np.array([self.sweep[row] if self.sweep else "" for row in rows[known]])
            stuck[known[1:]] = (np.diff(time_s[known]) <= 0) & (part_of[1:] == part_of[:-1])
            self._refuse(rows, stuck, ["time"], "expected a time after that of the line before [s]")
            before = np.maximum.accumulate(np.where(valid, time_s, -np.inf))
            after = np.minimum.accumulate(np.where(valid, time_s, np.inf)[::-1])[::-1]
            time_s = np.where(valid | ((before < time_s) & (time_s < after)), time_s, np.nan)
        if "exposure_ms" in self.columns:
            exposure_ms = _filled(self.columns["exposure_ms"][rows], valid)
            self._refuse(rows, exposure_ms <= 0, ["exposure_ms"], "expected a time above 0 ms")
        part = tuple(self.sweep[row] for row in rows) if self.sweep is not None and cut else None
        return LinePointing(self.kind, self._positions(rows, valid, mounting), valid, time_s, exposure_ms, part)

    def _positions(self, rows: NDArray[np.intp], valid: NDArray[np.bool_], mounting: Mounting) -> Floats:
        """Return (line, 2) positions of the model, or (line, 1) places, interpolated for invalid lines."""
        values = np.stack([_filled(self.columns[name][rows], valid) for name in KINDS[self.kind]], axis=-1)
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

    def _refuse(self, rows: NDArray[np.intp], wrong: NDArray[np.bool_], columns: Sequence[str], expected: str) -> None:
        """Raise SceneError for the first wrong row, with its number in the file."""
        if not wrong.any():
            return
        first = rows[np.argmax(wrong)]
        came = ", ".join(f"{name} = {self.columns[name][first]:.10g}" for name in columns)
        count = int(np.count_nonzero(wrong))
        more = "" if count == 1 else f" (the first of {count} such rows)"
        raise SceneError(f"{self.path}, row {self.numbers[first]}: {came}{more}, {expected}; correct the table")


def _filled(values: Floats, valid: NDArray[np.bool_]) -> Floats:
    """Return the values; those of invalid lines that are unknown, or far beyond those of valid lines, interpolated."""
    low, high = values[valid].min(), values[valid].max()
    at = np.arange(len(values))
    beyond = (high - low) / valid.sum() * (1 + (~valid).sum())  # lines before the first valid one lie so far off
    known = valid | ((values >= low - beyond) & (values <= high + beyond))
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
        raise SceneError(f"{path} has {what}; leave it out; accepted are {', '.join(ACCEPTED)}")
    kinds = [kind for kind, names in KINDS.items() if set(names) & set(header)]
    missing = [name for kind in kinds for name in KINDS[kind] if name not in header]
    if len(kinds) != 1 or missing:
        came = f"{missing[0]} is missing" if missing else f"it has {len(kinds)} kinds" if kinds else "it has none"
        wanted = "; or ".join(", ".join(names) for names in KINDS.values())
        raise SceneError(f"{path} must have one kind of pointing, but {came}; give {wanted}")
    if not cells:
        raise SceneError(f"{path} has no row below its header; give a row for each line")
    columns = {
        name: _numbers(path, name, {number: row[at] for number, row in cells.items()})
        for at, name in enumerate(header)
        if name != "sweep"
    }
    sweep = tuple(row[header.index("sweep")] for row in cells.values()) if "sweep" in header else None
    return PointingTable(path, kinds[0], columns, sweep, tuple(cells))


def _numbers(path: Path, name: str, cells: Mapping[int, str]) -> Floats:
    """Return the cells of a column, by their rows in the file, as numbers: NaN for empty ones, 1 for True."""
    values = np.empty(len(cells))
    for at, (number, cell) in enumerate(cells.items()):
        try:
            values[at] = WORDS[cell.lower()] if cell.lower() in WORDS else float(cell)
        except ValueError:
            raise SceneError(
                f"{path}, row {number}: {name} = {cell[:40]!r} is no number; write numbers with a decimal"
                " point, and 1 or 0 for valid"
            ) from None
    return values


def _csv_cells(path: Path) -> tuple[list[str], dict[int, list[str]]]:
    """Return the names of the columns, and the cells of rows that are not blank by their number in the file."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"{path} cannot be read as a pointing table: {error}; name a text file (CSV)") from error
    delimiter = max((",", ";", "\t"), key=(lines[0] if lines else "").count)
    rows = [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=delimiter)]
    if not rows:
        raise SceneError(f"{path} is empty; give a header and a row for each line")
    names = [name.lower() for name in rows[0]]
    cells = {number: row for number, row in enumerate(rows[1:], FIRST_ROW) if any(row)}
    for number, row in cells.items():
        if len(row) != len(names):
            raise SceneError(
                f"{path}, row {number} has {len(row)} cells, the header in row 1 has {len(names)}; give each as many"
            )
    return names, cells


def find_pointing(folder: Path, stem: str) -> Path | None:
    """Return the file ``STEM.pointing.csv`` (or .tsv, .txt) of a cube in a folder."""
    names = [f"{stem}.pointing{ending}" for ending in ENDINGS]
    return next((within(folder, folder / name) for name in names if (folder / name).is_file()), None)
