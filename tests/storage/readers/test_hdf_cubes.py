"""NetCDF and HDF5 cubes: the published layout of EMIT, CF files of xarray, and damaged files."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import h5py
import numpy as np
import pytest
import rioxarray  # noqa: F401 - registers the accessor that writes a place
import xarray as xr
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import SceneError, WavelengthError
from spectralzoom.storage.readers.cube_sources import read_by_chunks
from spectralzoom.storage.readers.open_cubes import open_cube_source
from spectralzoom.storage.readers.scene_files import load_scene_file

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
    """Values, wavelengths, widths and bad bands are EMIT's; pixels in the sensor's geometry have no map grid."""
    values = emit_file(tmp_path / "emit.nc")
    source = open_cube_source(tmp_path / "emit.nc")
    assert (source.shape, source.nodata, source.bad_bands) == ((7, 6, 5), -9999.0, (2,))
    scene = load_scene_file(tmp_path / "emit.nc")
    np.testing.assert_array_equal(scene.wavelength_nm, NM[[0, 1, 3, 4]])
    np.testing.assert_array_equal(scene.fwhm_nm, 8.5)
    read = xr.open_dataset(tmp_path / "emit.nc", engine="h5netcdf")["reflectance"].values
    np.testing.assert_array_equal(scene.values, read[..., [0, 1, 3, 4]])
    assert np.isnan(scene.values[2, 3]).all()
    assert values[2, 3, 0] == -9999
    assert scene.geobox is None


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


def test_hdf5_without_dimension_names_is_y_x_band(tmp_path: Path) -> None:
    """A note says so; another order is refused with the number of wavelengths."""
    for name, values in (("a.h5", CUBE), ("b.h5", np.moveaxis(CUBE, -1, 0))):
        with h5py.File(tmp_path / name, "w") as file:
            file["cube"] = values
            file["wavelength"] = NM
    scene = load_scene_file(tmp_path / "a.h5")
    np.testing.assert_array_equal(scene.values, CUBE)
    assert "dims have no names, read as y, x, band" in scene.provenance
    with pytest.raises(
        WavelengthError, match=r"left out: it has float64 of shape \(5,\) for 6 bands.*axes are y, x, b"
    ):
        load_scene_file(tmp_path / "b.h5")


def test_an_address_selects_a_variable(tmp_path: Path) -> None:
    """The name of the variable may be given with its groups or without."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["field/one"] = CUBE
        file["field/two"] = CUBE + 1
        file["wavelength"] = NM
    for name, more in (("field/one", 0), ("two", 1)):
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


NO_CUBE_AXES = xr.Dataset({"rain": (("level", "lat", "lon"), CUBE.astype(float))})


@pytest.mark.parametrize(
    ("write", "words"),
    [
        (lambda path: path.write_text("text"), "cannot be read as NetCDF or HDF5: it begins as neither; copy it again"),
        (
            partial(NO_CUBE_AXES.to_netcdf, engine="h5netcdf"),
            r"has dims level, lat, lon; expected y, x, band \(or band, y, x\); rename them",
        ),
        (partial(hold, name="name", value="none"), "has no array of numbers with the axes y, x and band; it has none"),
    ],
)
def test_unusable_hdf_files_raise_one_error(write: Any, words: str, tmp_path: Path) -> None:
    """The files are damaged, or without a cube."""
    write(tmp_path / "bad.h5")
    with pytest.raises((SceneError, WavelengthError), match=words):
        load_scene_file(tmp_path / "bad.h5")


SCALED, NAN = {"scale_factor": 0.01}, float("nan")
UNSIGNED = {"_Unsigned": "true"}
BYTES = np.int8([0, 100, -128, -1])
COUNTS = np.int16([0, 101, -3, -9])


