"""Formats against second readers: equal values, wavelengths and place, and speed; and a large BIL cube."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import odc.geo.geobox as odc_geobox
import rasterio
import scipy.io
import spectral
import xarray as xr
import zarr
from measure import Row, ratio, time_in_turn
from numpy.typing import NDArray
from odc.geo.xr import xr_coords
from PIL import Image

import spectralzoom

SHAPE = 256, 320, 120  # (y, x, band)
LARGE_LINES = 3200  # of 640 samples and 270 bands of 16 bits: 1.1 GB
BLOCK = 64
NM = np.linspace(400, 1000, SHAPE[2])
GRID = odc_geobox.GeoBox(SHAPE[:2], rasterio.transform.from_origin(5e5, 5e6, 2, 2), "EPSG:32632")
Read = Callable[[], NDArray[Any]]


@dataclass(frozen=True)
class Format:
    """One file, and how another reader gives its values (y, x, band) and the transform of its place."""

    name: str
    path: Path
    reader: str
    read: Read
    nm: NDArray[np.float64] | None = None
    transform: Any = None


def rows() -> list[Row]:
    with tempfile.TemporaryDirectory() as name, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        cube = np.random.default_rng(0).integers(1, 4000, SHAPE).astype(np.uint16)
        return [*map(_compared, _formats(Path(name), cube)), *_large(Path(name))]


def _compared(one: Format) -> Row:
    """Compare one file's content by both readers, and their time."""
    cube = spectralzoom.open_cube(one.path)
    bands = cube.file_band.values  # sorted by wavelength
    values = np.array_equal(cube.values, one.read()[..., bands], equal_nan=True)
    rising = one.nm is None or np.allclose(cube.wavelength, one.nm)
    place = one.transform is None or cube.odc.geobox.affine.almost_equals(one.transform)
    clocks = time_in_turn({"ours": lambda: spectralzoom.open_cube(one.path).values, "other": one.read}, 3)
    parts = {"values": values, "wavelengths": rising if one.nm is not None else None}
    parts["place"] = place if one.transform is not None else None
    equal = ", ".join(f"{name} {'equal' if found else 'DIFFER'}" for name, found in parts.items() if found is not None)
    more = f"{one.reader}; our time over its {ratio(clocks, 'ours', 'other'):.2f}"
    return Row(one.name, equal, "equal", values and rising and place, more)


