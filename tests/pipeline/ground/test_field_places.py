"""Position and size of fields on the ground: areas by class, and footprints against figures worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from affine import Affine
from hypothesis import given
from hypothesis import strategies as st
from odc.geo.geobox import GeoBox

from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.pipeline.ground.field_places import (
    NoPlace,
    PlacedPicture,
    PosedField,
    areas_by_number,
    footprint_of,
    scale_of_view,
)
from spectralzoom.pipeline.ground.georeference import pixel_rows_m2
from spectralzoom.pipeline.ground.map_grid import ground_grid
from spectralzoom.pipeline.ground.view import pixel_places
from tests.pipeline.ground.test_view import view

SHAPE = (600, 30)  # more rows than one block holds
CLASSES = np.random.default_rng(0).choice(np.array([0, 2, UNLABELLED], np.uint8), SHAPE)
IFOV = 1e-4


def test_areas_of_a_posed_field_are_sums_of_footprints() -> None:
    """Only pixels below the horizon limit and with a class count; the upper rows see the sky."""
    grid = ground_grid(view(tilt_deg=2.0), SHAPE)
    points = np.stack(np.meshgrid(*pixel_places(SHAPE), indexing="ij"), axis=-1)
    near = grid.frame.view.sink(points) > grid.least_sink
    assert 0 < near.sum() < near.size
    wanted = [grid.frame.view.area_m2(points[near & (number == CLASSES)]).sum() for number in range(3)]
    assert areas_by_number(PosedField(grid), CLASSES, 3) == pytest.approx(wanted, rel=1e-12)


def test_areas_of_a_georeferenced_image_are_on_the_ellipsoid() -> None:
    """Each class's area is the sum of its pixels' areas, on a grid that is turned."""
    geobox = GeoBox(SHAPE, Affine(4.33, 2.5, 534_257, 2.5, -4.33, 5_772_301), "EPSG:32632")
    each = np.stack(list(pixel_rows_m2(geobox)))
    wanted = [each[number == CLASSES].sum() for number in range(3)]
    assert areas_by_number(PlacedPicture(geobox), CLASSES, 3) == pytest.approx(wanted, rel=1e-9)


def test_numbers_out_of_range_are_left_out_and_an_unknown_scale_gives_none() -> None:
    """Numbers below 0 and from the count on are ignored. Without a pixel size the result is None."""
    numbers = np.array([[-1, 0, 0], [1, 2, 7]])
    assert areas_by_number(NoPlace((2, 3), pixel_m=0.5), numbers, 2).tolist() == [0.5, 0.25]
    assert areas_by_number(NoPlace((2, 3)), numbers, 2) is None


def test_a_view_straight_down_has_the_area_of_its_pixels():
    """From 100 m, 400 x 600 pixels of 0.1 mrad, 1 cm each, cover 4 x 6 m. In 8.64 s that is 1 ha an hour."""
    found = scale_of_view(view(IFOV, tilt_deg=90, height_m=100), (400, 600))
    assert found.pixel_m == pytest.approx(0.01)
    assert (found.footprint.width_m, found.footprint.depth_m) == pytest.approx((6, 4))
    assert found.area_m2 == pytest.approx(24)
    assert found.footprint.range_m[0] == pytest.approx(100)
    assert found.hectares_per_hour(8.64) == pytest.approx(1)


def test_range_is_the_length_of_the_oblique_ray():
    """At 30 deg below the horizon the ground is twice as far away as the rig is high."""
    near, middle, far = footprint_of(view(IFOV, tilt_deg=30), (21, 21)).range_m
    assert near < middle < far
    assert middle == pytest.approx(24, rel=1e-4)


@given(tilt=st.floats(15, 90), heading=st.floats(-360, 360), roll=st.floats(-20, 20))
def test_footprint_area_is_the_sum_of_the_pixel_areas(tilt: float, heading: float, roll: float):
    """The sum of pixel areas and the area within the corners agree for any tilt, heading and roll."""
    rig = view(IFOV, tilt_deg=tilt, heading_deg=heading, roll_deg=roll)
    shape = (60, 90)
    places = np.stack(np.meshgrid(*pixel_places(shape), indexing="ij"), axis=-1)
    found = footprint_of(rig, shape)
    assert found.area_m2 == pytest.approx(float(rig.area_m2(places).sum()), rel=1e-4)
    assert found.area_m2 <= found.width_m * found.depth_m * (1 + 1e-9)


@given(tilt=st.floats(15, 90), turn=st.floats(-360, 360))
def test_heading_does_not_change_the_footprint_size(tilt: float, turn: float):
    """Width, depth, area and range depend on the view and not on the compass direction."""
    one, other = (footprint_of(view(IFOV, tilt_deg=tilt, heading_deg=heading), (80, 50)) for heading in (0, turn))
    assert (other.width_m, other.depth_m, other.area_m2) == pytest.approx((one.width_m, one.depth_m, one.area_m2))
    assert other.range_m == pytest.approx(one.range_m)


def test_a_view_of_the_horizon_has_a_finite_footprint():
    """The footprint covers only the part of the field that is mapped, below the horizon."""
    found = footprint_of(view(IFOV, tilt_deg=1), (800, 400))
    assert np.isfinite([found.width_m, found.depth_m, found.area_m2]).all()
    assert found.range_m[2] < 100 * 12 / np.tan(np.deg2rad(1))
