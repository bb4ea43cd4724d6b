"""Open ENVI cubes: one file, or the parts of one cube in a folder of a Headwall camera.

A folder has the layout of the Nano-Hyperspec: ``raw_<frame>``, each named by its first frame, times of the frames in
``frameIndex_<frame>.txt``, ``darkReference`` and ``whiteReference``. The reader was tested on small folders in this
layout, and on the references of a real MV.X.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.envi_headers import EnviHeader, header_text, parse_envi_header
from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.exposures import Taken, check_parts, taken_with
from spectralzoom.pipeline.frame_indices import FRAME_INDEX, FrameIndex, LineTimes, parse_frame_index, times_of_lines
from spectralzoom.storage.readers.acquired import acquired_of
from spectralzoom.storage.readers.band_facts import bad_bands, bands_of_fields, numbers_of_list
from spectralzoom.storage.readers.band_matches import match_bands
from spectralzoom.storage.readers.cube_sources import MOST_MISSING, ONE_FILE, CubeSource, LineFacts
from spectralzoom.storage.readers.file_numbers import FileNumbers
from spectralzoom.storage.readers.image_files import rescaled
from spectralzoom.storage.readers.places import place_of_envi
from spectralzoom.storage.readers.user_files import first_there, is_there

# where a data file's name may differ from its header's
DATA_ENDINGS = ("", ".bin", ".dat", ".img", ".raw", ".bil", ".bip", ".bsq", ".cube")
LONGEST_LINE = 1000  # characters of a frame index; a frame's line has about 25
_PART = re.compile(r"raw_(\d{1,12})(\.[A-Za-z]{1,4})?", re.IGNORECASE)


@dataclass(frozen=True)
class EnviCube:
    """An open ENVI cube. ``values`` are read from the file, (line, sample, band) in the file's type."""

    header_path: Path
    path: Path
    header: EnviHeader
    values: FileNumbers
    lost_lines: int  # in the header and not whole in the file
    notes: tuple[str, ...]


def open_envi_cube(path: str | Path) -> EnviCube:
    """Open a cube by its header or its data file, of any interleave, type, byte order and header offset.

    A file that is cut off keeps its whole lines, with a note. Raises SceneError: header or data are missing or
    cannot be used, or no line is whole.
    """
    header_path, data_path = find_envi_pair(Path(path))
    header = load_envi_header(header_path)
    if "spectral library" in header.kind.lower():
        raise SceneError(f"{header_path} describes a spectral library, expected a cube (line, sample, band)")
    size = data_path.stat().st_size - header.offset
    item = header.dtype.itemsize
    samples, bands = header.samples, header.bands
    whole = size // header.line_bytes
    promised = whole if header.lines is None else header.lines
    if header.interleave == "bsq":  # only lines of the last band are missing
        whole = max(size - (bands - 1) * promised * samples * item, 0) // (samples * item)
    held = min(promised, max(whole, 0))
    if held < 1:
        raise SceneError(
            f"{data_path} holds {max(size, 0)} bytes after an offset of {header.offset}, no whole line of "
            f"{samples} samples x {bands} bands x {item} bytes in all bands; copy it again"
        )
    notes = list(header.notes)
    if header.lines is None:
        notes.append(f"the header does not say how many lines there are; the file holds {held}")
    if held < promised:
        notes.append(f"{data_path.name} is cut off: {held} of {promised} lines are whole")
    elif size > promised * header.line_bytes:
        notes.append(f"{data_path.name} holds {size - promised * header.line_bytes} bytes more than its header says")
    strides = {
        "bil": (bands * samples * item, item, samples * item),
        "bip": (samples * bands * item, bands * item, item),
        "bsq": (samples * item, item, promised * samples * item if bands > 1 else item),  # lines may be any number
    }[header.interleave]
    values = FileNumbers(data_path, header.offset, (held, samples, bands), header.dtype, strides)
    return EnviCube(header_path, data_path, header, values, promised - held, tuple(notes))


