"""Open images as cubes through rasterio: GeoTIFF and JPEG 2000 some rows at a time, PNG, JPEG and BMP whole.

A TIFF with several images is refused. Transparent and masked pixels have no value. Places,
wavelengths and bad bands are read from the tags of GDAL's ENVI and GeoTIFF drivers, and from band names.
"""

from __future__ import annotations

import importlib
import math
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.envi_headers import finite_number, wavelengths_nm
from spectralzoom.pipeline.errors import SceneError
from spectralzoom.storage.readers.acquired import acquired_of
from spectralzoom.storage.readers.cube_sources import (
    BLOCK_LINES,
    DEFLATE_RATIO,
    MOST_RATIO,
    Bands,
    CubeSource,
    check_claim,
    check_memory,
    read_by_chunks,
    reading,
    unpacked,
)
from spectralzoom.storage.readers.orientation import orientation_of, upright
from spectralzoom.storage.readers.own_files import check_overviews, check_sidecars
from spectralzoom.storage.readers.places import place_of_file

PICTURE_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp")  # of files that are read as a whole
JPEG2000_ENDINGS = (".jp2", ".j2k")
IMAGE_ENDINGS = (*PICTURE_ENDINGS, ".tif", ".tiff", *JPEG2000_ENDINGS)
# A file is only opened by the driver of its ending: other formats of GDAL may name any file or server.
_DRIVERS = dict.fromkeys(JPEG2000_ENDINGS, "JP2OpenJPEG") | {".png": "PNG", ".bmp": "BMP"}
_DRIVERS |= dict.fromkeys((".jpg", ".jpeg"), "JPEG") | dict.fromkeys((".tif", ".tiff"), "GTiff")
_STRICT = {"GDAL_ERROR_ON_LIBJPEG_WARNING": True, "GDAL_PNG_WHOLE_IMAGE_OPTIM": False}  # cut off files are refused
_CALLED = {"GTiff": "TIFF", "JP2OpenJPEG": "JPEG 2000"}  # in messages
ALPHA_NOTE = (
    "its alpha channel says where there are pixels, and is no band; if it is one, write so into the file"
    " (gdal_edit.py -colorinterp_4 undefined)"
)
RGB_NM = (640.0, 550.0, 460.0)
NEAR_INFRARED_NM = 800.0
GREY_NM = 550.0
_COLOURS_NM: Mapping[tuple[str, ...], tuple[float, ...]] = {
    ("gray",): (GREY_NM,),
    ("red", "green", "blue"): RGB_NM,
    ("red", "green", "blue", "undefined"): (*RGB_NM, NEAR_INFRARED_NM),
    ("red", "green", "blue", "nir"): (*RGB_NM, NEAR_INFRARED_NM),
}


