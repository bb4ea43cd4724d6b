"""The map's grid covers the field, agrees with exact areas, and shows the pixels of the scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from odc.geo.geobox import GeoBox
from pyproj import Proj

from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.pipeline.ground import map_grid
from spectralzoom.pipeline.ground.field_places import PosedField
from spectralzoom.pipeline.ground.view import pixel_places
from tests.pipeline.ground.test_view import view


def whole(grid: map_grid.GroundGrid) -> np.ndarray:
    """Return the scene pixels of a whole map."""
    return grid.scene_pixels(slice(0, grid.shape[0]), slice(0, grid.shape[1]))


@pytest.mark.parametrize(
    "pose", [{}, {"tilt_deg": 90.0}, {"roll_deg": 20.0, "slope_deg": 8.0, "aspect_deg": 200.0}, {"lat_deg": -89.5}]
)
def test_map_covers_every_pixel_of_the_field(pose: dict[str, float]):
    """The centres of the scene's corner pixels fall on the map, and the field reaches each of its edges to 3 px."""
    shape = (160, 200)
    grid = map_grid.ground_grid(view(**pose), shape)
    y, x = pixel_places(shape)
    corners = np.array([[y[0], x[0]], [y[0], x[-1]], [y[-1], x[0]], [y[-1], x[-1]]])
    place = grid.frame.ground_to_map(grid.frame.view.scene_to_ground(corners))
    column, row = ~grid.geobox.affine * place.T
    assert (row >= 0).all() and (row <= grid.shape[0]).all()  # noqa: PT018
    assert (column >= 0).all() and (column <= grid.shape[1]).all()  # noqa: PT018
    seen = np.isfinite(whole(grid)[..., 0])
    for edge in (seen[:3], seen[-3:], seen[:, :3], seen[:, -3:]):
        assert edge.any()


@pytest.mark.parametrize("pose", [{}, {"tilt_deg": 90.0}, {"slope_deg": 10.0, "aspect_deg": 120.0}, {"lat_deg": 85.0}])
def test_mapped_area_is_the_sum_of_pixel_footprints(pose: dict[str, float]):
    """The map pixels of the field, times the ground area of each, equal the sum of exact areas to 0.2 %."""
    grid = map_grid.ground_grid(view(**pose), (300, 260))
    rig = grid.frame.view.pose
    pixel_m2 = grid.geobox.resolution.x**2 / Proj(grid.frame.crs).get_factors(rig.lon_deg, rig.lat_deg).areal_scale
    exact = np.nansum(PosedField(grid).pixel_areas_m2(slice(None), slice(None)))
    assert np.isfinite(whole(grid)[..., 0]).sum() * pixel_m2 == pytest.approx(exact, rel=2e-3)


def test_a_map_pixel_shows_the_scene_pixel_that_views_it():
    """The ray of the scene pixel in the geolocation grid ends at the centre of its map pixel, to 1e-6 m."""
    grid = map_grid.ground_grid(view(slope_deg=5.0), (80, 120))
    pixels = whole(grid)
    row, column = (int(at) for at in np.argwhere(np.isfinite(pixels[..., 0]))[1234])
    place = pixels[row, column] - (np.array([80, 120]) - 1) / 2
    found = grid.frame.ground_to_map(grid.frame.view.scene_to_ground(place))
    assert found == pytest.approx(grid.geobox.affine * (column + 0.5, row + 0.5), abs=1e-6)


@pytest.mark.parametrize(("step", "bound"), [(0.05, 1e-6), (1.0, 2e-5)])
@pytest.mark.parametrize("pose", [{}, {"lat_deg": 85.0}, {"lat_deg": -79.0, "slope_deg": 12.0}])
def test_places_interpolated_between_tie_points_are_exact(pose: dict[str, float], step: float, bound: float):
    """Places interpolated linearly between tie points every 32 pixels agree with PROJ to the given part of a pixel."""
    grid = map_grid.ground_grid(view(**({"height_m": 1000.0, "tilt_deg": 80.0} | pose)), (900, 900))
    grid = replace(grid, geobox=GeoBox.from_bbox(grid.geobox.boundingbox, resolution=step))
    rows, columns = (slice(size // 3, size // 3 + 75) for size in grid.shape)
    x, y = (np.arange(part.start, part.stop) + 0.5 for part in (columns, rows))
    affine = grid.geobox.affine
    exact = grid.frame.map_to_ground(np.stack(np.meshgrid(affine.c + affine.a * x, affine.f + affine.e * y), axis=-1))
    assert np.abs(grid.ground_m(rows, columns) - exact).max() / step < bound


def test_resolution_is_the_rounded_median_footprint():
    """It differs from the median footprint by a ratio below 1.16."""
    rig = view()
    step = map_grid.ground_grid(rig, (200, 200)).geobox.resolution.x
    assert abs(np.log(step / map_grid.median_footprint_m(rig, (200, 200)))) < np.log(1.16)
    assert step == map_grid.round_step(step) == float(f"{step:.1e}")


def test_grids_of_two_poses_share_their_pixel_raster():
    """A rig moved by a metre gets another map, whose origin differs by whole pixels."""
    here, there = (map_grid.ground_grid(view(lat_deg=52.1 + shift), (90, 90)) for shift in (0.0, 1e-5))
    offset = (here.geobox.affine.f - there.geobox.affine.f) / here.geobox.resolution.x
    assert offset == pytest.approx(round(offset), abs=1e-4)
    assert abs(offset) > 10


def test_far_pixels_are_left_out_and_counted():
    """Towards the horizon footprints grow; the map ends where they are 8 times the median. All pixels are counted."""
    grid = map_grid.ground_grid(view(tilt_deg=0.5), (400, 300))
    counts = grid.counts()
    assert all(count > 0 for count in counts.values())
    assert sum(counts.values()) == 400 * 300
    assert grid.shape[0] * grid.shape[1] < 1.4 * 8 * 400 * 300  # rounded
    assert grid.least_sink == pytest.approx(map_grid.median_sink(grid.frame.view, (400, 300)) / 4)
    nearest_sky = np.nanmin(whole(grid)[..., 0]) - 199.5
    side = np.sqrt(grid.frame.view.area_m2([nearest_sky, 0.0]))
    assert side == pytest.approx(8 * map_grid.median_footprint_m(grid.frame.view, (400, 300)), rel=0.2)


def test_the_nearest_pixel_is_read():
    """A pixel reaches half a pixel to either side of its centre. NaN places have no class."""
    classes = np.arange(12, dtype=np.uint8).reshape(3, 4)
    places = np.array([[[-0.5, -0.5], [0.49, 0.51], [2.5, 3.5], [np.nan, 1.0]]])
    assert map_grid.nearest_at(classes, places, UNLABELLED).tolist() == [[0, 1, 11, UNLABELLED]]


def test_images_are_interpolated_between_pixels():
    """A ramp is read exactly; beyond the outer centres the outer pixels count. NaN does not change its neighbours."""
    y, x = (np.arange(size) for size in (5, 6))
    ramp = (y[:, None] * 2 + x).astype(np.float32)[..., None]
    found = map_grid.image_at(ramp, np.array([[[0.75, 1.5], [4.4, 2.0], [np.nan, np.nan]]]))[0, :, 0]
    assert found[:2] == pytest.approx([3.0, 10.0], abs=1e-5)
    assert np.isnan(found[2])
    ramp[0, 0] = np.nan
    assert np.isnan(map_grid.image_at(ramp, np.array([[[0.0, 0.0]]]))).all()
    assert map_grid.image_at(ramp, np.array([[[0.0, 0.75]]]))[0, 0, 0] == pytest.approx(1.0)
