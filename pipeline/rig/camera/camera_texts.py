"""Text files beside a camera's cubes: ENVI headers, and frame indices.

A header is ``key = value`` lines after the word ENVI; values in braces may be nested and have several lines. Headwall
adds lines that begin with ``;``, some of which hold settings. Any file (``storage.readers.envi_files``) and a camera's
own (``camera_cubes``) have further checks in their readers.

``frameIndex_<n>.txt`` belongs to ``raw_<n>``: a heading, then one line per frame with its number and its time in
microseconds. Versions of the camera's program differ in the separator (a tab or spaces) and in the line ends. Frames
may be missing or listed twice. It was tested on small indices made in these layouts.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError

FRAME_INDEX = re.compile(r"frameindex_(\d{1,12})\.txt", re.IGNORECASE)  # names of its files
UNBALANCED = "opens more braces than it closes"
MOST_UNBALANCED = 16  # values with an open brace; the search for each end reads the rest of the header
NANOMETRES = {"nm", "nanometer", "nanometers", "nanometre", "nanometres"}
MICROMETRES = {"um", "µm", "μm", "micron", "microns", "micrometer", "micrometers", "micrometre", "micrometres"}
UNSAID = {"", "unknown"}
LONGEST_LINE = 1000  # characters; a frame's line has about 25
_LARGEST = 2**62
_WHOLE = re.compile(r"-?\d{1,19}")

INTERLEAVES = ("bil", "bip", "bsq")
# data type codes of the format's description
DATA_TYPES = {1: "u1", 2: "i2", 3: "i4", 4: "f4", 5: "f8", 6: "c8", 9: "c16", 12: "u2", 13: "u4", 14: "i8", 15: "u8"}
# words of a file type that is not plain numbers
OTHER_FILES = ("tiff", "jpeg", "jp2", "png", "bmp", "hdf", "netcdf", "nitf", "virtual", "meta")


def split_header(text: str, where: str, notes: list[str]) -> tuple[dict[str, str], dict[str, str]]:
    """Return the fields, and the settings in comments: keys in lower case, values without the outer braces.

    ``notes`` describe unusual forms; messages call the header ``where``. Raises SceneError: it does not begin with ENVI
    (ArcGIS headers do not), or a brace is never closed.
    """
    lines = text.lstrip("\ufeff").splitlines()
    first = next((number for number, line in enumerate(lines) if line.strip()), None)
    if first is None or lines[first].strip().upper() != "ENVI":
        begins = "is empty" if first is None else f"begins with {lines[first].strip()[:40]!r}"
        raise SceneError(f"{where} {begins}, expected ENVI on its own line; name an ENVI header")
    settings: dict[str, str] = {}
    plain: list[str] = []
    for line in lines[first + 1 :]:
        if not line.lstrip().startswith(";"):
            plain.append(line)
        elif sign := re.search(r"[=:]", line):
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
    """Yield keys and values without the outer braces."""
    number = 0
    while number < len(lines):
        line = lines[number].strip()
        number += 1
        key, sign, value = (part.strip() for part in line.partition("="))
        if not sign or not key or re.search(r"[{}]", key):
            if line:
                notes.append(f"passed over {line[:40]!r}, which is no key = value")
            continue
        key = " ".join(key.split()).lower()
        if value.startswith("{"):
            value, number = _braced(value, lines, number, f"{where}: {key}", notes)
        yield key, value


def _braced(value: str, lines: list[str], number: int, where: str, notes: list[str]) -> tuple[str, int]:
    """Return the content of a value in braces, and the number of the line after its end."""
    parts = [value]
    depth = _depth(value)
    end = number
    while depth > 0 and end < len(lines):
        parts.append(lines[end])
        depth += _depth(lines[end])
        end += 1
    if depth > 0:  # one brace too many: the first line that ends with one closes the value
        ends = [at for at, part in enumerate(parts) if part.rstrip().endswith("}")]
        if not ends:
            raise SceneError(f"{where} opens a brace that is never closed; is the header cut off?")
        parts = parts[: ends[0] + 1]
        end = number + ends[0]
        notes.append(f"{where} {UNBALANCED}")
        if sum(note.endswith(UNBALANCED) for note in notes) > MOST_UNBALANCED:
            raise SceneError(f"{where} {UNBALANCED}, as do {MOST_UNBALANCED} values before it; correct the header")
    whole = "\n".join(parts)
    close = whole.rfind("}")
    return whole[1 : close if close > 0 else None].strip(), end


def _depth(text: str) -> int:
    """Return the number of open braces, without escaped ones."""
    bare = re.sub(r"\\[{}]", "", text)
    return bare.count("{") - bare.count("}")


def finite_number(text: str) -> float | None:
    """Return a text as a finite number; None where it is none."""
    try:
        number = float(text)
    except ValueError:
        return None
    return number if np.isfinite(number) else None


def wavelengths_nm(
    fields: Mapping[str, str], channels: int, notes: list[str]
) -> tuple[NDArray[np.float64] | None, float]:
    """Return (band,) centres [nm] and the header's unit in nm, with notes on assumptions.

    Without a unit they are read as nm or micrometres by their size. Centres that do not fit the bands are left out.
    """
    values = listed_numbers(fields, "wavelength", channels, notes)
    if values is None:
        return None, 1.0
    unit = fields.get("wavelength units", "").strip().lower()
    if unit in UNSAID and 200 <= values.min() <= values.max() <= 20000:
        unit = "nm"
        notes.append("the wavelengths have no unit, read as nm by their size")
    elif unit in UNSAID and 0.2 <= values.min() <= values.max() <= 20:
        unit = "micrometres"
        notes.append("the wavelengths have no unit, read as micrometres by their size")
    if unit not in NANOMETRES | MICROMETRES:
        notes.append(f"wavelength units = {unit!r} are no lengths that can be read; the wavelengths are left out")
        return None, 1.0
    scale = 1.0 if unit in NANOMETRES else 1000.0
    return values * scale, scale


def listed_numbers(fields: Mapping[str, str], key: str, count: int, notes: list[str]) -> NDArray[np.float64] | None:
    """Return the numbers of a list separated by commas or spaces; None with a note where it is none."""
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
    wavelength_nm: NDArray[np.float64] | None  # (band,)
    fwhm_nm: NDArray[np.float64] | None  # (band,)
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

    Wavelengths are returned in nm, as :func:`wavelengths_nm` reads them. Raises SceneError: it does not begin with
    ENVI, a size, type or interleave is missing or impossible, or the file holds more than plain numbers (compressed,
    bytes between frames).
    """
    notes: list[str] = []
    fields, settings = split_header(text, where, notes)
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
    channels = samples if "spectral library" in kind.lower() else bands
    wavelength, scale = wavelengths_nm(fields, channels, notes)
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
    widths = None if wavelength is None else listed_numbers(fields, "fwhm", channels, notes)
    return EnviHeader(
        samples=samples,
        lines=_whole(fields, "lines", where, least=0) if "lines" in fields else None,
        bands=bands,
        dtype=np.dtype(("<", ">")[order] + DATA_TYPES[code]),
        interleave=interleave,
        offset=_whole(fields, "header offset", where, least=0, otherwise=0),
        kind=kind,
        wavelength_nm=wavelength,
        fwhm_nm=None if widths is None or not (widths > 0).all() else widths * scale,
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


@dataclass(frozen=True)
class FrameIndex:
    """Frames by ascending number, each once."""

    frame: NDArray[np.int64]  # (entry,)
    stamp_us: NDArray[np.int64]  # (entry,) microseconds, of an origin that the file does not say
    notes: tuple[str, ...]


@dataclass(frozen=True)
class LineTimes:
    """Times of the lines of one file by its index; -1 where it has none."""

    frame: NDArray[np.int64]  # (line,)
    stamp_us: NDArray[np.int64]  # (line,)
    notes: tuple[str, ...] = ()

    @classmethod
    def unknown(cls, lines: int) -> LineTimes:
        """Return lines without any time."""
        return cls(np.full(lines, -1), np.full(lines, -1))

    def put(self, start: int, own: LineTimes) -> None:
        """Fill in the times of one file, whose first line is line ``start``."""
        stop = start + len(own.frame)
        self.frame[start:stop], self.stamp_us[start:stop] = own.frame, own.stamp_us


def place_parts(parts: Sequence[tuple[str, int, int]], most: int, notes: list[str]) -> list[int]:
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


def parse_frame_index(lines: Iterable[str], name: str = "the frame index", where: str = "") -> FrameIndex:
    """Read an index's lines; other lines than frames are counted, the second of two equal frames is dropped.

    Notes call it ``name``, messages ``where`` or ``name``. Raises SceneError: no line is a frame.
    """
    frames, stamps = array("q"), array("q")
    odd = 0
    for number, line in enumerate(lines):
        words = [word for word in re.split(r"[\t ,;]+", line.strip()) if word]
        whole = [int(word) for word in words[:2] if _WHOLE.fullmatch(word)]
        if len(whole) == 2 and all(0 <= one < _LARGEST for one in whole):
            frames.append(whole[0])
            stamps.append(whole[1])
        elif words and number:  # the first is the heading
            odd += 1
    if not frames:
        raise SceneError(
            f"{where or name} lists no frame, expected lines of number and microseconds; remove or repair it"
        )
    numbers, first = np.unique(np.array(frames, np.int64), return_index=True)
    notes = [f"{name}: {odd} lines are no frames"] if odd else []
    if len(numbers) < len(frames):
        notes.append(f"{name}: {len(frames) - len(numbers)} frames are listed twice, the first counts")
    found = np.array(stamps, np.int64)[first]
    if (np.diff(found) < 0).any():
        notes.append(f"{name}: time goes back {np.count_nonzero(np.diff(found) < 0)} times")
    return FrameIndex(numbers, found, tuple(notes))


def times_of_lines(index: FrameIndex, first_frame: int, lines: int, lost: int = 0) -> LineTimes:
    """Return frame and time of each of a file's ``lines``.

    Lines are frames in order from ``first_frame`` on, the number in the file's name. The index may list as many frames
    as the file has lines, with or without the ``lost`` ones at its end. Then it lists these lines, whatever the
    numbers: the camera dropped the others. An index of a later file that begins at 0 counts from that file's start.
    """
    frame = index.frame + (first_frame if index.frame[0] == 0 else 0)
    if len(frame) in (lines, lines + lost):
        dropped = int(frame[-1] - frame[0]) + 1 - len(frame)
        notes = (f"{dropped} frames between the first and the last were dropped by the camera",) if dropped else ()
        return LineTimes(frame[:lines], index.stamp_us[:lines], notes)
    found = LineTimes.unknown(lines)
    place = frame - first_frame
    inside = (place >= 0) & (place < lines)
    found.frame[place[inside]] = frame[inside]
    found.stamp_us[place[inside]] = index.stamp_us[inside]
    known, beyond = int(np.count_nonzero(inside)), int(np.count_nonzero(~inside))
    findings: tuple[str, ...] = () if known == lines else (f"the frame index has the time of {known} of {lines} lines",)
    findings += (f"the frame index lists {beyond} frames beyond the lines",) if beyond else ()
    return replace(found, notes=findings)
