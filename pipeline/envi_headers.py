"""Read ENVI headers: the one parser of readers of files and of the camera's loop.

A header is ``key = value`` lines after the word ENVI; values in braces may be nested and have several lines. Headwall
adds lines that begin with ``;``, some of which hold settings.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from spectralzoom.pipeline.errors import SceneError

INTERLEAVES = ("bil", "bip", "bsq")
# data type codes of the format's description
DATA_TYPES = {1: "u1", 2: "i2", 3: "i4", 4: "f4", 5: "f8", 6: "c8", 9: "c16", 12: "u2", 13: "u4", 14: "i8", 15: "u8"}
# words of a file type that is not plain numbers
OTHER_FILES = ("tiff", "jpeg", "jp2", "png", "bmp", "hdf", "netcdf", "nitf", "virtual", "meta")


def header_text(content: bytes) -> str:
    """Return the text of a header in UTF-8, or else Latin-1."""
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def split_header(text: str, where: str) -> tuple[dict[str, str], dict[str, str]]:
    """Return the fields, and the settings in comments: keys in lower case, values without the outer braces.

    Of a key that is given twice the last value counts. Messages call the header ``where``. Raises SceneError: it does
    not begin with ENVI (ArcGIS headers do not), or a brace is never closed.
    """
    lines = text.removeprefix("\ufeff").lstrip().splitlines()
    if not lines or lines[0].strip().upper() != "ENVI":
        begins = f"begins with {lines[0].strip()[:40]!r}" if lines else "is empty"
        raise SceneError(f"{where} {begins}, expected ENVI on its own line; name an ENVI header")
    fields: dict[str, str] = {}
    settings: dict[str, str] = {}
    key, parts, depth = "", [""], 0
    for line in lines[1:]:
        if line.lstrip().startswith(";"):
            name, sign, value = re.sub(r"[=:]", "=", line.lstrip()[1:], count=1).partition("=")
            if sign:
                settings[name.strip().lower()] = value.strip()
            continue
        if depth:
            parts.append(line)
        else:
            name, sign, value = line.partition("=")
            key, parts = " ".join(name.split()).lower(), [value.strip()]
            if not sign or not key:
                continue
        if parts[0].startswith("{"):
            bare = re.sub(r"\\[{}]", "", parts[-1])
            depth += bare.count("{") - bare.count("}")
        if depth <= 0:
            whole, depth = "\n".join(parts), 0
            fields[key] = whole[1 : whole.rfind("}")].strip() if whole.startswith("{") else whole
    if depth:
        raise SceneError(f"{where}: {key} opens a brace that is never closed; is the header cut off?")
    return fields, settings


def finite_number(text: str) -> float | None:
    """Return a text as a finite number; None where it is none."""
    try:
        number = float(text)
    except ValueError:
        return None
    return number if np.isfinite(number) else None


@dataclass(frozen=True)
class EnviHeader:
    """The content of one header; missing fields are None."""

    samples: int
    lines: int | None  # None: as many as the data file holds
    bands: int
    dtype: np.dtype[np.generic]  # with its byte order
    interleave: str  # bil, bip or bsq
    offset: int  # bytes before the numbers
    kind: str  # file type, such as ENVI Standard or ENVI Spectral Library
    nodata: float | None
    fields: Mapping[str, str]  # all of them, keys in lower case, values without the outer braces
    settings: Mapping[str, str]  # of the lines that begin with ;
    notes: tuple[str, ...]

    @property
    def line_bytes(self) -> int:
        """Bytes of a line."""
        return self.samples * self.bands * self.dtype.itemsize


def parse_envi_header(text: str, where: str = "the header") -> EnviHeader:
    """Read a header's text; messages call it ``where``.

    Raises SceneError: it does not begin with ENVI, a size, type or interleave is missing or impossible, or the file
    holds more than plain numbers (compressed, bytes between frames).
    """
    notes: list[str] = []
    fields, settings = split_header(text, where)
    samples, bands = (_whole(fields, key, where, least=1) for key in ("samples", "bands"))
    kind = fields.get("file type", "ENVI Standard")
    # Numbers that are not contiguous would be read as other numbers.
    if finite_number(fields.get("file compression", "0")) != 0:
        raise SceneError(f"{where}: file compression = {fields['file compression']!r}, expected 0; unpack the file")
    for key in ("major frame offsets", "minor frame offsets"):
        if any(word and finite_number(word) != 0 for word in re.split(r"[,\s]+", fields.get(key, ""))):
            raise SceneError(
                f"{where}: {key} = {fields[key]!r} puts bytes between frames, which is not supported; remove them"
            )
    if any(word in kind.lower() for word in OTHER_FILES):
        raise SceneError(f"{where}: file type = {kind!r}, expected plain numbers (ENVI Standard); name the file itself")
    code = _whole(fields, "data type", where, least=1)
    if code not in DATA_TYPES:
        raise SceneError(f"{where}: data type = {code} is none of ENVI's {', '.join(map(str, DATA_TYPES))}; correct it")
    if "byte order" not in fields and np.dtype(DATA_TYPES[code]).itemsize > 1:
        notes.append("the byte order is missing, little endian is assumed")
    order = _whole(fields, "byte order", where, least=0, otherwise=0)
    if order > 1:
        raise SceneError(f"{where}: byte order = {order}, expected 0 (little endian) or 1 (big endian); correct it")
    interleave = fields.get("interleave", "").strip().lower()
    if "interleave" not in fields and bands == 1:
        notes.append("the interleave is missing, which with one band does not matter")
        interleave = "bsq"
    if interleave not in INTERLEAVES:
        says = f"interleave = {interleave!r}" if interleave else "no interleave"
        raise SceneError(f"{where}: {says}, expected one of {', '.join(INTERLEAVES)}; correct it")
    return EnviHeader(
        samples=samples,
        lines=_whole(fields, "lines", where, least=0) if "lines" in fields else None,
        bands=bands,
        dtype=np.dtype(("<", ">")[order] + DATA_TYPES[code]),
        interleave=interleave,
        offset=_whole(fields, "header offset", where, least=0, otherwise=0),
        kind=kind,
        nodata=finite_number(fields.get("data ignore value", "")),
        fields=fields,
        settings=settings,
        notes=tuple(notes),
    )


def _whole(fields: Mapping[str, str], key: str, where: str, *, least: int, otherwise: int | None = None) -> int:
    if key not in fields and otherwise is not None:
        return otherwise
    if key not in fields:
        raise SceneError(f"{where} does not say {key}; add the line '{key} = ...'")
    number = finite_number(fields[key])
    if number is None or number != int(number) or number < least:
        raise SceneError(f"{where}: {key} = {fields[key]!r}, expected a whole number from {least}; correct it")
    return int(number)
