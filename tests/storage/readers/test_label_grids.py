"""Georeferenced labels are resampled to the pixels of the scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from affine import Affine
from numpy.typing import NDArray
from pyproj import Transformer

from spectralzoom.flows.training.init_command import draft_scene
from spectralzoom.pipeline.errors import SceneError
from spectralzoom.storage.readers.scene_files import load_scene_file, open_scene_file
from tests.storage.readers.test_raster_tags import write as write_bands

WEST = 600_000.0
NORTH = 5_700_000.0
SIDE = 60
CLASSES = np.zeros((SIDE, SIDE), np.uint8)  # three stripes and a corner, without any symmetry
CLASSES[:, 20:], CLASSES[:, 45:], CLASSES[:10, :15] = 1, 2, 3
NORTH_UP = Affine(1, 0, WEST, 0, -1, NORTH)
SOUTH_UP = Affine(1, 0, WEST, 0, 1, NORTH - SIDE)


def write(path: Path, values: NDArray[Any], transform: Affine = NORTH_UP, crs: Any = 32632, **about: Any) -> Path:
    """Write a GeoTIFF of (y, x) or (y, x, band) values, and return its path."""
    place = {"crs": crs, "transform": transform} if crs else {}
    write_bands(path, np.moveaxis(np.atleast_3d(values), -1, 0), **place, **about).close()
    return path


def image(folder: Path, transform: Affine = NORTH_UP, classes: NDArray[np.uint8] = CLASSES) -> Path:
    """Write an image whose only band is ten times the class plus 5, with its wavelength in scene.toml."""
    (folder / "scene.toml").write_text("wavelengths_nm = [800]\n")
    return write(folder / "field.tif", classes * np.uint8(10) + np.uint8(5), transform)


def agree(scene: Any) -> float:
    """Return the fraction of the labelled pixels whose label is the class that the image shows there."""
    there = scene.labels != 255
    named = np.array([int(name.removeprefix("class_")) for name in scene.class_names])
    return float((named[scene.labels[there]] == (scene.values[..., 0][there] - 5) / 10).mean())


def test_labels_shifted_by_seven_metres_are_aligned(tmp_path: Path) -> None:
    """Labels that begin 7 m to the east stay on their ground; pixels that they do not reach are unlabelled."""
    path = image(tmp_path)
    write(tmp_path / "field_labels.tif", CLASSES[:, 7:], NORTH_UP * Affine.translation(7, 0))
    write(tmp_path / "pixel_by_pixel.tif", np.pad(CLASSES[:, 7:], ((0, 0), (0, 7)), mode="edge"), NORTH_UP)
    scene = load_scene_file(path)
    assert agree(scene) == 1.0
    assert (scene.labels[:, :7] == 255).all()
    assert (scene.labels[:, 7:] != 255).all()
    assert any("have another grid than the scene" in note for note in scene.provenance)
    assert agree(load_scene_file(path, labels=tmp_path / "pixel_by_pixel.tif")) < 0.8  # without their georeference


def test_labels_in_another_crs_are_aligned(tmp_path: Path) -> None:
    """Labels in degrees agree with the image in more than 98 % of the pixels; borders of classes may differ."""
    path = image(tmp_path)
    to_metres = Transformer.from_crs(4326, 32632, always_xy=True)
    to_degrees = Transformer.from_crs(32632, 4326, always_xy=True)
    west, south, east, north = to_degrees.transform_bounds(WEST - 5, NORTH - SIDE - 5, WEST + SIDE + 5, NORTH + 5)
    grid = Affine((east - west) / 200, 0, west, 0, (south - north) / 200, north)
    lon, lat = grid * (np.meshgrid(np.arange(200) + 0.5, np.arange(200) + 0.5))
    x, y = to_metres.transform(lon, lat)
    row, column = (np.clip(np.floor(at), 0, SIDE - 1).astype(int) for at in (NORTH - y, x - WEST))
    write(tmp_path / "field_labels.tif", CLASSES[row, column], grid, "EPSG:4326")
    scene = load_scene_file(path)
    assert scene.labels is not None
    assert (scene.labels != 255).all()
    assert agree(scene) > 0.98


@pytest.mark.parametrize("turned", ["labels", "image"])
def test_labels_align_with_rows_in_opposite_order(tmp_path: Path, turned: str) -> None:
    """Rows from the south up and rows from the north down show the same ground."""
    flipped = np.ascontiguousarray(CLASSES[::-1])
    path = image(tmp_path, SOUTH_UP, flipped) if turned == "image" else image(tmp_path)
    labels = (flipped, SOUTH_UP) if turned == "labels" else (CLASSES, NORTH_UP)
    write(tmp_path / "field_labels.tif", *labels)
    scene = load_scene_file(path)
    assert agree(scene) == 1.0
    assert (scene.labels != 255).all()


def test_labels_on_the_same_grid_are_unchanged(tmp_path: Path) -> None:
    """An offset of 0.01 px counts as rounding and gives no note."""
    path = image(tmp_path)
    write(tmp_path / "field_labels.tif", CLASSES, NORTH_UP * Affine.translation(0.01, -0.01))
    scene = load_scene_file(path)
    np.testing.assert_array_equal(scene.labels, CLASSES)
    assert not any("nearest" in note for note in scene.provenance)
    assert not scene.regridded


def test_labels_outside_of_the_image_are_refused(tmp_path: Path) -> None:
    """The refusal says how to leave labels out that were found by their name."""
    path = image(tmp_path)
    write(tmp_path / "field_labels.tif", CLASSES, NORTH_UP * Affine.translation(500, 0))
    with pytest.raises(SceneError, match=r"do not lie on the scene: x 600500 to 600560, y .* the scene x 600000"):
        load_scene_file(path)
    with pytest.raises(SceneError, match=r'found by their name: labels = "" in a scene.toml beside the scene leaves'):
        open_scene_file(path)
    (tmp_path / "scene.toml").write_text('labels = ""\n')
    assert open_scene_file(path, wavelengths=[800]).labels is None


@pytest.mark.parametrize("turned", [False, True])
def test_nodata_of_a_label_file_is_unlabelled(tmp_path: Path, turned: bool) -> None:
    """The value is found on the scene's grid and on another; a note counts its pixels."""
    path = image(tmp_path)
    codes = np.where(CLASSES == 3, np.uint8(255), CLASSES)
    grid = (codes[::-1].copy(), SOUTH_UP) if turned else (codes, NORTH_UP)
    write(tmp_path / "field_labels.tif", *grid, nodata=255)
    scene = load_scene_file(path)
    assert scene.class_names == ("class_0", "class_1", "class_2")
    np.testing.assert_array_equal(scene.labels == 255, CLASSES == 3)
    assert any("150 px have the label file's no-data value 255" in note for note in scene.provenance)
    assert [one.value for one in draft_scene(path).classes] == [0, 1, 2]


def test_a_stated_class_overrides_nodata(tmp_path: Path) -> None:
    """A class in scene.toml counts, even if the file marks its value as no data."""
    path = image(tmp_path)
    write(tmp_path / "field_labels.tif", CLASSES, NORTH_UP, nodata=0)
    assert load_scene_file(path).class_names == ("class_1", "class_2", "class_3")
    names = "\n".join(f"class_{number} = {number}" for number in range(4))
    (tmp_path / "scene.toml").write_text(f"wavelengths_nm = [800]\n[classes]\n{names}\n")
    np.testing.assert_array_equal(load_scene_file(path).labels, CLASSES)