def open_image(path: Path, *, scaled: bool = True) -> CubeSource:
    """Open an image, (y, x, band), without its alpha channel.

    Scale and offset of the file are applied if ``scaled``; else the numbers of a palette are kept. Raises SceneError:
    there is no such file, it is damaged, claims more than its bytes can hold, or is a scene with a palette.
    """
    if not path.is_file():
        raise SceneError(f"there is no file {path}; check the name (seen from {Path.cwd()})")
    driver = _DRIVERS[path.suffix.lower()]
    check_sidecars(path)
    with _opened(path) as file:
        check_overviews(file, path)
        if len(file.subdatasets) > 1:
            raise SceneError(
                f"{path} holds {len(file.subdatasets)} images, expected one with all bands; write them as the bands of"
                " one (rio stack), or give the image alone in a file"
            )
        block = max(file.block_shapes)
        item = max(np.dtype(one).itemsize for one in file.dtypes)
        claimed = (file.height, file.width, file.count)
        _check_size(path, driver, claimed, item, math.prod(block) * file.count)
        kinds = [kind.name for kind in file.colorinterp]
        if scaled and kinds == ["palette"]:
            raise SceneError(f"{path} holds places in a palette; write its colours (gdal_translate -expand rgb)")
        alpha = kinds.index("alpha") if "alpha" in kinds else None
        keep = [band for band in range(file.count) if band != alpha]
        kind = np.result_type(*(np.dtype(file.dtypes[band]) for band in keep or [0]))
        height, width = file.height, file.width
        geobox, where = place_of_file(file)
        known, of_bands = _bands_of(file, keep, [kinds[band] for band in keep], path)
        acquired = acquired_of({**file.tags(), **file.tags(ns="EXIF"), **file.tags(ns="IMAGERY")})
        notes = [*([] if alpha is None else [ALPHA_NOTE]), *where, *of_bands, *acquired.notes]
        scale, offset = (np.array([of[band] for band in keep]) for of in (file.scales, file.offsets))
        at_once = height if driver not in _CALLED else block[0] if driver == "JP2OpenJPEG" else 1

        def read_rows(first: int, last: int) -> NDArray[Any]:
            """Return some rows, (y, x, band) (SceneError: they are damaged)."""
            with _opened(path) as opened:
                planes = opened.read([band + 1 for band in keep], window=((first, last), (0, width)))
            return np.ascontiguousarray(np.moveaxis(planes, 0, -1), kind)

        bad = set(bad_bands(_file_tags(file).get("bbl"), file.count))
        source = CubeSource(
            name=path.name,
            shape=(height, width, len(keep)),
            dtype=kind,
            read=read_by_chunks(read_rows, height, at_once),
            files=(path,),
            bands=known,
            nodata=None if "NODATA_VALUES" in file.tags() else file.nodata,  # a colour is in the mask
            geobox=geobox,
            bad_bands=tuple(place for place, band in enumerate(keep) if band in bad),
            void=_void(file, alpha),
            acquired=acquired.text,
            notes=tuple(notes),
        )
    read = source.read
    void = source.void
    if scaled and void is not None and not void.all():
        source = replace(
            source,
            dtype=np.dtype(np.float32),
            read=lambda first, last: np.where(
                void[first:last, :, None], np.float32(np.nan), np.float32(read(first, last))
            ),
        )
    plain = not scaled or ((scale == 1).all() and (offset == 0).all())
    return upright(source if plain else rescaled(source, scale, offset), orientation_of(path))


