"""ENVI headers and the numbers that they describe: read leniently, and refused where they say too little.

The fields are taken apart in `camera_texts`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.rig.camera.camera_texts import finite_number, listed_numbers, split_header, wavelengths_nm

INTERLEAVES = ("bil", "bip", "bsq")
# data type codes of the format's description
_CODES = (1, 2, 3, 4, 5, 6, 9, 12, 13, 14, 15)
DATA_TYPES = dict(zip(_CODES, ("u1", "i2", "i4", "f4", "f8", "c8", "c16", "u2", "u4", "i8", "u8"), strict=True))
# of these a header describes another kind of file than plain numbers
OTHER_FILES = ("tiff", "jpeg", "jp2", "png", "bmp", "hdf", "netcdf", "nitf", "virtual", "meta")


@dataclass(frozen=True)
class EnviHeader:
    """The content of one header; what it leaves out is None."""

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
    fields: Mapping[str, str]  # all of them as written, keys in lower case, the outer braces taken off
    settings: Mapping[str, str]  # of the lines that begin with ;
    notes: tuple[str, ...]

    @property
    def line_bytes(self) -> int:
        """Bytes of a line."""
        return self.samples * self.bands * self.dtype.itemsize


def parse_envi_header(text: str, where: str = "the header") -> EnviHeader:
    """Read a header's text; messages call it ``where``.

    Wavelengths come out in nm. Without a unit they are read as nm or micrometres by their size, and a note says so.
    Wavelengths that do not fit the bands are left out with a note. Raises SceneError: it does not begin with ENVI
    (ArcGIS headers do not), or a size, type or interleave is missing or impossible. So does a file that holds more than
    plain numbers (compressed, with bytes between frames).
    """
    notes: list[str] = []
    fields, settings = split_header(text, where, notes)
    samples, bands = (_whole(fields, key, where, least=1) for key in ("samples", "bands"))
    kind = fields.get("file type", "ENVI Standard")
    _refuse_layouts(fields, kind, where)
    channels = samples if "spectral library" in kind.lower() else bands
    wavelength, scale = wavelengths_nm(fields, channels, notes)
    code = _whole(fields, "data type", where, least=1)
    if code not in DATA_TYPES:
        raise SceneError(f"{where}: data type = {code} is none of ENVI's {', '.join(map(str, DATA_TYPES))}; correct it")
    if "byte order" not in fields and np.dtype(DATA_TYPES[code]).itemsize > 1:
        notes.append("the byte order is not said, taken as little endian")
    order = _whole(fields, "byte order", where, least=0, otherwise=0)
    if order > 1:
        raise SceneError(f"{where}: byte order = {order}, expected 0 (little endian) or 1 (big endian); correct it")
    interleave = fields.get("interleave", "").strip().lower()
    if "interleave" not in fields and bands == 1:
        notes.append("the interleave is not said, and with one band does not matter")
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


def _refuse_layouts(fields: Mapping[str, str], kind: str, where: str) -> None:
    """Refuse files whose numbers do not simply follow each other: they would be read as other numbers (SceneError)."""
    if finite_number(fields.get("file compression", "0")) != 0:
        raise SceneError(f"{where}: file compression = {fields['file compression']!r}, expected 0; unpack the file")
    for key in ("major frame offsets", "minor frame offsets"):
        words = [word for word in re.split(r"[,\s]+", fields.get(key, "")) if word]
        if any(finite_number(word) != 0 for word in words):
            raise SceneError(
                f"{where}: {key} = {fields[key]!r} puts bytes between frames, which is not read; store them without"
            )
    if any(word in kind.lower() for word in OTHER_FILES):
        raise SceneError(f"{where}: file type = {kind!r}, expected plain numbers (ENVI Standard); name the file itself")
