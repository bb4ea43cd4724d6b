"""What a raster file says beside its numbers: where it lies on the earth, its wavelengths, and which bands are bad.

Tags are those that GDAL writes (its drivers of ENVI and GeoTIFF, the domain IMAGERY of 3.10), and those that people do.
"""

from __future__ import annotations

import importlib
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.lazy import deferred
from pipeline.rig.camera.camera_texts import finite_number, wavelengths_nm
from storage.readers.scene_toml import BandWavelengths

if TYPE_CHECKING:  # half a second to import, for files with a place alone
    import odc.geo.crs as odc_crs
    import odc.geo.geobox as odc_geobox
    import pyproj
    from odc.geo.geobox import GeoBox
else:
    odc_crs = deferred("odc.geo.crs")
    odc_geobox = deferred("odc.geo.geobox")
    pyproj = deferred("pyproj")

Notes = tuple[str, ...]
_CENTRES = ("wavelength", "wavelength_nm", "center_wavelength", "centre_wavelength", "central_wavelength")
_UNITS = ("wavelength_units", "wavelengthunits", "wavelength_unit", "units")
_WIDTHS = ("fwhm", "fwhm_nm")
_LENGTHS = r"nm|nanomet(?:er|re)s?|µm|um|micromet(?:er|re)s?"
_DESCRIBED = re.compile(rf"(?<![\w.])(\d+(?:\.\d+)?)\s*({_LENGTHS})\b", re.IGNORECASE)
SAMPLED_PX, MOST_BETWEEN = 256, 0.1  # how a mask is told: so many pixels a side, of which so many are half there


def place_of_file(file: Any) -> tuple[GeoBox | None, Notes]:
    """Where an opened rasterio file lies; None, and why, where CRS or transform is missing or they are no grid."""
    if file.transform.is_identity:
        other = " and ".join([*(["ground control points"] if file.gcps[0] else []), *(["RPCs"] if file.rpcs else [])])
        told = f"its place is told by {other}, which are not read; warp it to a map first (gdalwarp)"
        return None, (told,) if other else ()
    if file.crs is None:
        return None, ("it has a transform and no CRS, so that its place on the earth is not known (gdal_edit -a_srs)",)
    if not file.transform.determinant:
        return None, ("its transform makes a line of its pixels; its place on the earth is not known",)
    try:
        crs = pyproj.CRS.from_wkt(file.crs.to_wkt())
    except Exception as error:  # of PROJ and of GDAL
        return None, (f"its CRS cannot be read ({error}); its place on the earth is not known",)
    if not (crs.is_projected or crs.is_geographic):
        return None, (f"its CRS, {crs.name!r}, is none of the earth; its place is not known",)
    code = crs.to_epsg()  # the same CRS by whichever words a file has it
    return odc_geobox.GeoBox(file.shape, file.transform, odc_crs.CRS(crs.to_wkt() if code is None else code)), ()


def place_of_envi(header: Mapping[str, str], data: Path, shape: tuple[int, int]) -> tuple[GeoBox | None, Notes]:
    """Where an ENVI file of (line, sample) ``shape`` lies, by its ``map info``, as GDAL reads it."""
    if "map info" not in header:
        return None, ()
    rasterio = importlib.import_module("rasterio")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            with rasterio.open(data, driver="ENVI") as file:
                found, notes = place_of_file(file)
    except Exception as error:  # GDAL raises anything at all on damaged headers
        return None, (f"its map info cannot be read: {error}",)
    return (None if found is None else odc_geobox.GeoBox(shape, found.affine, found.crs)), notes


def bands_said(file: Any, keep: Sequence[int], path: Path) -> tuple[BandWavelengths | None, Notes]:
    """Wavelengths and widths of an opened rasterio file's bands by its tags, else by their descriptions."""
    notes: list[str] = []
    of_file, of_bands = _lower(file.tags()) | _lower(file.tags(ns="ENVI")), [_band_tags(file, band) for band in keep]
    fields = {}
    for key, names in (("wavelength", _CENTRES), ("fwhm", _WIDTHS)):
        values = [_first(tags, names) for tags in of_bands]
        whole = _first(of_file, names)
        if all(values):
            fields[key] = ", ".join(str(value) for value in values)
        elif whole is not None:
            fields[key] = _picked(whole, keep, file.count)
    unit = _first(of_bands[0], _UNITS) or _first(of_file, _UNITS) if keep else None
    fields["wavelength units"] = unit or ("nm" if any("wavelength_nm" in tags for tags in of_bands) else "")
    centres, scale = wavelengths_nm(fields, len(keep), notes)
    if centres is None:
        described = [_described(file.descriptions[band]) for band in keep]
        if None in described or not described:
            return None, tuple(notes)
        return BandWavelengths(np.array(described), None, f"wavelengths from the band names of {path}"), tuple(notes)
    widths = [finite_number(word) for word in re.split(r"[,\s]+", fields.get("fwhm", "")) if word]
    known = len(widths) == len(keep) and all(width is not None and width > 0 for width in widths)
    fwhm = np.array(widths, np.float64) * scale if known else None
    return BandWavelengths(centres, fwhm, f"wavelengths from the tags of {path}"), tuple(notes)


