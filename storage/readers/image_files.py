"""Open images as cubes through rasterio: GeoTIFF and JPEG 2000 some rows at a time, PNG, JPEG and BMP whole.

A TIFF with several images is refused. Transparent and masked pixels have no value. Places,
wavelengths and bad bands are read from the tags of GDAL's ENVI and GeoTIFF drivers, and from band names.
"""

from __future__ import annotations

import importlib
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image

from spectralzoom.pipeline.envi_headers import header_text, split_header
from spectralzoom.pipeline.errors import SceneError
from spectralzoom.storage.readers.acquired import acquired_of
from spectralzoom.storage.readers.band_facts import CENTRES, bad_bands, bands_of_fields, is_named, letters, split_list
from spectralzoom.storage.readers.cube_sources import (
    BLOCK_LINES,
    DEFLATE_RATIO,
    MOST_RATIO,
    CubeSource,
    ReadLines,
    check_claim,
    check_memory,
    library_log,
    read_by_chunks,
    reading,
    unpacked,
)
from spectralzoom.storage.readers.own_files import check_overviews, check_sidecars
from spectralzoom.storage.readers.places import place_of_file
from spectralzoom.storage.readers.user_files import first_there, is_there

PICTURE_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp")  # of files that are read as a whole
JPEG2000_ENDINGS = (".jp2", ".j2k")
IMAGE_ENDINGS = (*PICTURE_ENDINGS, ".tif", ".tiff", *JPEG2000_ENDINGS)
# A file is only opened by the driver of its ending: other formats of GDAL may name any file or server.
_DRIVERS = dict.fromkeys(JPEG2000_ENDINGS, "JP2OpenJPEG") | {".png": "PNG", ".bmp": "BMP"}
_DRIVERS |= dict.fromkeys((".jpg", ".jpeg"), "JPEG") | dict.fromkeys((".tif", ".tiff"), "GTiff")
_STRICT = {"GDAL_ERROR_ON_LIBJPEG_WARNING": True, "GDAL_PNG_WHOLE_IMAGE_OPTIM": False}  # cut off files are refused
_CALLED = {"GTiff": "TIFF", "JP2OpenJPEG": "JPEG 2000"}  # in messages
MOST_WARNINGS = 5  # of GDAL, as notes
MOST_HEADER = 1 << 24  # bytes
ALPHA_NOTE = (
    "its alpha channel says where there are pixels, and is no band; if it is one, write so into the file"
    " (gdal_edit.py -colorinterp_4 undefined)"
)


def open_image(path: Path, *, scaled: bool = True) -> CubeSource:
    """Open an image, (y, x, band), without its alpha channel.

    Scale and offset of the file are applied if ``scaled``; else the numbers of a palette are kept. Raises SceneError:
    it is damaged, claims more than its bytes can hold, or is a scene with a palette.
    """
    with library_log() as heard:
        check_sidecars(path, _DRIVERS[path.suffix.lower()])
        with _opened(path) as file:
            _check_image(file, path)
            for own in file.files:  # also metadata, mask and overviews beside it
                is_there(Path(own))
            if scaled and [kind.name for kind in file.colorinterp] == ["palette"]:
                raise SceneError(f"{path} holds places in a palette; write its colours (gdal_translate -expand rgb)")
            orientation, exif = _exif_of(path)
            source = _source_of(file, path, exif, scaled)
    texts = [re.sub(r"^CPLE_\w+ in ", "", one.getMessage()) for one in heard if one.name.startswith("rasterio")]
    warned = dict.fromkeys(f"GDAL warns: {text.removeprefix(f'{path.name}: ')[:200]}" for text in texts)
    return _upright(replace(source, notes=(*source.notes, *list(warned)[:MOST_WARNINGS])), orientation)


