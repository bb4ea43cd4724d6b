"""Ground coordinates on the earth: textbook Cartesian coordinates, geodesics, exact inverses, and the CRS chosen."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import Geod, Proj

from pipeline.errors import PoseError
from pipeline.ground.map_grid import MapFrame, default_epsg, map_crs
from pipeline.ground.view import GroundView, RigPose

SEMI_MAJOR_M, FLATTENING = 6378137.0, 1 / 298.257223563
ECCENTRICITY2 = FLATTENING * (2 - FLATTENING)


def frame(lon: float = 9.5, lat: float = 52.1, epsg: int | None = None, **more: float) -> MapFrame:
    """A map around a rig at the place, 100 m up and looking down at 45 deg."""
    pose = RigPose(lon_deg=lon, lat_deg=lat, height_m=100.0, heading_deg=40.0, tilt_deg=45.0, **more)
    return MapFrame(GroundView(pose, 1e-4), map_crs(pose, epsg))


def earth_centred(lon_deg: float, lat_deg: float, height_m: float) -> np.ndarray:
    """Cartesian coordinates of the earth, the textbook's way."""
    lon, lat = np.deg2rad([lon_deg, lat_deg])
    normal = SEMI_MAJOR_M / np.sqrt(1 - ECCENTRICITY2 * np.sin(lat) ** 2)
    flat = (normal + height_m) * np.cos(lat)
    return np.array([flat * np.cos(lon), flat * np.sin(lon), (normal * (1 - ECCENTRICITY2) + height_m) * np.sin(lat)])


@pytest.mark.parametrize(("lon", "lat"), [(9.5, 52.1), (-70.2, -33.4), (179.9999, 10.0), (20.0, 89.0), (0.0, 0.0)])
def test_metres_around_the_foot_are_the_textbooks(lon: float, lat: float):
    """East, north and up of the foot, added in Cartesian coordinates, come to the same longitude, latitude, height."""
    east_north_up = np.array([1200.0, -800.0, 35.0])
    a, b = np.deg2rad([lon, lat])
    east = np.array([-np.sin(a), np.cos(a), 0])
    up = np.array([np.cos(b) * np.cos(a), np.cos(b) * np.sin(a), np.sin(b)])
    wanted = earth_centred(lon, lat, 250.0) + east_north_up @ np.stack([east, np.cross(up, east), up])
    found = frame(lon, lat, elevation_m=250.0).ground_to_geodetic(east_north_up)
    assert earth_centred(*found) == pytest.approx(wanted, abs=1e-8)


@settings(max_examples=40)
@given(
    st.floats(-180, 180),
    st.floats(-89.9, 89.9),
    st.floats(-2000, 2000),
    st.floats(-2000, 2000),
    st.floats(0, 15),
    st.floats(-180, 180),
)
def test_map_and_ground_undo_each_other(lon: float, lat: float, east: float, north: float, slope: float, aspect: float):
    """Points of the plane come back from the map to a tenth of a micrometre, wherever the rig stands."""
    around = frame(lon, lat, slope_deg=slope, aspect_deg=aspect, elevation_m=700.0)
    point = np.array([east, north, 0.0])
    point[2] = -point @ around.view.normal
    assert around.map_to_ground(around.ground_to_map(point)) == pytest.approx(point, abs=1e-6)


def test_nothing_is_taken_for_flat():
    """A kilometre away the geodesic agrees to 0.1 mm, metres per degree at the foot do not to 5 cm."""
    around, point = frame(), np.array([700.0, 714.0, 0.0])
    lon, lat, height = around.ground_to_geodetic(point)
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
def test_the_rigs_own_zone_is_taken(lon: float, lat: float, epsg: int):
    """UTM by longitude and hemisphere, polar stereographic beyond 84 N and 80 S."""
    around = frame(lon, lat)
    assert default_epsg(around.view.pose) == epsg
    x, y = around.ground_to_map([0, 0, 0])
    assert Proj(epsg)(lon, lat) == pytest.approx((x, y), abs=1e-4)


@pytest.mark.parametrize(
    ("epsg", "words"),
    [
        (32601, "made for longitudes -180 to -174.*lon_deg 9.5, lat_deg 52.1; leave epsg out for EPSG:32632"),
        (4326, r"EPSG:4326 \(WGS 84\) is no projected CRS in metres"),
        (2263, "no projected CRS in metres"),
        (30001, "there is no EPSG:30001; give the code of a projected CRS"),
    ],
)
def test_a_crs_that_does_not_suit_is_refused(epsg: int, words: str):
    """Another place's zone, degrees, feet and codes that do not exist say what to do."""
    with pytest.raises(PoseError, match=words):
        frame(epsg=epsg)


def test_any_projected_crs_of_the_place_can_be_asked_for():
    """ETRS89 / UTM 32N and Lambert's conformal cone for Europe, and a neighbouring zone just across its border."""
    assert frame(epsg=25832).ground_to_map([0, 0, 0]) == pytest.approx(frame().ground_to_map([0, 0, 0]), abs=1e-3)
    assert frame(epsg=3034).crs.name.endswith("LCC Europe")
    assert frame(lon=12.3, epsg=32632).crs.utm_zone == "32N"


@pytest.mark.parametrize(
    ("place", "square_m2"),
    [
        ({"lon": 9.0}, 0.9996**2),
        ({"epsg": 3857}, 2.6458),
        ({"lon": 9.0, "elevation_m": 2000.0}, 0.9996**2 * (1 - 6.26e-4)),
    ],
)
def test_the_map_has_its_own_scale(place: dict[str, float], square_m2: float):
    """A square metre is 0.9992 m2 near a UTM zone's axis, 2.65 m2 in web Mercator, and less on high ground."""
    origin, east, north = frame(**place).ground_to_map(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]))
    a, b = east - origin, north - origin
    assert a[0] * b[1] - a[1] * b[0] == pytest.approx(square_m2, rel=1e-4)


def test_nan_stays_nan():
    """A ray without ground has no place on the map."""
    assert np.isnan(frame().ground_to_map([np.nan, 0, 0])).all()
