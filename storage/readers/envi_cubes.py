"""ENVI files: headers read leniently and refused where they say too little, cubes lazily.

The numbers stay in their file until a part of the view is read.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.rig.camera.camera_texts import finite_number, listed_numbers, split_header, wavelengths_nm

LARGEST_HEADER = 1 << 22  # bytes; the largest seen holds 33 thousand
INTERLEAVES = ("bil", "bip", "bsq")
# data type codes of the format's description
_CODES = (1, 2, 3, 4, 5, 6, 9, 12, 13, 14, 15)
DATA_TYPES = dict(zip(_CODES, ("u1", "i2", "i4", "f4", "f8", "c8", "c16", "u2", "u4", "i8", "u8"), strict=True))
# of these a header describes another kind of file than plain numbers
OTHER_FILES = ("tiff", "jpeg", "jp2", "png", "bmp", "hdf", "netcdf", "nitf", "virtual", "meta")
# where a data file's name may differ from its header's
DATA_ENDINGS = ("", ".bin", ".dat", ".img", ".raw", ".bil", ".bip", ".bsq", ".cube")


@dataclass(frozen=True)
class EnviHeader:
    """What one header says; what it leaves out is None, and what was made of it stands in ``notes``."""

    where: str  # the header's path, for messages
    samples: int
    lines: int | None  # None: as many as the data file holds
    bands: int
    dtype: np.dtype[np.generic]  # with its byte order
    interleave: str  # bil, bip or bsq
    offset: int  # bytes before the numbers
    kind: str  # file type, such as ENVI Standard or ENVI Spectral Library
    wavelength_nm: NDArray[np.float64] | None  # (band,)
    fwhm_nm: NDArray[np.float64] | None  # (band,)
    band_names: tuple[str, ...]
    nodata: float | None
    fields: Mapping[str, str]  # all of them as written, keys in lower case, the outer braces taken off
    settings: Mapping[str, str]  # of the lines that begin with ;
    notes: tuple[str, ...]


@dataclass(frozen=True)
class EnviCube:
    """An ENVI cube, opened. ``values`` is a read-only view of the file, (line, sample, band) in the file's type."""

    path: Path
    header: EnviHeader
    values: NDArray[Any]
    lost_lines: int  # that the header promises and the file does not hold whole
    notes: tuple[str, ...]


def open_envi_cube(path: str | Path) -> EnviCube:
    """Open a cube by its header or its data file, of any interleave, type, byte order and header offset.

    A file that is cut off keeps the lines that are whole in all bands, and ``lost_lines`` and a note say so. Raises
    SceneError: header or data are missing or cannot be used, or no line is whole.
    """
    header_path, data_path = find_envi_pair(Path(path))
    header = load_envi_header(header_path)
    if "spectral library" in header.kind.lower():
        raise SceneError(f"{header_path} describes a spectral library, expected a cube (line, sample, band)")
    size = data_path.stat().st_size - header.offset
    item = header.dtype.itemsize
    line_bytes = header.samples * header.bands * item
    promised = size // line_bytes if header.lines is None else header.lines
    whole = size // line_bytes
    if header.interleave == "bsq":  # band after band: the last one says how far all of them reach
        row = header.samples * item
        whole = max(size - (header.bands - 1) * promised * row, 0) // row
    held = min(promised, max(whole, 0))
    if held < 1:
        raise SceneError(
            f"{data_path} holds {max(size, 0)} bytes after an offset of {header.offset}, no whole line of "
            f"{header.samples} samples x {header.bands} bands x {item} bytes in all bands; copy it again"
        )
    notes = list(header.notes)
    if header.lines is None:
        notes.append(f"the header does not say how many lines there are; the file holds {held}")
    if held < promised:
        notes.append(f"{data_path.name} is cut off: {held} of {promised} lines are whole")
    elif size > promised * line_bytes:
        notes.append(f"{data_path.name} holds {size - promised * line_bytes} bytes more than its header says")
    samples, bands = header.samples, header.bands
    strides = {
        "bil": (bands * samples * item, item, samples * item),
        "bip": (samples * bands * item, bands * item, item),
        "bsq": (samples * item, item, promised * samples * item if bands > 1 else item),  # lines may be any promise
    }[header.interleave]
    content = np.memmap(data_path, np.uint8, mode="r")
    values: NDArray[Any] = np.ndarray((held, samples, bands), header.dtype, content, header.offset, strides)
    return EnviCube(data_path, header, values, promised - held, tuple(notes))


def find_envi_pair(path: Path) -> tuple[Path, Path]:
    """Give header and data file of an address that names either (SceneError: one of them is missing)."""
    if path.suffix.lower() == ".hdr":
        stem = path.with_suffix("")
        endings = (ending for name in DATA_ENDINGS for ending in {name: None, name.upper(): None})
        data = next((file for file in (stem.with_name(stem.name + end) for end in endings) if file.is_file()), None)
        if not path.exists():
            raise SceneError(f"there is no file {path}; check the name (seen from {Path.cwd()})")
        if data is None:
            raise SceneError(
                f"no data file beside {path}; expected {stem.name} or {stem.name}.bin, .dat, .img, .raw, ..."
            )
        return path, data
    if not path.is_file():
        raise SceneError(f"there is no file {path}; check the name (seen from {Path.cwd()})")
    names = [path.name + ".hdr", path.stem + ".hdr", path.name + ".HDR", path.stem + ".HDR"]
    header = next((file for file in map(path.with_name, names) if file.is_file()), None)
    if header is None:
        wanted = " or ".join(dict.fromkeys(names[:2]))
        raise SceneError(f"no header beside {path}; expected {wanted}, or the ending of another kind in its name")
    return header, path


