"""Arrays out of image, TIFF, array and MATLAB files, with what the file says of its colours, its place and its gaps.

TIFF and JPEG 2000 go through rasterio, some rows at a time. Several images of one size in a file are its bands, in
their order: so cameras that know no bands write cubes. Transparent pixels have no value.
"""

from __future__ import annotations

import importlib
import math
import re
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.errors import SceneError
from storage.readers.array_files import NAMED_ENDINGS, load_named, load_npy, split_step, take_step
from storage.readers.cube_sources import (
    DEFLATE_RATIO,
    GREY_NM,
    NEAR_INFRARED_NM,
    RGB_NM,
    Raster,
    check_claim,
    check_memory,
    check_numbers,
    unpacked,
)
from storage.readers.envi_cubes import open_envi_cube
from storage.readers.hdf_cubes import HDF_ENDINGS
from storage.readers.raster_tags import (
    bad_bands,
    bad_bands_said,
    bands_said,
    is_mask,
    place_of_envi,
    place_of_file,
    void_pixels,
)
from storage.readers.scene_toml import BandWavelengths

if TYPE_CHECKING:
    from odc.geo.geobox import GeoBox

TIFF_ENDINGS = (".tif", ".tiff")
JPEG2000_ENDINGS = (".jp2", ".j2k")
ROW_ENDINGS = (*TIFF_ENDINGS, *JPEG2000_ENDINGS)  # of files that are read some rows at a time
_DRIVERS = {"GTiff": "TIFF", "JP2OpenJPEG": "JPEG 2000"}  # of GDAL, and what messages call their files
ALPHA_NOTE = "its alpha channel says where there are pixels, and is no band"
NO_MASK_NOTE = (
    "its channel called alpha holds what no mask does, and is taken as a band: programs call the fourth band of a file "
    "alpha where nobody says what it is"
)
_ROWS = 64  # about as many as are read at a time


@dataclass(frozen=True)
class Scaling:
    """What the numbers of a file mean: ``number * scale + offset``, band by band."""

    scale: NDArray[np.float64]  # (band,)
    offset: NDArray[np.float64]  # (band,)
    nodata: float | None  # the number that stands for no value, before scaling
    dtype: np.dtype[Any]  # of the numbers

    @property
    def stated(self) -> str:
        """What hashes of scenes say of it."""
        return f"scale {self.scale.tolist()} offset {self.offset.tolist()}"

    @property
    def note(self) -> str:
        """One sentence for people."""
        pairs = sorted(set(zip(self.scale.tolist(), self.offset.tolist(), strict=True)))
        others = "" if len(pairs) == 1 else ", or others by the band"
        return f"values are the file's numbers times {pairs[0][0]:g} plus {pairs[0][1]:g}{others}, as it says"


def _scaling_said(file: Any, keep: list[int], images: int, kind: np.dtype[Any]) -> Scaling | None:
    """Scale and offset of an opened file's bands; None where it says none."""
    scale, offset = (
        np.tile(np.array([said[band] for band in keep], np.float64), images) for said in (file.scales, file.offsets)
    )
    if (scale == 1).all() and (offset == 0).all():
        return None
    return Scaling(scale, offset, file.nodata, kind)


