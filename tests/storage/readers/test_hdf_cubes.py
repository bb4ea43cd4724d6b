"""NetCDF and HDF5 cubes: published layouts of EMIT, PRISMA and NEON, CF files of xarray, and damaged files."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import h5py
import numpy as np
import pytest
import rasterio
import rasterio.shutil
import rasterio.transform
import rioxarray  # noqa: F401 - registers the accessor that writes a place
import xarray as xr
from numpy.typing import NDArray

from pipeline.errors import SceneError, WavelengthError
from storage.readers.cube_sources import read_by_chunks
from storage.readers.open_cubes import open_cube
from storage.readers.scene_files import load_scene_file
from tests.storage.readers.test_raster_tags import write as write_bands

RNG = np.random.default_rng(5)
NM = np.array([450.0, 550.0, 660.0, 800.0, 900.0])
CUBE = RNG.integers(1, 9000, (7, 6, 5)).astype(np.int16)  # (y, x, band)
CORNER = 400_000.0, 5_700_000.0  # upper left, of pixels of 2 m


def emit_file(path: Path) -> NDArray[np.float32]:
    """Write EMIT L2A reflectance: (downtrack, crosstrack, bands), groups of wavelengths and of geolocation."""
    values = (CUBE / 9000).astype(np.float32)
    values[2, 3] = -9999
    root = xr.Dataset(
        {"reflectance": (("downtrack", "crosstrack", "bands"), values, {"units": "unitless", "long_name": "R"})},
        attrs={"geotransform": [10.0, 0.0005, 0.0, 50.0, 0.0, -0.0005], "spatial_ref": 'GEOGCS["WGS 84"]'},
    )
    bands = {
        "wavelengths": (("bands",), NM.astype(np.float32), {"units": "nm"}),
        "fwhm": (("bands",), np.full(5, 8.5, np.float32), {"units": "nm"}),
        "good_wavelengths": (("bands",), np.array([1, 1, 0, 1, 1], np.float32)),
    }
    table = {name: (("ortho_y", "ortho_x"), np.ones((9, 9), np.int32)) for name in ("glt_x", "glt_y")}
    groups = {"/": root, "/sensor_band_parameters": xr.Dataset(bands), "/location": xr.Dataset(table)}
    packed = {"/": {"reflectance": {"_FillValue": np.float32(-9999), "zlib": True, "chunksizes": (4, 3, 5)}}}
    xr.DataTree.from_dict(groups).to_netcdf(path, engine="h5netcdf", encoding=packed)
    return values


def test_emit_reflectance_is_read(tmp_path: Path) -> None:
    """Values, wavelengths, widths and bad bands are EMIT's; a note says that there is no map grid."""
    values = emit_file(tmp_path / "emit.nc")
    source = open_cube(tmp_path / "emit.nc")
    assert (source.shape, source.nodata, source.bad_bands) == ((7, 6, 5), -9999.0, (2,))
    scene = load_scene_file(tmp_path / "emit.nc")
    np.testing.assert_array_equal(scene.wavelength_nm, NM[[0, 1, 3, 4]])
    np.testing.assert_array_equal(scene.fwhm_nm, 8.5)
    read = xr.open_dataset(tmp_path / "emit.nc", engine="h5netcdf")["reflectance"].values
    np.testing.assert_array_equal(scene.values, read[..., [0, 1, 3, 4]])
    assert np.isnan(scene.values[2, 3]).all()
    assert values[2, 3, 0] == -9999
    assert scene.geobox is None
    assert any("sensor's own geometry" in note for note in scene.provenance)


def neon_file(path: Path, **about: Any) -> None:
    """Write NEON AOP reflectance: int16 (y, x, band) without named axes, everything else below Metadata."""
    with h5py.File(path, "w") as file:
        data = file.create_dataset("SERC/Reflectance/Reflectance_Data", data=CUBE, chunks=(2, 2, 5))
        data[1, 1] = -9999
        data.attrs.update({"Scale_Factor": 10000.0, "Data_Ignore_Value": -9999.0, **about})
        below = file.create_group("SERC/Reflectance/Metadata")
        spectra = below.create_group("Spectral_Data")
        spectra.create_dataset("Wavelength", data=NM).attrs["Units"] = "nanometers"
        spectra.create_dataset("FWHM", data=np.full(5, 5.8))
        below.create_dataset("Ancillary_Imagery/Weather_Quality_Indicator", data=np.zeros((7, 6, 3), np.uint8))
        info = "UTM, 1.000, 1.000, 400000.00, 5700000.0, 2.0, 2.0, 32, North, WGS-84, units=Meters, 0"
        below.create_dataset("Coordinate_System/Map_Info", data=info)
        below.create_dataset("Coordinate_System/EPSG Code", data="32632")