def bad_bands(said: str | None, count: int) -> tuple[int, ...]:
    """Bands, from 0, that a list of bad bands marks by 0 (``{1, 1, 0}``); none where it is no list of ``count``."""
    flags = [finite_number(word) for word in re.split(r"[,\s{}]+", said or "") if word]
    return tuple(band for band, flag in enumerate(flags) if flag == 0) if len(flags) == count else ()


def bad_bands_said(file: Any, keep: Sequence[int]) -> tuple[int, ...]:
    """Bands of an opened rasterio file that it calls bad, by their places in ``keep``."""
    said = _first(_lower(file.tags(ns="ENVI")) | _lower(file.tags()), ("bbl", "bad_bands", "bad_band_list"))
    bad = set(bad_bands(said, file.count))
    bad |= {band for band in keep if _first(_band_tags(file, band), ("bbl", "bad_band")) in _BAD}
    return tuple(place for place, band in enumerate(keep) if band in bad)


_BAD = ("0", "0.0")


def _band_tags(file: Any, band: int) -> dict[str, str]:
    """Tags of one band, counted from 0; GDAL's own in micrometres count first."""
    tags, imagery = _lower(file.tags(band + 1)), file.tags(band + 1, ns="IMAGERY")
    if "CENTRAL_WAVELENGTH_UM" in imagery:
        tags |= {"wavelength": imagery["CENTRAL_WAVELENGTH_UM"], "wavelength_units": "um"}
        tags |= {"fwhm": imagery["FWHM_UM"]} if "FWHM_UM" in imagery else {}
    return tags


def _lower(tags: Mapping[str, str]) -> dict[str, str]:
    return {"_".join(name.lower().split()): value for name, value in tags.items()}


def _first(tags: Mapping[str, str], names: Sequence[str]) -> str | None:
    return next((tags[name] for name in names if tags.get(name)), None)


def _picked(listed: str, keep: Sequence[int], count: int) -> str:
    """The numbers of some bands out of a list of all; the list as it is where it has not one of each."""
    words = [word for word in re.split(r"[,\s{}]+", listed) if word]
    return ", ".join(words[band] for band in keep) if len(words) == count else ", ".join(words)


def _described(name: str | None) -> float | None:
    """Nanometres out of a band's name such as ``Band 12 (660.5 Nanometers)``."""
    found = _DESCRIBED.search(name or "")
    if found is None:
        return None
    return float(found[1]) * (1.0 if found[2].lower().startswith("n") else 1000.0)


def is_mask(file: Any, channel: int) -> bool:
    """Tell whether a channel says where there are pixels: nearly all of its values are 0 or its greatest.

    Of at most 256 x 256 px in the middle. Programs call the fourth band of bytes alpha where nobody says what it is.
    """
    high, wide = min(file.height, SAMPLED_PX), min(file.width, SAMPLED_PX)
    window = importlib.import_module("rasterio").windows.Window(
        (file.width - wide) // 2, (file.height - high) // 2, wide, high
    )
    values = file.read(channel + 1, window=window)
    return bool(np.mean((values > 0) & (values < values.max())) <= MOST_BETWEEN)


def void_pixels(file: Any, rows: Any, alpha: int | None) -> NDArray[np.bool_] | None:
    """(y, x) pixels of a window that alpha or the file's mask says are not there; None where it has neither."""
    if alpha is not None:
        return np.asarray(file.read(alpha + 1, window=rows) == 0)
    kinds, flags = importlib.import_module("rasterio").enums.MaskFlags, file.mask_flag_enums[0] if file.count else []
    if kinds.per_dataset not in flags or kinds.alpha in flags:  # a channel that is called alpha and is none
        return None
    return np.asarray(file.read_masks(1, window=rows) == 0)
