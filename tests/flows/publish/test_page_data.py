"""What pages carry with them: spectra in bytes, places on the earth, numbers as pictures, a library as it was made."""

from __future__ import annotations

import hashlib
import io
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from odc.geo.geobox import GeoBox
from PIL import Image

from flows.publish import page_data
from flows.publish.field_map import FieldMap, map_facts
from flows.publish.page_data import (
    SHA256,
    class_means,
    indexed_png,
    page_spectra,
    part,
    places_of_grid,
    places_of_pose,
    policy,
)
from flows.publish.report import MAP_SCRIPTS
from pipeline.ground.map_grid import MapFrame, map_crs
from pipeline.ground.view import GroundView, RigPose

SIZES = st.tuples(st.integers(1, 9), st.integers(1, 9), st.integers(1, 70))


@given(SIZES, st.integers(0, 9), st.sampled_from([10**6, 500, 60]))
def test_spectra_are_kept_to_half_a_step(shape: tuple[int, int, int], seed: int, most: int) -> None:
    """Where they fit they are the mosaic's own; of too many there are means, in no more values than a page may have."""
    rng = np.random.default_rng(seed)
    mosaic = rng.normal(0.4, 0.2, shape).astype(np.float32)
    mosaic[rng.random(shape[:2]) < 0.2] = np.nan
    nm = rng.permutation(np.linspace(400, 900, shape[2]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page_data, "MOST_VALUES", most)
        found = page_spectra([mosaic[:3], mosaic[3:]], shape, nm, 4)
    assert found.levels.size <= max(most, found.levels.shape[2])
    assert (np.diff(found.wavelength_nm) > 0).all()
    if found.bands_each > 1 or found.pixel_px > 4:
        assert mosaic.size > most
        return
    values, wanted = found.values(), mosaic[..., np.argsort(nm)]
    assert (np.isnan(values) == np.isnan(wanted)).all()
    assert np.nanmax(np.abs(values - wanted) - 0.51 * found.step, initial=-1.0) <= 1e-6


def test_bands_and_pixels_that_are_taken_together_are_means(monkeypatch: pytest.MonkeyPatch) -> None:
    """Over those that have a value; bands first, down to thirty."""
    monkeypatch.setattr(page_data, "MOST_VALUES", 31 * 4)
    mosaic = np.random.default_rng(0).random((4, 4, 61)).astype(np.float32)
    mosaic[0, 0] = np.nan
    found = page_spectra([mosaic], mosaic.shape, np.arange(61.0), 4)
    assert (found.bands_each, found.pixel_px, found.levels.shape) == (2, 8, (2, 2, 31))
    wanted = np.nanmean(mosaic[:2, :2, 4:6], axis=(0, 1, 2))
    assert abs(found.values()[0, 0, 2] - wanted) <= found.step[2]
    assert found.wavelength_nm[2] == 4.5
    assert found.wavelength_nm[-1] == 60


def test_a_class_mean_is_over_the_places_that_are_its_own() -> None:
    """Half of a place or more; a class of smaller patches has none, and so has one that is not there."""
    mosaic = np.arange(8, dtype=np.float32).reshape(2, 2, 2)
    spectra = page_spectra([mosaic], mosaic.shape, np.array([500.0, 600.0]), 2)
    classes = np.array([[0, 0, 1, 1], [0, 0, 0, 1], [2, 0, 255, 255], [0, 0, 255, 255]], np.uint8)
    means, sizes = class_means(spectra, classes, 4)
    assert sizes.tolist() == [2, 1, 0, 0]
    np.testing.assert_allclose(means[0], [2, 3], atol=0.02)
    np.testing.assert_allclose(means[1], [2, 3], atol=0.02)
    assert np.isnan(means[2:]).all()


def test_numbers_come_back_from_their_picture() -> None:
    """Whatever colours they are drawn in, also where two are alike."""
    numbers = np.random.default_rng(0).integers(0, 256, (20, 30)).astype(np.uint8)
    for colours in (np.zeros((256, 3), np.uint8), np.full((9, 4), 77, np.uint8)):
        with Image.open(io.BytesIO(indexed_png(numbers, colours))) as picture:
            assert picture.mode == "P"
            assert (np.asarray(picture) == numbers).all()


@pytest.mark.parametrize("tilt", [90.0, 40.0])
def test_places_between_nodes_are_those_of_the_pose(tilt: float) -> None:
    """To a tenth of a pixel's footprint, at the middle of every mesh, where they are worst."""
    pose = RigPose(lon_deg=9.5, lat_deg=52.1, heading_deg=30.0, tilt_deg=tilt, height_m=12.0)
    frame, shape = MapFrame(GroundView(pose, 1e-4), map_crs(pose)), (1024, 1280)
    found = places_of_pose(frame, shape).on_map
    rows, columns = (np.linspace(0, size, count) for size, count in zip(shape, found.shape[:2], strict=True))
    y, x = ((nodes[1:] + nodes[:-1]) / 2 for nodes in (rows, columns))
    points = np.stack(np.meshgrid(y - shape[0] / 2, x - shape[1] / 2, indexing="ij"), axis=-1)
    exact = frame.ground_to_map(frame.view.scene_to_ground(points))
    between = (found[1:, 1:] + found[1:, :-1] + found[:-1, 1:] + found[:-1, :-1]) / 4
    footprint = np.sqrt(frame.view.area_m2(points))
    assert (np.hypot(*np.moveaxis(between - exact, -1, 0)) / footprint).max() < 0.1


def test_places_of_a_scene_are_its_grids() -> None:
    """Corners are those of the file's transform; longitudes and latitudes those of its CRS."""
    geobox = GeoBox.from_bbox((500000, 5700000, 500064, 5700048), "EPSG:32632", resolution=1.0)
    found = places_of_grid(geobox)
    assert found is not None
    assert found.crs == "EPSG:32632"
    assert found.on_map[0, 0].tolist() == [500000, 5700048]
    assert found.on_map[-1, -1].tolist() == [500064, 5700000]
    assert found.lon_lat[0, 0, 0] == pytest.approx(9.0, abs=1e-9)


@pytest.mark.parametrize("name", SHA256)
def test_the_library_is_as_it_was_published(name: str) -> None:
    """Leaflet 1.9.4 of npm's registry, byte for byte, its licence beside it."""
    content = (Path(page_data.__file__).parent / name).read_bytes()
    assert hashlib.sha256(content).hexdigest() == SHA256[name]


def test_scripts_end_no_tag_and_are_all_named() -> None:
    """None of them holds what would end it, and the policy has a hash for each."""
    assert all("</script" not in part(name) and "<!--" not in part(name) for name in MAP_SCRIPTS)
    assert len(re.findall(r"'sha256-[A-Za-z0-9+/=]{44}'", policy(MAP_SCRIPTS))) == len(MAP_SCRIPTS)
    assert "unsafe-inline" not in policy(MAP_SCRIPTS).partition("script-src")[2]


def test_a_map_of_little_and_one_that_is_large() -> None:
    """Layers that a run has not are not offered; of a large map every n-th pixel is shown, and that is said."""
    classes = np.full((30, 5000), 255, np.uint8)
    facts = map_facts(FieldMap(("soil",), None, classes, np.zeros((30, 5000, 3), np.uint8), "Grey", 8))
    assert [layer.key for layer in facts["layers"]] == ["classes", "colour"]
    assert [one["name"] for one in facts["classes"]] == ["soil", "no class"]
    assert facts["data"]["step"] == 3
    assert facts["notes"] == ["The map is large: one of 3 x 3 px is shown."]
