"""Places of files on the earth: the same as other readers find, in any unit; a reason wherever a place is dropped."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import odc.geo.xr
import pytest
import rasterio
import rasterio.shutil
import rioxarray
import xarray as xr
from affine import Affine
from odc.geo.geobox import GeoBox
from PIL import Image
from pyproj import CRS, Transformer
from rasterio.control import GroundControlPoint
from rasterio.rpc import RPC

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.ground.georeference import pixel_side_m
from spectralzoom.storage.readers.cube_sources import CubeSource
from spectralzoom.storage.readers.open_cubes import open_cube_source
from spectralzoom.storage.readers.places import place_of_dataset
from tests.storage.readers.test_envi_cubes import write_envi
from tests.storage.readers.test_raster_tags import write as write_bands

SHAPE = (6, 7)
VALUES = np.arange(42, dtype=np.float32).reshape(SHAPE)
PLACE = Affine(2, 0, 400_000, 0, -2, 5_700_000)
Y, X = 5_700_000 - 1 - 2.0 * np.arange(6), 400_000 + 1 + 2.0 * np.arange(7)
LAT, LON = 52 - 1e-3 * np.arange(6), 7.5 + 1e-3 * np.arange(7)
DEGREES = Affine(1e-3, 0, 7.4995, 0, -1e-3, 52.0005)
WKT = {"crs_wkt": CRS.from_epsg(32632).to_wkt()}
NORTH_EAST = ("degrees_north", "degrees_east")
TRANSVERSE = {name: value for name, value in CRS.from_epsg(32632).to_cf().items() if name != "crs_wkt"}
PLATE = {name: value for name, value in CRS.from_epsg(4326).to_cf().items() if name != "crs_wkt"}
SATELLITE = {
    **{"grid_mapping_name": "geostationary", "perspective_point_height": 35786023.0, "sweep_angle_axis": "x"},
    **{"semi_major_axis": 6378137.0, "semi_minor_axis": 6356752.31414, "longitude_of_projection_origin": -75.0},
}
POLE = {"grid_north_pole_latitude": 39.25, "grid_north_pole_longitude": -162.0}
ROTATED = {"grid_mapping_name": "rotated_latitude_longitude", **POLE}


def dataset(
    y: Any = None,
    x: Any = None,
    units: str | tuple[str, str] | None = "m",
    mapping: Mapping[str, Any] | None = None,
    dims: tuple[str, str] = ("y", "x"),
    **about: Any,
) -> xr.Dataset:
    """Return an image ``v`` with coordinates and a grid mapping ``crs``; ``about`` are attributes of the image."""
    pair = (units, units) if units is None or isinstance(units, str) else units
    axes = {} if y is None else dict(zip(dims, zip((y, x), pair, strict=True), strict=True))
    names = {unit: {"units": unit} for unit in pair if unit is not None} | {None: {}}
    coordinates = {
        dim: (dim, one, names[unit] | ({"standard_name": f"projection_{dim}_coordinate"} if unit == "m" else {}))
        for dim, (one, unit) in axes.items()
    }
    named = {} if mapping is None else {"grid_mapping": "crs"}
    scalar = {} if mapping is None else {"crs": ((), np.int32(0), dict(mapping))}
    return xr.Dataset({"v": (dims, VALUES, {**named, **about}), **scalar}, coordinates)


def geotransform(transform: Affine, **mapping: Any) -> dict[str, Any]:
    return {"GeoTransform": " ".join(map(str, transform.to_gdal())), **mapping}


def corners(transform: Affine, crs: Any) -> np.ndarray[Any, Any]:
    """Return longitude and latitude of the corners [deg]."""
    places = np.array([transform * corner for corner in ((0, 0), (7, 0), (0, 6), (7, 6))]).T
    return np.array(Transformer.from_crs(CRS.from_user_input(crs), 4326, always_xy=True).transform(*places))


def of_rasterio(path: Path) -> tuple[Affine, Any]:
    with rasterio.open(f"NETCDF:{path}:v" if path.suffix == ".nc" else path) as file:
        return file.transform, CRS.from_wkt(file.crs.to_wkt())


def _image(path: Path) -> xr.DataArray:
    options: dict[str, Any] = {"engine": "zarr", "consolidated": False} if path.is_dir() else {"engine": "h5netcdf"}
    return xr.open_dataset(path, decode_coords="all", **options)["v"]


def of_rioxarray(path: Path) -> tuple[Affine, Any]:
    image = rioxarray.open_rasterio(path) if path.suffix == ".tif" else _image(path)
    y, x = image.dims[-2:]
    image = image.rio.set_spatial_dims(x, y)
    return image.rio.transform(), image.rio.crs.to_wkt()


def of_odc(path: Path) -> tuple[Affine, Any]:
    geobox = _image(path).odc.geobox
    return geobox.affine, geobox.crs.to_wkt()


EVERY = (of_rasterio, of_rioxarray, of_odc)
BARE = dataset(Y, X, mapping=WKT)
del BARE["v"].attrs["grid_mapping"]
ROWS = dataset(dims=("row", "col"), mapping=WKT).assign(
    north=("row", Y, {"units": "m", "standard_name": "projection_y_coordinate"}),
    east=("col", X, {"units": "m", "axis": "X"}),
)
TURNED = Affine(1.7, 1, 400_000, 1, -1.7, 5_700_000)
SOUTH = PLACE * Affine.translation(0, 1_450_000)
GEOZARR = {"proj:code": "EPSG:32632", "spatial:transform": list(PLACE[:6])}
# kind -> the file's content, readers that find its place too, transform and CRS
DATASETS: dict[str, tuple[xr.Dataset, tuple[Any, ...], Affine, Any]] = {
    "WKT": (dataset(Y, X, mapping=WKT), EVERY, PLACE, 32632),
    "parameters": (dataset(Y, X, mapping=TRANSVERSE), EVERY[:2], PLACE, 32632),
    "south first": (dataset(Y[::-1], X, mapping=WKT), EVERY[1:], Affine(2, 0, 4e5, 0, 2, 5_699_988), 32632),
    "degrees": (dataset(LAT, LON, NORTH_EAST, PLATE, ("lat", "lon")), EVERY[:2], DEGREES, 4326),
    "single precision": (
        dataset(np.float32(LAT), np.float32(LON), NORTH_EAST, {"spatial_ref": CRS(4326).to_wkt()}, ("lat", "lon")),
        (of_rioxarray, of_odc),
        DEGREES,
        4326,
    ),
    "no grid mapping": (dataset(LAT, LON, NORTH_EAST, dims=("latitude", "longitude")), (), DEGREES, 4326),
    "not named": (BARE, (), PLACE, 32632),
    "other names": (ROWS, (), PLACE, 32632),
    "GeoTransform": (dataset(mapping=geotransform(PLACE, **WKT)), EVERY, PLACE, 32632),
    "turned": (dataset(mapping=geotransform(TURNED, **WKT)), EVERY[:2], TURNED, 32632),
    "turned pole": (
        dataset(1 + LAT - 52, LON - 7.5, "degrees", ROTATED, ("rlat", "rlon")).rename(rlat="y", rlon="x"),
        (of_rioxarray,),
        Affine(1e-3, 0, -5e-4, 0, -1e-3, 1.0005),
        CRS.from_cf(ROTATED),
    ),
    "satellite": (dataset(Y - 2_900_000, X, mapping=SATELLITE), EVERY[:2], SOUTH, CRS.from_cf(SATELLITE)),
    "GeoZarr": (dataset(**GEOZARR), (), PLACE, 32632),
    "old xarray": (dataset(Y, X, crs="+init=epsg:32632"), (), PLACE, 32632),
}


@pytest.mark.parametrize("ending", ["nc", "zarr"])
@pytest.mark.parametrize("kind", DATASETS)
def test_other_readers_find_the_same_place(tmp_path: Path, kind: str, ending: str) -> None:
    """NetCDF and Zarr as rasterio, rioxarray and odc-geo read them; each opens the file that the test wrote."""
    content, others, transform, crs = DATASETS[kind]
    path = tmp_path / f"a.{ending}"
    if ending == "nc":
        content.to_netcdf(path, engine="h5netcdf")
    else:
        content.to_zarr(path, zarr_format=3, consolidated=False)
        others = tuple(other for other in others if other is not of_rasterio)
    geobox = open_cube_source(f"{path}:v").geobox
    found = corners(geobox.affine, geobox.crs.to_wkt())
    np.testing.assert_allclose(
        found, corners(transform, crs), rtol=0, atol=4e-6 if kind == "single precision" else 1e-9
    )
    for other in others:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            np.testing.assert_allclose(corners(*other(path)), found, rtol=0, atol=5e-6)


SURVEY_FOOT = 1200 / 3937  # [m]
UNITS = [("km", 1e3), ("kilometers", 1e3), ("metre", 1), ("ft", 0.3048), ("feet", 0.3048)]
UNITS += [("US_survey_foot", SURVEY_FOOT), ("us-ft", SURVEY_FOOT)]


@pytest.mark.parametrize(("unit", "metres"), UNITS)
@pytest.mark.parametrize("epsg", [32632, 2263])
def test_coordinates_are_read_in_their_unit(unit: str, metres: float, epsg: int) -> None:
    """A CRS in metres and one in feet give the same pixels of 2 m, whatever the unit of the coordinates."""
    mapping = {"crs_wkt": CRS.from_epsg(epsg).to_wkt()}
    top, left = (Y[0], X[0]) if epsg == 32632 else (60_000, 300_000)
    content = dataset((Y - Y[0] + top) / metres, (X - X[0] + left) / metres, unit, mapping)
    geobox, _ = place_of_dataset(content, "v", ("y", "x"))
    assert geobox is not None
    own = 1 if epsg == 32632 else SURVEY_FOOT
    np.testing.assert_allclose(geobox.affine[:6], np.divide([2, 0, left - 1, 0, -2, top + 1], own), rtol=1e-9)
    assert pixel_side_m(geobox) == pytest.approx(2, rel=5e-4)


@pytest.mark.parametrize(
    ("unit", "scale", "epsg"), [("degree", 1, 4326), ("radians", np.pi / 180, 4326), ("degrees_north", 0.9, 4807)]
)
def test_angles_are_read_in_their_unit(unit: str, scale: float, epsg: int) -> None:
    """Degrees and radians, also where the CRS is in grads."""
    content = dataset(LAT * scale, LON * scale, unit, {"crs_wkt": CRS.from_epsg(epsg).to_wkt()})
    geobox, _ = place_of_dataset(content, "v", ("y", "x"))
    assert geobox is not None
    np.testing.assert_allclose(geobox.affine[:6], DEGREES[:6], rtol=1e-6)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (dataset(Y, X, "furlong", WKT), r"x is in 'furlong', and its CRS, 'WGS 84 / UTM zone 32N', in metre; allowed"),
        (dataset(LAT, LON, NORTH_EAST, WKT), "x is in 'degrees_east'.*in metre; allowed are m, km, ft or us-ft"),
        (dataset(LAT, LON, None, WKT, ("lat", "lon")), "lon is in 'degree'.*Correct the units of lon, or take the CRS"),
        (dataset(Y, X, "m", PLATE), "x is in 'm', and its CRS.*in degree"),
        (dataset(Y, X, "degC", WKT), "x is in 'degC'"),
        (dataset(Y, X, "rad", WKT), "x is in 'rad'"),
        (dataset(LAT, LON, "degrees_true", PLATE), "x is in 'degrees_true'"),
    ],
)
def test_units_that_do_not_fit_the_crs_are_refused(tmp_path: Path, content: xr.Dataset, words: str) -> None:
    """The error names the unit, those that are allowed, and what to correct."""
    content.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    dims = tuple(str(dim) for dim in content["v"].dims)
    with pytest.raises(SceneError, match=words):
        open_cube_source(f"{tmp_path / 'a.nc'}:v")
    with pytest.raises(SceneError, match=words):
        place_of_dataset(content, "v", (dims[0], dims[1]))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (dataset(Y, X, None, WKT), "x states no unit; it is read in metre"),
        (dataset(Y - 4, X, mapping=geotransform(PLACE, **WKT)), "its transform contradicts y and x, which are used"),
        (
            dataset(Y, X, mapping={**TRANSVERSE, "crs_wkt": "PROJCS["}),
            "cannot be read from crs_wkt of its grid mapping",
        ),
        (dataset(LAT, LON, NORTH_EAST, dims=("lat", "lon"), projection="Geographic"), "and are read as WGS 84"),
        (dataset(Y, X, mapping=geotransform(TURNED, **WKT)), "its grid is turned, so that y and x are not used"),
    ],
)
def test_a_doubt_about_a_place_is_a_note(content: xr.Dataset, words: str) -> None:
    """The place is read, by the coordinates if two places contradict each other."""
    dims = tuple(str(dim) for dim in content["v"].dims)
    geobox, notes = place_of_dataset(content, "v", (dims[0], dims[1]))
    assert geobox is not None
    assert any(words in note for note in notes)


ONE_ROW = dataset(Y, X, mapping=WKT).isel(y=[0])
SEVERAL = BARE.assign(other=((), 0, PLATE))
SWATH = dataset().assign(lat=(("y", "x"), np.ones(SHAPE)), lon=(("y", "x"), np.ones(SHAPE)))
LOCAL = {"crs_wkt": 'LOCAL_CS["field",UNIT["metre",1]]'}
DROPPED: list[tuple[xr.Dataset, str]] = [
    (dataset(Y, X), "it has coordinates and no CRS (write one: rio.write_crs of rioxarray)"),
    (dataset(Y, X, crs="UTM"), "the CRS cannot be read from crs"),
    (dataset(Y, X, grid_mapping="lost"), "its grid mapping lost is not in the file"),
    (dataset(Y, X, mapping={"crs_wkt": "PROJCS[broken"}), "the CRS cannot be read from crs_wkt of its grid mapping"),
    (dataset(Y, X, mapping={"grid_mapping_name": "polar_stereographic"}), "it lacks 'latitude_of_projection_origin'"),
    (dataset(Y, X, mapping=LOCAL), "its CRS, 'field', is not geographic or projected"),
    (dataset(5e6 - np.arange(6.0) ** 2, X, mapping=WKT), "y is not evenly spaced (steps of -9 to -1); resample it"),
    (dataset(np.float32(5.7e6 - 0.1 * np.arange(6)), X, mapping=WKT), "y is not evenly spaced (steps of -0.5 to 0)"),
    (dataset(Y / 1e3, X / 1e3, "km", TRANSVERSE), "false easting and northing may be in km or m; add crs_wkt"),
    (ONE_ROW, "y has one value, so that the size of its pixel is not known"),
    (SEVERAL, "the file has several grid mappings (crs, other), and the cube names none of them"),
    (SWATH, "its place is given by latitudes of each pixel (lat), not read"),
    (dataset(mapping=WKT), "it has a CRS, and neither coordinates along its axes nor a GeoTransform"),
    (dataset(mapping={"GeoTransform": "1 2 x", **WKT}), "its transform is no grid of pixels"),
    (dataset(LAT, LON, "degrees", PLATE).assign_coords(x=LON + 352), "is no place in its CRS, 'WGS 84'"),
    (dataset(**{**GEOZARR, "spatial:shape": [3, 3]}), "its spatial:transform is that of an image of another shape"),
    (dataset(Y, X, "m", {"crs_wkt": CRS(2193).to_wkt()}).assign_coords(x=X + 1e9), "is no place in its CRS"),
]


@pytest.mark.parametrize(("content", "words"), DROPPED, ids=[words[:40] for _, words in DROPPED])
def test_a_dropped_place_has_its_reason(content: xr.Dataset, words: str) -> None:
    """No traceback and no silence: each dataset has some place, or a part of one."""
    geobox, notes = place_of_dataset(content, "v", ("y", "x"))
    assert geobox is None
    assert any(words in note for note in notes), notes


def test_pixel_numbers_are_no_place() -> None:
    """Counted rows and columns without a CRS give no note: nothing is lost."""
    assert place_of_dataset(dataset(np.arange(6), np.arange(7), None), "v", ("y", "x")) == (None, ())


def test_vectors_beside_a_cube_without_names_of_axes_are_coordinates(tmp_path: Path) -> None:
    """HDF5 files of h5py often have no scales; a grid mapping may be named by its path, and have heights."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["v"], file["x"], file["y"], file["crs"] = VALUES, X, Y, 0
        file["v"].attrs["grid_mapping"] = "/crs"
        file["crs"].attrs.update({**TRANSVERSE, "geopotential_datum_name": "NAVD88"})
    assert open_cube_source(tmp_path / "a.h5").geobox == GeoBox(SHAPE, PLACE, "EPSG:32632")