def test_neon_reflectance_is_read(tmp_path: Path) -> None:
    """Values are divided by their scale, no-data is NaN, and the grid comes from the map info."""
    neon_file(tmp_path / "NEON_SERC.h5")
    scene = load_scene_file(tmp_path / "NEON_SERC.h5")
    expected = CUBE / 10000
    expected[1, 1] = np.nan
    np.testing.assert_allclose(scene.values, expected, rtol=1e-6)
    np.testing.assert_array_equal(scene.wavelength_nm, NM)
    assert scene.fwhm_nm is not None
    assert scene.geobox.crs.epsg == 32632
    assert scene.geobox.affine[:6] == (2.0, 0.0, CORNER[0], 0.0, -2.0, CORNER[1])
    with rasterio.open(f"HDF5:{tmp_path / 'NEON_SERC.h5'}://SERC/Reflectance/Reflectance_Data") as other:
        assert other.count == 7  # GDAL takes the first axis for bands
        np.testing.assert_array_equal(other.read(1)[3], CUBE[0, 3])


def prisma_file(path: Path, level: str = "D", **about: Any) -> dict[str, NDArray[np.uint16]]:
    """Write PRISMA L2: (y, band, x) of two spectrometers, wavelengths descending, 0 for bands that are not used."""
    cubes = {"Vnir": RNG.integers(1, 65536, (7, 4, 6)), "Swir": RNG.integers(1, 65536, (7, 3, 6))}
    for cube in cubes.values():
        cube[0, :, 0] = 0  # outside the swath
    cubes["Vnir"][3, 2, 3] = 0  # a dark reading
    said: dict[str, Any] = {
        "List_Cw_Vnir": np.array([0, 977.4, 660.3, 450.1], np.float32),
        "List_Fwhm_Vnir": np.array([0, 13.0, 12.0, 11.0], np.float32),
        "List_Cw_Swir": np.array([2490.0, 943.4, 0], np.float32),
        "List_Fwhm_Swir": np.array([9.0, 10.0, 0], np.float32),
        **{f"L2Scale{part}{end}": value for part in ("Vnir", "Swir") for end, value in (("Min", 0.1), ("Max", 0.9))},
        "Epsg_Code": np.int64(32632),
        "Product_ULcorner_easting": 400_015.0,
        "Product_ULcorner_northing": 5_699_985.0,
        "Product_LRcorner_easting": 400_165.0,
        "Product_LRcorner_northing": 5_699_805.0,
    }
    with h5py.File(path, "w") as file:
        for part, cube in cubes.items():
            file[f"HDFEOS/SWATHS/PRS_L2{level}_HCO/Data Fields/{part.upper()}_Cube"] = cube.astype(np.uint16)
        file.attrs.update(said | about)
    return {part: cube.astype(np.uint16) for part, cube in cubes.items()}


def test_prisma_reflectance_is_read(tmp_path: Path) -> None:
    """Both spectrometers form one scaled cube by ascending wavelength; corners are centres of pixels of 30 m."""
    cubes = prisma_file(tmp_path / "PRS_L2D.he5")
    scene = load_scene_file(tmp_path / "PRS_L2D.he5")
    np.testing.assert_allclose(scene.wavelength_nm, [450.1, 660.3, 943.4, 977.4, 2490.0], rtol=1e-6)
    np.testing.assert_allclose(scene.fwhm_nm, [11, 12, 10, 13, 9])
    expected = np.stack([cubes["Vnir"][:, 3], cubes["Vnir"][:, 2], cubes["Swir"][:, 1], cubes["Vnir"][:, 1]], axis=-1)
    np.testing.assert_allclose(scene.values[1:, :, :4], 0.1 + expected[1:] / 65535 * 0.8, rtol=1e-6)
    assert np.isnan(scene.values[0, 0]).all()
    assert scene.values[3, 3, 1] == pytest.approx(0.1)  # 0 in one band is a value
    assert scene.geobox.crs.epsg == 32632
    assert scene.geobox.affine[:6] == (30.0, 0.0, 400_000.0, 0.0, -30.0, 5_700_000.0)
    assert "a PRISMA product of level 2D; 2 bands without a wavelength are left out" in scene.provenance


