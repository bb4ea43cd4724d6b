"""Polygons on pixels: masks, areas compared with shapely's, CRS round trips, and parts of patches."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyproj
import pytest
import shapely
from affine import Affine
from hypothesis import given
from hypothesis import strategies as st
from odc.geo.geobox import GeoBox

from spectralzoom.pipeline.geometry.grid import SceneGrid, patch_means
from spectralzoom.pipeline.ground.field_places import NoPlace, PlacedPicture, PosedField
from spectralzoom.pipeline.ground.map_grid import ground_grid
from spectralzoom.pipeline.ground.view import GroundView, RigPose
from spectralzoom.pipeline.ground.zones import figures_of_plot, on_field, pixels_inside

SHAPE = (60, 80)
corners = st.lists(st.tuples(st.floats(-20, 100), st.floats(-20, 80)), min_size=3, max_size=8)
polygons = corners.map(lambda points: shapely.MultiPoint(points).convex_hull).filter(lambda one: one.area > 1)


def posed(lon_deg: float = 7.6, lat_deg: float = 51.96, *, tilt_deg: float = 35.0) -> PosedField:
    """Return a field of 60 x 80 px of 1 mrad in front of a rig 30 m high."""
    pose = RigPose(lon_deg=lon_deg, lat_deg=lat_deg, heading_deg=20.0, tilt_deg=tilt_deg, height_m=30.0)
    return PosedField(ground_grid(GroundView(pose, 1e-3), SHAPE))


@given(polygons)
def test_masks_of_a_polygon_and_its_complement_partition_the_pixels(area: Any) -> None:
    """Each pixel belongs to exactly one of the two masks."""
    outside = shapely.box(-200, -200, 300, 300).difference(area)
    inner, outer = pixels_inside([area], SHAPE), pixels_inside([outside], SHAPE)
    assert (inner ^ outer).all()


@given(polygons)
def test_mask_size_is_the_polygon_area(area: Any) -> None:
    """Mask and area differ by at most the border's length plus one pixel."""
    there = area.intersection(shapely.box(0, 0, SHAPE[1], SHAPE[0]))
    assert abs(pixels_inside([area], SHAPE).sum() - there.area) <= there.length + 1


@given(polygons, st.integers(0, 40), st.integers(0, 50))
def test_a_window_shows_its_part_of_the_mask(area: Any, top: int, left: int) -> None:
    """Pixels do not depend on the window's origin, except those whose centres lie on the border."""
    whole = pixels_inside([area], SHAPE)
    part = pixels_inside([area], (20, 30), origin=(top, left))
    y, x = np.nonzero(part != whole[top : top + 20, left : left + 30])
    centres = shapely.points(x + left + 0.5, y + top + 0.5)
    assert (shapely.distance(centres, area.boundary) < 1e-6).all()  # rounding decides on the border


def test_holes_and_separate_parts_are_kept() -> None:
    """The mask has the pixels of a square without its hole, and those of a second rectangle."""
    ring = shapely.box(10, 10, 30, 30).difference(shapely.box(15, 15, 25, 25))
    found = pixels_inside([shapely.union(ring, shapely.box(50, 40, 60, 45))], SHAPE)
    assert found.sum() == 400 - 100 + 50
    assert not found[15:25, 15:25].any()


@pytest.mark.parametrize("crs", [32632, 4326, 3857, 3035, 31466])
def test_polygons_return_from_the_map_unchanged(crs: int) -> None:
    """A polygon in pixels, projected to the ground and to another CRS, returns to its pixels."""
    place = posed()
    drawn = shapely.segmentize(shapely.Polygon([(5, 5), (70, 8), (60, 50), (9, 44)]), 1)
    frame = place.grid.frame
    middle = np.array([SHAPE[1], SHAPE[0]]) / 2
    on_map = shapely.transform(
        drawn, lambda at: frame.ground_to_map(place.view.scene_to_ground((at - middle)[:, ::-1]))
    )
    to_crs = pyproj.Transformer.from_crs(place.crs, crs, always_xy=True)
    away = shapely.transform(on_map, lambda at: np.stack(to_crs.transform(at[:, 0], at[:, 1]), axis=-1))
    assert on_field(away, pyproj.CRS.from_epsg(crs), place).symmetric_difference(drawn).area < 0.02 * drawn.length