def _source_of(file: Any, path: Path, exif: Mapping[str, Any], scaled: bool) -> CubeSource:
    """Return an open image as a cube, upright or not."""
    beside, header, of_header = _header_beside(file, path)
    alpha = _alpha_band(file, beside)
    keep = [band for band in range(file.count) if band != alpha]
    void, of_mask = _void(file, alpha)
    geobox, where = place_of_file(file)
    tags = _tags_of(file, keep, beside)
    names, colours = [file.descriptions[band] for band in keep], [file.colorinterp[band].name for band in keep]
    bands = bands_of_fields(tags, names, " and ".join([str(path), *(one.name for one in header)]), colours)
    of_header = of_header if header or bands.wavelength_nm is None else ()
    bands = replace(bands, notes=(*bands.notes, *of_header))
    bad, doubts = bad_bands(tags, len(keep))
    acquired = acquired_of({**exif, **file.tags(), **file.tags(ns="EXIF"), **file.tags(ns="IMAGERY")})
    kind, read = _values_of(file, path, keep, void if scaled else None)
    of_colour = "NODATA_VALUES" in file.tags()  # which is in the mask
    voids = [None if of_colour else file.nodatavals[band] for band in keep or [0]]
    source = CubeSource(
        name=path.name,
        shape=(file.height, file.width, len(keep)),
        dtype=kind,
        read=read,
        files=(path, *header),
        bands=bands,
        nodata=voids[0],
        geobox=geobox,
        bad_bands=bad,
        void=void,
        acquired=acquired.text,
        notes=(*(() if alpha is None else (ALPHA_NOTE,)), *of_mask, *where, *bands.notes, *doubts, *acquired.notes),
    )
    if not scaled:
        return source
    scale, offset = (np.array([of[band] for band in keep]) for of in (file.scales, file.offsets))
    alike = len(set(map(str, voids))) == 1
    return rescaled(source, scale, offset, None if alike else np.array(voids, np.float64))


def _header_beside(file: Any, path: Path) -> tuple[dict[str, str], tuple[Path, ...], tuple[str, ...]]:
    """Return the fields of an ENVI header beside an image without wavelengths, and its path; and notes that name it.

    A header of another size has neither.
    """
    names = [f"{stem}{ending}" for stem in (path.name, path.stem) for ending in (".hdr", ".HDR")]
    found = first_there(map(path.with_name, names))
    if found is None or _states_wavelengths(_tags_of(file, range(file.count), {})):
        return {}, (), ()
    try:
        with found.open("rb") as opened:
            fields, _ = split_header(header_text(opened.read(MOST_HEADER)), found.name)
    except (SceneError, OSError):  # of another kind
        return {}, (), ()
    lines, samples, bands = (fields.get(key, "?") for key in ("lines", "samples", "bands"))
    if not _states_wavelengths(fields):
        return {}, (), ()
    if (lines, samples, bands) != (str(file.height), str(file.width), str(file.count)):
        size = f"{lines} x {samples} px (y x x) and {bands} bands"
        return {}, (), (f"{found.name} beside it is not read: it describes {size}",)
    others = ", ".join(key for key in fields if re.match(r"reflectance scale|data .*(ignore|gain|offset)", key))
    left = f"of {found.name} beside it, facts of bands are read, and not {others}; state these in a scene.toml"
    return fields, (found,), (left,) if others else ()


def _states_wavelengths(fields: Mapping[str, object]) -> bool:
    return any(CENTRES.fullmatch(letters(key)) for key in fields)


def _check_image(file: Any, path: Path) -> None:
    """Refuse several images, overviews elsewhere, and a size beyond bytes or memory (SceneError)."""
    check_overviews(file, path)
    if len(file.subdatasets) > 1:
        raise SceneError(
            f"{path} holds {len(file.subdatasets)} images, expected one with all bands; write them as the bands of"
            " one (rio stack), or give the image alone in a file"
        )
    item = max(np.dtype(one).itemsize for one in file.dtypes)
    claimed = file.height * file.width * file.count * item
    if file.driver != "JPEG":  # its blocks may have no byte each
        check_claim(path, claimed, path.stat().st_size, MOST_RATIO if file.driver in _CALLED else DEFLATE_RATIO)
    at_a_time = math.prod(max(file.block_shapes)) * file.count * item + claimed // file.height * BLOCK_LINES
    check_memory(path, at_a_time if file.driver in _CALLED else claimed * 3)