def _formats(folder: Path, cube: NDArray[np.uint16]) -> Iterator[Format]:
    about = {"wavelength": NM.tolist(), "wavelength units": "nm"}
    place = "{UTM, 1, 1, 500000, 5000000, 2, 2, 32, North, WGS-84, units=Meters}"
    for kind in ("bil", "bip", "bsq"):
        path = folder / f"{kind}.hdr"
        metadata = {**about, "map info": place}
        spectral.envi.save_image(str(path), cube, interleave=kind, ext="img", metadata=metadata, force=True)

        def read_envi(path: Path = path) -> NDArray[Any]:
            return np.asarray(spectral.open_image(str(path)).load(dtype=np.uint16))

        yield Format(f"ENVI {kind}", path, "SPy", read_envi, NM, GRID.affine)
    size = {"height": SHAPE[0], "width": SHAPE[1], "count": SHAPE[2], "dtype": "uint16"}
    for name, driver, more in (
        ("GeoTIFF, strips", "GTiff", {}),
        ("GeoTIFF, tiles and deflate", "GTiff", {"tiled": True, "compress": "deflate"}),
        ("JPEG 2000", "JP2OpenJPEG", {"QUALITY": 100, "REVERSIBLE": "YES"}),
    ):
        path = folder / f"{name.replace(', ', '_').replace(' ', '_')}.{'jp2' if driver[0] == 'J' else 'tif'}"
        bands = 4 if driver[0] == "J" else SHAPE[2]
        options = {**size, "count": bands, "crs": "EPSG:32632", "transform": GRID.affine, **more}
        with rasterio.open(path, "w", driver, **options) as file:
            file.write(np.moveaxis(cube[..., :bands], -1, 0))
            for band, nm in enumerate(NM[:bands] if driver == "GTiff" else (), 1):
                file.update_tags(band, ns="IMAGERY", CENTRAL_WAVELENGTH_UM=f"{nm / 1000:.9g}")

        def read_tiff(path: Path = path) -> NDArray[Any]:
            with rasterio.open(path) as file:
                return np.moveaxis(file.read(), 0, -1)

        yield Format(name, path, "rasterio", read_tiff, NM if driver == "GTiff" else None, GRID.affine)
    Image.fromarray(cube[..., :3].astype(np.uint8)).save(folder / "a.png")
    yield Format("PNG", folder / "a.png", "Pillow", lambda: np.asarray(Image.open(folder / "a.png")))
    data = xr.DataArray(cube * 0.25, dims=("y", "x", "band"), attrs={"grid_mapping": "spatial_ref"})
    coordinates = {"wavelength": ("band", NM, {"units": "nm"}), **xr_coords(GRID)}
    placed = data.to_dataset(name="cube").assign_coords(coordinates)
    packed = {"cube": {"dtype": "i2", "scale_factor": np.float32(0.25), "_FillValue": -1}}
    engines: dict[str, tuple[str, Callable[[Path], object]]] = {
        "NetCDF 3": ("3.nc", lambda path: placed.to_netcdf(path, engine="scipy", encoding=packed)),
        "NetCDF 4": ("4.nc", lambda path: placed.to_netcdf(path, engine="h5netcdf", encoding=packed)),
        "Zarr 2": ("2.zarr", lambda path: placed.to_zarr(path, zarr_format=2, encoding=packed)),
        "Zarr 3": ("3.zarr", lambda path: placed.to_zarr(path, encoding=packed, consolidated=False)),
    }
    for name, (file_name, write) in engines.items():
        write(folder / file_name)

        def read_cf(path: Path = folder / file_name) -> NDArray[Any]:
            engine = {"3.nc": "scipy", "4.nc": "h5netcdf"}.get(path.name, "zarr")
            with xr.open_dataset(path, engine=engine) as opened:
                return np.asarray(opened["cube"].values, np.float32)

        yield Format(name, folder / file_name, "xarray", read_cf, NM, GRID.affine)
    with h5py.File(folder / "a.h5", "w") as file:
        file.create_dataset("cube", data=cube, chunks=(16, 64, SHAPE[2]), compression="gzip", shuffle=True)
        file["wavelength"] = NM
    yield Format("HDF5, deflate", folder / "a.h5", "h5py", lambda: h5py.File(folder / "a.h5")["cube"][:], NM)
    scipy.io.savemat(folder / "a.mat", {"cube": cube}, do_compression=True)
    yield Format("MATLAB 5", folder / "a.mat", "scipy", lambda: scipy.io.loadmat(folder / "a.mat")["cube"])
    np.save(folder / "a.npy", cube)
    yield Format(".npy", folder / "a.npy", "numpy", lambda: np.load(folder / "a.npy"))
    zarr.create_array(path := folder / "plain.zarr", data=cube)
    yield Format("Zarr, bare array", path, "zarr", lambda: np.asarray(zarr.open_array(path)[...]))


def _large(folder: Path) -> list[Row]:
    """Read a large BIL cube block by block, beside a memory map of numpy's."""
    shape = LARGE_LINES, 640, 270
    data = folder / "large.img"
    with data.open("wb") as file:
        for first in range(0, LARGE_LINES, BLOCK):
            file.write(np.full((BLOCK, shape[2], shape[1]), first, "<u2").tobytes())
    header = f"ENVI\nsamples = {shape[1]}\nlines = {shape[0]}\nbands = {shape[2]}\ndata type = 12\ninterleave = bil\n"
    data.with_suffix(".hdr").write_text(header + "byte order = 0\n")

    def ours() -> None:
        cube = spectralzoom.open_cube(data)
        for first in range(0, LARGE_LINES, BLOCK):
            _ = cube[first : first + BLOCK].values

    def plain() -> None:
        mapped = np.memmap(data, "<u2", "r", shape=(shape[0], shape[2], shape[1]))
        for first in range(0, LARGE_LINES, BLOCK):
            np.ascontiguousarray(np.swapaxes(mapped[first : first + BLOCK], 1, 2))

    def gdal() -> None:
        with rasterio.open(data, driver="ENVI") as file:
            for first in range(0, LARGE_LINES, BLOCK):
                planes = file.read(window=((first, first + BLOCK), (0, shape[1])))
                np.ascontiguousarray(np.moveaxis(planes, 0, -1))

    clocks = time_in_turn({"ours": ours, "plain": plain, "gdal": gdal}, 5)
    size = data.stat().st_size
    what = f"BIL cube of {size / 1e9:.1f} GB, {BLOCK} lines at a time: time over numpy's memory map"
    own = ratio(clocks, "ours", "plain")
    rate = size / 1e6 / clocks["ours"].cpu_min_s
    return [
        Row(what, f"{own:.2f}", "<= 1.1", own <= 1.1, f"{rate:.0f} MB/s; GDAL {ratio(clocks, 'gdal', 'plain'):.1f}")
    ]