@pytest.mark.parametrize("lon_deg", [179.9999, -179.9999])
def test_a_polygon_across_the_antimeridian_stays_whole(lon_deg: float) -> None:
    """Longitudes on both sides of 180 deg cover the field, in one polygon or split as RFC 7946 demands."""
    place = posed(lon_deg, -17.0)
    whole = shapely.Polygon([(179.99, -17.01), (-179.99, -17.01), (-179.99, -16.99), (179.99, -16.99)])
    parts = shapely.union(shapely.box(179.99, -17.01, 180, -16.99), shapely.box(-180, -17.01, -179.99, -16.99))
    for shape in (whole, parts):
        assert pixels_inside([on_field(shape, pyproj.CRS.from_epsg(4326), place)], SHAPE).all()
    assert on_field(shapely.box(-179.9, -17.01, -179.8, -16.99), pyproj.CRS.from_epsg(4326), place).is_empty


def test_ground_behind_the_rig_has_no_pixels() -> None:
    """A polygon around the rig's foot has only its pixels in the field; one behind the rig has none."""
    place = posed()
    foot = np.array(place.grid.frame.ground_to_map(np.zeros((1, 3))))[0]
    around = shapely.Point(foot).buffer(float(place.scale(1e-3).footprint.range_m[1]) * 0.82)  # type: ignore[union-attr]
    found = pixels_inside([on_field(around, place.crs, place)], SHAPE)
    assert 0.1 < found.mean() < 0.9
    assert found[-1].all()
    assert not found[0].any()
    assert on_field(shapely.Point(foot - [0, 60]).buffer(20), place.crs, place).is_empty


@pytest.mark.parametrize("turn", [0.0, 30.0])
def test_a_georeferenced_image_maps_polygons_by_its_transform(turn: float) -> None:
    """Rows and columns follow the GeoBox, also if it is turned. Pixel areas are the product of its sides."""
    affine = Affine.translation(4e5, 5.7e6) @ Affine.rotation(turn) @ Affine.scale(0.5, -0.5)
    place = PlacedPicture(GeoBox(SHAPE, affine, 32632))
    field = shapely.Polygon([place.geobox.affine @ at for at in ((10, 20), (30, 20), (30, 50), (10, 50))])
    found = pixels_inside([on_field(field, place.crs, place)], SHAPE)
    assert found[20:50, 10:30].all()
    assert found.sum() == 600
    assert place.pixel_areas_m2(slice(0, 2), slice(0, 3)) == pytest.approx(
        np.full((2, 3), 0.25), rel=2e-3
    )  # area on the ground, not on the map


@given(polygons)
def test_a_patch_counts_by_its_pixels_inside(area: Any) -> None:
    """The fraction of a patch is the mean of the mask over its pixels on the scene."""
    grid = SceneGrid(*SHAPE, 8)
    kept = pixels_inside([area], SHAPE)
    for patch_number, fraction in zip(grid.every_patch(), patch_means(kept, grid), strict=True):
        y, x = grid.patch_origin(patch_number)
        assert fraction == pytest.approx(kept[y : y + 8, x : x + 8].mean())


def test_plot_confidence_is_the_mean_of_known_pixels() -> None:
    """Pixels of 0.5, 0.7 and 0.9 and an unknown one have the mean of the three. Without a known pixel it is None."""
    classes = np.array([[0, 0], [0, 1]], np.uint8)
    confidence = np.array([[0.5, 0.7], [0.9, np.nan]], np.float32)
    values = (NoPlace((2, 2)), classes, confidence, ("crop", "unknown"))
    whole = figures_of_plot("all", shapely.box(0, 0, 2, 2), *values)
    unknown = figures_of_plot("unknown", shapely.box(1, 1, 2, 2), *values)
    assert (whole.pixels, whole.confidence) == (4, pytest.approx(0.7))
    assert (whole.fractions["unknown"], unknown.fractions["unknown"], unknown.confidence) == (0.25, 1.0, None)
