"""Use the georeference of a scene's file: its grid, CRS and pixel areas, in metres and degrees."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import odc.geo.geobox as odc_geobox
import pyproj
from affine import Affine
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

Floats = NDArray[np.float64]
WGS84 = 4326  # by EPSG
STEP_M = 100.0  # for the slopes of a projection
TIE_POINTS = 65  # along each side of a grid, between which the scale of its map is linear
OFF_GRID_PX = 0.02  # allowed offset of pixels on one grid: coordinates in files are rounded
SAME_SIZE = 1e-6  # allowed difference of pixels of one size


def zoomed_out(geobox: GeoBox, factor: int, shape: tuple[int, int]) -> GeoBox:
    """Return the grid of (y, x) ``shape`` from the same corner, with pixels ``factor`` times as long.

    The last row and column may reach beyond the given grid: a scene is padded to whole coarse pixels.
    """
    if factor == 1 and tuple(geobox.shape) == shape:
        return geobox
    a, b, c, d, e, f = geobox.affine[:6]
    return odc_geobox.GeoBox(shape, Affine(a * factor, b * factor, c, d * factor, e * factor, f), geobox.crs)


def shift_px(grid: GeoBox, other: GeoBox) -> tuple[float, float] | None:
    """Return the offset (x, y) of another grid of the same CRS from a grid [px].

    None if its pixels have another size or direction.
    """
    a, b, c, d, e, f = (~grid.affine * other.affine)[:6]
    return None if max(abs(a - 1), abs(b), abs(d), abs(e - 1)) > SAME_SIZE else (float(c), float(f))


def georeference_record(geobox: GeoBox | None) -> dict[str, Any]:
    """Return the georeference for the keys of stores; empty for a scene without one, so that its keys stay."""
    if geobox is None:
        return {}
    return {"georeference": {"crs": crs_key(geobox), "transform": [float(number) for number in geobox.affine[:6]]}}


def geobox_of_record(params: Mapping[str, Any], shape: tuple[int, int]) -> GeoBox | None:
    """Return the grid of (y, x) ``shape`` that `georeference_record` wrote into a store's key; None without one."""
    known = params.get("georeference")
    return None if known is None else odc_geobox.GeoBox(shape, Affine(*known["transform"]), known["crs"])


def crs_key(geobox: GeoBox) -> str:
    """Return a grid's CRS as text: its EPSG code, or its WKT if it has none."""
    assert geobox.crs is not None
    return geobox.crs.to_wkt() if geobox.crs.epsg is None else f"EPSG:{geobox.crs.epsg}"


def crs_name(geobox: GeoBox) -> str:
    """Return the usual name of a grid's CRS: its EPSG code, or its name if it has none."""
    assert geobox.crs is not None
    return str(geobox.crs.proj.name) if geobox.crs.epsg is None else crs_key(geobox)


def pixel_side_m(geobox: GeoBox) -> float:
    """Return the side of the square that has the area of the middle pixel [m]."""
    middle = _metres_of_units(geobox, *np.divide(geobox.shape.xy, 2))
    return float(np.sqrt(abs(float(geobox.affine.determinant)) * _area(middle)))


def pixel_rows_m2(geobox: GeoBox) -> Iterator[Floats]:
    """Yield the ground area of the pixels of each row, (x,) [m2], from the first row down.

    Areas are those on the ellipsoid, at any scale of the map. The scale of the projection is computed at `TIE_POINTS`
    places along each side, and linear between: the error is 2e-4 on a grid of the whole earth. Pixels that are not on
    the earth, such as beside the disk that a satellite sees, have no area.
    """
    rows, columns = geobox.shape
    tie_points_y, tie_points_x = np.linspace(0, rows, TIE_POINTS), np.linspace(0, columns, TIE_POINTS)
    tie_points = _area(_metres_of_units(geobox, *np.meshgrid(tie_points_x, tie_points_y)))
    units = abs(float(geobox.affine.determinant))
    if not np.isfinite(tie_points).all():
        for row in range(rows):
            yield np.nan_to_num(units * _area(_metres_of_units(geobox, np.arange(columns) + 0.5, row + 0.5)))
        return
    across = np.array([np.interp(np.arange(columns) + 0.5, tie_points_x, line) for line in tie_points])  # (tie, x)
    place = (np.arange(rows) + 0.5) * (TIE_POINTS - 1) / rows
    for above, fraction in zip(place.astype(int), place % 1, strict=True):
        yield units * ((1 - fraction) * across[above] + fraction * across[above + 1])


def _metres_of_units(geobox: GeoBox, column: Any, row: Any) -> Floats:
    """Return the geocentric step (..., X, Y or Z, x or y) [m] of one unit of the map at places in pixels.

    It is NaN at places that are not on the earth.
    """
    assert geobox.crs is not None
    crs = pyproj.CRS.from_wkt(geobox.crs.to_wkt())
    geodetic = crs.geodetic_crs
    assert geodetic is not None
    ellipsoid = crs.get_geod()
    assert ellipsoid is not None
    to_geodetic = pyproj.Transformer.from_crs(crs, geodetic, always_xy=True)
    a, b, c, d, e, f = geobox.affine[:6]
    x, y = a * column + b * row + c, d * column + e * row + f
    step = STEP_M / (crs.axis_info[0].unit_conversion_factor * (ellipsoid.a if crs.is_geographic else 1.0))

    def place(dx: float, dy: float) -> Floats:
        lon, lat = np.multiply(to_geodetic.transform(x + dx, y + dy), geodetic.axis_info[0].unit_conversion_factor)
        lat = np.clip(lat, -np.pi / 2, np.pi / 2)  # pixels may reach beyond the pole
        normal = ellipsoid.a / np.sqrt(1 - ellipsoid.es * np.sin(lat) ** 2)  # radius of curvature
        across = normal * np.cos(lat)
        return np.stack(
            [across * np.cos(lon), across * np.sin(lon), (1 - ellipsoid.es) * normal * np.sin(lat)], axis=-1
        )

    with np.errstate(invalid="ignore"):
        steps = [place(*one) - place(-one[0], -one[1]) for one in ((step, 0.0), (0.0, step))]
    return np.stack(steps, axis=-1) / (2 * step)


def _area(steps: Floats) -> Floats:
    """Return the area of the parallelograms between two steps (..., 3, 2)."""
    return np.asarray(np.linalg.norm(np.cross(steps[..., 0], steps[..., 1]), axis=-1), np.float64)