def test_one_row_has_the_step_of_its_geotransform() -> None:
    """A row cut out of an image keeps its place."""
    content = dataset(Y, X, mapping=geotransform(PLACE, **WKT)).isel(y=[2])
    geobox, _ = place_of_dataset(content, "v", ("y", "x"))
    assert geobox == GeoBox((1, 7), PLACE * Affine.translation(0, 2), "EPSG:32632")


def test_a_part_of_a_turned_image_keeps_its_place() -> None:
    """odc-geo writes pixel numbers as the coordinates of a turned grid."""
    geobox = GeoBox(SHAPE, TURNED, "EPSG:32632")
    image = odc.geo.xr.wrap_xr(VALUES, geobox).isel(y=slice(1, 5), x=slice(2, None))
    found, notes = place_of_dataset(image.to_dataset(name="v"), "v", ("y", "x"))
    assert (found, notes) == (geobox[1:5, 2:], ())


def test_netcdf_and_zarr_of_gdal_have_gdals_place(tmp_path: Path) -> None:
    """GDAL writes NetCDF with the southern row first, under the GeoTransform of the upright image."""
    write_bands(tmp_path / "a.tif", VALUES[None], crs="EPSG:32632", transform=PLACE).close()
    rasterio.shutil.copy(tmp_path / "a.tif", tmp_path / "a.nc", driver="netCDF", FORMAT="NC4")
    rasterio.shutil.copy(tmp_path / "a.tif", tmp_path / "a.zarr", driver="Zarr")
    cube = open_cube_source(f"{tmp_path / 'a.nc'}:Band1")
    assert cube.geobox == GeoBox(SHAPE, PLACE * Affine(1, 0, 0, 0, -1, 6), "EPSG:32632")
    assert not any("contradicts" in note for note in cube.notes)
    np.testing.assert_array_equal(cube.read(0, 6)[::-1, :, 0], VALUES)
    assert open_cube_source(f"{tmp_path / 'a.zarr'}:a").geobox == GeoBox(SHAPE, PLACE, "EPSG:32632")


