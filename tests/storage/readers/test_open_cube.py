"""open_cube: one xarray.DataArray (y, x, band) for every kind of file, read when it is needed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import odc.geo.xr  # noqa: F401 - the accessor of places
import pytest
import rasterio
import rasterio.transform
import scipy.io
import spectral
import xarray as xr
import zarr

import spectralzoom
from spectralzoom.pipeline.errors import SceneError

CUBE = np.random.default_rng(1).integers(1, 4000, (7, 6, 5)).astype(np.uint16)
NM = np.array([450.0, 550.0, 660.0, 800.0, 900.0])


def write_geotiff(path: Path) -> None:
    place = {"crs": "EPSG:32632", "transform": rasterio.transform.from_origin(5e5, 5e6, 2, 2)}
    with rasterio.open(path, "w", "GTiff", count=5, height=7, width=6, dtype="uint16", **place) as file:
        file.write(np.moveaxis(CUBE, -1, 0))
        for band, nm in enumerate(NM, 1):
            file.update_tags(band, ns="IMAGERY", CENTRAL_WAVELENGTH_UM=nm / 1000)


def write_netcdf(path: Path) -> None:
    data = xr.Dataset({"cube": (("band", "y", "x"), np.moveaxis(CUBE, -1, 0))})
    data.assign_coords(wavelength=("band", NM, {"units": "nm"})).to_netcdf(path, engine="h5netcdf")


def write_hdf(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["cube"], file["wavelength"] = CUBE, NM


def write_matlab_73(path: Path) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        file["cube"] = CUBE.T


def write_zarr(path: Path) -> None:
    group = zarr.create_group(path)
    group.create_array("cube", data=CUBE, chunks=(3, 6, 5), dimension_names=("y", "x", "band"))
    group.create_array("wavelength", data=NM, dimension_names=("band",))


KINDS: dict[str, Callable[[Path], object]] = {
    "a.hdr": lambda path: spectral.envi.save_image(
        str(path), CUBE, ext="img", interleave="bil", metadata={"wavelength": NM.tolist(), "wavelength units": "nm"}
    ),
    "a.tif": write_geotiff,
    "a.nc": write_netcdf,
    "a.h5": write_hdf,
    "a.zarr": write_zarr,
    "a.mat": lambda path: scipy.io.savemat(path, {"cube": CUBE}),
    "a73.mat": write_matlab_73,
    "a.npy": lambda path: np.save(path, CUBE),
}


@pytest.mark.parametrize("name", KINDS)
def test_every_kind_is_one_data_array(tmp_path: Path, name: str) -> None:
    """Any part equals that of the array which was written; wavelengths and place are coordinates."""
    KINDS[name](tmp_path / name)
    cube = spectralzoom.open_cube(tmp_path / name)
    assert cube.dims == ("y", "x", "band")
    np.testing.assert_array_equal(cube.values, CUBE)
    np.testing.assert_array_equal(cube[2].values, CUBE[2])
    np.testing.assert_array_equal(cube[5:1:-2, 1:, [3, 0]].values, CUBE[5:1:-2, 1:, [3, 0]])
    np.testing.assert_array_equal(cube.isel(y=slice(0, 0)).values, CUBE[:0])
    if name not in ("a.mat", "a73.mat", "a.npy"):
        np.testing.assert_allclose(cube.wavelength, NM)
        np.testing.assert_array_equal(cube.sel(wavelength=670, method="nearest"), CUBE[..., 2])
    assert (cube.odc.crs is not None) == (name == "a.tif")


def test_bands_of_two_detectors_are_sorted(tmp_path: Path) -> None:
    """Values, widths and bad bands go with their wavelengths; equal centres stay; cubes with gaps keep their order."""
    nm = [450, 550, 660, 550, 700]
    about = {"wavelength": nm, "fwhm": [5, 6, 7, 8, 9], "bbl": [1, 1, 0, 1, 1]}
    spectral.envi.save_image(str(tmp_path / "a.hdr"), CUBE, ext="img", metadata=about)
    cube = spectralzoom.open_cube(tmp_path / "a.hdr")
    np.testing.assert_array_equal(cube.values, CUBE[..., [0, 1, 3, 2, 4]])
    assert cube.detector.values.tolist() == [0, 0, 1, 0, 1]
    assert (cube.fwhm.values.tolist(), cube.bad_band.values.tolist()) == ([5, 6, 8, 7, 9], [False] * 3 + [True, False])
    np.testing.assert_array_equal(cube.sel(wavelength=slice(540, 560)), CUBE[..., [1, 3]])
    gaps = {"wavelength": [900, "nan", 660, 550, 450]}
    spectral.envi.save_image(str(tmp_path / "b.hdr"), CUBE, ext="img", metadata=gaps)
    np.testing.assert_array_equal(spectralzoom.open_cube(tmp_path / "b.hdr").values, CUBE)


@pytest.mark.parametrize("shape", [(7, 6), (6, 7)])
@pytest.mark.parametrize("bands_first", [True, False])
@pytest.mark.parametrize("words", [("nRow", "nCol"), ("lines", "samples"), ("H", "W"), ("row", "col"), ("nr", "nc")])
def test_a_table_of_matlab_is_a_cube(tmp_path: Path, shape: tuple[int, int], bands_first: bool, words: tuple) -> None:
    """Sizes beside it give its rows and columns; pixels go down the columns, and a note says so."""
    picture = CUBE.reshape(*shape, 5)
    table = picture.reshape(-1, 5, order="F")
    sizes = dict(zip(words, shape, strict=True))
    content = {"Y": table.T if bands_first else table, **sizes, "maxValue": 4000.0}
    scipy.io.savemat(tmp_path / "a.mat", content)
    with h5py.File(tmp_path / "b.mat", "w") as file:  # version 7.3 has the axes in reverse
        for key, value in content.items():
            file[key] = np.atleast_2d(value).T
    for name in ("a.mat", "b.mat"):
        cube = spectralzoom.open_cube(tmp_path / name)
        np.testing.assert_array_equal(cube.values, picture)
        assert any("pixels go down columns" in note for note in cube.notes)


def test_sizes_that_fit_no_table_change_nothing(tmp_path: Path) -> None:
    """A table of spectra without its picture's size is refused with the way to store a cube."""
    scipy.io.savemat(tmp_path / "a.mat", {"Y": np.ones((5, 4200)), "nRow": 7, "nCol": 7})
    with pytest.raises(SceneError, match="is a table of 5 x 4200 numbers"):
        spectralzoom.open_cube(tmp_path / "a.mat")
