"""Scenes: what a file without a radiance law becomes, and the linear map from components to bands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.errors import SceneError, ShapeError
from pipeline.geometry.camera import LineCamera
from pipeline.lazy import Once
from pipeline.simulator.scenes.image_scene import raster_from_values
from pipeline.simulator.scenes.scene import RasterScene, SceneLight, SceneRaster

CAMERA = LineCamera()
WAVELENGTH = np.array([660.0, 800.0])


def picture(seed: int = 0, shape: tuple[int, ...] = (20, 30, 2)) -> np.ndarray:
    """Random values in 0..255."""
    return (np.random.default_rng(seed).random(shape) * 255).astype(np.uint8)


def test_bright_end_fills_the_stated_share_of_the_well() -> None:
    """The 99.9th percentile gives 60 % of the full well, whatever the unit of the file."""
    scene = raster_from_values(picture(), CAMERA, name="p", wavelength_nm=WAVELENGTH)
    bright = np.percentile(picture(), 99.9)
    np.testing.assert_allclose(bright * scene.electrons, 0.6 * CAMERA.full_well_e, rtol=1e-6)
    np.testing.assert_allclose(scene.panel * scene.electrons, scene.panel_electrons, rtol=1e-6)


def test_values_are_those_of_the_file() -> None:
    """A scene made of values returns them; a scene of components returns their mixture."""
    scene = raster_from_values(picture(), CAMERA, name="p", wavelength_nm=WAVELENGTH)
    np.testing.assert_allclose(scene.values(), picture(), rtol=1e-6)
    planes, electrons = np.ones((4, 5, 3), np.float32), np.full((3, 2), 100, np.float32)
    panel, white = np.full(2, 0.5, np.float32), np.full(2, 200, np.float32)
    mixed = RasterScene("m", "k", SceneRaster.of(planes), Once.of(SceneLight(electrons, white)), panel, WAVELENGTH)
    np.testing.assert_allclose(mixed.values(), np.full((4, 5, 2), 300 / 200 * 0.5))


def test_gaps_are_filled_and_counted() -> None:
    """Pixels without a value get the band's median; a band without any gets 0."""
    values = picture().astype(np.float32)
    values[3, 4, 0], values[5, 6, 0], values[5, 6, 1] = np.nan, np.inf, -np.inf
    scene = raster_from_values(values, CAMERA, name="gaps", wavelength_nm=WAVELENGTH)
    assert scene.filled_px == 2
    known = values[..., 0][np.isfinite(values[..., 0])]
    assert scene.planes[3, 4, 0] == np.median(known)
    values[..., 1] = np.nan
    assert (raster_from_values(values, CAMERA, name="gaps", wavelength_nm=WAVELENGTH).planes[..., 1] == 0).all()


def test_black_scene_keeps_scale_one() -> None:
    """Without positive light the scale is 1 and everything stays finite."""
    scene = raster_from_values(np.zeros((5, 5, 2)), CAMERA, name="black", wavelength_nm=WAVELENGTH)
    np.testing.assert_allclose(scene.electrons, 0.6 * CAMERA.full_well_e, rtol=1e-6)
    assert (scene.values() == 0).all()


def test_key_follows_the_content() -> None:
    """Equal values have equal keys, one changed pixel another."""
    changed = picture()
    changed[0, 0, 0] ^= 1
    keys = [raster_from_values(v, CAMERA, name="p", wavelength_nm=WAVELENGTH).key for v in (picture(), changed)]
    assert keys[0] != keys[1]
    assert keys[0] == raster_from_values(picture(), CAMERA, name="q", wavelength_nm=WAVELENGTH).key


def test_bright_end_of_a_large_scene_is_sampled() -> None:
    """Above 2^24 values the percentile is read on a part of the pixels and hardly moves."""
    row = np.linspace(0, 1, 6_000, dtype=np.float32)
    values = np.broadcast_to(row[:, None, None], (6_000, 3_000, 2))
    scene = raster_from_values(values, CAMERA, name="large", wavelength_nm=WAVELENGTH, key="k")
    np.testing.assert_allclose(scene.panel * 0.6, 0.999, rtol=1e-3)


