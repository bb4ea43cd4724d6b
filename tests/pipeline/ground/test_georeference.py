"""Pixel areas and coarser grids of georeferenced scenes."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest
from affine import Affine
from hypothesis import given
from hypothesis import strategies as st
from odc.geo.geobox import GeoBox

from spectralzoom.pipeline.geometry.grid import SceneGrid, patch_pixels
from spectralzoom.pipeline.ground.georeference import pixel_rows_m2, pixel_side_m, zoomed_out

PLACES = {32632: (8.0, 51.0), 3857: (8.0, 60.0), 3035: (8.0, 51.0), 4326: (8.0, 51.0), 2263: (-74.0, 40.7)}
PLACES |= {6933: (8.0, 51.0), 3413: (0.0, 90.0)}  # stretched to equal areas; a corner at the pole


def box(epsg: int, step: float, turn: float = 20, shape: tuple[int, int] = (300, 400)) -> GeoBox:
    """Return a turned grid at a usual place of its CRS."""
    left, top = pyproj.Transformer.from_crs(4326, epsg, always_xy=True).transform(*PLACES[epsg])
    cos, sin = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    return GeoBox(shape, Affine(step * cos, step * sin, left, step * sin, -step * cos, top), f"EPSG:{epsg}")


@pytest.mark.parametrize(
    ("epsg", "step"), [(32632, 10.0), (3857, 10.0), (3035, 10.0), (4326, 1e-4), (2263, 30.0), (3413, 10.0)]
)
def test_areas_are_on_the_ellipsoid(epsg: int, step: float) -> None:
    """In metres, feet and degrees, for any projection, pixel areas sum to the area of the outline on the ellipsoid."""
    geobox = box(epsg, step)
    rows, columns = geobox.shape
    fraction = np.linspace(0, 1, 2000)
    nothing, whole = np.zeros(2000), np.ones(2000)
    column = np.concatenate([fraction, whole, 1 - fraction, nothing]) * columns
    row = np.concatenate([nothing, fraction, whole, 1 - fraction]) * rows
    a, b, c, d, e, f = geobox.affine[:6]
    to_degrees = pyproj.Transformer.from_crs(epsg, 4326, always_xy=True)
    places = to_degrees.transform(a * column + b * row + c, d * column + e * row + f)
    outline = abs(pyproj.CRS.from_epsg(epsg).get_geod().polygon_area_perimeter(*places)[0])
    assert np.sum(list(pixel_rows_m2(geobox))) == pytest.approx(outline, rel=1e-5)
    assert pixel_side_m(geobox) == pytest.approx(np.sqrt(outline / rows / columns), rel=1e-3)


EARTH_M2 = 5.1006562172e14  # of the ellipsoid of WGS 84


@pytest.mark.parametrize(
    ("transform", "shape", "fraction"),
    [
        (Affine(1, 0, -180, 0, -1, 90), (180, 360), 1.0),
        (Affine(1, 0, -180, 0, -1, 90.5), (181, 360), 1.0),  # half a pixel beyond each pole
        (Affine(1, 0, 0, 0, -1, 90), (90, 180), 0.25),
    ],
)
def test_areas_at_the_poles(transform: Affine, shape: tuple[int, int], fraction: float) -> None:
    """The whole earth in degrees has its area; nothing lies beyond a pole."""
    areas = np.sum(list(pixel_rows_m2(GeoBox(shape, transform, "EPSG:4326"))))
    assert areas == pytest.approx(EARTH_M2 * fraction, rel=3e-4)


def test_pixels_beside_the_earths_disk_have_no_area() -> None:
    """The corners of an image of a whole hemisphere by a satellite show space."""
    satellite = pyproj.CRS.from_proj4("+proj=geos +h=35786023 +lon_0=-75 +sweep=x").to_wkt()
    areas = np.array(
        list(pixel_rows_m2(GeoBox((100, 100), Affine(108_800, 0, -5.44e6, 0, -108_800, 5.44e6), satellite)))
    )
    assert (areas[[0, 0, -1, -1], [0, -1, 0, -1]] == 0).all()
    assert areas[50, 50] == pytest.approx(108_800**2, rel=1e-3)
    assert 0.35 < areas.sum() / EARTH_M2 < 0.45


@given(st.integers(1, 70), st.integers(1, 70), st.sampled_from([1, 2, 4, 8]), st.floats(-180, 180))
def test_a_coarser_grid_has_the_same_origin(height: int, width: int, factor: int, turn: float) -> None:
    """Coarse pixel (y, x) begins where fine pixel (factor y, factor x) does, also on a turned grid."""
    fine = box(32632, 0.05, turn, (height, width))
    shape = -(-height // factor), -(-width // factor)
    coarse = zoomed_out(fine, factor, shape)
    assert (tuple(coarse.shape), coarse.crs) == (shape, fine.crs)
    for y, x in ((0, 0), (shape[0] - 1, shape[1] - 1)):
        there, wanted = (
            np.array([t.a * column + t.b * row + t.c, t.d * column + t.e * row + t.f])
            for t, row, column in ((coarse.affine, y, x), (fine.affine, y * factor, x * factor))
        )
        np.testing.assert_allclose(there, wanted, atol=1e-6)


@given(st.integers(1, 40), st.integers(1, 40), st.integers(1, 9), st.integers(0, 2**32 - 1))
def test_patches_contain_every_pixel_once(height: int, width: int, patch: int, seed: int) -> None:
    """A pixel of the scene lies at its place in its patch; pixels beyond the scene are False."""
    grid = SceneGrid(height, width, patch)
    image = np.random.default_rng(seed).random((height, width)) < 0.5
    patch_index = patch_pixels(grid, image)
    assert patch_index.sum() == image.sum()
    for (y, x), patch_number in zip(grid.patch_origin(np.arange(len(patch_index))), patch_index, strict=True):
        part = image[y : y + patch, x : x + patch]
        np.testing.assert_array_equal(patch_number[: part.shape[0], : part.shape[1]], part)


def test_areas_do_not_change_across_180_degrees_of_longitude() -> None:
    """Near Fiji longitudes jump from 180 to -180 deg, but square metres do not change."""
    areas = []
    for shift_m in (0, 20_000):
        field = GeoBox((20, 200), Affine(10, 0, 179_300 + shift_m, 0, -10, 8_140_000), "EPSG:32701")
        areas.append(np.concatenate(list(pixel_rows_m2(field))))
    assert areas[0] == pytest.approx(areas[1], rel=1e-3)
    assert areas[0] == pytest.approx(100, rel=0.01)