@dataclass(frozen=True)
class TiffRows:
    """A TIFF or JPEG 2000, opened: (y, x, band) of ``dtype``, without its alpha channel.

    Where the file says scale and offset, values are float32 and have them applied, NaN where there is no value.
    """

    path: Path
    shape: tuple[int, int, int]
    dtype: np.dtype[Any]
    bands: tuple[tuple[str, tuple[int, ...]], ...]  # image of the file, and those of its bands, counted from 0
    assumed_nm: tuple[float, ...] | None
    nodata: float | None
    notes: tuple[str, ...]
    alpha: int | None = None  # the channel that says where there are pixels, from 0
    geobox: GeoBox | None = None
    known: BandWavelengths | None = None
    bad_bands: tuple[int, ...] = ()
    scaling: Scaling | None = None
    files: tuple[Path, ...] = ()  # that it is read from, where that is not the path alone
    block_lines: int = 1  # lines that are decoded together, where that takes long

    def unscaled(self) -> TiffRows:
        """Return the same file as it stands: labels and masks are numbers, whatever scale the file says."""
        if self.scaling is None:
            return self
        return replace(self, scaling=None, dtype=self.scaling.dtype, nodata=self.scaling.nodata)

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Rows ``start`` to ``stop`` (SceneError where they are damaged)."""
        rasterio = importlib.import_module("rasterio")
        rows = rasterio.windows.Window(0, start, self.shape[1], stop - start)
        planes = []
        for image, bands in self.bands:
            with _tiff(rasterio, self.path, image) as file:
                planes.append(file.read([band + 1 for band in bands], window=rows))
        raw = np.moveaxis(np.concatenate(planes), 0, -1)
        if self.scaling is None:
            return np.ascontiguousarray(raw, self.dtype)
        return np.ascontiguousarray(unpacked(raw, self.scaling.scale, self.scaling.offset, self.scaling.nodata))

    def void(self, start: int, stop: int) -> NDArray[np.bool_] | None:
        """(y, x) of rows ``start`` to ``stop`` that are transparent or masked; None where the file knows neither."""
        rasterio = importlib.import_module("rasterio")
        with _tiff(rasterio, self.path, self.bands[0][0]) as file:
            return void_pixels(file, rasterio.windows.Window(0, start, self.shape[1], stop - start), self.alpha)


def open_tiff_rows(path: Path) -> TiffRows:
    """Open a TIFF or JPEG 2000 to be read some rows at a time.

    Raises SceneError: the file is missing or damaged, or claims more than its bytes can mean.
    """
    if not path.is_file():
        raise SceneError(f"there is no file {path}; check the name (seen from {Path.cwd()})")
    return open_image_rows(path, str(path))


def open_image_rows(path: Path, image: str) -> TiffRows:
    """Open an image by the name that GDAL knows it by, in the file or folder ``path`` that messages name.

    Raises SceneError: it is damaged, or claims more than its bytes can mean.
    """
    rasterio = importlib.import_module("rasterio")
    stored = Path(image).stat().st_size if Path(image).is_file() else path.stat().st_size
    with _tiff(rasterio, path, image) as file:
        images, notes = _images(rasterio, path, image, file)
        names = [kind.name for kind in file.colorinterp]
        deepest = max(np.dtype(name).itemsize for name in file.dtypes)
        check_claim(path, file.height * file.width * deepest, stored)  # before any of it is read
        check_memory(path, math.prod(max(file.block_shapes)) * file.count * deepest)
        no_mask = "alpha" in names and not is_mask(file, names.index("alpha"))
        if no_mask:
            names = ["undefined" if name == "alpha" else name for name in names]
        keep, assumed, more = _named_bands(names)
        more += (NO_MASK_NOTE,) if no_mask else ()
        geobox, where = place_of_file(file)
        known, told = bands_said(file, keep, path) if len(images) == 1 else (None, ())
        kind = np.result_type(*(np.dtype(file.dtypes[band]) for band in keep or [0]))
        bands = tuple((image, tuple(keep)) for image in images)
        shape = (file.height, file.width, len(keep) * len(images))
        scaling = _scaling_said(file, keep, len(images), kind)
        check_claim(path, math.prod(shape) * kind.itemsize, stored)
        block = math.prod(max(file.block_shapes)) * file.count * kind.itemsize
        check_memory(path, block + min(_ROWS, shape[0]) * shape[1] * shape[2] * kind.itemsize)
        return TiffRows(
            path,
            shape,
            kind if scaling is None else np.dtype(np.float32),
            bands,
            assumed_nm=assumed if len(images) == 1 else None,
            nodata=file.nodata if scaling is None else None,
            notes=(*notes, *more, *where, *told, *([] if scaling is None else [scaling.note])),
            alpha=names.index("alpha") if "alpha" in names else None,
            geobox=geobox,
            known=known,
            bad_bands=bad_bands_said(file, keep) if len(images) == 1 else (),
            scaling=scaling,
            block_lines=max(file.block_shapes)[0] if file.driver == "JP2OpenJPEG" else 1,
        )


def read_tiff(path: Path, *, scaled: bool = True) -> Raster:
    """Read a whole TIFF or JPEG 2000, with its scale or as it stands (SceneError as for :func:`open_tiff_rows`)."""
    rows = open_tiff_rows(path) if scaled else open_tiff_rows(path).unscaled()
    check_memory(path, 2 * math.prod(rows.shape) * rows.dtype.itemsize)
    return Raster(
        rows.read(0, rows.shape[0]),
        rows.assumed_nm,
        rows.nodata,
        rows.notes,
        known=rows.known,
        geobox=rows.geobox,
        void=rows.void(0, rows.shape[0]),
        bad_bands=rows.bad_bands,
        scaling="" if rows.scaling is None else rows.scaling.stated,
    )


def _images(rasterio: Any, path: Path, image: str, first: Any) -> tuple[list[str], tuple[str, ...]]:
    """Names of the images that are bands of one cube; the first alone where another is of another kind."""
    names = list(first.subdatasets)
    if len(names) < 2:
        return [image], ()
    for name in names:
        with _tiff(rasterio, path, name) as other:
            if (other.shape, other.dtypes) != (first.shape, first.dtypes):
                return [image], (f"the first of {len(names)} images in the file, which are of several kinds",)
    return names, (f"{len(names)} images of one size in the file are taken as its bands",)


@contextmanager
def _tiff(rasterio: Any, path: Path, image: str) -> Iterator[Any]:
    """One image of a file, as its ending says and nothing else: other formats of GDAL's may name any file or server."""
    driver = "JP2OpenJPEG" if image.lower().endswith(JPEG2000_ENDINGS) else "GTiff"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)  # a scene lies on the camera's grid
        try:
            with rasterio.open(image, driver=driver) as file:
                yield file
        except SceneError:
            raise
        except Exception as error:  # decoders raise anything at all on damaged bytes
            raise SceneError(f"{path} cannot be read as {_DRIVERS[driver]}: {error}; is it damaged?") from error