@pytest.mark.parametrize(
    ("dims", "unit", "scale"),
    [(("y", "x", "wl"), "nm", 1.0), (("wl", "y", "x"), "micrometer", 1e-3), (("y", "wl", "x"), "m", 1e-9)],
)
def test_cf_files_are_read(tmp_path: Path, dims: tuple[str, ...], unit: str, scale: float) -> None:
    """Any order of axes and unit of wavelengths gives the same scene: unpacked values, grid and units."""
    path = tmp_path / "cube.nc"
    packing = {"dtype": "i2", "scale_factor": 0.25, "add_offset": 3.0, "_FillValue": -1}
    values = CUBE.transpose([("y", "x", "wl").index(dim) for dim in dims]) * 0.25 + 3
    data = xr.DataArray(values, dims=dims, name="radiance", attrs={"units": "W m-2 sr-1 um-1"}).to_dataset()
    x, y = CORNER[0] + 1 + 2 * np.arange(6), CORNER[1] - 1 - 2 * np.arange(7)
    about_bands = {"units": unit, "standard_name": "radiation_wavelength"}
    data = data.assign_coords(wl=("wl", NM * scale, about_bands), x=x, y=y).rio.write_crs(32632)
    data.rio.write_coordinate_system().to_netcdf(path, engine="h5netcdf", encoding={"radiance": packing})
    scene = load_scene_file(path)
    with xr.open_dataset(path, engine="h5netcdf") as read:
        np.testing.assert_allclose(scene.values, read["radiance"].transpose("y", "x", "wl").values, rtol=1e-6)
    np.testing.assert_allclose(scene.wavelength_nm, NM)
    assert scene.geobox.crs.epsg == 32632
    assert scene.geobox.affine[:6] == (2.0, 0.0, CORNER[0], 0.0, -2.0, CORNER[1])
    assert "values are in W m-2 sr-1 um-1" in scene.provenance


def test_hdf5_without_dimension_names_is_read(tmp_path: Path) -> None:
    """The axis whose length is the number of wavelengths is the band; a note says which."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["cube"] = np.moveaxis(CUBE, -1, 0)
        file["wavelength"] = NM
    scene = load_scene_file(tmp_path / "a.h5")
    np.testing.assert_array_equal(scene.values, CUBE)
    assert "dims have no names, read as y, x and band: axis 0 (from 0) is band" in scene.provenance


def test_an_address_selects_variable_and_time_step(tmp_path: Path) -> None:
    """The name of the variable may be given with its groups or without."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["field/one"] = CUBE
        file["field/two"] = CUBE + 1
        file["wavelength"] = NM
        file["series/days"] = np.stack([CUBE, CUBE + 7])
    for name, more in (("field/one", 0), ("two", 1), ("series/days:1", 7)):
        np.testing.assert_array_equal(load_scene_file(f"{tmp_path / 'a.h5'}:{name}").values, CUBE + more)


def test_chunks_are_read_once(tmp_path: Path) -> None:
    """Lines read in order equal those read at once; each way reads every chunk once."""
    read = Mock(side_effect=lambda start, stop: CUBE[start:stop])
    lines = read_by_chunks(read, 7, 3)
    np.testing.assert_array_equal(np.concatenate([lines(at, min(at + 2, 7)) for at in range(0, 7, 2)]), CUBE)
    np.testing.assert_array_equal(lines(0, 7), CUBE)
    assert [call.args[0] for call in read.call_args_list] == [0, 3, 6, 0, 3, 6]


def hold(path: Path, name: str, value: Any) -> None:
    """Write an HDF5 file of one entry."""
    with h5py.File(path, "w") as file:
        file[name] = value


def lost_attribute(path: Path) -> None:
    prisma_file(path)
    with h5py.File(path, "r+") as file:
        del file.attrs["L2ScaleSwirMax"]


SHORT_LISTS = dict.fromkeys(("List_Cw_Vnir", "List_Fwhm_Vnir"), np.ones(3, np.float32))
LEVEL_1 = "HDFEOS/SWATHS/PRS_L1_HCO/Data Fields/VNIR_Cube"
NO_CUBE_AXES = xr.Dataset({"rain": (("level", "lat", "lon"), CUBE.astype(float))})


