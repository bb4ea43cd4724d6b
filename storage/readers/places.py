"""Read where the pixels of a file lie on the earth: rasters of GDAL, ENVI headers, NetCDF, HDF5 and Zarr datasets.

Each function returns a GeoBox, or None with notes that say why a place is dropped. CRS are read by pyproj. Coordinates
are pixel centres, in the unit that their attributes state.
"""

from __future__ import annotations

import importlib
import math
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import odc.geo.crs as odc_crs
import odc.geo.geobox as odc_geobox
from affine import Affine
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from odc.geo.math import affine_from_axis
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.ground.georeference import OFF_GRID_PX
from spectralzoom.storage.readers.band_facts import unit_of
from spectralzoom.storage.readers.cube_sources import library_log
from spectralzoom.storage.readers.own_files import check_sidecars

if TYPE_CHECKING:
    import xarray as xr

Place = tuple[GeoBox | None, tuple[str, ...]]

_WKT = ("crs_wkt", "spatial_ref")  # of a grid mapping, before CF's parameters
_CRS_ATTRIBUTES = ("proj:wkt2", "proj:code", "crs")  # of the image or dataset: GeoZarr's, and that of older xarray
_NAMES = {"y": ("lat", "latitude"), "x": ("lon", "longitude")}
_DIRECTIONS = {"y": r"degrees?_?n(orth)?", "x": r"degrees?_?e(ast)?"}
_UNITS = {  # spelling: kind, and metres or radians
    r"m|met(er|re)s?": ("linear", 1.0),
    r"km|kilomet(er|re)s?": ("linear", 1000.0),
    r"ft|foot|feet": ("linear", 0.3048),
    r"us[- ]?(ft|foot|feet|survey (foot|feet))|survey (foot|feet)": ("linear", 1200 / 3937),
    r"deg(ree)?s?( ?([nsew]|north|south|east|west))?|°": ("angular", math.radians(1)),
    r"rad(ian)?s?": ("angular", 1.0),
}
_ALLOWED = "m, km, ft or us-ft on a projected CRS, degrees or rad on a geographic one"
_ENVI_PLACES = ("map info", "geo points", "rpc info", "coordinate system string")
_WGS84 = r"(?i)wgs[- _]*(19)?84|world geodetic system 1984"


@dataclass(frozen=True)
class _Axis:
    """The coordinates of the pixel centres along one axis."""

    name: str
    values: NDArray[np.float64]
    precision: float  # by which stored numbers may be rounded
    unit: str  # as stated; degree for a latitude or longitude without one
    geographic: bool  # a latitude or longitude, by standard name, unit or name

    @property
    def counts(self) -> bool:
        """Return whether the coordinates count pixels."""
        from_start = self.values[0] in (0.0, 0.5, 1.0) and bool((np.diff(self.values) == 1).all())
        return self.unit.lower() in ("pixel", "pixels", "px") or (self.unit in ("", "1") and from_start)


