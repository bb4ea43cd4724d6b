"""The ground stage: the map of a survey with a pose, stored in the archive with areas in hectares."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import xarray as xr

from spectralzoom.flows.settings.survey_settings import Settings
from spectralzoom.flows.tasks.stages.maps import STORE, colours_of, ground
from spectralzoom.flows.tasks.zones import place_of_field
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.pipeline.ground.field_places import PosedField
from spectralzoom.pipeline.ground.map_grid import GroundGrid
from spectralzoom.pipeline.ground.view import pixel_places
from spectralzoom.storage.arrays import class_maps
from spectralzoom.storage.arrays.georeference import AngularGrid
from spectralzoom.storage.arrays.ground_maps import load_ground_map
from spectralzoom.storage.arrays.layout import open_group, read_array
from spectralzoom.storage.store import Archive, Ref
from tests.exported_run import POSE
from tests.storage.plain_mosaic import write_values
from tests.storage.small_archive import write_class_map

Stores = tuple[Ref, Ref]
SHAPE = (120, 160)
FIELD: Any = SimpleNamespace(shape=SHAPE, geobox=None, pixel_m=None)
LEGEND = class_maps.ClassNames(("weed", "crop"), np.array([[255, 0, 0], [0, 255, 0]], np.uint8))


@dataclass(frozen=True)
class Run:
    """Stand-in for a survey, with what the stage needs."""

    archive: Archive
    settings: Settings = field(default_factory=lambda: Settings(pose=POSE))
    report: Callable[[float], None] = lambda done: None

    @property
    def ground_grid(self) -> GroundGrid:
        """Return the grid that the settings ask for."""
        place = place_of_field(self.settings, FIELD)
        assert isinstance(place, PosedField)
        return place.grid


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
def run(tmp_path: Path) -> Run:
    """Return a survey of a small field with a pose."""
    return Run(Archive.open(tmp_path / "archive"))


@pytest.fixture
def stores(tmp_path: Path) -> Stores:
    """Return stores of a class map of two halves, the upper right nodata, and of a mosaic that brightens downwards."""
    classes = np.zeros(SHAPE, np.uint8)
    classes[:, 80:] = 1
    classes[:30, 80:] = UNLABELLED
    confidence = np.where(classes == UNLABELLED, np.nan, 0.25 + 0.5 * (classes == 1)).astype(np.float32)
    found = class_maps.ClassMap(classes, confidence, LEGEND.names, LEGEND.colours)
    write_class_map(tmp_path / "map" / "class_map.zarr", found)
    believe(tmp_path / "map", np.zeros(SHAPE, np.float32))
    values = np.linspace(0.1, 0.9, SHAPE[0])[:, None, None] * np.ones((*SHAPE, 4))
    values[:20, :20] = np.nan
    nm = np.array([460.0, 550.0, 640.0, 800.0])
    write_values(tmp_path / "mosaic" / "mosaic.zarr", values, nm, AngularGrid(1e-4, SHAPE, 1))
    return Ref("segment", "m", tmp_path / "map"), Ref("rectify", "r", tmp_path / "mosaic")


def draw(run: Run, stores: Stores) -> Ref:
    """Run the stage as an engine does and return its store."""
    return ground.produce(run.archive, ground.wants(run, *stores))[0]


def image(ref: Ref, name: str) -> np.ndarray:
    """Read an image of a map on the ground."""
    return read_array(open_group(ref.path / STORE), name)


def test_map_and_picture_follow_the_rays_to_the_ground(run: Run, stores: Stores) -> None:
    """Each scene pixel's class is at the end of its ray; the picture brightens towards the rig, as the mosaic does."""
    ref = draw(run, stores)
    found = load_ground_map(ref.path / STORE)
    grid = run.ground_grid
    y, x = pixel_places(SHAPE)
    points = np.stack(np.meshgrid(y[10:-10:9], x[10:-10:9], indexing="ij"), axis=-1).reshape(-1, 2)
    places = grid.frame.ground_to_map(grid.frame.view.scene_to_ground(points))
    column, row = (np.floor(part).astype(int) for part in ~found.geobox.affine * places.T)
    wanted = np.where(points[:, 1] < 0, 0, np.where(points[:, 0] < y[30], UNLABELLED, 1))
    assert image(ref, "classes")[row, column].tolist() == wanted.tolist()
    sure = image(ref, "confidence")[row, column]
    np.testing.assert_array_equal(np.isnan(sure), wanted == UNLABELLED)
    assert sure[wanted == 1] == pytest.approx(0.75)
    tones = colours_of(stores[1])
    assert np.nanmin(tones) >= 1
    assert np.isnan(tones[:20, :20]).all()
    picture = image(ref, "picture")
    seen = picture.max(axis=2) > 0
    assert 0.3 < seen.mean() < 0.95
    assert not seen[0, 0]
    row, column = np.nonzero(seen)
    along = row * np.cos(np.deg2rad(25)) - column * np.sin(np.deg2rad(25))  # towards the rig on a north-up map
    assert np.corrcoef(along, picture[row, column, 0])[0, 1] > 0.95