@pytest.mark.parametrize(
    ("write", "words"),
    [
        (lambda path: path.write_text("text"), "cannot be read as NetCDF or HDF5: it does not begin as HDF5.*nccopy"),
        (
            partial(NO_CUBE_AXES.to_netcdf, engine="h5netcdf"),
            r"has dims level, lat, lon; expected y, x, band \(or band, y, x\); rename them",
        ),
        (partial(hold, name="name", value="none"), "has no array of numbers with the axes y, x and band; it has none"),
        (lost_attribute, "cannot be read as NetCDF or HDF5: KeyError: .*L2ScaleSwirMax"),
        (partial(prisma_file, **SHORT_LISTS), r"expected one size \(y, x\) and \[3, 3\] bands, as it has wavelengths"),
        (partial(hold, name=LEVEL_1, value=np.ones((7, 4, 6), "u2")), "is no PRISMA product of level 2B, 2C or 2D"),
    ],
)
def test_unusable_hdf_files_raise_one_error(write: Any, words: str, tmp_path: Path) -> None:
    """The files are damaged, inconsistent, without a cube, or of another product."""
    write(tmp_path / "bad.h5")
    with pytest.raises((SceneError, WavelengthError), match=words):
        load_scene_file(tmp_path / "bad.h5")


def test_rows_from_south_to_north_have_gdals_position(tmp_path: Path) -> None:
    """GDAL writes the southern row first, under the GeoTransform of the upright image."""
    values = np.arange(12, dtype=np.float32).reshape(3, 4)
    upright = rasterio.transform.from_origin(500_000, 5_000_030, 10, 10)
    write_bands(tmp_path / "a.tif", values[None], crs="EPSG:32632", transform=upright).close()
    rasterio.shutil.copy(tmp_path / "a.tif", tmp_path / "a.nc", driver="netCDF", FORMAT="NC4")
    cube = open_cube(f"{tmp_path / 'a.nc'}:Band1")
    assert cube.geobox.affine.to_gdal() == (500_000, 10, 0, 5_000_000, 0, 10)
    assert np.array_equal(cube.read(0, 3)[::-1, :, 0], values)


SCALED, NAN = {"scale_factor": 0.01}, float("nan")
COUNTS = np.int16([0, 101, -3, -9])


@pytest.mark.parametrize(
    ("stored", "about", "read"),
    [
        (np.int8([0, 100, -128, -1]), {**SCALED, "_Unsigned": "true", "_FillValue": np.int8(-1)}, [0, 1, 1.28, NAN]),
        (COUNTS, {**SCALED, "valid_min": np.int16(0), "valid_max": np.int16(100)}, [0, NAN, NAN, NAN]),
        (COUNTS, {**SCALED, "valid_range": np.int16([0, 200])}, [0, 1.01, NAN, NAN]),
        (COUNTS, {**SCALED, "_FillValue": np.int16(-9), "missing_value": np.int16(-3)}, [0, 1.01, NAN, NAN]),
        (COUNTS, {"_FillValue": np.int16(-9), "valid_range": np.int16([0, 100])}, np.int16([0, -9, -9, -9])),
        (COUNTS, {"valid_range": np.int16([0, 100])}, [0, NAN, NAN, NAN]),
        (np.float32(COUNTS), {"_FillValue": np.float32(NAN), "missing_value": -3.0}, [0, 101, NAN, -9]),
    ],
    ids=["unsigned", "least and most", "range", "two fills", "filled", "not filled", "floats"],
)
def test_netcdf_packing_is_decoded(tmp_path: Path, stored: Any, about: dict[str, Any], read: Any) -> None:
    """Unsigned numbers, valid ranges and fill values are decoded; whole numbers with a fill value stay whole."""
    with h5py.File(tmp_path / "a.nc", "w") as file:
        file["values"] = stored.reshape(1, 4, 1)
        file["values"].attrs.update(about)
    cube = open_cube(f"{tmp_path / 'a.nc'}:values")
    assert cube.dtype == (np.float32 if isinstance(read, list) else read.dtype)
    np.testing.assert_allclose(cube.read(0, 1)[0, :, 0], read, rtol=1e-6 if "scale_factor" in about else 0)