def rescaled(source: CubeSource, scale: NDArray[np.float64], offset: NDArray[np.float64]) -> CubeSource:
    """Return the cube with ``number * scale + offset`` as values, (band,) each, NaN for its no-data value."""
    pairs = sorted(set(zip(scale.tolist(), offset.tolist(), strict=True)))
    others = "" if len(pairs) == 1 else " (others by band)"
    return replace(
        source,
        dtype=np.dtype(np.float32),
        read=lambda first, last: unpacked(source.read(first, last), scale, offset, source.nodata),
        nodata=None,
        scaling=f"scale {scale.tolist()} offset {offset.tolist()}",
        notes=(
            *source.notes,
            f"values are the file's numbers times {pairs[0][0]:g} plus {pairs[0][1]:g}{others}, as in its header",
        ),
    )


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a file (SceneError: it is damaged, or of another kind)."""
    rasterio = importlib.import_module("rasterio")
    driver = _DRIVERS[path.suffix.lower()]
    with warnings.catch_warnings(), rasterio.Env(**_STRICT):
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        with (
            reading(path, _CALLED.get(driver, path.suffix.lower()), "Copy it again, or save it as PNG or TIFF"),
            rasterio.open(path, driver=driver) as file,
        ):
            yield file


def _check_size(path: Path, driver: str, shape: tuple[int, int, int], item: int, block: int) -> None:
    """Refuse more than the file's bytes or the memory can hold (SceneError)."""
    claimed = math.prod(shape) * item
    if driver != "JPEG":  # its blocks may have no byte each
        check_claim(path, claimed, path.stat().st_size, MOST_RATIO if driver in _CALLED else DEFLATE_RATIO)
    check_memory(path, claimed * 3 if driver not in _CALLED else block * item + claimed // shape[0] * BLOCK_LINES)


def _void(file: Any, alpha: int | None) -> NDArray[np.bool_] | None:
    """Return (y, x) pixels that are transparent or masked; None without a mask."""
    kinds = importlib.import_module("rasterio").enums.MaskFlags
    flags = file.mask_flag_enums[0]
    if alpha is None and (kinds.per_dataset not in flags or kinds.alpha in flags):
        return None
    parts = []
    for first in range(0, file.height, BLOCK_LINES):
        window = ((first, min(first + BLOCK_LINES, file.height)), (0, file.width))
        seen = file.read_masks(1, window=window) if alpha is None else file.read(alpha + 1, window=window)
        parts.append(seen == 0)
    found = np.concatenate(parts)
    return found if found.any() else None


_UNIT = "wavelength_units"
_LENGTHS = r"nm|nanomet(?:er|re)s?|µm|um|micromet(?:er|re)s?"
_DESCRIBED = re.compile(rf"(?<![\w.])(\d+(?:\.\d+)?)\s*({_LENGTHS})\b", re.IGNORECASE)  # Band 12 (660.5 Nanometers)


def _of_colours(colours_nm: Sequence[float]) -> Bands:
    listed = ", ".join(f"{nm:g}" for nm in colours_nm)
    return Bands(np.array(colours_nm), None, f"wavelengths assumed from the file's colours: {listed} nm")


def _bands_of(file: Any, keep: Sequence[int], kinds: Sequence[str], path: Path) -> tuple[Bands, tuple[str, ...]]:
    """Return wavelengths and widths by the tags of an open file, else its band names, else its colours; and notes."""
    notes: list[str] = []
    of_file = _file_tags(file)
    of_bands = []
    for band in keep:  # counted from 0; GDAL's own tags take precedence
        tags = _lower(file.tags(band + 1))
        imagery = file.tags(band + 1, ns="IMAGERY")
        if "CENTRAL_WAVELENGTH_UM" in imagery:
            tags |= {"wavelength": imagery["CENTRAL_WAVELENGTH_UM"], _UNIT: "um"}
            tags |= {"fwhm": imagery["FWHM_UM"]} if "FWHM_UM" in imagery else {}
        of_bands.append(tags)
    fields = {"wavelength units": next(iter(of_bands), {}).get(_UNIT) or of_file.get(_UNIT, "")}
    for key in ("wavelength", "fwhm"):
        values = [tags.get(key, "") for tags in of_bands]
        if all(values):
            fields[key] = ", ".join(values)
        elif key in of_file:
            words = [word for word in re.split(r"[,\s{}]+", of_file[key]) if word]
            fields[key] = ", ".join([words[band] for band in keep] if len(words) == file.count else words)
    centres, scale = wavelengths_nm(fields, len(keep), notes)
    if centres is not None:
        widths = [finite_number(word) for word in re.split(r"[,\s]+", fields.get("fwhm", "")) if word]
        known = len(widths) == len(keep) and all(width is not None and width > 0 for width in widths)
        fwhm = np.array(widths, np.float64) * scale if known else None
        return Bands(centres, fwhm, f"wavelengths from the tags of {path}"), tuple(notes)
    named = [_DESCRIBED.search(file.descriptions[band] or "") for band in keep]
    if named and None not in named:
        nm = [float(one[1]) * (1.0 if one[2].lower().startswith("n") else 1000.0) for one in named if one is not None]
        return Bands(np.array(nm), None, f"wavelengths from the band names of {path}"), tuple(notes)
    colours_nm = _COLOURS_NM.get(tuple(kinds))
    return Bands() if colours_nm is None else _of_colours(colours_nm), tuple(notes)


def bad_bands(listed: str | None, count: int) -> tuple[int, ...]:
    """Return the bands (from 0) that a list of ``count`` flags marks by 0, such as ``{1, 1, 0}``."""
    flags = [finite_number(word) for word in re.split(r"[,\s{}]+", listed or "") if word]
    return tuple(band for band, flag in enumerate(flags) if flag == 0) if len(flags) == count else ()


def _file_tags(file: Any) -> dict[str, str]:
    return _lower(file.tags()) | _lower(file.tags(ns="ENVI"))


def _lower(tags: Mapping[str, str]) -> dict[str, str]:
    return {"_".join(name.lower().split()): value for name, value in tags.items()}