def place_of_dataset(dataset: xr.Dataset, name: str, dims: tuple[str, str]) -> Place:
    """Return the grid on the earth of one variable, whose axes (y, x) are ``dims``; or None, with notes.

    Open the dataset with ``mask_and_scale=True`` and any ``decode_coords``. Read are CF's grid mapping with its
    GeoTransform, coordinates of pixel centres along ``dims``, latitudes and longitudes without a grid mapping, and
    GeoZarr's ``proj:`` and ``spatial:`` attributes. Coordinates win over a transform that contradicts them.

    Raises SceneError: coordinates have a unit that is not known, or that does not fit their CRS.
    """
    cube = dataset.variables[name]
    shape = cube.sizes[dims[0]], cube.sizes[dims[1]]
    axes = [_axis(dataset, dim, kind) for dim, kind in zip(dims, "yx", strict=True)]
    known = [axis for axis in axes if axis is not None]
    notes: list[str] = []
    mapping = _grid_mapping(dataset, cube, notes)
    attributes = {**_plain(dataset.attrs), **_plain(cube.attrs)}
    crs = _crs(mapping, attributes, known, notes)
    stated = _stated_transform(mapping, attributes, shape, notes)
    if crs is not None and not _is_map(crs):
        return _placed(shape, Affine.identity(), crs, notes)
    transform = None if crs is None else _transform(axes, stated, crs, shape, notes)
    if crs is not None and transform is not None:
        return _placed(shape, transform, crs, notes)
    if crs is not None and not notes:
        notes.append("it has a CRS, and neither coordinates along its axes nor a GeoTransform")
    elif not notes and (stated is not None or any(not axis.counts for axis in known)):
        notes.append("it has coordinates and no CRS (write one: rio.write_crs of rioxarray)")
    for other, one in dataset.variables.items():
        of_name = re.match(r"lat(itude)?(?![a-z])", str(other).rpartition("/")[2].lower())
        if one.shape == shape and (of_name or one.attrs.get("standard_name") == "latitude"):
            notes.append(f"its place is given by latitudes of each pixel ({other}), not read; resample it to a grid")
    return None, tuple(notes)


def _axis(dataset: xr.Dataset, dim: str, kind: str) -> _Axis | None:
    """Return the coordinates along one axis: those of its name, else others that CF's attributes mark."""
    angle = "latitude" if kind == "y" else "longitude"
    marks = (angle, f"grid_{angle}", f"projection_{kind}_coordinate", f"projection_{kind}_angular_coordinate")
    for name in (dim, *dataset.variables):
        found = dataset.variables.get(name)
        if found is None or found.dims != (dim,) or found.dtype.kind not in "iuf" or not found.size:
            continue
        standard, axis = (str(found.attrs.get(key, "")).strip() for key in ("standard_name", "axis"))
        unit = unit_of(found.attrs)
        word = str(name).rpartition("/")[2]
        if not (
            name == dim or standard in marks or kind in (axis.lower(), word.lower()) or word.lower() in _NAMES[kind]
        ):
            continue
        values = np.asarray(found.values)
        rounded = float(np.spacing(np.abs(values).max())) if values.dtype.kind == "f" else 0.0
        by_name = bool(re.fullmatch(_DIRECTIONS[kind], unit.lower())) or word.lower() in _NAMES[kind]
        geographic = standard == angle if standard else by_name
        unit = unit or ("degree" if geographic or standard in marks[:2] else "")
        return _Axis(word, values.astype(np.float64), rounded, unit, geographic)
    return None


def _plain(attributes: Mapping[Any, Any]) -> dict[str, Any]:
    """Return attributes as Python's own texts and numbers, arrays as lists."""
    found = {}
    for name, value in attributes.items():
        number = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
        number = number[0] if isinstance(number, list) and len(number) == 1 else number
        found[str(name)] = number.decode("utf-8", "replace") if isinstance(number, bytes) else number
    return found


def _grid_mapping(dataset: xr.Dataset, cube: xr.Variable, notes: list[str]) -> dict[str, Any]:
    """Return the attributes of the grid mapping that the cube names, else of the only one there is."""
    text = str(cube.encoding.get("grid_mapping", cube.attrs.get("grid_mapping", ""))).strip()
    for key in re.findall(r"[^\s:]+", text)[:1]:  # of "crs: x y other: lat lon" the first
        if key.removeprefix("/") in dataset.variables:
            return _plain(dataset.variables[key.removeprefix("/")].attrs)
        notes.append(f"its grid mapping {key} is not in the file")
    scalars = {str(key): _plain(one.attrs) for key, one in dataset.variables.items() if not one.ndim}
    single = {key: about for key, about in scalars.items() if {"grid_mapping_name", *_WKT} & set(about)}
    if len(single) > 1:
        notes.append(f"the file has several grid mappings ({', '.join(single)}), and the cube names none of them")
        return {}
    return next(iter(single.values()), {})