# --- images and ENVI headers --------------------------------------------------------------------------------------


def geotiff(path: Path, **profile: Any) -> CubeSource:
    write_bands(path, VALUES[None], **profile).close()
    return open_cube_source(path)


@pytest.mark.parametrize(("epsg", "code"), [(32632, 32632), (2263, 2263), ("EPSG:32632+5773", 32632)])
def test_a_geotiff_has_the_place_that_rasterio_reads(tmp_path: Path, epsg: Any, code: int) -> None:
    """Of a compound CRS the horizontal part is used."""
    place = PLACE if code == 32632 else Affine(2, 0, 1_000_000, 0, -2, 200_000)
    geobox = geotiff(tmp_path / "a.tif", crs=CRS.from_user_input(epsg).to_wkt(), transform=place).geobox
    assert geobox == GeoBox(SHAPE, of_rasterio(tmp_path / "a.tif")[0], f"EPSG:{code}")
    assert geobox.affine == of_rioxarray(tmp_path / "a.tif")[0]


RPCS = RPC(0, 1, 52, 1, [1.0] * 20, [1.0] * 20, 3, 3, 7, 1, [1.0] * 20, [1.0] * 20, 3, 3)
POINTS = [GroundControlPoint(0, 0, 7, 52), GroundControlPoint(6, 0, 7, 51.9), GroundControlPoint(0, 7, 7.1, 52)]