def find_envi_pair(path: Path) -> tuple[Path, Path]:
    """Return header and data file by the address of either (SceneError: one of them is missing)."""
    if not is_there(path) or (path.suffix.lower() != ".hdr" and not path.is_file()):
        raise SceneError(f"there is no file {path}; check the name (seen from {Path.cwd()})")
    if path.suffix.lower() == ".hdr":
        stem = path.with_suffix("")
        endings = (ending for name in DATA_ENDINGS for ending in {name: None, name.upper(): None})
        data = first_there(stem.with_name(stem.name + end) for end in endings)
        if data is None:
            raise SceneError(
                f"no data file beside {path}; expected {stem.name} or {stem.name}.bin, .dat, .img, .raw, ..."
            )
        return path, data
    names = [path.name + ".hdr", path.stem + ".hdr", path.name + ".HDR", path.stem + ".HDR"]
    header = first_there(map(path.with_name, names))
    if header is None:
        wanted = " or ".join(dict.fromkeys(names[:2]))
        raise SceneError(f"no header beside {path}; expected {wanted}, or the ending of another kind in its name")
    return header, path


def load_envi_header(path: Path) -> EnviHeader:
    """Read one header file (SceneError: there is no such file, or it is no usable ENVI header)."""
    is_there(path)
    try:
        return parse_envi_header(header_text(path.read_bytes()), str(path))
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error}; name an ENVI header") from error


def open_envi_source(path: Path, *, scaled: bool = True) -> CubeSource:
    """Open one ENVI cube by its header or data file (SceneError as `open_envi_cube`).

    Numbers are divided by the header's reflectance scale factor if ``scaled``, or else have its gains and offsets.
    """
    cube = open_envi_cube(path)
    source = _joined(cube.path.name, {0: cube}, list(cube.notes))
    geobox, where = place_of_envi(cube.header.fields, cube.path, source.shape[:2])
    source = replace(source, geobox=geobox, notes=(*source.notes, *where))
    if not scaled:
        return source
    return _scaled(source, cube.header.fields)


def _scaled(source: CubeSource, fields: Mapping[str, str]) -> CubeSource:
    """Return a cube with the first of the header's scales as its values, and a note on the others."""
    count = source.shape[2]
    factor = _numbers(fields, "reflectance scale factor", 1, 1.0)[0]
    scales = {"reflectance scale factor": (np.full(count, 1 / factor if factor > 0 else 1.0), np.zeros(count))}
    for kind in ("data reflectance", "data"):
        gain, offset = f"{kind} gain values", f"{kind} offset values"
        scales[gain] = _numbers(fields, gain, count, 1.0), _numbers(fields, offset, count, 0.0)
    first, *others = [key for key, one in scales.items() if (one[0] != 1).any() or one[1].any()] or list(scales)[:1]
    notes = [f"{key} of the header is not applied: {first} is" for key in others]
    fill, ignored = None, fields.get("data ignore value", "")
    if ignored and source.nodata is None and numbers_of_list(ignored, 1) is None:
        fill = numbers_of_list(ignored, count)
        notes += [] if fill is not None else [f"data ignore value = {ignored!r} is no number, and is not read"]
    return rescaled(replace(source, notes=(*source.notes, *notes)), *scales[first], fill)


def _numbers(fields: Mapping[str, str], name: str, count: int, default: float) -> NDArray[np.float64]:
    """Return the numbers of a list in a header, one a band; the default where there is none. SceneError: others."""
    found = numbers_of_list(fields[name], count) if fields.get(name) else np.full(count, default)
    if found is None or not np.isfinite(found).all():
        raise SceneError(f"the header lists {name} = {fields[name]!r}, expected {count} as numbers; correct it")
    return found


def is_headwall_folder(folder: Path) -> bool:
    """Return whether a folder has parts of a Headwall camera's cube."""
    return any(_PART.fullmatch(entry.name) for entry in folder.iterdir())


