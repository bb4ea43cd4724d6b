"""Orientation tags: pictures are read as Pillow shows them; maps stay as they are, with a note."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image, ImageOps

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.storage.readers.open_cubes import open_cube_source
from spectralzoom.storage.readers.scene_files import load_scene_file

RNG = np.random.default_rng(3)
PICTURE = np.kron(RNG.integers(0, 255, (4, 6, 3)), np.ones((8, 8, 1))).astype(np.uint8)  # (y, x, band), smooth for JPEG


def tagged(path: Path, tag: int, picture: np.ndarray = PICTURE) -> Path:
    """Write a picture with an orientation tag, by Pillow."""
    exif = Image.Exif()
    exif[274] = tag
    more = {"quality": 100, "subsampling": 0} if path.suffix == ".jpg" else {}
    Image.fromarray(picture).save(path, exif=exif, **more)
    return path


@pytest.mark.parametrize("ending", ["jpg", "png", "tif"])
@pytest.mark.parametrize("tag", range(1, 9))
def test_pictures_are_read_as_pillow_shows_them(tmp_path: Path, ending: str, tag: int) -> None:
    """Rows read apart equal those of the whole picture."""
    path = tagged(tmp_path / f"a.{ending}", tag)
    with Image.open(path) as opened:
        shown = np.asarray(ImageOps.exif_transpose(opened))
    source = open_cube_source(path)
    assert source.shape == shown.shape
    np.testing.assert_array_equal(np.concatenate([source.read(0, 5), source.read(5, source.shape[0])]), shown)
    assert any(f"orientation tag {tag} says" in note for note in source.notes) == (tag > 1)


def test_an_upright_mask_fits_a_turned_picture(tmp_path: Path) -> None:
    """The mask was drawn on the picture as a viewer shows it; one of the file's own rows is refused by the tag."""
    tagged(tmp_path / "a.jpg", 6)
    shown = np.rot90(PICTURE, -1)
    mask = (shown[..., 0] > 100).astype(np.uint8)
    Image.fromarray(mask).save(tmp_path / "a_mask.png")
    scene = load_scene_file(tmp_path / "a.jpg")
    assert np.mean((scene.values[..., 0] > 100) == (scene.labels == 1)) > 0.99
    Image.fromarray((PICTURE[..., 0] > 100).astype(np.uint8)).save(tmp_path / "a_mask.png")
    with pytest.raises(SceneError, match="orientation tag 6"):
        load_scene_file(tmp_path / "a.jpg")


def test_transparent_pixels_are_turned_too(tmp_path: Path) -> None:
    """The mask of a picture belongs to its pixels."""
    alpha = np.where(np.arange(48) < 16, 0, 255).astype(np.uint8)
    tagged(tmp_path / "a.png", 8, np.dstack([PICTURE, np.broadcast_to(alpha, PICTURE.shape[:2])]))
    source = open_cube_source(tmp_path / "a.png")
    np.testing.assert_array_equal(np.isnan(source.read(0, 48)).all(axis=2), source.void)
    assert source.void[-16:].all()
    assert not source.void[:-16].any()


PLACE = [  # pixels of 2 m in UTM 32 north
    (33550, "d", 3, (2.0, 2.0, 0.0), True),
    (33922, "d", 6, (0.0, 0.0, 0.0, 5e5, 5e6, 0.0), True),
    (34735, "H", 16, (1, 1, 0, 3, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, 32632), True),
]


@pytest.mark.parametrize("bigtiff", [True, False])
@pytest.mark.parametrize("place", [PLACE, []], ids=["map", "picture"])
def test_a_map_is_not_turned(tmp_path: Path, bigtiff: bool, place: list[tuple]) -> None:
    """A TIFF with a place keeps its rows, and a note says so; one without a place is turned."""
    values = RNG.integers(0, 255, (5, 7, 3)).astype(np.uint8)
    tags = [(274, "H", 1, 3, True), *place]
    tifffile.imwrite(tmp_path / "a.tif", values, bigtiff=bigtiff, extratags=tags, photometric="rgb", metadata=None)
    source = open_cube_source(tmp_path / "a.tif")
    assert (source.geobox is not None) == bool(place)
    np.testing.assert_array_equal(source.read(0, 5), values if place else values[::-1, ::-1])
    assert ["orientation tag 3" in note for note in source.notes].count(True) == 1