@pytest.mark.parametrize(
    ("profile", "words"),
    [
        ({"transform": PLACE}, "a transform and no CRS"),
        ({"crs": "EPSG:25832"}, "a CRS and no transform"),
        ({"rpcs": RPCS}, "control points, RPCs or arrays of geolocation, which are not read"),
        ({"crs": "EPSG:4326", "gcps": POINTS}, "control points, RPCs or arrays of geolocation, which are not read"),
        ({"crs": "EPSG:4326", "transform": PLACE}, "is no place in its CRS, 'WGS 84'; correct one of them"),
        ({"crs": "EPSG:4978", "transform": PLACE}, "is not geographic or projected"),
    ],
)
def test_a_geotiff_without_a_usable_place_says_why(tmp_path: Path, profile: dict[str, Any], words: str) -> None:
    """The note names what is there, and what is missing."""
    cube = geotiff(tmp_path / "a.tif", **profile)
    assert cube.geobox is None
    assert any(words in note for note in cube.notes)


def test_a_picture_with_a_world_file_lacks_a_crs(tmp_path: Path) -> None:
    """The note says so."""
    Image.fromarray(np.uint8(VALUES)).save(tmp_path / "a.png")
    (tmp_path / "a.pgw").write_text("2\n0\n0\n-2\n400001\n5699999\n")
    assert any("a transform and no CRS" in note for note in open_cube_source(tmp_path / "a.png").notes)


