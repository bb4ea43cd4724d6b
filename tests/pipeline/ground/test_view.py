"""Rays of a posed rig: known places, exact inverses, footprints as derivatives, the horizon, geodetic coordinates."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import CRS, Geod, Proj

from spectralzoom.pipeline.errors import PoseError
from spectralzoom.pipeline.ground.map_grid import MapFrame, default_epsg
from spectralzoom.pipeline.ground.view import GroundView, RigPose, pixel_places

IFOV = 7.4e-3 / 70
SEMI_MAJOR_M, FLATTENING = 6378137.0, 1 / 298.257223563
ECCENTRICITY2 = FLATTENING * (2 - FLATTENING)


def view(ifov_rad: float = IFOV, **changes: float | None) -> GroundView:
    """Return a rig 12 m above ground near Hanover that looks down at 40 deg, with ``changes``."""
    given: dict[str, Any] = {"lon_deg": 9.5, "lat_deg": 52.1, "heading_deg": 30.0, "tilt_deg": 40.0, "height_m": 12.0}
    return GroundView(RigPose(**(given | changes)), ifov_rad)


poses = st.builds(
    lambda heading, tilt, roll, slope, aspect: view(
        heading_deg=heading, tilt_deg=tilt, roll_deg=roll, slope_deg=slope, aspect_deg=aspect
    ),
    st.floats(-360, 360),
    st.floats(20, 90),
    st.floats(-180, 180),
    st.floats(0, 10),
    st.floats(-180, 180),
)
places = st.tuples(st.floats(-900, 900), st.floats(-900, 900))


def test_a_view_straight_down_is_a_north_up_image():
    """At tilt 90 and heading 0, x is east and y is south; distances are height times tangent."""
    points = view(heading_deg=0, tilt_deg=90, height_m=10).scene_to_ground([[0, 0], [0, 100], [100, 0]])
    step = 100 * IFOV * 10
    assert points == pytest.approx(np.array([[0, 0, 0], [step, 0, 0], [0, -step, 0]]), abs=1e-12)


@pytest.mark.parametrize(("heading", "towards"), [(0, (0, 1)), (90, (1, 0)), (180, (0, -1)), (-90, (-1, 0))])
def test_the_undeflected_ray_points_along_the_heading(heading: float, towards: tuple[int, int]):
    """At 45 deg the centre of the scene is as far ahead as the rig is high."""
    found = view(heading_deg=heading, tilt_deg=45, height_m=10).scene_to_ground([0, 0])
    assert found == pytest.approx([10 * towards[0], 10 * towards[1], 0], abs=1e-12)


def test_lower_rows_are_nearer_and_positive_roll_lowers_the_right_side():
    """y grows towards the rig. With positive roll a pixel on the right points further down than one on the left."""
    straight, rolled = view(), view(roll_deg=10)
    near, far = straight.scene_to_ground([[300, 0], [-300, 0]])
    assert np.hypot(*near[:2]) < np.hypot(*far[:2])
    right, left = rolled.sink([[0, 300], [0, -300]])
    assert right > left
    assert straight.sink([0, 300]) == pytest.approx(straight.sink([0, -300]))


@given(poses, places)
def test_ground_to_scene_inverts_scene_to_ground(rig: GroundView, place: tuple[float, float]):
    """Every ray that meets the ground ends on its plane, and its point leads back to its pixel."""
    ground = rig.scene_to_ground(place)
    if rig.sink(place) < 0.05:
        return
    assert rig.ground_to_scene(ground) == pytest.approx(place, abs=1e-8)
    assert ground @ rig.normal == pytest.approx(0, abs=1e-9)


@given(poses, places)
def test_pixel_areas_are_derivatives_of_ground_points(rig: GroundView, place: tuple[float, float]):
    """A pixel's level area agrees with finite differences along its two sides."""
    if rig.sink(place) < 0.1:
        return
    half = 0.05
    y, x = place
    down = (rig.scene_to_ground([y + half, x]) - rig.scene_to_ground([y - half, x])) / (2 * half)
    right = (rig.scene_to_ground([y, x + half]) - rig.scene_to_ground([y, x - half])) / (2 * half)
    assert rig.area_m2(place) == pytest.approx(abs(down[0] * right[1] - down[1] * right[0]), rel=1e-5)