def _crs(mapping: Mapping[str, Any], attributes: Mapping[str, Any], axes: list[_Axis], notes: list[str]) -> CRS | None:
    """Return the first CRS that can be read: of the grid mapping, of attributes, WGS 84 of latitudes and longitudes."""
    given = [(f"{key} of its grid mapping", mapping[key]) for key in _WKT if mapping.get(key)]
    if mapping.get("grid_mapping_name"):
        given.append(("its grid mapping", mapping))
    given += [(key, attributes[key]) for key in _CRS_ATTRIBUTES if attributes.get(key)]
    if isinstance(attributes.get("_CRS"), dict):  # GDAL's in Zarr
        given.append(("_CRS", attributes["_CRS"].get("wkt")))
    for where, value in given:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of old texts such as +init=epsg
                if re.search(r"init=(?!\w+:)", str(value)):
                    raise ValueError("it names a file, which is not opened")
                return _crs_of_cf(mapping, axes) if value is mapping else CRS(value)
        except Exception as error:  # of PROJ; KeyError of a parameter that is missing
            lacks = f"it lacks {error}" if isinstance(error, KeyError) else error
            notes.append(f"the CRS cannot be read from {where}: {lacks}")
    if not given and not notes and len(axes) == 2 and all(axis.geographic for axis in axes):
        notes.append("its latitudes and longitudes have no grid mapping, and are read as WGS 84")
        return CRS.from_epsg(4326)
    return None


def _crs_of_cf(mapping: Mapping[str, Any], axes: list[_Axis]) -> CRS:
    """Return the CRS by CF's parameters, whose false easting and northing are in the unit of the axes."""
    shifted = any(mapping.get(key) for key in ("false_easting", "false_northing"))
    for unit in [axis.unit for axis in axes if shifted and _unit(axis.unit)[1] not in (0, 1)]:
        raise ValueError(f"false easting and northing may be in {unit} or m; add crs_wkt")
    parameters = {key: value for key, value in mapping.items() if key not in _WKT}
    parameters.setdefault("projected_crs_name", str(mapping["grid_mapping_name"]).replace("_", " "))
    return CRS(CRS.from_cf(parameters).to_wkt())


def _stated_transform(
    mapping: Mapping[str, Any], attributes: Mapping[str, Any], shape: tuple[int, int], notes: list[str]
) -> Affine | None:
    """Return the transform of pixel corners by a GeoTransform or GeoZarr's attributes; None without one."""
    of_gdal = mapping.get("GeoTransform")
    numbers = of_gdal or attributes.get("spatial:transform")
    if not numbers:
        return None
    of_centres = attributes.get("spatial:registration") == "node"
    if not of_gdal and (of_centres or list(attributes.get("spatial:shape", shape)) != [*shape]):
        notes.append("its spatial:transform is that of an image of another shape, or not of its pixels' corners")
        return None
    try:
        words = [float(word) for word in re.split(r"[\s,\[\]()]+", str(numbers)) if word]
        found = Affine.from_gdal(*words) if of_gdal else Affine(*words[:6])
    except (TypeError, ValueError):
        found = Affine.scale(0)
    if not math.isfinite(found.determinant) or not found.determinant:
        notes.append("its transform is no grid of pixels")
        return None
    return found


def _transform(
    axes: list[_Axis | None], stated: Affine | None, crs: CRS, shape: tuple[int, int], notes: list[str]
) -> Affine | None:
    """Return the transform by coordinates in units of the CRS, else the stated one; None with a note."""
    y, x = axes
    if y is None or x is None:
        return stated
    if y.counts or x.counts:
        if stated is None or y.values[0] % 1 != 0.5 or x.values[0] % 1 != 0.5:
            return stated
        return stated * affine_from_axis(x.values, y.values, 1)  # odc-geo counts pixels from 0.5
    if stated is not None and (stated.b or stated.d):
        notes.append(f"its grid is turned, so that {y.name} and {x.name} are not used")
        return stated
    along_x = _line(x, _per_unit(x, crs, notes), None if stated is None else stated.a, notes)
    along_y = _line(y, _per_unit(y, crs, notes), None if stated is None else stated.e, notes)
    if along_x is None or along_y is None:
        return None
    (left, width, x_px), (top, height, y_px) = along_x, along_y
    found = Affine(width, 0.0, left, 0.0, height, top)
    flipped = Affine(1, 0, 0, 0, -1, shape[0])  # GDAL stores NetCDF from the bottom up
    for other in () if stated is None else (stated, stated * flipped):
        corners = [np.subtract(~found * (other * corner), corner) for corner in ((0, 0), shape[::-1])]
        if (np.abs(corners) <= np.maximum(OFF_GRID_PX, (x_px, y_px))).all():
            return other
    notes += [] if stated is None else [f"its transform contradicts {y.name} and {x.name}, which are used"]
    return found