def envi(folder: Path, **fields: str) -> CubeSource:
    write_envi(folder / "a.img", VALUES[..., None], "bip", **fields)
    return open_cube_source(folder / "a.hdr")


UTM = "UTM, 1, 1, 400000, 5700000, 2, 2, 32, North"


@pytest.mark.parametrize(
    ("map_info", "side_m"),
    [
        (f"{UTM}, WGS-84, units=Meters", 2),
        ("UTM, 1, 1, 1312336, 18700787, 2, 2, 32, North, WGS-84, units=Feet", 0.6096),
        ("UTM, 1, 1, 1312333, 18700750, 2, 2, 32, North, WGS-84, units=US Feet", 0.6096),
        ("UTM, 1, 1, 400, 5700, .002, .002, 32, North, WGS-84, units=Km", 2),
        ("Geographic Lat/Lon, 1, 1, 27000, 187200, 1, 1, WGS-84, units=Seconds", 24.3),
    ],
)
def test_map_info_is_read_in_its_unit(tmp_path: Path, map_info: str, side_m: float) -> None:
    """Feet, kilometres and seconds of arc give true sizes of pixels."""
    cube = envi(tmp_path, map_info=f"{{{map_info}}}")
    assert pixel_side_m(cube.geobox) == pytest.approx(side_m, rel=1e-3)
    assert not cube.notes