def open_headwall_cube(folder: Path) -> CubeSource:
    """Open the parts of a folder as one cube, in the order of their frames.

    Lines are missing between parts, and at the end of a file that is cut off. Empty parts are left out. Raises
    SceneError: a part cannot be used, parts differ in their frames, or too many lines are missing.
    """
    entries = [entry for entry in sorted(folder.iterdir()) if not entry.is_dir()]
    numbered = [(int(match[1]), entry) for entry in entries if (match := _PART.fullmatch(entry.name)) is not None]
    headers = dict(sorted(one for one in numbered if one[1].suffix.lower() == ".hdr"))
    if headers and (lone := [entry for number, entry in numbered if number not in headers]):
        name = lone[0].name
        raise SceneError(f"{lone[0]} has no header {lone[0].stem}.hdr; copy the header, or move {name} elsewhere")
    if not headers:
        raise SceneError(
            f"{folder} is a folder, expected a file, a Zarr store, or a folder with raw_<frame> files of a Headwall "
            f"camera; name one of the files in it, or {ONE_FILE}"
        )
    notes: list[str] = []
    opened: dict[int, EnviCube] = {}
    for number, header in headers.items():
        data = find_envi_pair(header)[1]
        if data.stat().st_size == 0:
            notes.append(f"{data.name} is empty and left out")
        else:
            opened[number] = open_envi_cube(header)
    if not opened:
        raise SceneError(f"every part of {folder} is empty; copy the folder again")
    frames = {(cube.values.shape[1:], str(cube.values.dtype)) for cube in opened.values()}
    if len(frames) > 1:
        raise SceneError(f"the parts of {folder} have frames of {sorted(frames)} (sample, band); name them one by one")
    parts = [(cube.path.name, number, cube.values.shape[0]) for number, cube in opened.items()]
    starts = _first_lines(parts, MOST_MISSING, notes)
    notes += [note for cube in opened.values() for note in cube.notes]
    if any("map info" in cube.header.fields for cube in opened.values()):
        notes.append("the map info of its parts is not read: lines of a folder are on no map; name one file")
    source = _joined(folder.resolve().name, dict(zip(starts, opened.values(), strict=True)), notes)
    listed = ((FRAME_INDEX.fullmatch(file.name), file) for file in entries)
    indices = {int(match[1]): file for match, file in listed if match is not None and int(match[1]) in opened}
    if not indices:
        return source
    times = LineTimes.unknown(source.shape[0])
    for start, (number, cube) in zip(starts, opened.items(), strict=True):
        if number not in indices:
            notes.append(f"there is no frame index for {cube.path.name}")
            continue
        index = load_frame_index(indices[number])
        own = times_of_lines(index, number, cube.values.shape[0], cube.lost_lines)
        there = slice(start, start + len(own.frame))
        times.frame[there], times.stamp_us[there] = own.frame, own.stamp_us
        notes.extend((*index.notes, *(f"{indices[number].name}: {note}" for note in own.notes)))
    lines, known = source.lines, times.stamp_us >= 0
    if known.any() and np.ptp(times.stamp_us[known]):  # a camera without a clock repeats its stamp
        lines = replace(lines, time_s=np.where(known, (times.stamp_us - times.stamp_us[known][0]) * 1e-6, np.nan))
    return replace(source, files=(*source.files, *indices.values()), lines=lines, notes=tuple(notes))


def _first_lines(parts: Sequence[tuple[str, int, int]], most: int, notes: list[str]) -> list[int]:
    """Return the first line of each part of a cube, from the parts' names, first frames and numbers of lines.

    Raises SceneError: more than ``most`` lines are in no part.
    """
    starts: list[int] = []
    end = 0
    missing = 0
    for name, frame, lines in parts:
        start = frame - parts[0][1]
        missing += max(start - end, 0)
        if missing > most:
            raise SceneError(f"{missing} lines before {name} are in no file, more than {most}; is it of another cube?")
        if start > end:
            notes.append(f"{start - end} lines before {name} are in no file")
        elif start < end:
            notes.append(f"{name} begins {end - start} frames before the part before it ends")
        starts.append(max(start, end))
        end = starts[-1] + lines
    return starts


