"""ENVI files for programs that read no Zarr: plain numbers with a header, written block by block."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from pipeline.errors import PoseError, ShapeError
from storage.archive.whole_files import written_aside
from storage.readers.envi_cubes import DATA_TYPES, INTERLEAVES

Blocks = Iterable[tuple[int, NDArray[Any]]]  # first line, (line, sample, band) values


@dataclass(frozen=True)
class EnviFile:
    """What one file is to hold."""

    shape: tuple[int, int, int]  # (line, sample, band)
    dtype: str  # such as <u2 or >f4: the header says the byte order
    interleave: str = "bil"
    wavelength_nm: NDArray[np.float64] | None = None  # (band,)
    fwhm_nm: NDArray[np.float64] | None = None  # (band,)
    description: str = ""
    nodata: float | None = None
    geobox: GeoBox | None = None  # where the image lies on a map


def write_envi(header: Path, file: EnviFile, blocks: Blocks) -> Path:
    """Write ``NAME.hdr`` and the numbers beside it, ``NAME.img`` in any order of bands; gives the latter's path.

    A pair that is there is replaced; a header never stands beside numbers that are not its own. Blocks of lines come in
    order; memory: two blocks. Raises ShapeError: the blocks do not fill the file, or the type or interleave is none of
    ENVI's. PoseError: the map's grid is turned, or its pixels do not run down and to the right. ArchiveError: the disk
    refuses.
    """
    text = header_text(file)
    data, kind = header.with_suffix(".img"), np.dtype(file.dtype)
    with written_aside(header.parent, [data.name, header.name]) as aside:
        with (aside / data.name).open("wb") as stream:
            reached = 0
            for first, values in blocks:
                if first != reached or values.shape[1:] != file.shape[1:] or first + len(values) > file.shape[0]:
                    raise ShapeError(
                        f"{data.name}: lines from {first} with shape {values.shape} do not follow {reached} of a file "
                        f"of {file.shape} (line, sample, band)"
                    )
                if file.interleave == "bsq":  # band after band
                    for band in range(file.shape[2]):
                        stream.seek((band * file.shape[0] + first) * file.shape[1] * kind.itemsize)
                        stream.write(np.ascontiguousarray(values[..., band], kind).data)
                else:
                    order = (0, 2, 1) if file.interleave == "bil" else (0, 1, 2)
                    stream.write(np.ascontiguousarray(values.transpose(order), kind).data)
                reached += len(values)
        if reached != file.shape[0]:
            raise ShapeError(f"{data.name}: {reached} of {file.shape[0]} lines were given")
        (aside / header.name).write_text(text, encoding="utf-8")
    return data


def header_text(file: EnviFile) -> str:
    """The header: sizes, type, byte order, bands, and the map where there is one.

    Raises ShapeError: the type or interleave is none of ENVI's, or there are not as many wavelengths as bands.
    PoseError: the map's grid is turned, or its pixels do not run down and to the right.
    """
    return "".join(["ENVI\n", *(f"{key} = {value}\n" for key, value in _fields(file))])


def _fields(file: EnviFile) -> Iterator[tuple[str, str]]:
    kind, (lines, samples, bands) = np.dtype(file.dtype), file.shape
    code = {name: code for code, name in DATA_TYPES.items()}.get(kind.str[1:])
    if code is None or file.interleave not in INTERLEAVES:
        raise ShapeError(
            f"ENVI has no {kind} in order {file.interleave!r}; use one of {', '.join(DATA_TYPES.values())} and of "
            f"{', '.join(INTERLEAVES)}"
        )
    if file.description:
        yield "description", _listed([file.description.replace("{", "(").replace("}", ")")])
    yield from (("samples", str(samples)), ("lines", str(lines)), ("bands", str(bands)))
    yield from (("header offset", "0"), ("file type", "ENVI Standard"), ("data type", str(code)))
    yield from (("interleave", file.interleave), ("byte order", "1" if kind.str[0] == ">" else "0"))
    if file.nodata is not None:
        yield "data ignore value", f"{file.nodata:.17g}"
    if file.geobox is not None:
        yield from _map_fields(file.geobox)
    if file.wavelength_nm is not None:
        yield "wavelength units", "Nanometers"
    for key, values in (("wavelength", file.wavelength_nm), ("fwhm", file.fwhm_nm)):
        if values is not None:
            if values.shape != (bands,):
                raise ShapeError(f"{key} has shape {values.shape}, the file has {bands} bands; give one a band")
            yield key, _listed([repr(number) for number in values.tolist()])


def _listed(words: list[str]) -> str:
    return "{" + ", ".join(words) + "}"


def _map_fields(geobox: GeoBox) -> Iterator[tuple[str, str]]:
    """Where the upper left pixel's corner lies, the pixels' sides, and the CRS as the WKT that ENVI reads."""
    a, b, c, d, e, f = (float(number) for number in geobox.affine[:6])
    if b or d or a <= 0 or e >= 0 or geobox.crs is None:
        raise PoseError(f"ENVI's map info takes a grid with north up and a CRS, got {geobox!r}")
    crs = pyproj.CRS.from_wkt(geobox.crs.to_wkt())
    zone = crs.utm_zone  # such as 32N; None where the projection is another
    place = [f"{number!r}" for number in (1.0, 1.0, c, f, a, -e)]
    datum = "WGS-84" if crs.geodetic_crs is not None and crs.geodetic_crs.to_epsg() == 4326 else "Unknown"
    if zone is None:
        words = ["Arbitrary", *place, "0"]
    else:
        words = ["UTM", *place, zone[:-1], "North" if zone[-1] == "N" else "South", datum]
    yield "map info", _listed([*words, "units=Meters"])
    yield "coordinate system string", "{" + crs.to_wkt("WKT1_ESRI") + "}"