@pytest.mark.parametrize(
    ("stored", "about", "read"),
    [
        (np.int8([0, 100, -128, -1]), {**SCALED, "_Unsigned": "true", "_FillValue": np.int8(-1)}, [0, 1, 1.28, NAN]),
        (COUNTS, {**SCALED, "valid_min": np.int16(0), "valid_max": np.int16(100)}, [0, NAN, NAN, NAN]),
        (COUNTS, {**SCALED, "valid_range": np.int16([0, 200])}, [0, 1.01, NAN, NAN]),
        (COUNTS, {**SCALED, "_FillValue": np.int16(-9), "missing_value": np.int16(-3)}, [0, 1.01, NAN, NAN]),
        (COUNTS, {"_FillValue": np.int16(-9), "valid_range": np.int16([0, 100])}, [0, NAN, NAN, NAN]),
        (COUNTS, {"valid_range": np.int16([0, 100])}, [0, NAN, NAN, NAN]),
        (np.float32(COUNTS), {"_FillValue": np.float32(NAN), "missing_value": -3.0}, [0, 101, NAN, -9]),
        (BYTES, {**UNSIGNED, **SCALED, "valid_range": np.int8([0, -2])}, [0, 1, 1.28, NAN]),
        (BYTES, {**UNSIGNED, **SCALED, "valid_range": np.uint8([0, 254])}, [0, 1, 1.28, NAN]),
        (BYTES, {**UNSIGNED, **SCALED, "valid_range": np.int64([0, 254])}, [0, 1, 1.28, NAN]),
        (BYTES, {**UNSIGNED, "valid_max": 254, "_FillValue": np.uint8(255)}, [0, 100, 128, NAN]),
        (BYTES, {**UNSIGNED, "_FillValue": np.int16(-1)}, [0, 100, 128, NAN]),
        (BYTES, {"_Unsigned": b"TRUE"}, [0, 100, 128, 255]),
        (BYTES.view("u1"), {"_Unsigned": "false", "valid_min": np.int8(-100)}, [0, 100, NAN, -1]),
        (COUNTS, {"scale_factor": -0.01, "valid_range": np.int16([-5, 200])}, [0, -1.01, 0.03, NAN]),
        (COUNTS, {**SCALED, "valid_range": [-0.05, 1.0]}, [0, NAN, -0.03, NAN]),
        (COUNTS, {"scale_factor": -0.01, "valid_range": [-0.5, 0.05]}, [0, NAN, 0.03, NAN]),
        (np.float32(COUNTS), {**SCALED, "_FillValue": np.float32(-9)}, [0, 1.01, -0.03, NAN]),
        (
            COUNTS,
            {"scale_factor": np.int8(2), "add_offset": np.int16([1]), "_FillValue": np.int16(-9)},
            [1, 203, -5, NAN],
        ),
        (COUNTS, {"valid_range": np.int64([-(2**40), 2**40]), "_FillValue": np.int16(-9)}, COUNTS),
        (COUNTS, {"_FillValue": np.int32(70000), "scale_factor": 1.0}, COUNTS),
        (np.float32([0, 1, 2, NAN]), {"valid_range": [0.5, 1.5]}, [NAN, 1, NAN, NAN]),
    ],
)
def test_netcdf_packing_is_decoded(tmp_path: Path, stored: Any, about: dict[str, Any], read: Any) -> None:
    """Unsigned numbers, valid ranges and fill values are decoded."""
    with h5py.File(tmp_path / "a.nc", "w") as file:
        file["values"] = stored.reshape(1, 4, 1)
        file["values"].attrs.update(about)
    cube = open_cube_source(f"{tmp_path / 'a.nc'}:values")
    assert cube.dtype == (np.float32 if isinstance(read, list) else read.dtype)
    np.testing.assert_allclose(cube.read(0, 1)[0, :, 0], read, rtol=1e-6 if "scale_factor" in about else 0)


def test_scales_may_be_one_a_band(tmp_path: Path) -> None:
    """Fill values are compared before scaling; a divisor of other conventions is named in a note."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["cube"] = CUBE
        file["cube"].attrs.update({"scale_factor": NM, "add_offset": 1.0, "_FillValue": CUBE[0, 0, 2], "Scale": 7})
    cube = open_cube_source(tmp_path / "a.h5")
    np.testing.assert_allclose(cube.read(0, 7), np.where(CUBE[0, 0, 2] == CUBE, NAN, CUBE * NM + 1), rtol=1e-6)
    assert "its Scale = 7 is not applied: only scale_factor and add_offset are" in cube.notes


@pytest.mark.parametrize("about", [{"scale_factor": "percent"}, {"add_offset": [1.0, 2.0]}, {"_Unsigned": "maybe"}])
def test_unclear_packing_is_refused(tmp_path: Path, about: dict[str, Any]) -> None:
    """The message names the attribute."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["cube"] = CUBE
        file["cube"].attrs.update(about)
    with pytest.raises(SceneError, match=f"cube has {next(iter(about))} = .*, expected .*; correct it"):
        open_cube_source(tmp_path / "a.h5")


IMAGE = xr.Dataset({"cube": (("y", "x", "band"), CUBE)})
TEXTS = [f"{one:g}" for one in NM]


@pytest.mark.parametrize("ending", ["nc", "zarr"])
@pytest.mark.parametrize(
    "data",
    [
        IMAGE.assign_attrs(wavelength=NM.tolist()),
        IMAGE.assign_attrs(wavelengths_nm=", ".join(TEXTS)),
        IMAGE.assign(cube=IMAGE["cube"].assign_attrs(long_name=[f"{one} nm" for one in TEXTS])),
        IMAGE.assign_coords(wavelength=("band", (NM * 10).astype("i2"), {"units": "nm", "scale_factor": 0.1})),
    ],
)
def test_wavelengths_are_attributes_or_texts(tmp_path: Path, data: xr.Dataset, ending: str) -> None:
    """Of the file or of the array, in one text, in a list, or packed."""
    path = tmp_path / f"a.{ending}"
    _ = data.to_netcdf(path, engine="h5netcdf") if ending == "nc" else data.to_zarr(path, zarr_format=2)
    np.testing.assert_allclose(load_scene_file(path).wavelength_nm, NM)


def test_netcdf_3_is_read(tmp_path: Path) -> None:
    """The classic format has the same values, wavelengths and place as NetCDF 4 of the same data."""
    packed = {"cube": {"dtype": "i2", "scale_factor": 0.5, "_FillValue": -1}}
    data = xr.Dataset({"cube": (("y", "x", "band"), CUBE * 0.5)}).assign_coords(
        wavelength=("band", NM, {"units": "nm"})
    )
    for name, engine in (("3.nc", "scipy"), ("4.nc", "h5netcdf")):
        data.to_netcdf(tmp_path / name, engine=engine, encoding=packed)
    three, four = (load_scene_file(tmp_path / name) for name in ("3.nc", "4.nc"))
    np.testing.assert_array_equal(three.values, four.values)
    np.testing.assert_array_equal(three.wavelength_nm, NM)
