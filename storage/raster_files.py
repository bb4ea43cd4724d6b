"""Arrays out of image, array and MATLAB files, with what the file says of its colours."""

from __future__ import annotations

import importlib
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.errors import SceneError
from storage.envi_cubes import open_envi_cube
from storage.wavelengths import BandWavelengths

RGB_NM = (640.0, 550.0, 460.0)
NEAR_INFRARED_NM = 800.0
GREY_NM = 550.0

IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp")
TIFF_ENDINGS = (".tif", ".tiff")
NAMED_ENDINGS = (".mat", ".npz")  # hold several arrays: FILE:VARIABLE picks one
SCENE_ENDINGS = (*IMAGE_ENDINGS, *TIFF_ENDINGS, ".npy", *NAMED_ENDINGS, ".hdr")

_WITH_VARIABLE = re.compile(r"^(?P<path>.+\.(?:mat|npz|zarr)):(?P<variable>[^/\\:]+)$", re.IGNORECASE)


@dataclass(frozen=True)
class Raster:
    """One array as it stands in its file: (y, x) or (y, x, band), numbers of any kind."""

    values: NDArray[Any]
    assumed_nm: tuple[float, ...] | None = None  # what the file's colours suggest, band by band
    nodata: float | None = None
    notes: tuple[str, ...] = ()
    indices: NDArray[np.uint8] | None = None  # (y, x) of an image that numbers its colours
    known: BandWavelengths | None = None  # what the file says of its bands
    files: tuple[Path, ...] = ()  # that it was read from, where that is more than the one named


def split_variable(address: str | Path) -> tuple[Path, str | None]:
    """``scene.mat:cube`` -> path and variable; None where the address names none."""
    found = _WITH_VARIABLE.match(str(address))
    return (Path(address), None) if found is None else (Path(found["path"]), found["variable"])


def load_raster(address: str | Path, *, dims: int) -> Raster:
    """Read one file; of a file with several arrays, the only one with ``dims`` axes (or the variable named).

    Arrays of .npy and ENVI files are read-only views: their numbers stay in the file until they are asked for.

    Raises
    ------
    SceneError : no such file, a kind that is not read, a damaged file, or an array that holds no real numbers.
    """
    path, variable = split_variable(address)
    if path.is_dir():
        raise SceneError(f"{path} is a folder, expected a file; name one of the files in it")
    if not path.is_file():
        raise SceneError(f"there is no file {path}; check the name (seen from {Path.cwd()})")
    ending = path.suffix.lower()
    if ending not in SCENE_ENDINGS:
        raise SceneError(f"{path} ends in {ending or 'nothing'}, which is not read; use {', '.join(SCENE_ENDINGS)}")
    try:
        raster = _read(path, ending, variable, dims)
    except SceneError:
        raise
    except Exception as error:  # decoders raise anything at all on damaged bytes
        objects = "pickle" in str(error) or "Python objects" in str(error)
        why = "it holds Python objects or is damaged" if objects else str(error)
        raise SceneError(f"{path} cannot be read as {ending}: {why}; write it again as plain numbers") from error
    _check_numbers(raster.values, path)
    return raster


def _read(path: Path, ending: str, variable: str | None, dims: int) -> Raster:
    if ending in IMAGE_ENDINGS:
        return _read_image(path)
    if ending in TIFF_ENDINGS:
        return _read_tiff(path)
    if ending == ".npy":
        return Raster(np.load(path, mmap_mode="r", allow_pickle=False))
    if ending == ".hdr":
        return _read_envi(path)
    arrays = _npz_arrays(path) if ending == ".npz" else _mat_arrays(path, variable)
    return Raster(_pick(arrays, path, variable, dims))


def _read_envi(path: Path) -> Raster:
    cube = open_envi_cube(path)
    known = None
    if cube.header.wavelength_nm is not None:
        known = BandWavelengths(cube.header.wavelength_nm, cube.header.fwhm_nm, f"wavelengths from {path}")
    return Raster(cube.values, None, cube.header.nodata, cube.notes, known=known, files=(path, cube.path))


