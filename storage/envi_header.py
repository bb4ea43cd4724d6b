"""ENVI headers as instruments and programs write them: read leniently, refused with a reason where they say too little.

The format is text of ``key = value`` lines after the word ENVI; values in braces may run over lines and be nested.
Headwall adds lines that begin with ``;``, some of which hold settings of their own.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError

LARGEST_HEADER = 1 << 22  # bytes; the largest seen holds 33 thousand
UNBALANCED = "opens more braces than it closes"
MOST_UNBALANCED = 16  # values that open more braces than they close: looking for each one's end reads the rest
INTERLEAVES = ("bil", "bip", "bsq")
# data type codes of the format's description
DATA_TYPES = {
    1: "u1", 2: "i2", 3: "i4", 4: "f4", 5: "f8", 6: "c8", 9: "c16", 12: "u2", 13: "u4", 14: "i8", 15: "u8",
}  # fmt: skip
NANOMETRES = {"nm", "nanometer", "nanometers", "nanometre", "nanometres"}
MICROMETRES = {"um", "µm", "μm", "micron", "microns", "micrometer", "micrometers", "micrometre", "micrometres"}
UNSAID = {"", "unknown"}
# of these a header describes another kind of file than plain numbers
OTHER_FILES = ("tiff", "jpeg", "jp2", "png", "bmp", "hdf", "netcdf", "nitf", "virtual", "meta")

_BRACE = re.compile(r"[{}]")
_SIGN = re.compile(r"[=:]")


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


def load_envi_header(path: Path) -> EnviHeader:
    """Read one header file.

    Raises
    ------
    SceneError : there is no such file, or it is no ENVI header that can be used; the message says why.
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
    """Read a header's text.

    Wavelengths come out in nm. Without a unit they are read as nm or micrometres by their size, and a note says so;
    wavelengths that do not fit the bands are left out with a note.

    Parameters
    ----------
    where
        What messages call it.

    Raises
    ------
    SceneError : it does not begin with ENVI (ArcGIS headers do not), a size, type or interleave is missing or
        impossible, or it says that its file holds more than plain numbers (compressed, with bytes between frames).
    """
    notes: list[str] = []
    fields, settings = _split(text, where, notes)
    samples, bands = (_whole(fields, key, where, least=1) for key in ("samples", "bands"))
    kind = fields.get("file type", "ENVI Standard")
    _refuse_layouts(fields, kind, where)
    channels = samples if "spectral library" in kind.lower() else bands
    wavelength, scale = _wavelengths(fields, channels, notes)
    return EnviHeader(
        where=where,
        samples=samples,
        lines=_whole(fields, "lines", where, least=0) if "lines" in fields else None,
        bands=bands,
        dtype=_data_type(fields, where, notes),
        interleave=_interleave(fields, bands, where, notes),
        offset=_whole(fields, "header offset", where, least=0) if "header offset" in fields else 0,
        kind=kind,
        wavelength_nm=wavelength,
        fwhm_nm=None if wavelength is None else _widths(fields, channels, scale, notes),
        band_names=tuple(name.strip() for name in fields["band names"].split(",")) if "band names" in fields else (),
        nodata=_number(fields.get("data ignore value", "")),
        fields=fields,
        settings=settings,
        notes=tuple(notes),
    )


def _split(text: str, where: str, notes: list[str]) -> tuple[dict[str, str], dict[str, str]]:
    """Fields and the settings in comments."""
    lines = text.lstrip("\ufeff").splitlines()
    first = next((number for number, line in enumerate(lines) if line.strip()), None)
    if first is None or lines[first].strip().upper() != "ENVI":
        begins = "is empty" if first is None else f"begins with {lines[first].strip()[:40]!r}"
        raise SceneError(f"{where} {begins}, expected ENVI on its own line; it is no ENVI header, name another")
    settings: dict[str, str] = {}
    plain: list[str] = []
    for line in lines[first + 1 :]:
        if not line.lstrip().startswith(";"):
            plain.append(line)
        elif sign := _SIGN.search(line):
            key = line[: sign.start()].lstrip()[1:].strip()
            if key:
                settings[key.lower()] = line[sign.end() :].strip()
    fields: dict[str, str] = {}
    for key, value in _pairs(plain, where, notes):
        if fields.get(key, value) != value:
            notes.append(f"{key} is given twice, the last one counts")
        fields[key] = value
    return fields, settings


