"""Convert polygons from any coordinates to a field: their pixels, parts of patches, and figures of plots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.pipeline.ground.field_places import FieldPlace, GroundPlace
from spectralzoom.pipeline.ground.georeference import WGS84

Mask = NDArray[np.bool_]
ROUND_THE_FIELD = 1.0  # times its size, on every side, within which polygons are converted
EDGE_PARTS = 256  # of that: a straight edge of one map is curved on another
FAR_EAST_DEG = 90.0  # beyond this longitude of the field, those of polygons count from it and not from Greenwich


def on_field(shape: BaseGeometry, crs: pyproj.CRS, place: GroundPlace) -> BaseGeometry:
    """Convert a polygon to the pixels of a field, as far as it lies there or near; empty if it does not.

    ``crs`` is that of the polygon, x before y, and its edges are straight there.
    """
    to_place = pyproj.Transformer.from_crs(crs, place.crs, always_xy=True)
    middle = _middle_deg(place) if crs.is_geographic else None
    back = pyproj.Transformer.from_crs(place.crs, crs, always_xy=True)
    outline = shapely.transform(place.outline, lambda at: np.stack(back.transform(at[:, 0], at[:, 1]), axis=-1))
    there, given = (_unwrapped(one, middle) for one in (outline, shape))
    (west, south), (east, north) = np.reshape(there.bounds, (2, 2))
    by = ROUND_THE_FIELD * max(east - west, north - south)
    around = shapely.box(west - by, south - by, east + by, north + by)
    near = shapely.intersection(given, around)
    if near.is_empty:
        return near
    fine = shapely.segmentize(near, max(np.ptp(np.reshape(around.bounds, (2, 2)), axis=0)) / EDGE_PARTS)
    moved = shapely.transform(fine, lambda places: np.stack(to_place.transform(places[:, 0], places[:, 1]), axis=-1))
    return place.to_pixels(shapely.make_valid(moved))


def extent_deg(shape: BaseGeometry, crs: pyproj.CRS) -> tuple[float, float, float, float]:
    """Return the west, south, east and north of a polygon [deg], for messages."""
    places = shapely.get_coordinates(shape)
    lon, lat = pyproj.Transformer.from_crs(crs, WGS84, always_xy=True).transform(places[:, 0], places[:, 1])
    return float(np.min(lon)), float(np.min(lat)), float(np.max(lon)), float(np.max(lat))


def _middle_deg(place: GroundPlace) -> float | None:
    """Return the longitude of a field so near 180 degrees that polygons may cross it; None for all others."""
    west, _, east, _ = extent_deg(place.outline, place.crs)
    middle = east if east - west > 180 else (west + east) / 2
    return middle if abs(middle) > FAR_EAST_DEG else None


def _unwrapped(shape: BaseGeometry, middle_deg: float | None) -> BaseGeometry:
    """Return a polygon with longitudes within 180 degrees of ``middle_deg``; unchanged if that is None."""
    if middle_deg is None:
        return shape
    return shapely.make_valid(
        shapely.transform(
            shape, lambda at: np.column_stack([(at[:, 0] - middle_deg + 180) % 360 - 180 + middle_deg, at[:, 1:]])
        )
    )


def pixels_inside(shapes: Sequence[BaseGeometry], size: tuple[int, int], *, origin: tuple[int, int] = (0, 0)) -> Mask:
    """Return which of (y, x) ``size`` pixels from row and column ``origin`` on have their centres in polygons."""
    import rasterio
    import rasterio.features as rasterio_features

    given = [one for one in shapes if not one.is_empty]
    if not given:
        return np.zeros(size, bool)
    place = rasterio.Affine.translation(origin[1], origin[0])
    found = rasterio_features.rasterize(given, out_shape=size, transform=place, dtype="uint8")
    return np.asarray(found, np.bool_)


@dataclass(frozen=True)
class PlotFigures:
    """Figures of one plot, as far as it lies on the field and is mapped."""

    plot: str
    pixels: int  # with their centres in it
    mapped_pixels: int  # of them, those with a class
    area_m2: float | None  # of the mapped pixels; None if their size is unknown
    confidence: float | None  # mean over the mapped pixels with a confidence
    fractions: dict[str, float | None]  # of the mapped area by class, or of the pixels if it is unknown


def figures_of_plot(
    plot: str,
    shape: BaseGeometry,
    place: FieldPlace,
    classes: NDArray[np.uint8],
    confidence: NDArray[np.float32],
    names: tuple[str, ...],
) -> PlotFigures:
    """Return the figures of a plot whose outline is in pixels of a (y, x) class map. Plots may overlap."""
    rows, columns = _window(shape, classes.shape)
    drawn = classes[rows, columns]
    inside = pixels_inside([shape], drawn.shape, origin=(rows.start, columns.start))
    mapped = inside & (drawn != UNLABELLED)
    ground = place.pixel_areas_m2(rows, columns)
    weight = np.where(mapped, 1.0 if ground is None else np.nan_to_num(ground), 0.0)
    by_class = np.bincount(drawn[mapped], weight[mapped], len(names))
    total = float(weight.sum())
    sure = confidence[rows, columns][mapped]
    sure = sure[np.isfinite(sure)]  # unknown pixels have no confidence
    return PlotFigures(
        plot,
        int(inside.sum()),
        int(mapped.sum()),
        None if ground is None else total,
        float(sure.mean(dtype=np.float64)) if sure.size else None,
        {name: float(one) / total if total else None for name, one in zip(names, by_class, strict=True)},
    )


def _window(shape: BaseGeometry, size: tuple[int, ...]) -> tuple[slice, slice]:
    """Return the rows and columns of a map of ``size`` around a polygon, at least one each."""
    bounds = np.zeros(4) if shape.is_empty else np.array(shape.bounds)
    firsts = (min(max(int(np.floor(low)), 0), most - 1) for low, most in zip(bounds[[1, 0]], size, strict=True))
    lasts = (min(max(int(np.ceil(high)), 1), most) for high, most in zip(bounds[[3, 2]], size, strict=True))
    rows, columns = (slice(first, max(last, first + 1)) for first, last in zip(firsts, lasts, strict=True))
    return rows, columns