def field_pixels(run: Run, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return the mask of map pixels within the field, and row and column of the field's pixel that each shows."""
    places = run.ground_grid.scene_pixels(*(slice(0, size) for size in shape))
    seen = np.isfinite(places[..., 0])
    return seen, np.floor(places[seen] + 0.5).astype(int).T


def test_changes_come_from_the_nearest_pixel(run: Run, stores: Stores, tmp_path: Path) -> None:
    """Old classes are not interpolated; outside of the field they are nodata."""
    rng = np.random.default_rng(3)
    old = np.where(rng.random(SHAPE) < rng.random((1, SHAPE[1])), UNLABELLED, rng.integers(0, 2, SHAPE))
    write_class_map(tmp_path / "later" / "class_map.zarr", class_maps.load_class_map(stores[0].path / "class_map.zarr"))
    believe(tmp_path / "later", np.zeros(SHAPE, np.float32), old.astype(np.uint8))
    ref = draw(run, (Ref("segment", "l", tmp_path / "later"), stores[1]))
    old_class = image(ref, "changed_from")
    seen, (row, column) = field_pixels(run, old_class.shape)
    np.testing.assert_array_equal(old_class[seen], old[row, column])
    assert (old_class[~seen] == UNLABELLED).all()


def test_a_first_visit_has_no_changes(run: Run, stores: Stores) -> None:
    """The store has no variable for changes."""
    ref = draw(run, stores)
    with xr.open_zarr(ref.path / STORE, consolidated=False) as content:
        assert "changed_from" not in content


def test_the_store_has_areas_pose_and_crs(run: Run, stores: Stores) -> None:
    """Areas are sums of footprints; plain xarray reads pose, pixel counts and CRS."""
    ref = draw(run, stores)
    areas = load_ground_map(ref.path / STORE).areas
    exact = run.ground_grid.frame.view.area_m2(np.stack(np.meshgrid(*pixel_places(SHAPE), indexing="ij"), axis=-1))
    assert areas["weed"]["m2"] == pytest.approx(exact[:, :80].sum(), rel=1e-12)
    assert areas["crop"]["m2"] == pytest.approx(exact[30:, 80:].sum(), rel=1e-12)
    assert areas["crop"]["ha"] == pytest.approx(areas["crop"]["m2"] / 10_000)
    with xr.open_zarr(ref.path / STORE, consolidated=False) as content:
        assert content.attrs["proj:code"] == "EPSG:32632"
        assert content.attrs["rig_pose"]["tilt_deg"] == 50.0
        assert content.attrs["scene_pixels"] == {"mapped_px": 120 * 160, "beyond_reach_px": 0, "no_ground_px": 0}


def test_the_key_follows_the_pose(run: Run, stores: Stores) -> None:
    """The same pose finds its store; another tilt makes a new one."""
    changed = [run.settings, replace(run.settings, pose=replace(POSE, tilt_deg=51.0)), run.settings]
    keys = [draw(replace(run, settings=settings), stores).key for settings in changed]
    assert keys[0] == keys[2] != keys[1]