def _pairs(lines: list[str], where: str, notes: list[str]) -> Iterator[tuple[str, str]]:
    """Keys and values, the outer braces taken off."""
    number = 0
    while number < len(lines):
        line = lines[number].strip()
        number += 1
        key, sign, value = (part.strip() for part in line.partition("="))
        if not sign or not key or _BRACE.search(key):
            if line:
                notes.append(f"passed over {line[:40]!r}, which is no key = value")
            continue
        key = " ".join(key.split()).lower()
        if value.startswith("{"):
            value, number = _braced(value, lines, number, f"{where}: {key}", notes)
        yield key, value


def _braced(value: str, lines: list[str], number: int, where: str, notes: list[str]) -> tuple[str, int]:
    """A value that begins with a brace, to where the brace closes, and the number of the line after it."""
    parts = [value]
    depth = _depth(value)
    end = number
    while depth > 0 and end < len(lines):
        parts.append(lines[end])
        depth += _depth(lines[end])
        end += 1
    if depth > 0:  # one brace too many inside: the first line that ends with one closes it all
        ends = [at for at, part in enumerate(parts) if part.rstrip().endswith("}")]
        if not ends:
            raise SceneError(f"{where} opens a brace that is never closed; is the header cut off?")
        parts, end = parts[: ends[0] + 1], number + ends[0]
        notes.append(f"{where} {UNBALANCED}")
        if sum(note.endswith(UNBALANCED) for note in notes) > MOST_UNBALANCED:
            raise SceneError(f"{where} {UNBALANCED}, as do {MOST_UNBALANCED} values before it; correct the header")
    return _unwrapped("\n".join(parts)), end


def _depth(text: str) -> int:
    """Braces opened less those closed; escaped ones do not count."""
    bare = re.sub(r"\\[{}]", "", text)
    return bare.count("{") - bare.count("}")


def _unwrapped(value: str) -> str:
    """The inside of the outer braces: what follows the last one is dropped."""
    close = value.rfind("}")
    return value[1 : close if close > 0 else None].strip()


def _whole(fields: Mapping[str, str], key: str, where: str, *, least: int) -> int:
    if key not in fields:
        raise SceneError(f"{where} does not say {key}; add the line '{key} = ...'")
    number = _number(fields[key])
    if number is None or number != int(number) or number < least:
        raise SceneError(f"{where}: {key} = {fields[key]!r}, expected a whole number from {least}; correct it")
    return int(number)


def _number(text: str) -> float | None:
    try:
        number = float(text)
    except ValueError:
        return None
    return number if np.isfinite(number) else None


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
    if _number(fields.get("file compression", "0")) != 0:
        raise SceneError(f"{where}: file compression = {fields['file compression']!r}, expected 0; unpack the file")
    for key in ("major frame offsets", "minor frame offsets"):
        words = [word for word in re.split(r"[,\s]+", fields.get(key, "")) if word]
        if any(_number(word) != 0 for word in words):
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


def _wavelengths(
    fields: Mapping[str, str], channels: int, notes: list[str]
) -> tuple[NDArray[np.float64] | None, float]:
    """Centres [nm] and what one of the header's units is in nm."""
    values = _listed(fields, "wavelength", channels, notes)
    if values is None:
        return None, 1.0
    unit = fields.get("wavelength units", "").strip().lower()
    if unit in NANOMETRES:
        scale = 1.0
    elif unit in MICROMETRES:
        scale = 1000.0
    elif unit in UNSAID and 200 <= values.min() <= values.max() <= 20000:
        scale = 1.0
        notes.append("the wavelengths have no unit, read as nm by their size")
    elif unit in UNSAID and 0.2 <= values.min() <= values.max() <= 20:
        scale = 1000.0
        notes.append("the wavelengths have no unit, read as micrometres by their size")
    else:
        notes.append(f"wavelength units = {unit!r} are no lengths that can be read; the wavelengths are left out")
        return None, 1.0
    return values * scale, scale


def _widths(fields: Mapping[str, str], channels: int, scale: float, notes: list[str]) -> NDArray[np.float64] | None:
    values = _listed(fields, "fwhm", channels, notes)
    return None if values is None or not (values > 0).all() else values * scale


def _listed(fields: Mapping[str, str], key: str, count: int, notes: list[str]) -> NDArray[np.float64] | None:
    """Numbers of a list, whatever commas and spaces stand between them; None with a note where it is none."""
    if key not in fields:
        return None
    words = [word for word in re.split(r"[,\s]+", fields[key]) if word]
    numbers = [_number(word) for word in words]
    if len(words) != count or None in numbers:
        wrong = next((word for word, number in zip(words, numbers, strict=True) if number is None), None)
        why = f"{len(words)} for {count} bands" if wrong is None else f"{wrong!r} is no number"
        notes.append(f"{key} is left out: {why}")
        return None
    return np.array(numbers, np.float64)