def _alpha_band(file: Any, beside: Mapping[str, str]) -> int | None:
    """Return the alpha channel, from 0; None without one, as GDAL calls a fourth band of bytes alpha by default."""
    kinds = [kind.name for kind in file.colorinterp]
    if "alpha" not in kinds:
        return None
    alpha, name = kinds.index("alpha"), file.descriptions[kinds.index("alpha")]
    tags = _tags_of(file, range(file.count), beside)
    known = bands_of_fields(tags, file.descriptions, "", kinds).wavelength_nm
    named = is_named(name, alpha) and not re.search("alpha|transparen|opacity|mask|^a$", name.lower())
    return None if named or (known is not None and np.isfinite(known[alpha])) else alpha


def _values_of(
    file: Any, path: Path, keep: Sequence[int], masked: NDArray[np.bool_] | None
) -> tuple[np.dtype[Any], ReadLines]:
    """Return type and reader of the values of some bands, NaN in ``masked`` (y, x) pixels."""
    whole = np.result_type(*(np.dtype(file.dtypes[band]) for band in keep or [0]))
    kind, width = whole if masked is None else np.dtype(np.float32), file.width
    rows = {"GTiff": 1, "JP2OpenJPEG": max(file.block_shapes)[0]}.get(file.driver, file.height)  # at a time

    def read_rows(first: int, last: int) -> NDArray[Any]:
        """Return some rows, (y, x, band) (SceneError: they are damaged)."""
        with _opened(path) as opened:
            planes = opened.read([band + 1 for band in keep], window=((first, last), (0, width)))
        lines = np.ascontiguousarray(np.moveaxis(planes, 0, -1), kind)
        if masked is not None:
            lines[masked[first:last]] = np.nan
        return lines

    return kind, read_by_chunks(read_rows, file.height, rows)