def test_a_range_determines_the_height():
    """With a range of 18 m to ground that falls by 5 deg along the view, the undeflected ray is 18 m long."""
    rig = view(height_m=None, range_m=18.0, slope_deg=5.0, aspect_deg=30.0)
    centre = rig.scene_to_ground([0, 0])
    assert np.linalg.norm(centre - [0, 0, rig.height_m]) == pytest.approx(18.0)
    assert centre[2] == pytest.approx(-np.tan(np.deg2rad(5)) * np.hypot(*centre[:2]))


def test_ground_descends_towards_its_aspect():
    """Ground of aspect 90 deg is lower in the east, so rays to the east reach further."""
    rig = view(tilt_deg=90, heading_deg=0, slope_deg=20, aspect_deg=90)
    east, west = rig.scene_to_ground([[0, 1000], [0, -1000]])
    assert east[2] < 0 < west[2]
    assert east[0] > -west[0]


def test_rays_without_ground_are_nan_and_counted():
    """With the horizon across the middle of the scene, the upper rows have no ground and no area."""
    rig = view(tilt_deg=0)
    y, x = pixel_places((101, 40))
    points = np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1)
    ground = rig.scene_to_ground(points)
    assert np.isnan(ground[:51]).all()
    assert np.isfinite(ground[51:]).all()
    assert rig.count_ground((101, 40)) == 50 * 40 == np.isfinite(rig.area_m2(points)).sum()


@given(poses, st.floats(0.01, 1.2))
def test_outline_contains_exactly_the_pixels_below_the_least_sink(rig: GroundView, least: float):
    """Its corners sink by at least the limit, and its area is the number of such pixels to 120."""
    outline = rig.outline_px((90, 120), least)
    assert (rig.sink(outline) >= least - 1e-9).all()
    after = np.roll(outline, -1, axis=0)
    area = abs(np.sum(outline[:, 0] * after[:, 1] - outline[:, 1] * after[:, 0])) / 2
    assert rig.count_ground((90, 120), least) == pytest.approx(area, abs=120)


def test_a_pose_needs_either_height_or_range():
    """Neither of them is too little, both are ambiguous."""
    for said in ({"height_m": None}, {"range_m": 5.0}):
        with pytest.raises(PoseError, match="height_m or range_m, one of the two"):
            view(**said)


def frame(lon: float = 9.5, lat: float = 52.1, **more: float) -> MapFrame:
    """Return a map around a rig at the place, 100 m up and looking down at 45 deg."""
    pose = RigPose(lon_deg=lon, lat_deg=lat, height_m=100.0, heading_deg=40.0, tilt_deg=45.0, **more)
    return MapFrame(GroundView(pose, 1e-4), CRS.from_epsg(default_epsg(pose)))


def earth_centred(lon_deg: float, lat_deg: float, height_m: float) -> np.ndarray:
    """Return Cartesian earth-centred coordinates by the textbook's formula."""
    lon, lat = np.deg2rad([lon_deg, lat_deg])
    normal = SEMI_MAJOR_M / np.sqrt(1 - ECCENTRICITY2 * np.sin(lat) ** 2)
    flat = (normal + height_m) * np.cos(lat)
    return np.array([flat * np.cos(lon), flat * np.sin(lon), (normal * (1 - ECCENTRICITY2) + height_m) * np.sin(lat)])