def _named_bands(names: list[str]) -> tuple[list[int], tuple[float, ...] | None, tuple[str, ...]]:
    """Which bands are kept (alpha is not), their wavelengths, and notes.

    Wavelengths are assumed only where the file names its bands red, green and blue, or grey.
    """
    keep = [index for index, name in enumerate(names) if name != "alpha"]
    notes = (ALPHA_NOTE,) if len(keep) < len(names) else ()
    kinds = [names[index] for index in keep]
    assumed: tuple[float, ...] | None = None
    if kinds[:3] == ["red", "green", "blue"] and len(kinds) == 3:
        assumed = RGB_NM
    elif kinds[:3] == ["red", "green", "blue"] and len(kinds) == 4 and kinds[3] in ("undefined", "nir"):
        assumed = (*RGB_NM, NEAR_INFRARED_NM)
    elif kinds in (["gray"], ["palette"]):
        assumed = (GREY_NM,)
    return keep, assumed, notes


IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp")
SCENE_ENDINGS = (*IMAGE_ENDINGS, *ROW_ENDINGS, ".npy", *NAMED_ENDINGS, ".hdr", *HDF_ENDINGS)

_PILLOW_LIMIT = threading.RLock()  # it is the process's, not a call's
_FORMATS = ("PNG", "JPEG", "BMP")  # whatever the ending says; Pillow's others may run programs
_BYTES = {"I": 4, "F": 4, "I;16": 2, "I;16L": 2, "I;16B": 2}  # a number, by Pillow's mode; 1 in the others
_WITH_VARIABLE = re.compile(
    r"^(?P<path>.+\.(?:mat|npz|zarr|npy|safe|zip)):(?P<variable>[^/\\:]+(?::\d+)?)$", re.IGNORECASE | re.DOTALL
)
_WITH_GROUPS = re.compile(
    r"^(?P<path>.+\.(?:nc4?|h5|hdf5|he5)):(?P<variable>[^:]+(?::\d+)?)$", re.IGNORECASE | re.DOTALL
)