def rescaled(
    source: CubeSource, scale: NDArray[np.float64], offset: NDArray[np.float64], fill: NDArray[np.float64] | None = None
) -> CubeSource:
    """Return the cube with ``number * scale + offset`` as values, (band,) each, NaN for its no-data value.

    ``fill`` is the no-data value of each band, NaN of one without. One that the numbers cannot hold is that of values.
    """
    nodata, kind = source.nodata, source.dtype
    notes = [] if fill is None else [f"the no-data values of the bands are {', '.join(f'{one:g}' for one in fill)}"]
    if (scale != 1).any() or offset.any():
        pairs = sorted(set(zip(scale.tolist(), offset.tolist(), strict=True)))
        others = "" if len(pairs) == 1 else " (others by band)"
        stated = f"times {pairs[0][0]:g} plus {pairs[0][1]:g}{others}, as in its header"
        notes.append(f"values are the file's numbers {stated}")
    elif fill is None:
        return source
    held = (
        nodata is None or kind.kind == "f" or (nodata % 1 == 0 and np.iinfo(kind).min <= nodata <= np.iinfo(kind).max)
    )
    if fill is None and not held:
        notes.append(f"its no-data value {nodata:g} is compared after scaling, since {kind} cannot hold it")
    void = nodata if fill is None else fill.astype(kind) if kind.kind == "f" else fill
    return replace(
        source,
        dtype=np.dtype(np.float32),
        read=lambda first, last: unpacked(source.read(first, last), scale, offset, void),
        nodata=None if held or fill is not None else nodata,
        packed_nodata=nodata if held and fill is None else None,
        scaling=f"scale {scale.tolist()} offset {offset.tolist()}{'' if fill is None else f' nodata {fill.tolist()}'}",
        notes=(*source.notes, *notes),
    )


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a file (SceneError: it is damaged, or of another kind)."""
    rasterio = importlib.import_module("rasterio")
    driver = _DRIVERS[path.suffix.lower()]
    with (
        library_log(),
        rasterio.Env(**_STRICT),
        reading(path, _CALLED.get(driver, path.suffix.lower()), "Copy it again, or save it as PNG or TIFF"),
        rasterio.open(path, driver=driver) as file,
    ):
        yield file


def _void(file: Any, alpha: int | None) -> tuple[NDArray[np.bool_] | None, tuple[str, ...]]:
    """Return (y, x) pixels that are transparent or masked, None without any or with all of them; and notes."""
    flags = {flag.name for flag in file.mask_flag_enums[0]}
    if alpha is None and ("per_dataset" not in flags or "alpha" in flags):
        return None, ()
    parts = []
    for first in range(0, file.height, BLOCK_LINES):
        window = ((first, min(first + BLOCK_LINES, file.height)), (0, file.width))
        seen = file.read_masks(1, window=window) if alpha is None else file.read(alpha + 1, window=window)
        parts.append(seen == 0)
    found = np.concatenate(parts)
    if found.all():
        return None, ("every pixel is transparent or masked: the mask is left out",)
    return found if found.any() else None, ()


def _tags_of(file: Any, bands: Sequence[int], beside: Mapping[str, str]) -> dict[str, str | Sequence[str]]:
    """Return the tags of an open file for some bands (from 0): texts of the file, and lists of the bands' own.

    Fields of a header ``beside`` it come first, and count where the file has none of this name.
    """
    tags: dict[str, str | Sequence[str]] = {}
    for name, value in {**beside, **file.tags(), **file.tags(ns="ENVI")}.items():
        words = split_list(value, file.count)
        tags[name] = value if words is None else [words[band] for band in bands]
    of_bands = [file.tags(band + 1) | file.tags(band + 1, ns="IMAGERY") for band in bands]
    names = dict.fromkeys(name for own in of_bands for name in own)
    return tags | {name: [own.get(name, "") for own in of_bands] for name in names}


_ORIENTATION = 274  # tag of Exif 2.32
_TURNS: Mapping[int, Callable[[NDArray[Any]], NDArray[Any]]] = {
    2: lambda image: image[:, ::-1],
    3: lambda image: image[::-1, ::-1],
    4: lambda image: image[::-1],
    5: lambda image: np.swapaxes(image, 0, 1),
    6: lambda image: np.rot90(image, -1),
    7: lambda image: np.swapaxes(image[::-1, ::-1], 0, 1),
    8: lambda image: np.rot90(image),
}


def _exif_of(path: Path) -> tuple[int, dict[str, Any]]:
    """Return the orientation tag of a TIFF, JPEG or PNG, or that of its XMP, else 1 (upright); and tags of Exif."""
    try:
        with Image.open(path) as image:
            found = image.getexif().get(_ORIENTATION, 1)
            more = image.getexif().get_ifd(ExifTags.IFD.Exif)  # GDAL reads those of a JPEG, but not of a PNG
    except Exception:  # of a kind that Pillow does not open; a damaged file is refused where it is read
        return 1, {}
    return int(found) if found in _TURNS else 1, {f"EXIF_{ExifTags.TAGS.get(tag, tag)}": more[tag] for tag in more}


def _upright(source: CubeSource, tag: int) -> CubeSource:
    """Return an image as its orientation tag says, with a note; one with a place on the earth stays as it is."""
    if tag == 1:
        return source
    if source.geobox is not None:
        left = f"its orientation tag {tag} is not applied, since the file says where its pixels lie on the earth"
        return replace(source, notes=(*source.notes, left))
    turn = _TURNS[tag]
    height, width, bands = source.shape
    shape = (width, height, bands) if tag >= 5 else source.shape
    check_memory(source.name, 2 * height * width * bands * source.dtype.itemsize)

    def read_all(_first: int, _last: int) -> NDArray[Any]:
        return np.ascontiguousarray(turn(source.read(0, height)))

    return replace(
        source,
        shape=shape,
        read=read_by_chunks(read_all, shape[0], shape[0]),
        void=None if source.void is None else turn(source.void),
        scaling=f"{source.scaling} orientation {tag}".strip(),
        notes=(*source.notes, f"the picture is turned upright, as its orientation tag {tag} says"),
    )