def _line(axis: _Axis, per_unit: float, stated: float | None, notes: list[str]) -> tuple[float, float, float] | None:
    """Return the first edge and the step, in units of the CRS, and the precision [px]; None with a note."""
    values, count = axis.values, len(axis.values)
    if count == 1:
        if stated is None:
            notes.append(f"{axis.name} has one value, so that the size of its pixel is not known")
            return None
        return float(values[0]) * per_unit - stated / 2, stated, axis.precision * per_unit / abs(stated)
    with np.errstate(all="ignore"):  # values may be any number
        steps = np.diff(values)
        step = float(values[-1] - values[0]) / (count - 1)
        off = np.abs(values - values[0] - step * np.arange(count)).max()
    rounded = axis.precision if axis.precision <= abs(step) / 2 else 0.0
    if not np.isfinite(off) or not step or off > max(OFF_GRID_PX * abs(step), rounded):
        notes.append(f"{axis.name} is not evenly spaced (steps of {steps.min():g} to {steps.max():g}); resample it")
        return None
    return (float(values[0]) - step / 2) * per_unit, step * per_unit, axis.precision / abs(step)


def _per_unit(axis: _Axis, crs: CRS, notes: list[str]) -> float:
    """Return how many units of the CRS one unit of an axis is (SceneError: as `_in_crs`)."""
    if axis.unit:
        return _in_crs(axis.name, axis.unit, crs)
    notes.append(f"{axis.name} states no unit; it is read in {crs.axis_info[0].unit_name}")
    return 1.0


def _in_crs(what: str, unit: str, crs: CRS) -> float:
    """Return how many units of the CRS one unit is (SceneError: it is not known, or does not fit the CRS)."""
    own = crs.axis_info[0]
    category, factor = _unit(unit)
    if category != ("angular" if crs.is_geographic else "linear"):
        raise SceneError(
            f"{what} is in {unit!r}, and its CRS, {crs.name!r}, in {own.unit_name}; allowed are {_ALLOWED}. Correct the"
            f" units of {what}, or take the CRS out to read the cube without a place"
        )
    ratio = factor / float(own.unit_conversion_factor)
    return 1.0 if math.isclose(ratio, 1, rel_tol=1e-12) else ratio


def _unit(text: str) -> tuple[str, float]:
    """Return linear or angular, and the metres or radians of one unit; empty and 0 for one that is not known."""
    plain = re.sub(r"[\s_]+", " ", text.strip().lower())
    return next((found for words, found in _UNITS.items() if re.fullmatch(words, plain)), ("", 0.0))


def place_of_file(file: Any) -> Place:
    """Return the grid on the earth of an open rasterio file, or None with a note."""
    plain = file.transform.is_identity
    if plain and (file.gcps[0] or file.rpcs or file.tags(ns="GEOLOCATION")):
        what = "ground control points, RPCs or arrays of geolocation"
        return None, (f"its place is given by {what}, which are not read; warp it first (gdalwarp)",)
    if plain or file.crs is None or not file.transform.determinant:
        lacks = "a transform and no CRS (gdal_edit -a_srs)" if file.crs is None else "a transform that is no grid"
        lacks = "a CRS and no transform (gdal_edit -a_ullr)" if plain else lacks
        return None, () if plain and file.crs is None else (f"it has {lacks}: its place on the earth is not known",)
    try:
        crs = CRS.from_wkt(file.crs.to_wkt())
    except Exception as error:  # of PROJ and of GDAL
        return None, (f"its CRS cannot be read ({error}); its place on the earth is not known",)
    return _placed(file.shape, file.transform, crs)


