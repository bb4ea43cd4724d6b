"""The ground stage: the map of a survey with a pose, stored in the archive with areas in hectares."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import xarray as xr

from spectralzoom.flows.opening.zones import place_of_field
from spectralzoom.flows.settings.settings import Settings
from spectralzoom.flows.stage import Output
from spectralzoom.flows.stages.ground import STORE, colours_of, ground
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.pipeline.ground.field_places import PosedField
from spectralzoom.pipeline.ground.map_grid import GroundGrid
from spectralzoom.pipeline.ground.view import pixel_places
from spectralzoom.storage.arrays import class_maps
from spectralzoom.storage.arrays.georeference import AngularGrid
from spectralzoom.storage.arrays.ground_maps import load_ground_map
from spectralzoom.storage.arrays.layout import open_group, read_array
from spectralzoom.storage.store import Ref, text_of
from tests.exported_run import POSE
from tests.storage.plain_mosaic import write_values
from tests.storage.small_archive import write_class_map

Inputs = tuple[Ref, Ref]  # class map and mosaic
SHAPE = (120, 160)
FIELD: Any = SimpleNamespace(shape=SHAPE, geobox=None, pixel_m=None)
LEGEND = class_maps.ClassNames(("weed", "crop"), np.array([[255, 0, 0], [0, 255, 0]], np.uint8))


def grid_of(settings: Settings) -> GroundGrid:
    """Return the grid on the ground that these settings ask for."""
    place = place_of_field(settings, FIELD)
    assert isinstance(place, PosedField)
    return place.grid


GRID = grid_of(Settings(pose=POSE))


def believe(folder: Path, age_days: np.ndarray, old_class: np.ndarray | None = None) -> None:
    """Write class probabilities of these ages (y, x), NaN where unknown; with old classes, those of a later visit."""
    values = np.where(np.isnan(age_days)[..., None], np.nan, np.log([0.5, 0.5])).astype(np.float32)
    path = folder / "class_probabilities.zarr"
    class_maps.create_probabilities(path, SHAPE, LEGEND, goes_on=old_class is not None)
    for top in range(0, SHAPE[0], 64):
        rows = slice(top, top + 64)
        packed = class_maps.packed_probabilities(values[rows])
        beside = age_days[rows], np.ones(SHAPE, np.float32)[rows], None if old_class is None else old_class[rows]
        class_maps.write_probabilities_tile(path, (top, 0), packed, *beside)


@pytest.fixture
def inputs(tmp_path: Path) -> Inputs:
    """Return stores of a class map of two halves, the upper right nodata, and of a mosaic that brightens downwards."""
    classes = np.zeros(SHAPE, np.uint8)
    classes[:, 80:] = 1
    classes[:30, 80:] = UNLABELLED
    confidence = np.where(classes == UNLABELLED, np.nan, 0.25 + 0.5 * (classes == 1)).astype(np.float32)
    found = class_maps.ClassMap(classes, confidence, LEGEND)
    write_class_map(tmp_path / "map" / "class_map.zarr", found)
    believe(tmp_path / "map", np.zeros(SHAPE, np.float32))
    values = np.linspace(0.1, 0.9, SHAPE[0])[:, None, None] * np.ones((*SHAPE, 4))
    values[:20, :20] = np.nan
    nm = np.array([460.0, 550.0, 640.0, 800.0])
    write_values(tmp_path / "mosaic" / "mosaic.zarr", values, nm, AngularGrid(1e-4, SHAPE, 1))
    return Ref("segment", "m", tmp_path / "map"), Ref("rectify", "r", tmp_path / "mosaic")


@pytest.fixture
def drawn(inputs: Inputs, tmp_path: Path) -> Path:
    """Return the folder of the map on the ground of these stores."""
    return draw(tmp_path / "ground", *inputs)


def draw(folder: Path, class_map: Ref, mosaic: Ref) -> Path:
    """Run the stage into a folder and return it."""
    folder.mkdir()
    ground.build(Output(folder, lambda done: None, folder), class_map, mosaic, ground_grid=GRID)
    return folder


def image(folder: Path, name: str) -> np.ndarray:
    """Read an image of a map on the ground."""
    return read_array(open_group(folder / STORE), name)


def test_map_and_picture_follow_the_rays_to_the_ground(inputs: Inputs, drawn: Path) -> None:
    """Each scene pixel's class is at the end of its ray; the picture brightens towards the rig, as the mosaic does."""
    found = load_ground_map(drawn / STORE)
    y, x = pixel_places(SHAPE)
    points = np.stack(np.meshgrid(y[10:-10:9], x[10:-10:9], indexing="ij"), axis=-1).reshape(-1, 2)
    places = GRID.frame.ground_to_map(GRID.frame.view.scene_to_ground(points))
    column, row = (np.floor(part).astype(int) for part in ~found.geobox.affine * places.T)
    wanted = np.where(points[:, 1] < 0, 0, np.where(points[:, 0] < y[30], UNLABELLED, 1))
    assert image(drawn, "classes")[row, column].tolist() == wanted.tolist()
    sure = image(drawn, "confidence")[row, column]
    np.testing.assert_array_equal(np.isnan(sure), wanted == UNLABELLED)
    assert sure[wanted == 1] == pytest.approx(0.75)
    tones = colours_of(inputs[1])
    assert np.nanmin(tones) >= 1
    assert np.isnan(tones[:20, :20]).all()
    picture = image(drawn, "picture")
    seen = picture.max(axis=2) > 0
    assert 0.3 < seen.mean() < 0.95
    assert not seen[0, 0]
    row, column = np.nonzero(seen)
    along = row * np.cos(np.deg2rad(25)) - column * np.sin(np.deg2rad(25))  # towards the rig on a north-up map
    assert np.corrcoef(along, picture[row, column, 0])[0, 1] > 0.95