def split_variable(address: str | Path) -> tuple[Path, str | None]:
    """``scene.mat:cube`` -> path and variable, with the step of time in ``cube:3``; None where none is named.

    The variable of a NetCDF or HDF5 file may begin with its groups: ``scene.h5:SERC/Reflectance/Reflectance_Data``.
    """
    found = _WITH_VARIABLE.match(str(address)) or _WITH_GROUPS.match(str(address))
    return (Path(address), None) if found is None else (Path(found["path"]), found["variable"])


def load_raster(address: str | Path, *, dims: int) -> Raster:
    """Read one file; of a file with several arrays, the only one with ``dims`` axes (or the variable named).

    Arrays of .npy and ENVI files are read-only views: their numbers stay in the file until they are asked for. Raises
    SceneError: no such file, a kind that is not read, a damaged file, or an array that holds no real numbers.
    """
    path, variable = split_variable(address)
    if path.is_dir():
        raise SceneError(f"{path} is a folder, expected a file; name one of the files in it")
    if not path.is_file():
        raise SceneError(f"there is no file {path}; check the name (seen from {Path.cwd()})")
    ending = path.suffix.lower()
    if ending in HDF_ENDINGS:
        raise SceneError(
            f"{path} is read as a scene alone; write labels, masks and reference frames as TIFF, PNG or .npy"
        )
    if ending in ROW_ENDINGS and (guess := content_guess(path)):
        raise SceneError(f"{path} cannot be read as {ending}: {guess}")
    if ending not in SCENE_ENDINGS:
        raise SceneError(f"{path} ends in {ending or 'nothing'}, which is not read; use {', '.join(SCENE_ENDINGS)}")
    try:
        raster = _read(path, ending, variable, dims)
    except SceneError:
        raise
    except Exception as error:  # decoders raise anything at all on damaged bytes
        objects = "pickle" in str(error) or "Python objects" in str(error)
        why = "it holds Python objects or is damaged" if objects else str(error)
        cure = "write it again as plain numbers" if ending not in IMAGE_ENDINGS else "copy it again, or save it as PNG"
        raise SceneError(f"{path} cannot be read as {ending}: {why}; {content_guess(path) or cure}") from error
    check_numbers(raster.values.dtype, path)
    if raster.values.size == 0:
        raise SceneError(f"{path} holds an empty array of shape {raster.values.shape}")
    return raster


_BEGINNINGS = {  # of files, and the endings that go with them
    b"\x89PNG": (".png",),
    b"\xff\xd8\xff": (".jpg", ".jpeg"),
    b"II*\0": TIFF_ENDINGS,
    b"MM\0*": TIFF_ENDINGS,
    b"\0\0\0\x0cjP": JPEG2000_ENDINGS,
    b"\xff\x4f\xff\x51": JPEG2000_ENDINGS,
    b"\x93NUMPY": (".npy",),
    b"PK\x03\x04": (".npz",),
    b"\x89HDF": (".mat", *HDF_ENDINGS),
    b"MATLAB": (".mat",),
}


def content_guess(path: Path) -> str:
    """What to do with a file that begins as one of another ending does; nothing where it does not."""
    with path.open("rb") as file:
        head = file.read(8)
    for begins, endings in _BEGINNINGS.items():
        if head.startswith(begins) and path.suffix.lower() not in endings:
            return f"it begins as a {endings[0]} file does; give it that ending"
    return ""


