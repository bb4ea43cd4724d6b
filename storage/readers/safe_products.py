"""Sentinel-2 products (SAFE), as a folder or the .zip that it comes in: the bands of one resolution as one cube.

The bands are JPEG 2000 files, which GDAL reads; metadata say wavelengths, quantification value and, from processing
baseline 04.00 on, an offset. GDAL's own driver of such products keeps the offset to itself, and leaves the copies of
finer bands at 20 m and 60 m out.
"""

from __future__ import annotations

import re
import zipfile
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from pipeline.errors import SceneError
from storage.readers.cube_sources import Bands, CubeSource
from storage.readers.image_files import open_image, rescaled

RESOLUTIONS = ("10m", "20m", "60m")
# bands in the order of their numbers in metadata: resolution, centre and width [nm] as ESA publishes them
_BANDS = {
    "B01": ("60m", 443.0, 20.0),
    "B02": ("10m", 490.0, 65.0),
    "B03": ("10m", 560.0, 35.0),
    "B04": ("10m", 665.0, 30.0),
    "B05": ("20m", 705.0, 15.0),
    "B06": ("20m", 740.0, 15.0),
    "B07": ("20m", 783.0, 20.0),
    "B08": ("10m", 842.0, 115.0),
    "B8A": ("20m", 865.0, 20.0),
    "B09": ("60m", 945.0, 20.0),
    "B10": ("60m", 1375.0, 30.0),
    "B11": ("20m", 1610.0, 90.0),
    "B12": ("20m", 2190.0, 180.0),
}
_IMAGE = re.compile(r"(?:^|/)GRANULE/([^/]+)/IMG_DATA/(?:R\d\dm/)?[^/]*_(B\w\w)(?:_(\d\dm))?\.jp2$", re.IGNORECASE)
_METADATA = re.compile(r"(?:^|/)MTD_MSIL(1C|2A)\.xml$")
_LARGEST_XML = 1 << 24  # bytes
NODATA = 0


def is_safe_product(path: Path) -> bool:
    """Tell whether an address is a Sentinel-2 product: a folder with its metadata, one called .SAFE, or a .zip."""
    if path.suffix.lower() == ".zip":
        return path.is_file()
    named = path.suffix.lower() == ".safe"
    return path.is_dir() and (named or any((path / f"MTD_MSIL{level}.xml").is_file() for level in ("1C", "2A")))


@dataclass(frozen=True)
class _Product:
    """The files of a product by their names within it, and what opens them."""

    path: Path
    names: Sequence[str]
    text: Callable[[str], bytes]
    address: Callable[[str], str]  # for GDAL


def open_safe_cube(path: Path, resolution: str | None = None) -> CubeSource:
    """Open the bands of one resolution (``10m``, ``20m`` or ``60m``; 10 m where none is named) as one cube.

    Values are reflectances with the product's quantification value and offset, NaN where the product has no data.
    Raises SceneError: it is no such product or damaged, has no such resolution, or holds several tiles.
    """
    wanted = "10m" if resolution is None else resolution.lower()
    if wanted not in RESOLUTIONS:
        raise SceneError(f"{path}:{resolution}: expected a resolution, {', '.join(RESOLUTIONS)}, after the colon")
    product = _opened(path)
    metadata = next((name for name in product.names if _METADATA.search(name)), None)
    images = _images_of(product, wanted)
    if metadata is None or not images:
        lacking = "metadata (MTD_MSIL1C.xml or MTD_MSIL2A.xml)" if metadata is None else f"bands of {wanted} (.jp2)"
        raise SceneError(
            f"{path} has no {lacking}; give a Sentinel-2 product of level 1C or 2A as its .SAFE folder or .zip, and"
            " unpack a .zip of anything else"
        )
    quantification, offsets, centres = _radiometry(product, metadata)
    opened = [open_image(path, product.address(name), scaled=False) for name in images.values()]
    first, names = opened[0], list(images)
    if any((one.shape, one.geobox) != (first.shape, first.geobox) for one in opened) or first.shape[2] != 1:
        raise SceneError(f"{path}: its bands of {wanted} are of several sizes or places; copy the product again")
    centre_nm = np.array([centres.get(name, _BANDS[name][1]) for name in names])
    origin = f"wavelengths from {metadata.rpartition('/')[2]}" if centres else "wavelengths as ESA publishes them"
    others = ", ".join(f":{one}" for one in RESOLUTIONS if one != wanted and _images_of(product, one))
    level = "1C" if "1C" in metadata.rpartition("/")[2] else "2A"
    note = f"Sentinel-2 level {level}, bands {', '.join(names)} of {wanted}"
    note += f"; other resolutions after the name of the product: {others}" if others else ""
    joined = replace(
        first,
        name=path.name,
        shape=(*first.shape[:2], len(names)),
        read=lambda start, stop: np.concatenate([one.read(start, stop) for one in opened], axis=2),
        files=(path,) if path.is_file() else tuple(path / name for name in (metadata, *images.values())),
        bands=Bands(centre_nm, np.array([_BANDS[name][2] for name in names]), "nm", origin),
        notes=(note,),
    )
    offset = np.array([offsets.get(name, 0.0) / quantification for name in names])
    source = rescaled(joined, np.full(len(names), 1 / quantification), offset, NODATA)
    return replace(source, scaling="", notes=(*source.notes, *first.notes))  # the hash of the metadata says the scale


