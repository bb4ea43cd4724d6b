"""Poses at their limits: nadir, horizon, sky, slopes, poles, date line, and a scene of one pixel."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from pyproj import Proj

from spectralzoom.pipeline.errors import PoseError
from spectralzoom.pipeline.ground.field_places import PosedField
from spectralzoom.pipeline.ground.map_grid import ground_grid
from tests.pipeline.ground.test_ground_grid import whole
from tests.pipeline.ground.test_view import IFOV
from tests.pipeline.ground.test_view import view as view_of

view = partial(view_of, heading_deg=0.0)


def test_nadir_view_keeps_the_heading_of_the_rig():
    """At nadir the image's upper edge points along the rig's heading, and pixels are square."""
    rig = view(tilt_deg=90.0, heading_deg=70.0)
    up = rig.scene_to_ground([-1000, 0])
    assert np.rad2deg(np.arctan2(up[0], up[1])) == pytest.approx(70.0)
    ends = rig.scene_to_ground([[-0.5, 0], [0.5, 0], [0, -0.5], [0, 0.5]])
    assert np.linalg.norm(ends[1::2] - ends[::2], axis=1) == pytest.approx([12 * IFOV] * 2)
    assert rig.ground_to_scene(rig.scene_to_ground([0, 0])) == pytest.approx([0, 0], abs=1e-9)


def test_ray_at_or_above_the_horizon_meets_no_ground():
    """Level and upward rays are NaN in both directions; a ray 0.001 px below the horizon is finite."""
    rig = view(tilt_deg=0.0)
    assert np.isnan(rig.scene_to_ground([[0, 0], [0, 500], [-1, 0]])).all()
    assert np.isfinite(rig.scene_to_ground([1e-3, 0])).all()
    assert np.isnan(rig.ground_to_scene([[0, -5, 0], [0, 0, 0], [3, 0, 12]])).all()


def test_field_without_ground_is_refused_with_its_pose():
    """The message names tilt, height and the remedy; a range needs a view that meets the ground."""
    with pytest.raises(PoseError, match=r"no ray of the field meets the ground .*tilt_deg -20, height_m 12.*tilt it"):
        ground_grid(view(tilt_deg=-20.0), (64, 64))
    with pytest.raises(PoseError, match="a range needs a view direction that meets the ground"):
        ground_grid(view(tilt_deg=0.0, height_m=None, range_m=30.0), (64, 64))


@pytest.mark.parametrize("slope", [30.0, 45.0])
def test_ground_that_falls_as_steeply_as_the_rays_is_not_met(slope: float):
    """At 30 deg half of the field and at 45 deg all of it has no ground; facing the slope, the field is full."""
    away = view(tilt_deg=30.0, slope_deg=slope, aspect_deg=0.0)
    if slope > 30:
        with pytest.raises(PoseError, match="slope_deg 45"):
            ground_grid(away, (80, 80))
    else:
        assert away.count_ground((80, 80)) == 40 * 80
    assert view(tilt_deg=30.0, slope_deg=slope, aspect_deg=180.0).count_ground((80, 80)) == 80 * 80


@pytest.mark.parametrize(("lat", "epsg"), [(85.3, 5041), (89.9999, 5041), (90.0, 5041), (-88.0, 5042), (-90.0, 5042)])
def test_map_near_a_pole_is_stereographic(lat: float, epsg: int):
    """Beyond UTM's limits, 84 N and 80 S, the default is stereographic up to the pole, and areas agree to 1 %."""
    grid = ground_grid(view(lat_deg=lat), (120, 90))
    assert grid.geobox.crs.epsg == epsg
    pixel_m2 = grid.geobox.resolution.x**2 / Proj(grid.frame.crs).get_factors(9.5, lat).areal_scale
    exact = np.nansum(PosedField(grid).pixel_areas_m2(slice(None), slice(None)))
    assert np.isfinite(whole(grid)[..., 0]).sum() * pixel_m2 == pytest.approx(exact, rel=1e-2)


@pytest.mark.parametrize(("lon", "heading"), [(179.99999, 90.0), (-179.99999, -90.0), (180.0, 90.0), (-180.0, 0.0)])
def test_field_across_the_date_line_is_one_map(lon: float, heading: float):
    """The map lies in the rig's zone and is as large as that of the same field elsewhere."""
    across = ground_grid(view(lon_deg=lon, lat_deg=-17.0, heading_deg=heading), (100, 100))
    here = ground_grid(view(lon_deg=170.5, lat_deg=-17.0, heading_deg=heading), (100, 100))
    assert np.abs(np.array(across.shape) - here.shape).max() <= 8  # meridian convergence rotates it slightly
    assert np.isfinite(whole(across)[..., 0]).mean() == pytest.approx(np.isfinite(whole(here)[..., 0]).mean(), abs=0.1)


def test_scene_of_one_pixel_has_a_map():
    """One pixel covers 1 to 6 pixels of the map, all within half a pixel, and counts as mapped."""
    grid = ground_grid(view(), (1, 1))
    places = whole(grid)[..., 0]
    assert 1 <= np.isfinite(places).sum() <= 6
    assert np.nanmax(np.abs(places)) <= 0.5
    assert grid.counts() == {"mapped_px": 1, "beyond_reach_px": 0, "no_ground_px": 0}