def _read(path: Path, ending: str, variable: str | None, dims: int) -> Raster:
    if ending in IMAGE_ENDINGS:
        with _of_any_size(), Image.open(path, formats=_FORMATS) as image:
            claimed = math.prod(image.size) * len(image.getbands()) * _BYTES.get(image.mode, 1)
            if image.format != "JPEG":  # which may say that blocks without end are alike
                check_claim(path, claimed, path.stat().st_size, DEFLATE_RATIO)
            check_memory(path, 3 * claimed)
            image.load()
            return _read_deep_colour(path) if _is_deep_colour(path) else _from_pillow(image)
    if ending in ROW_ENDINGS:
        return read_tiff(path, scaled=dims == 3)
    if ending == ".npy":
        named, step = split_step(variable, ())
        if named is not None:
            raise SceneError(f"{path} holds one array, which has no name; only a step of time can be told: {path}:0")
        return Raster(take_step(load_npy(path), step, dims, str(path)))
    if ending != ".hdr":
        named_array = load_named(path, variable, dims)
        return Raster(named_array.values, notes=named_array.notes, known=named_array.wavelengths)
    cube, known = open_envi_cube(path), None
    if cube.header.wavelength_nm is not None:
        known = BandWavelengths(cube.header.wavelength_nm, cube.header.fwhm_nm, f"wavelengths from {path}")
    header, (lines, samples, bands) = cube.header, cube.values.shape
    geobox, notes = place_of_envi(header.fields, cube.path, (lines, samples))
    return Raster(
        cube.values,
        None,
        header.nodata,
        (*cube.notes, *notes),
        known=known,
        files=(path, cube.path),
        geobox=geobox,
        bad_bands=bad_bands(header.fields.get("bbl"), bands),
    )


@contextmanager
def _of_any_size() -> Iterator[None]:
    """Mosaics are large on purpose: what a file claims is judged by its bytes and the memory, not by Pillow's limit."""
    with _PILLOW_LIMIT:
        before, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
        try:
            yield
        finally:
            Image.MAX_IMAGE_PIXELS = before


def image_shape(path: Path) -> tuple[int, int, int]:
    """(y, x, band) of a picture by its head (SceneError: it is damaged, or of another kind than its ending)."""
    try:
        with _of_any_size(), Image.open(path, formats=_FORMATS) as image:
            return (
                image.size[1],
                image.size[0],
                1 if image.mode in ("1", "L", "LA", "La", "F") or "I" in image.mode else 3,
            )
    except Exception as error:  # decoders raise anything at all on damaged bytes
        raise SceneError(f"{path} cannot be read as {path.suffix.lower()}: {error}; is it damaged?") from error


def _is_deep_colour(path: Path) -> bool:
    """Whether a PNG has 16 bits and more than one channel, which Pillow would cut to 8 (bytes 24, 25 of the file)."""
    with path.open("rb") as file:
        head = file.read(26)
    return len(head) == 26 and head[1:4] == b"PNG" and head[24] == 16 and head[25] in (2, 4, 6)


def _read_deep_colour(path: Path) -> Raster:
    try:
        cv2 = importlib.import_module("cv2")
    except ImportError as error:
        raise SceneError(
            f"{path} is a 16-bit colour PNG, which needs OpenCV; pip install opencv-python-headless, or save .npy"
        ) from error
    values = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if values is None:
        raise SceneError(f"{path} cannot be decoded as a 16-bit PNG; is it damaged?")
    if values.ndim == 3 and values.shape[2] >= 3:
        values = values[..., [2, 1, 0, *range(3, values.shape[2])]]
    alpha = values.ndim == 3 and values.shape[2] in (2, 4)
    return _colours(values, alpha)


def _from_pillow(image: Image.Image) -> Raster:
    if image.mode == "P":
        colours = np.asarray(image.convert("RGB"))
        notes = ("colours looked up in the image's palette",)
        return Raster(colours, RGB_NM, notes=notes, indices=np.asarray(image))
    if image.mode in ("CMYK", "YCbCr", "LAB", "HSV", "PA"):
        return Raster(np.asarray(image.convert("RGB")), RGB_NM, notes=(f"converted from {image.mode} to RGB",))
    values = np.asarray(image)
    return _colours(values, alpha=image.mode in ("LA", "RGBA", "La", "RGBa"))


def _colours(values: NDArray[Any], alpha: bool) -> Raster:
    notes: tuple[str, ...] = ()
    void = values[..., -1] == 0 if alpha else None
    if alpha:
        values, notes = values[..., :-1], (ALPHA_NOTE,)
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    if values.ndim == 2:
        return Raster(values, (GREY_NM,), notes=notes, void=void)
    return Raster(values, RGB_NM if values.shape[2] == 3 else None, notes=notes, void=void)
