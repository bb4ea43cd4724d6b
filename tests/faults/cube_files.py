"""Small files of every format that is read, to be mutated, and one reading of an arbitrary file.

A reading has a time limit, and its memory is traced.
"""

from __future__ import annotations

import signal
import time
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from PIL import Image

from spectralzoom.pipeline.errors import PipelineError
from spectralzoom.storage.readers.open_cubes import open_cube_source
from tests.envi_files import listed, write_cube

SHAPE = (20, 12, 5)
LONGEST_S = 30  # longer readings count as hanging


def _cube() -> Any:
    return np.random.default_rng(0).integers(0, 4096, SHAPE, dtype=np.uint16)


def _envi(folder: Path) -> str:
    bands = {"wavelength units": "Nanometers", "wavelength": listed(np.linspace(400, 800, SHAPE[2]))}
    write_cube(folder / "a.hdr", _cube(), "u2", **bands)
    return "a.hdr"


def _headwall(folder: Path) -> str:
    for first in (0, 10):
        write_cube(folder / "part.hdr", _cube()[first : first + 10], "u2")
        (folder / "part.hdr").rename(folder / f"raw_{first}.hdr")
        (folder / "part.img").rename(folder / f"raw_{first}")
        rows = "".join(f"{frame}\t{1000 + 10 * frame}\n" for frame in range(first, first + 10))
        (folder / f"frameIndex_{first}.txt").write_text("Frame#\tTimestamp\n" + rows)
    write_cube(folder / "darkReference.hdr", _cube()[:1] // 8, "u2")
    return "."


def _npy(folder: Path) -> str:
    np.save(folder / "a.npy", _cube())
    return "a.npy"


def _mat(folder: Path, **how: Any) -> str:
    from scipy.io import savemat

    savemat(folder / "a.mat", {"cube": _cube(), "name": "x", "cell": np.array([1, "a"], object)}, **how)
    return "a.mat"


def _mat_hdf(folder: Path) -> str:
    import h5py

    with h5py.File(folder / "a.mat", "w", userblock_size=512) as file:
        file.create_dataset("cube", data=_cube().T, chunks=(5, 6, 10), compression="gzip")
        file["more"] = np.arange(9)
    return "a.mat"


def _deep_png(folder: Path) -> str:
    import cv2

    cv2.imwrite(str(folder / "a.png"), _cube()[..., :3])
    return "a.png"


def _image(folder: Path, name: str) -> str:
    Image.fromarray((_cube()[..., :3] >> 4).astype(np.uint8)).save(folder / name)
    return name


def _tiff(folder: Path, values: Any, **how: Any) -> str:
    from tifffile import imwrite

    imwrite(folder / "a.tif", values, photometric="minisblack", **how)
    return "a.tif"


def _zarr(folder: Path, version: int) -> str:
    import zarr

    group = zarr.open_group(folder / "a.zarr", mode="w", zarr_format=2 if version == 2 else 3)
    more: Any = {} if version == 2 else {"shards": (20, 12, 5), "dimension_names": ("y", "x", "band")}
    group.create_array("cube", data=_cube(), chunks=(10, 12, 5), **more)
    group.create_array("wavelength", data=np.linspace(400, 800, SHAPE[2])).attrs["units"] = "nm"
    return "a.zarr"


def _netcdf(folder: Path) -> str:
    import xarray as xr

    cube = xr.DataArray(_cube(), dims=("y", "x", "wl"), name="cube").astype("i4").to_dataset()
    packing = {"cube": {"zlib": True, "chunksizes": (10, 6, 5)}}
    cube = cube.assign_coords(wl=("wl", np.linspace(400, 800, SHAPE[2]), {"units": "nm"}))
    cube.to_netcdf(folder / "a.nc", engine="h5netcdf", encoding=packing)
    return "a.nc"


def _jpeg_2000(folder: Path) -> str:
    import rasterio

    with rasterio.open(
        folder / "a.jp2", "w", "JP2OpenJPEG", SHAPE[1], SHAPE[0], 3, dtype="uint16", QUALITY="100", REVERSIBLE="YES"
    ) as file:
        file.write(np.moveaxis(_cube()[..., :3], -1, 0))
    return "a.jp2"


FORMATS: dict[str, Callable[[Path], str]] = {
    "ENVI": _envi,
    "Headwall folder": _headwall,
    ".npy": _npy,
    ".mat v5": lambda folder: _mat(folder),
    ".mat v7": lambda folder: _mat(folder, do_compression=True),
    ".mat v7.3": _mat_hdf,
    "PNG": lambda folder: _image(folder, "a.png"),
    "PNG 16 bit": _deep_png,
    "JPEG": lambda folder: _image(folder, "a.jpg"),
    "BMP": lambda folder: _image(folder, "a.bmp"),
    "TIFF strips": lambda folder: _tiff(folder, _cube(), planarconfig="contig", rowsperstrip=4),
    "TIFF tiles": lambda folder: _tiff(folder, _cube(), planarconfig="contig", tile=(16, 16), compression="zlib"),
    "TIFF pages": lambda folder: _tiff(folder, np.moveaxis(_cube(), -1, 0), compression="zlib"),
    "Zarr v2": lambda folder: _zarr(folder, 2),
    "Zarr v3": lambda folder: _zarr(folder, 3),
    "NetCDF 4": _netcdf,
    "JPEG 2000": _jpeg_2000,
}


class TookTooLongError(Exception):
    """The reading of a file took longer than its limit."""


@contextmanager
def at_most(seconds: int) -> Iterator[None]:
    """Raise TookTooLongError in the block after so many seconds; only in the main thread."""

    def ring(signum: int, frame: FrameType | None) -> None:
        raise TookTooLongError(f"more than {seconds} s")

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@dataclass(frozen=True)
class Reading:
    """The result of opening and reading one source."""

    refused: str | None  # class of an error that has a message
    wrong: str | None  # a result that no reading may have
    seconds: float
    peak_bytes: int


def try_reading(address: Path) -> Reading:
    """Open a source, and read its first and last lines."""
    tracemalloc.start()
    begun = time.monotonic()
    refused = None
    wrong = None
    try:
        with at_most(LONGEST_S):
            source = open_cube_source(address)
            held = int(source.valid.sum())
            source.read(0, min(held, 64))
            source.read(max(held - 64, 0), held)
    except PipelineError as error:
        refused = type(error).__name__
        wrong = "an error without words" if not str(error) or "Traceback" in str(error) else None
    except BaseException as error:
        wrong = f"{type(error).__name__}: {str(error)[:200]}"
    seconds = time.monotonic() - begun
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return Reading(refused, wrong, seconds, peak)