def _is_map(crs: CRS) -> bool:
    return bool(crs.is_projected or crs.is_geographic)


def _placed(shape: tuple[int, int], transform: Affine, crs: CRS, notes: Sequence[str] = ()) -> Place:
    """Return a grid in the horizontal part of its CRS, by its EPSG code if it has one; None if it is on no map."""
    if not _is_map(crs):
        return None, (*notes, f"its CRS, {crs.name!r}, is not geographic or projected; its place is not known")
    flat = crs.to_2d() if len(crs.axis_info) > 2 else crs
    geodetic = flat.geodetic_crs
    assert geodetic is not None
    x, y = transform * (shape[1] / 2, shape[0] / 2)
    try:
        lon, lat = Transformer.from_crs(flat, geodetic, always_xy=True).transform(x, y)
    except ProjError as error:
        return None, (*notes, f"its CRS, {crs.name!r}, cannot be used: {error}")
    half_turns = np.abs([lon, 2 * lat]) * geodetic.axis_info[0].unit_conversion_factor / math.pi
    if not (half_turns <= 1).all():  # inf and NaN, too
        return None, (*notes, f"its middle, {x:g}, {y:g}, is no place in its CRS, {crs.name!r}; correct one of them")
    code = 4326 if flat.equals(CRS.from_epsg(4326), ignore_axis_order=True) else flat.to_epsg()
    return odc_geobox.GeoBox(shape, transform, odc_crs.CRS(flat.to_wkt() if code is None else code)), tuple(notes)


def place_of_envi(header: Mapping[str, str], data: Path, shape: tuple[int, int]) -> Place:
    """Return the grid of an ENVI file with (line, sample) ``shape``, by its header as GDAL reads it.

    Raises SceneError: ``map info`` states a unit that is not known, or that does not fit its CRS.
    """
    if not set(_ENVI_PLACES) & set(header):
        return None, ()
    rasterio = importlib.import_module("rasterio")
    with library_log():
        check_sidecars(data, "ENVI")
    try:
        with library_log(), rasterio.open(data, driver="ENVI") as file:
            found, notes = place_of_file(file)
    except Exception as error:  # of GDAL and PROJ
        return None, (f"its map info cannot be read: {error}",)
    if found is None or found.crs is None:
        stated = " and ".join(key for key in _ENVI_PLACES if key in header)
        return None, notes or (f"the header has {stated}, which give no grid; its place on the earth is not known",)
    crs = CRS(found.crs.to_wkt())
    words = [word.strip() for word in header.get("map info", "").strip("{} ").split(",")]
    unit = next((word.partition("=")[2].strip() for word in words if word.lower().startswith("units")), "")
    of_gdal = ("minutes", "seconds") if crs.is_geographic else ("feet",)  # which it reads, all as international feet
    scale = _in_crs("map info", unit, crs) if unit and unit.lower() not in of_gdal else 1.0
    if unit.lower() == "feet" and re.search(r"(?i)foot_us|us[ _]survey", header.get("coordinate system string", "")):
        scale = 1200 / 3937 / 0.3048
    datum = next((word for word in words[9 if words[0].lower() == "utm" else 7 : 10] if "=" not in word), "WGS-84")
    as_wgs84 = crs.geodetic_crs is not None and re.match(_WGS84, crs.geodetic_crs.name)
    if as_wgs84 and "coordinate system string" not in header and not re.fullmatch(_WGS84, datum):
        notes = (*notes, f"its datum, {datum!r}, is read as WGS 84, so that its place may be some 100 m off")
    return _placed(shape, Affine.scale(scale) * found.affine, crs, notes)