@pytest.mark.parametrize(
    "map_info",
    [
        f"{UTM}, WGS-84, units=Furlong",
        f"{UTM}, WGS-84, units=Degrees",
        "Geographic Lat/Lon, 1, 1, 7.5, 52, 1e-5, 1e-5, WGS-84, units=Meters",
    ],
)
def test_map_info_in_another_unit_is_refused(tmp_path: Path, map_info: str) -> None:
    """GDAL ignores such a unit; the error names it."""
    with pytest.raises(SceneError, match=r"map info is in '(Furlong|Degrees|Meters)', and its CRS"):
        envi(tmp_path, map_info=f"{{{map_info}}}")


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"map_info": "{Arbitrary, 1, 1, 0, 0, 1, 1}"}, "its CRS, 'Arbitrary', is not geographic or projected"),
        ({"map_info": "{UTM, 1, 1}"}, "the header has map info, which give no grid"),
        ({"map_info": f"{{{UTM.replace('2, 2', 'a, 2')}, WGS-84}}"}, "a transform that is no grid"),
        ({"coordinate_system_string": f"{{{WKT['crs_wkt']}}}"}, "the header has coordinate system string, which give"),
        ({"geo_points": "{1, 1, 52, 7, 5, 1, 52, 7.1, 1, 4, 51.9, 7, 5, 4, 51.9, 7.1}"}, "ground control points"),
    ],
)
def test_an_envi_header_without_a_usable_place_says_why(tmp_path: Path, fields: dict[str, str], words: str) -> None:
    """The note names what the header states."""
    cube = envi(tmp_path, **fields)
    assert cube.geobox is None
    assert any(words in note for note in cube.notes)


def test_an_unknown_datum_of_map_info_is_a_note(tmp_path: Path) -> None:
    """GDAL takes it for WGS 84."""
    assert any(
        "datum, 'Tokyo Mean', is read as WGS 84" in one
        for one in envi(tmp_path, map_info=f"{{{UTM}, Tokyo Mean}}").notes
    )


def test_survey_feet_of_an_envi_file_of_gdal_stay_survey_feet(tmp_path: Path) -> None:
    """GDAL writes a CRS in US survey feet with units=Feet, and reads it as international feet: 0.6 m off."""
    place = Affine(2, 0, 1_000_000, 0, -2, 200_000)
    about: dict[str, Any] = {"photometric": None, "crs": "EPSG:2263", "transform": place}
    write_bands(tmp_path / "a.img", VALUES[None], driver="ENVI", **about).close()
    found = open_cube_source(tmp_path / "a.hdr").geobox
    np.testing.assert_allclose(corners(found.affine, found.crs.to_wkt()), corners(place, 2263), rtol=0, atol=1e-9)
