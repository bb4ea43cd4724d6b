"""The text of ENVI headers, as instruments and programs write them, taken apart into fields.

The format is ``key = value`` lines after the word ENVI; values in braces may run over lines and be nested. Headwall
adds lines that begin with ``;``, some of which hold settings of their own. What a header must say is for whoever reads
it: files from anywhere (``storage.readers.envi_cubes``), or a camera's own (``camera_cubes``).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError

UNBALANCED = "opens more braces than it closes"
MOST_UNBALANCED = 16  # values that open more braces than they close: looking for each one's end reads the rest
NANOMETRES = {"nm", "nanometer", "nanometers", "nanometre", "nanometres"}
MICROMETRES = {"um", "µm", "μm", "micron", "microns", "micrometer", "micrometers", "micrometre", "micrometres"}
UNSAID = {"", "unknown"}

_BRACE = re.compile(r"[{}]")
_SIGN = re.compile(r"[=:]")


def split_header(text: str, where: str, notes: list[str]) -> tuple[dict[str, str], dict[str, str]]:
    """Fields, and settings in comments: as written, keys in lower case, the outer braces taken off.

    What was made of strange forms is added to ``notes``; messages call the header ``where``.

    Raises
    ------
    SceneError : it does not begin with ENVI (ArcGIS headers do not), or a brace is never closed.
    """
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


def finite_number(text: str) -> float | None:
    """The number that a text is; None where it is none, or not finite."""
    try:
        number = float(text)
    except ValueError:
        return None
    return number if np.isfinite(number) else None


def wavelengths_nm(
    fields: Mapping[str, str], channels: int, notes: list[str]
) -> tuple[NDArray[np.float64] | None, float]:
    """(band,) centres [nm] and what one of the header's units is in nm.

    Without a unit they are read as nm or micrometres by their size; those that do not fit the bands are left out. Notes
    say so.
    """
    values = listed_numbers(fields, "wavelength", channels, notes)
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


def listed_numbers(fields: Mapping[str, str], key: str, count: int, notes: list[str]) -> NDArray[np.float64] | None:
    """Numbers of a list, whatever commas and spaces stand between them; None with a note where it is none."""
    if key not in fields:
        return None
    words = [word for word in re.split(r"[,\s]+", fields[key]) if word]
    numbers = [finite_number(word) for word in words]
    if len(words) != count or None in numbers:
        wrong = next((word for word, number in zip(words, numbers, strict=True) if number is None), None)
        why = f"{len(words)} for {count} bands" if wrong is None else f"{wrong!r} is no number"
        notes.append(f"{key} is left out: {why}")
        return None
    return np.array(numbers, np.float64)