def _check_numbers(values: NDArray[Any], path: Path) -> None:
    if values.dtype.kind == "c":
        raise SceneError(f"{path} holds complex numbers; store their magnitude")
    if values.dtype.kind not in "buif":
        raise SceneError(f"{path} holds {values.dtype}, expected whole or floating numbers")
    if values.size == 0:
        raise SceneError(f"{path} holds an empty array of shape {values.shape}")


# --- images -----------------------------------------------------------------------------------------------------------


def _read_image(path: Path) -> Raster:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # mosaics are large on purpose
        with Image.open(path) as image:
            image.load()
            if _is_deep_colour(path):
                return _read_deep_colour(path)
            return _from_pillow(image)


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
    if image.mode in ("CMYK", "YCbCr", "LAB", "HSV"):
        return Raster(np.asarray(image.convert("RGB")), RGB_NM, notes=(f"converted from {image.mode} to RGB",))
    values = np.asarray(image)
    return _colours(values, alpha=image.mode in ("LA", "RGBA", "La", "RGBa"))


def _colours(values: NDArray[Any], alpha: bool) -> Raster:
    notes: tuple[str, ...] = ()
    if alpha:
        values, notes = values[..., :-1], ("alpha channel dropped",)
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    if values.ndim == 2:
        return Raster(values, (GREY_NM,), notes=notes)
    return Raster(values, RGB_NM if values.shape[2] == 3 else None, notes=notes)


# --- TIFF -------------------------------------------------------------------------------------------------------------


def _read_tiff(path: Path) -> Raster:
    try:
        rasterio = importlib.import_module("rasterio")
    except ImportError:
        return _read_plain_tiff(path)
    with _tiff(rasterio, path) as file:
        planes, nodata = file.read(), file.nodata
        keep, assumed, notes = _named_bands([kind.name for kind in file.colorinterp])
    return Raster(np.moveaxis(planes, 0, -1)[..., keep], assumed, nodata, notes)


def open_tiff_rows(path: Path) -> TiffRows | None:
    """Open a TIFF to be read some rows at a time; None where rasterio, which can do so, is not installed.

    Raises
    ------
    SceneError : the file is missing or damaged.
    """
    try:
        rasterio = importlib.import_module("rasterio")
    except ImportError:
        return None
    if not path.is_file():
        raise SceneError(f"there is no file {path}; check the name (seen from {Path.cwd()})")
    with _tiff(rasterio, path) as file:
        keep, assumed, notes = _named_bands([kind.name for kind in file.colorinterp])
        kind = np.result_type(*(file.dtypes[band] for band in keep))
        return TiffRows(path, (file.height, file.width, len(keep)), kind, tuple(keep), assumed, file.nodata, notes)