def _opened(path: Path) -> _Product:
    if not path.is_file():
        names = sorted(entry.relative_to(path).as_posix() for entry in path.rglob("*") if entry.is_file())
        return _Product(
            path, names, lambda name: (path / name).read_bytes()[:_LARGEST_XML], lambda name: str(path / name)
        )
    try:
        with zipfile.ZipFile(path) as pack:
            names = pack.namelist()
    except (OSError, zipfile.BadZipFile) as error:
        raise SceneError(f"{path} cannot be read as a .zip: {error}; is it damaged? copy it again") from error

    def text(name: str) -> bytes:
        with zipfile.ZipFile(path) as pack, pack.open(name) as file:
            return file.read(_LARGEST_XML)

    return _Product(path, names, text, lambda name: f"/vsizip/{{{path.resolve()}}}/{name}")


def _images_of(product: _Product, resolution: str) -> dict[str, str]:
    """Files of a resolution by their bands, in the bands' order (SceneError: they are of several tiles)."""
    found: dict[str, dict[str, str]] = defaultdict(dict)
    for name in product.names:
        match = _IMAGE.search(name)
        if match is not None and match[2].upper() in _BANDS:
            band = match[2].upper()
            if (match[3] or _BANDS[band][0]).lower() == resolution:
                found[match[1]][band] = name
    if len(found) > 1:
        raise SceneError(
            f"{product.path} holds {len(found)} tiles, expected one; take one of its folders GRANULE/... apart"
        )
    return {band: files[band] for files in found.values() for band in _BANDS if band in files}


def _radiometry(product: _Product, metadata: str) -> tuple[float, dict[str, float], dict[str, float]]:
    """Return quantification value, offsets by band and central wavelengths [nm] by band (SceneError: damaged)."""
    try:
        elements = list(ElementTree.fromstring(product.text(metadata)).iter())
    except ElementTree.ParseError as error:
        raise SceneError(f"{product.path}: {metadata} cannot be read as XML: {error}; copy it again") from error
    numbers, quantification = list(_BANDS), 0.0
    offsets, centres = dict[str, float](), dict[str, float]()
    try:
        for element in elements:
            tag = element.tag.rpartition("}")[2]
            if tag in ("QUANTIFICATION_VALUE", "BOA_QUANTIFICATION_VALUE"):
                quantification = float(element.text or "")
            elif tag in ("RADIO_ADD_OFFSET", "BOA_ADD_OFFSET"):
                offsets[numbers[int(element.get("band_id", ""))]] = float(element.text or "")
            elif tag == "Spectral_Information" and (centre := element.findtext("Wavelength/CENTRAL")):
                centres[numbers[int(element.get("bandId", ""))]] = float(centre)
    except (ValueError, IndexError) as error:
        raise SceneError(f"{product.path}: {metadata} holds what is no number: {error}; copy it again") from error
    if quantification <= 0:
        raise SceneError(f"{product.path}: {metadata} has no quantification value above 0; copy the product again")
    return quantification, offsets, centres