def load_envi_header(path: Path) -> EnviHeader:
    """Read one header file.

    Raises SceneError: there is no such file, or it is no ENVI header that can be used; the message says why.
    """
    try:
        if path.exists() and not path.is_file():
            raise SceneError(f"{path} is no file; name an ENVI header")
        if path.stat().st_size > LARGEST_HEADER:
            raise SceneError(f"{path} has {path.stat().st_size} bytes, too many for a header; name the .hdr file")
        content = path.read_bytes()
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error}; name an ENVI header") from error
    if b"\0" in content:
        raise SceneError(f"{path} holds binary data, expected the text of an ENVI header; name the .hdr file")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    return parse_envi_header(text, str(path))


def parse_envi_header(text: str, where: str = "the header") -> EnviHeader:
    """Read a header's text; messages call it ``where``.

    Wavelengths come out in nm. Without a unit they are read as nm or micrometres by their size, and a note says so;
    wavelengths that do not fit the bands are left out with a note. Raises SceneError: it does not begin with ENVI
    (ArcGIS headers do not), a size, type or interleave is missing or impossible, or it says that its file holds more
    than plain numbers (compressed, with bytes between frames).
    """
    notes: list[str] = []
    fields, settings = split_header(text, where, notes)
    samples, bands = (_whole(fields, key, where, least=1) for key in ("samples", "bands"))
    kind = fields.get("file type", "ENVI Standard")
    _refuse_layouts(fields, kind, where)
    channels = samples if "spectral library" in kind.lower() else bands
    wavelength, scale = wavelengths_nm(fields, channels, notes)
    dtype, interleave = _data_type(fields, where, notes), _interleave(fields, bands, where, notes)
    widths = None if wavelength is None else listed_numbers(fields, "fwhm", channels, notes)
    return EnviHeader(
        where=where,
        samples=samples,
        lines=_whole(fields, "lines", where, least=0) if "lines" in fields else None,
        bands=bands,
        dtype=dtype,
        interleave=interleave,
        offset=_whole(fields, "header offset", where, least=0) if "header offset" in fields else 0,
        kind=kind,
        wavelength_nm=wavelength,
        fwhm_nm=None if widths is None or not (widths > 0).all() else widths * scale,
        band_names=tuple(name.strip() for name in fields["band names"].split(",")) if "band names" in fields else (),
        nodata=finite_number(fields.get("data ignore value", "")),
        fields=fields,
        settings=settings,
        notes=tuple(notes),
    )


def _whole(fields: Mapping[str, str], key: str, where: str, *, least: int) -> int:
    if key not in fields:
        raise SceneError(f"{where} does not say {key}; add the line '{key} = ...'")
    number = finite_number(fields[key])
    if number is None or number != int(number) or number < least:
        raise SceneError(f"{where}: {key} = {fields[key]!r}, expected a whole number from {least}; correct it")
    return int(number)


def _data_type(fields: Mapping[str, str], where: str, notes: list[str]) -> np.dtype[np.generic]:
    code = _whole(fields, "data type", where, least=1)
    if code not in DATA_TYPES:
        raise SceneError(f"{where}: data type = {code} is none of ENVI's {', '.join(map(str, DATA_TYPES))}; correct it")
    if "byte order" not in fields and np.dtype(DATA_TYPES[code]).itemsize > 1:
        notes.append("the byte order is not said, taken as little endian")
    order = _whole(fields, "byte order", where, least=0) if "byte order" in fields else 0
    if order > 1:
        raise SceneError(f"{where}: byte order = {order}, expected 0 (little endian) or 1 (big endian); correct it")
    return np.dtype(("<", ">")[order] + DATA_TYPES[code])


def _refuse_layouts(fields: Mapping[str, str], kind: str, where: str) -> None:
    """Refuse files whose numbers do not simply follow each other: they would be read as other numbers."""
    if finite_number(fields.get("file compression", "0")) != 0:
        raise SceneError(f"{where}: file compression = {fields['file compression']!r}, expected 0; unpack the file")
    for key in ("major frame offsets", "minor frame offsets"):
        words = [word for word in re.split(r"[,\s]+", fields.get(key, "")) if word]
        if any(finite_number(word) != 0 for word in words):
            raise SceneError(
                f"{where}: {key} = {fields[key]!r} puts bytes between frames, which is not read; store them without"
            )
    other = next((word for word in OTHER_FILES if word in kind.lower()), None)
    if other is not None:
        raise SceneError(f"{where}: file type = {kind!r}, expected plain numbers (ENVI Standard); name the file itself")


def _interleave(fields: Mapping[str, str], bands: int, where: str, notes: list[str]) -> str:
    if "interleave" not in fields and bands == 1:
        notes.append("the interleave is not said, and with one band does not matter")
        return "bsq"
    found = fields.get("interleave", "").strip().lower()
    if found not in INTERLEAVES:
        says = f"interleave = {found!r}" if found else "no interleave"
        raise SceneError(f"{where}: {says}, expected one of {', '.join(INTERLEAVES)}; correct it")
    return found