@pytest.mark.parametrize(("lon", "lat"), [(9.5, 52.1), (-70.2, -33.4), (179.9999, 10.0), (20.0, 89.0), (0.0, 0.0)])
def test_local_metres_agree_with_cartesian_coordinates(lon: float, lat: float):
    """East, north and up of the rig's foot, added in Cartesian coordinates, give the same geodetic position."""
    east_north_up = np.array([1200.0, -800.0, 35.0])
    a, b = np.deg2rad([lon, lat])
    east = np.array([-np.sin(a), np.cos(a), 0])
    up = np.array([np.cos(b) * np.cos(a), np.cos(b) * np.sin(a), np.sin(b)])
    wanted = earth_centred(lon, lat, 250.0) + east_north_up @ np.stack([east, np.cross(up, east), up])
    found = frame(lon, lat, elevation_m=250.0).ground_to_geodetic(east_north_up)
    assert earth_centred(*found) == pytest.approx(wanted, abs=1e-8)


@given(
    st.floats(-180, 180),
    st.floats(-89.9, 89.9),
    st.floats(-2000, 2000),
    st.floats(-2000, 2000),
    st.floats(0, 15),
    st.floats(-180, 180),
)
def test_map_and_ground_are_inverse(lon: float, lat: float, east: float, north: float, slope: float, aspect: float):
    """Points of the plane return from the map to 1e-6 m, anywhere on the earth."""
    around = frame(lon, lat, slope_deg=slope, aspect_deg=aspect, elevation_m=700.0)
    point = np.array([east, north, 0.0])
    point[2] = -point @ around.view.normal
    assert around.map_to_ground(around.ground_to_map(point)) == pytest.approx(point, abs=1e-6)


def test_ground_positions_include_the_curvature_of_the_earth():
    """A kilometre away the geodesic distance agrees to 0.1 mm; metres per degree at the foot err by over 5 cm."""
    point = np.array([700.0, 714.0, 0.0])
    lon, lat, height = frame().ground_to_geodetic(point)
    azimuth, _, distance = Geod(ellps="WGS84").inv(9.5, 52.1, lon, lat)
    assert distance == pytest.approx(np.hypot(*point[:2]), abs=1e-4)
    assert azimuth == pytest.approx(np.rad2deg(np.arctan2(*point[:2])), abs=1e-5)
    assert height == pytest.approx(distance**2 / 2 / 6.38e6, rel=1e-2)
    b = np.deg2rad(52.1)
    normal = SEMI_MAJOR_M / np.sqrt(1 - ECCENTRICITY2 * np.sin(b) ** 2)
    meridian = normal * (1 - ECCENTRICITY2) / (1 - ECCENTRICITY2 * np.sin(b) ** 2)
    flat = np.deg2rad([(lon - 9.5) * np.cos(b), lat - 52.1]) * [normal, meridian]
    assert np.hypot(*(flat - point[:2])) > 0.05


@pytest.mark.parametrize(
    ("lon", "lat", "epsg"),
    [
        (9.5, 52.1, 32632),
        (-179.99, 1.0, 32601),
        (179.99, 1.0, 32660),
        (180.0, -1.0, 32701),
        (-58.4, -34.6, 32721),
        (15.0, 84.1, 5041),
        (15.0, -80.5, 5042),
    ],
)
def test_default_crs_is_the_zone_of_the_rig(lon: float, lat: float, epsg: int):
    """UTM zones follow longitude and hemisphere; beyond 84 N and 80 S the CRS is polar stereographic."""
    around = frame(lon, lat)
    assert default_epsg(around.view.pose) == epsg
    x, y = around.ground_to_map([0, 0, 0])
    assert Proj(epsg)(lon, lat) == pytest.approx((x, y), abs=1e-4)


@pytest.mark.parametrize(
    ("place", "square_m2"),
    [({"lon": 9.0}, 0.9996**2), ({"lon": 9.0, "elevation_m": 2000.0}, 0.9996**2 * (1 - 6.26e-4))],
)
def test_the_map_scale_depends_on_projection_and_elevation(place: dict[str, float], square_m2: float):
    """A square metre is 0.9992 m2 near a UTM zone's axis, and less on high ground."""
    origin, east, north = frame(**place).ground_to_map(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]))
    a, b = east - origin, north - origin
    assert a[0] * b[1] - a[1] * b[0] == pytest.approx(square_m2, rel=1e-4)