def test_unusable_scenes_are_refused() -> None:
    """Missing axes, nothing finite, and labels of another size are named."""
    with pytest.raises(SceneError, match=r"\(y, x, band\)"):
        raster_from_values(picture(shape=(4, 5)), CAMERA, name="flat", wavelength_nm=WAVELENGTH)
    with pytest.raises(SceneError, match="no finite value"):
        raster_from_values(np.full((2, 2, 2), np.nan), CAMERA, name="void", wavelength_nm=WAVELENGTH)
    labels = np.zeros((3, 3), np.uint8)
    with pytest.raises(SceneError, match="crop or pad"):
        raster_from_values(picture(), CAMERA, name="p", wavelength_nm=WAVELENGTH, labels=labels)
    with pytest.raises(ShapeError, match="2 components to 3 bands"):
        raster_from_values(picture(), CAMERA, name="p", wavelength_nm=np.arange(3.0))


def test_a_raster_is_drawn_when_it_is_looked_at() -> None:
    """Name, size and bands are known before; what is drawn must be what was announced."""
    drawn: list[int] = []

    def draw() -> tuple[np.ndarray, np.ndarray]:
        drawn.append(1)
        return np.ones((4, 5, 2), np.float32), np.zeros((4, 5), np.uint8)

    light = Once.of(SceneLight(np.ones(2, np.float32), np.ones(2, np.float32)))
    scene = RasterScene(
        "s", "k", SceneRaster((4, 5, 2), labelled=True, draw=draw), light, np.ones(2, np.float32), WAVELENGTH
    )
    assert (scene.shape, scene.labelled, drawn) == ((4, 5), True, [])
    assert scene.labels is not None
    assert scene.labels.shape == scene.planes.shape[:2]
    assert replace(scene, key="other").planes is scene.planes
    assert drawn == [1]
    for other in (SceneRaster((4, 6, 2), labelled=True, draw=draw), SceneRaster((4, 5, 2), labelled=False, draw=draw)):
        with pytest.raises(SceneError, match="crop or pad"):
            other.drawn()
    with pytest.raises(SceneError, match="not empty"):
        SceneRaster((0, 5, 2), labelled=False, draw=draw)


@pytest.mark.parametrize("value", [1e30, -1e20, 2e9, 1e300])
def test_values_that_no_sensor_gives_are_refused(value: float) -> None:
    """All light is measured by the brightest: one message with the first place, the value and what to do."""
    values = np.ones((4, 5, 2))
    values[1, 3, 0], values[2, 0, 1], values[0, 0, 0], values[0, 1, 0] = value, value, np.nan, np.inf
    with pytest.raises(SceneError, match=r"scene p has 2 values, the first \S+ at y 1, x 3, band 0, .*; put NaN"):
        raster_from_values(values, CAMERA, name="p", wavelength_nm=WAVELENGTH)


def test_light_too_small_for_numbers_is_refused() -> None:
    """Electrons per unit would be infinite."""
    with pytest.raises(SceneError, match="brightest values of scene p are 1e-38, too small to be told from nothing"):
        raster_from_values(np.full((4, 5, 2), 1e-38), CAMERA, name="p", wavelength_nm=WAVELENGTH)


def test_pixels_without_most_bands_are_missing_and_unlabelled() -> None:
    """Half of the bands is enough to be known by; a scene with every value misses nothing."""
    values, labels = np.ones((4, 5, 2)), np.zeros((4, 5), np.uint8)
    values[0, 0], values[1, 1, 0], values[2, 2] = np.nan, np.nan, np.inf
    scene = raster_from_values(values, CAMERA, name="p", wavelength_nm=WAVELENGTH, labels=labels)
    assert scene.missing is not None
    assert np.argwhere(scene.missing).tolist() == [[0, 0], [2, 2]]
    assert scene.labels is not None
    assert np.argwhere(scene.labels == 255).tolist() == [[0, 0], [2, 2]]
    assert scene.filled_px == 3
    assert not labels.any()
    assert raster_from_values(np.ones((4, 5, 2)), CAMERA, name="p", wavelength_nm=WAVELENGTH).missing is None
