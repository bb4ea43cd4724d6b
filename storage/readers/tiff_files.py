"""TIFF files: through rasterio, some rows at a time, or whole through tifffile where that is all there is.

Several images of one size in a file are its bands, in their order: so cameras that know no bands write cubes.
"""

from __future__ import annotations

import importlib
import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from storage.readers.cube_sources import GREY_NM, NEAR_INFRARED_NM, RGB_NM, Raster, check_claim, check_memory

TIFF_ENDINGS = (".tif", ".tiff")
_NODATA_TAG = 42113  # GDAL's
_ROWS = 64  # about as many as are read at a time


@dataclass(frozen=True)
class TiffRows:
    """A TIFF, opened: (y, x, band) of ``dtype``, without its alpha channel."""

    path: Path
    shape: tuple[int, int, int]
    dtype: np.dtype[Any]
    bands: tuple[tuple[str, tuple[int, ...]], ...]  # image of the file, and those of its bands, counted from 0
    assumed_nm: tuple[float, ...] | None
    nodata: float | None
    notes: tuple[str, ...]

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Rows ``start`` to ``stop`` (SceneError where they are damaged)."""
        rasterio = importlib.import_module("rasterio")
        rows = rasterio.windows.Window(0, start, self.shape[1], stop - start)
        planes = []
        for image, bands in self.bands:
            with _tiff(rasterio, self.path, image) as file:
                planes.append(file.read([band + 1 for band in bands], window=rows))
        return np.ascontiguousarray(np.moveaxis(np.concatenate(planes), 0, -1), self.dtype)


def open_tiff_rows(path: Path) -> TiffRows | None:
    """Open a TIFF to be read some rows at a time; None where rasterio, which can do so, is not installed.

    Raises SceneError: the file is missing or damaged, or claims more than its bytes can mean.
    """
    try:
        rasterio = importlib.import_module("rasterio")
    except ImportError:
        return None
    if not path.is_file():
        raise SceneError(f"there is no file {path}; check the name (seen from {Path.cwd()})")
    with _tiff(rasterio, path, str(path)) as file:
        images, notes = _images(rasterio, path, file)
        keep, assumed, more = _named_bands([kind.name for kind in file.colorinterp])
        kind = np.result_type(*(np.dtype(file.dtypes[band]) for band in keep or [0]))
        bands = tuple((image, tuple(keep)) for image in images)
        shape = (file.height, file.width, len(keep) * len(images))
        check_claim(path, math.prod(shape) * kind.itemsize, path.stat().st_size)
        block = math.prod(max(file.block_shapes)) * file.count * kind.itemsize
        check_memory(path, block + min(_ROWS, shape[0]) * shape[1] * shape[2] * kind.itemsize)
        assumed = assumed if len(images) == 1 else None
        return TiffRows(path, shape, kind, bands, assumed, file.nodata, (*notes, *more))


def read_tiff(path: Path) -> Raster:
    """Read a whole TIFF (SceneError as for :func:`open_tiff_rows`)."""
    rows = open_tiff_rows(path)
    if rows is None:
        return _read_plain_tiff(path)
    check_memory(path, 2 * math.prod(rows.shape) * rows.dtype.itemsize)
    return Raster(rows.read(0, rows.shape[0]), rows.assumed_nm, rows.nodata, rows.notes)


def _images(rasterio: Any, path: Path, first: Any) -> tuple[list[str], tuple[str, ...]]:
    """Names of the images that are bands of one cube; the first alone where another is of another kind."""
    names = list(first.subdatasets)
    if len(names) < 2:
        return [str(path)], ()
    for name in names:
        with _tiff(rasterio, path, name) as other:
            if (other.shape, other.dtypes) != (first.shape, first.dtypes):
                return [str(path)], (f"the first of {len(names)} images in the file, which are of several kinds",)
    return names, (f"{len(names)} images of one size in the file are taken as its bands",)


@contextmanager
def _tiff(rasterio: Any, path: Path, image: str) -> Iterator[Any]:
    """One image of a file, as TIFF and nothing else: other formats of GDAL's may name any file or server."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)  # a scene lies on the camera's grid
        try:
            with rasterio.open(image, driver="GTiff") as file:
                yield file
        except SceneError:
            raise
        except Exception as error:  # decoders raise anything at all on damaged bytes
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
    with tifffile.TiffFile(path, _multifile=False) as file:  # headers may name other files
        page = file.pages[0]
        series = file.series[0]
        check_claim(path, int(series.nbytes), path.stat().st_size)
        check_memory(path, 2 * int(series.nbytes))
        values, axes = series.asarray(), series.axes
        rgb, extra = page.photometric.name == "RGB", [kind.name for kind in page.extrasamples or ()]
        nodata = page.tags.valueof(_NODATA_TAG)
    if values.ndim == 3 and axes.index("Y") == 1:
        values = np.moveaxis(values, 0, -1)
    count = 1 if values.ndim == 2 else values.shape[2]
    names = ["red", "green", "blue"] if rgb else ["gray"]
    names += ["alpha" if "ALPHA" in kind else "undefined" for kind in extra]
    names += ["undefined"] * (count - len(names))
    void = None if nodata is None else float(nodata)
    keep, assumed, notes = _named_bands(names[:count])
    return Raster(values.reshape(*values.shape[:2], count)[..., keep], assumed, void, notes)