def field_pixels(shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return the mask of map pixels within the field, and row and column of the field's pixel that each shows."""
    places = GRID.scene_pixels(*(slice(0, size) for size in shape))
    seen = np.isfinite(places[..., 0])
    return seen, np.floor(places[seen] + 0.5).astype(int).T


def test_changes_come_from_the_nearest_pixel(inputs: Inputs, tmp_path: Path) -> None:
    """Old classes are not interpolated; outside of the field they are nodata."""
    rng = np.random.default_rng(3)
    old = np.where(rng.random(SHAPE) < rng.random((1, SHAPE[1])), UNLABELLED, rng.integers(0, 2, SHAPE))
    write_class_map(tmp_path / "later" / "class_map.zarr", class_maps.load_class_map(inputs[0].path / "class_map.zarr"))
    believe(tmp_path / "later", np.zeros(SHAPE, np.float32), old.astype(np.uint8))
    drawn = draw(tmp_path / "ground", Ref("segment", "l", tmp_path / "later"), inputs[1])
    old_class = image(drawn, "changed_from")
    seen, (row, column) = field_pixels(old_class.shape)
    np.testing.assert_array_equal(old_class[seen], old[row, column])
    assert (old_class[~seen] == UNLABELLED).all()


def test_the_store_has_areas_pose_and_crs(drawn: Path) -> None:
    """Areas are sums of footprints; plain xarray reads pose, pixel counts and CRS; a first visit has no changes."""
    areas = load_ground_map(drawn / STORE).areas
    exact = GRID.frame.view.area_m2(np.stack(np.meshgrid(*pixel_places(SHAPE), indexing="ij"), axis=-1))
    assert areas["weed"]["m2"] == pytest.approx(exact[:, :80].sum(), rel=1e-12)
    assert areas["crop"]["m2"] == pytest.approx(exact[30:, 80:].sum(), rel=1e-12)
    assert areas["crop"]["ha"] == pytest.approx(areas["crop"]["m2"] / 10_000)
    with xr.open_zarr(drawn / STORE, consolidated=False) as content:
        assert "changed_from" not in content
        assert content.attrs["proj:code"] == "EPSG:32632"
        assert content.attrs["rig_pose"]["tilt_deg"] == 50.0
        assert content.attrs["scene_pixels"] == {"mapped_px": 120 * 160, "beyond_reach_px": 0, "no_ground_px": 0}


def test_the_key_follows_the_pose() -> None:
    """The same pose has the same key; another tilt has another one."""
    same, other = (grid_of(Settings(pose=replace(POSE, tilt_deg=tilt))) for tilt in (POSE.tilt_deg, 51.0))
    assert text_of(same) == text_of(GRID) != text_of(other)