def _joined(name: str, parts: Mapping[int, EnviCube], notes: list[str]) -> CubeSource:
    """Return files by their first lines as one cube; lines that are in no file are 0 and not valid."""
    cubes = list(parts.values())
    last, cube = list(parts.items())[-1]
    lost = cube.lost_lines if cube.lost_lines <= MOST_MISSING else 0
    if lost < cube.lost_lines:
        notes.append(f"the {cube.lost_lines} lines that {cube.path.name} lacks are not filled up")
    _, samples, count = cubes[0].values.shape
    height = last + cube.values.shape[0] + lost
    native = cubes[0].values.dtype.newbyteorder("=")
    valid = np.zeros(height, np.bool_)
    for start, part in parts.items():
        valid[start : start + part.values.shape[0]] = True
    taken, exposure_ms = _taken(parts, height, notes)
    of_parts = [bands_of_fields(one.header.fields, [None] * count, one.header_path.name) for one in cubes]
    bands = next((one for one in of_parts if one.wavelength_nm is not None), of_parts[0])
    for one, part in zip(of_parts, cubes, strict=True):
        order, _ = match_bands(one, bands, part.header_path.name, cubes[0].header_path.name)
        if order is not None and (order != np.arange(count)).any():
            where = f"{part.header_path.name} has the bands of {cubes[0].header_path.name} in another order"
            raise SceneError(f"{where}; name these parts one by one")
    bad, doubts = bad_bands(cubes[0].header.fields, count)
    notes += [*bands.notes, *doubts]

    acquired = acquired_of({**cubes[0].header.settings, **cubes[0].header.fields})

    def read(start: int, stop: int) -> NDArray[Any]:
        """Return some lines (line, sample, band)."""
        for begin, part in parts.items():
            if begin <= start < stop <= begin + part.values.shape[0]:
                return part.values[start - begin : stop - begin].astype(native, order="C")
        block = np.zeros((stop - start, samples, count), native)
        for begin, part in parts.items():
            low, high = max(start, begin), min(stop, begin + part.values.shape[0])
            if low < high:
                block[low - start : high - start] = part.values[low - begin : high - begin]
        return block

    return CubeSource(
        name=name,
        shape=(height, samples, count),
        dtype=native,
        read=read,
        files=tuple(file for one in cubes for file in (one.header_path, one.path)),
        lines=LineFacts(valid, exposure_ms=exposure_ms),
        taken=taken,
        bands=bands,
        nodata=cubes[0].header.nodata,
        bad_bands=bad,
        acquired=acquired.text,
        notes=(*notes, *acquired.notes),
    )


def _taken(parts: Mapping[int, EnviCube], height: int, notes: list[str]) -> tuple[Taken, NDArray[np.float64] | None]:
    """Return gain and binning of all parts, and (line,) exposures; those that no header states are the usual one.

    Raises SceneError: parts were taken with another gain or binning.
    """
    every = {
        start: taken_with(part.header_path.name, part.header.fields, part.header.settings)
        for start, part in parts.items()
    }
    first = next(iter(every.values()))
    for one in every.values():
        check_parts(one, first)
    if all(one.exposure_ms is None for one in every.values()):
        return first, None
    exposure_ms = np.full(height, np.nan)
    for start, one in every.items():
        exposure_ms[start : start + parts[start].values.shape[0]] = (
            np.nan if one.exposure_ms is None else one.exposure_ms
        )
    usual = float(np.nanmedian(exposure_ms))
    unknown = [one.where for one in every.values() if one.exposure_ms is None]
    notes += [f"{where} does not state its exposure: {usual:g} ms is assumed" for where in unknown]
    return first, np.nan_to_num(exposure_ms, nan=usual)


def load_frame_index(path: Path) -> FrameIndex:
    """Read one index (SceneError: the file cannot be read, or no line of it is a frame)."""
    is_there(path)
    try:
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            return parse_frame_index(iter(lambda: file.readline(LONGEST_LINE), ""), path.name, str(path))
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error}; remove it to read the cube without times") from error