@dataclass(frozen=True)
class TiffRows:
    """A TIFF, opened: (y, x, band) of ``dtype``, without its alpha channel."""

    path: Path
    shape: tuple[int, int, int]
    dtype: np.dtype[Any]
    bands: tuple[int, ...]  # of the file, counted from 0
    assumed_nm: tuple[float, ...] | None
    nodata: float | None
    notes: tuple[str, ...]

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Rows ``start`` to ``stop`` (SceneError where they are damaged)."""
        rasterio = importlib.import_module("rasterio")
        with _tiff(rasterio, self.path) as file:
            rows = rasterio.windows.Window(0, start, self.shape[1], stop - start)
            planes = file.read([band + 1 for band in self.bands], window=rows)
        return np.ascontiguousarray(np.moveaxis(planes, 0, -1), self.dtype)


@contextmanager
def _tiff(rasterio: Any, path: Path) -> Iterator[Any]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)  # a scene lies on the camera's grid
        try:
            with rasterio.open(path) as file:
                yield file
        except rasterio.errors.RasterioError as error:
            raise SceneError(f"{path} cannot be read as TIFF: {error}; is it damaged?") from error


def _named_bands(names: list[str]) -> tuple[list[int], tuple[float, ...] | None, tuple[str, ...]]:
    """Which bands are kept (alpha is not), their wavelengths, and notes.

    Wavelengths are assumed only where the file names its bands red, green and blue, or grey.
    """
    keep = [index for index, name in enumerate(names) if name != "alpha"]
    notes = ("alpha channel dropped",) if len(keep) < len(names) else ()
    kinds = [names[index] for index in keep]
    assumed: tuple[float, ...] | None = None
    if kinds[:3] == ["red", "green", "blue"] and len(kinds) == 3:
        assumed = RGB_NM
    elif kinds[:3] == ["red", "green", "blue"] and len(kinds) == 4 and kinds[3] in ("undefined", "nir"):
        assumed = (*RGB_NM, NEAR_INFRARED_NM)
    elif kinds in (["gray"], ["palette"]):
        assumed = (GREY_NM,)
    return keep, assumed, notes


def _read_plain_tiff(path: Path) -> Raster:
    try:
        tifffile = importlib.import_module("tifffile")
    except ImportError as error:
        raise SceneError(
            f"{path} is a TIFF, which needs rasterio; pip install 'spectralzoom[geo]', or save it as .npy"
        ) from error
    with tifffile.TiffFile(path) as file:
        page = file.pages[0]
        series = file.series[0]
        values, axes = series.asarray(), series.axes
        rgb, extra = page.photometric.name == "RGB", [kind.name for kind in page.extrasamples or ()]
        nodata = page.tags.valueof(42113)
    if values.ndim == 3 and axes.index("Y") == 1:
        values = np.moveaxis(values, 0, -1)
    count = 1 if values.ndim == 2 else values.shape[2]
    names = ["red", "green", "blue"] if rgb else ["gray"]
    names += ["alpha" if "ALPHA" in kind else "undefined" for kind in extra]
    names += ["undefined"] * (count - len(names))
    void = None if nodata is None else float(nodata)
    keep, assumed, notes = _named_bands(names[:count])
    return Raster(values.reshape(*values.shape[:2], count)[..., keep], assumed, void, notes)


# --- files with several arrays ----------------------------------------------------------------------------------------


def _npz_arrays(path: Path) -> dict[str, NDArray[Any]]:
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def is_hdf_mat(path: Path) -> bool:
    """Whether a .mat file is of version 7.3, which is HDF5 behind 512 bytes of MATLAB's own."""
    with path.open("rb") as file:
        head = file.read(520)
    return b"\x89HDF\r\n\x1a\n" in (head[:8], head[512:])


def _mat_arrays(path: Path, wanted: str | None) -> dict[str, NDArray[Any]]:
    """All arrays of numbers; only the one wanted, where it is there."""
    if is_hdf_mat(path):
        return _hdf_arrays(path)
    read = importlib.import_module("scipy.io").loadmat
    content = {} if wanted is None else read(path, variable_names=[wanted])
    if wanted is None or wanted not in content:
        content = read(path)
    arrays = {name: value for name, value in content.items() if isinstance(value, np.ndarray)}
    return {name: value for name, value in arrays.items() if value.dtype.kind in "buifc"}


def _hdf_arrays(path: Path) -> dict[str, NDArray[Any]]:
    try:
        h5py = importlib.import_module("h5py")
    except ImportError as error:
        raise SceneError(f"{path} is MATLAB 7.3, which needs h5py; pip install h5py, or save it with -v7") from error
    with h5py.File(path, "r") as file:
        # MATLAB counts axes from the other end than HDF5
        return {name: np.asarray(file[name]).T for name in file if _is_own(file, name, h5py)}


def _is_own(file: Any, name: str, h5py: Any) -> bool:
    """Whether a name is a data set of numbers kept in this very file: others may lead anywhere on the disk."""
    if not isinstance(file.get(name, getlink=True), h5py.HardLink):
        return False
    item = file[name]
    return isinstance(item, h5py.Dataset) and not item.external and not item.is_virtual and item.dtype.kind in "buifc"


def _pick(arrays: dict[str, NDArray[Any]], path: Path, variable: str | None, dims: int) -> NDArray[Any]:
    listing = ", ".join(f"{name} {value.shape}" for name, value in arrays.items()) or "none"
    if variable is not None:
        if variable not in arrays:
            raise SceneError(f"{path} has no array {variable}; it has {listing}")
        return arrays[variable]
    for wanted in (dims, 5 - dims):
        fitting = [name for name, value in arrays.items() if value.ndim == wanted and value.size > 1]
        if len(fitting) == 1:
            return arrays[fitting[0]]
        if fitting:
            break
    raise SceneError(f"{path} has no single array with {dims} axes; it has {listing}; name one: {path.name}:VARIABLE")
