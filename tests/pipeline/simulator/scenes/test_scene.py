"""Scenes from files, and daylight: scene values, the sun's position, and light from noon to night."""

from __future__ import annotations

import errno
import os
from dataclasses import replace
from datetime import UTC, datetime
from unittest.mock import Mock

import numpy as np
import pytest

from spectralzoom.pipeline.errors import SceneError, ShapeError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.once import Once
from spectralzoom.pipeline.simulator.rig_model import Sky
from spectralzoom.pipeline.simulator.scenes import scene as scene_module
from spectralzoom.pipeline.simulator.scenes.daylight import knots_within, relative_daylight, sun_elevation_deg
from spectralzoom.pipeline.simulator.scenes.farm import land
from spectralzoom.pipeline.simulator.scenes.farm.farm_scene import farm_scene
from spectralzoom.pipeline.simulator.scenes.scene import (
    RasterScene,
    SceneRadiance,
    SceneRaster,
    raster_from_values,
    scratch,
)
from tests.pipeline.simulator.small_scenes import made_scene

BANDS = np.array([400.0, 550.0, 760.0, 1000.0])
EQUINOX = Sky(started=datetime(2026, 3, 20, 0, 0, tzinfo=UTC), latitude_deg=29.5, longitude_deg=0.0)


def test_sun_at_an_equinox_is_90_deg_minus_latitude_high() -> None:
    """At 29.5 deg north the sun is 60.5 deg high at noon, and as far below the horizon at midnight."""
    high = sun_elevation_deg(EQUINOX, np.arange(0, 86400, 300.0))
    assert high.max() == pytest.approx(60.5, abs=0.1)
    assert high.min() == pytest.approx(-60.5, abs=0.3)


@pytest.mark.parametrize(
    ("day", "elevation", "percent"), [((4, 16), 20.0, 1.04), ((4, 29), 30.0, 0.66), ((5, 23), 45.0, 0.38)]
)
def test_rate_of_morning_light_matches_hand_calculation(day: tuple[int, int], elevation: float, percent: float) -> None:
    """Due east at 29.5 deg north the sun rises by 13.05 deg an hour: cot(h) dh/dt is 1.04, 0.66, 0.38 % in 60 s."""
    sky = replace(EQUINOX, started=datetime(2026, *day, tzinfo=UTC))
    seconds = np.arange(4 * 3600.0, 12 * 3600.0, 60.0)
    start = float(np.interp(elevation, sun_elevation_deg(sky, seconds), seconds))
    before, after = np.sin(np.deg2rad(sun_elevation_deg(sky, np.array([start, start + 60]))))
    assert 100 * (after / before - 1) == pytest.approx(percent, abs=0.02)


def test_low_sun_is_redder() -> None:
    """At 5 deg green has lost more than the near infrared; at 20 deg it has lost more than the sine of elevation."""
    sky = replace(EQUINOX, started=datetime(2026, 3, 20, 15, 0, tzinfo=UTC))
    seconds = np.arange(0, 4 * 3600, 60.0)
    height = sun_elevation_deg(sky, seconds)
    light = relative_daylight(sky, BANDS, seconds)
    low = light[np.abs(height - 5).argmin()]
    assert low[1] < 0.8 * low[3]
    twenty = np.abs(height - 20).argmin()
    assert light[twenty, 1] < np.sin(np.deg2rad(height[twenty])) / np.sin(np.deg2rad(height[0]))


@pytest.mark.parametrize("hour", [0, 5, 12, 17])
def test_night_is_dark_and_finite(hour: int) -> None:
    """Over a day from any start hour, light is finite, positive with the sun up and exactly 0 with the sun down."""
    sky = replace(EQUINOX, started=datetime(2026, 3, 20, hour, tzinfo=UTC))
    seconds = np.arange(0, 86400, 300.0)
    light = relative_daylight(sky, BANDS, seconds)
    height = sun_elevation_deg(sky, seconds)
    assert np.isfinite(light).all()
    assert (light[height < -0.1] == 0).all()
    assert (light[height > 0.1] > 0).all()


def test_light_falls_to_0_at_sunset_without_a_step() -> None:
    """In a second light changes by less than 1 % of that at the start, with the sun 3 deg high."""
    sky = replace(EQUINOX, started=datetime(2026, 3, 20, 17, 55, tzinfo=UTC))
    light = relative_daylight(sky, BANDS, np.arange(0, 1200.0))
    assert light[-1].max() == 0
    assert np.abs(np.diff(light, axis=0)).max() < 0.01


def test_daylight_between_knots_is_accurate() -> None:
    """Between its knots light is right to 2e-6 of the start's, until sunset, and the turn of the year makes no jump."""
    sky = Sky(started=datetime(2026, 12, 31, 22, 0, tzinfo=UTC), latitude_deg=0.0, longitude_deg=-150.0)
    seconds = np.arange(0, 7 * 3600, 10.0)
    on, half = (relative_daylight(sky, BANDS, seconds + shift) for shift in (0.0, 5.0))
    near = sun_elevation_deg(sky, seconds)[1:-2] > 1
    bend = np.abs(on[:-3] - on[1:-2] - on[2:-1] + on[3:]) / 16  # of a parabola, at the middle
    assert bend[near].max() < 2e-6
    np.testing.assert_allclose(half[:-1], (on[:-1] + on[1:]) / 2, rtol=1e-9, atol=1e-12)


def test_knots_within_a_survey() -> None:
    """The knots are the survey's ends and the full ten seconds of the day between them."""
    sky = replace(EQUINOX, started=datetime(2026, 3, 20, 9, 0, 7, tzinfo=UTC))
    np.testing.assert_allclose(knots_within(sky, 20.0), [0, 3, 13, 20])


CAMERA = LineCamera()
WAVELENGTH = np.array([660.0, 800.0])


def picture(seed: int = 0, shape: tuple[int, ...] = (20, 30, 2)) -> np.ndarray:
    """Return random values in 0..255."""
    return (np.random.default_rng(seed).random(shape) * 255).astype(np.uint8)


def test_bright_end_fills_60_percent_of_the_well() -> None:
    """The 99.9th percentile of the values gives 60 % of the full well."""
    scene = raster_from_values(picture(), CAMERA, name="p", wavelength_nm=WAVELENGTH)
    bright = np.percentile(picture(), 99.9)
    np.testing.assert_allclose(bright * scene.electrons, 0.6 * CAMERA.full_scale_e, rtol=1e-6)
    np.testing.assert_allclose(scene.white_reference * scene.electrons, scene.white_reference_electrons, rtol=1e-6)


def test_scene_returns_the_values_it_was_made_of() -> None:
    """A scene made of values returns them; a scene of components returns their mixture."""
    scene = raster_from_values(picture(), CAMERA, name="p", wavelength_nm=WAVELENGTH)
    np.testing.assert_allclose(scene.values(), picture(), rtol=1e-6)
    mixed = made_scene(np.ones((4, 5, 3)), np.full((3, 2), 100), WAVELENGTH, white=np.full(2, 200))
    half = replace(mixed, white_reference=np.full(2, 0.5, np.float32))
    np.testing.assert_allclose(half.values(), np.full((4, 5, 2), 300 / 200 * 0.5))


def test_gaps_are_filled_and_counted() -> None:
    """Pixels without a value get the band's median; a band without any value gets 0."""
    values = picture().astype(np.float32)
    values[3, 4, 0], values[5, 6, 0], values[5, 6, 1] = np.nan, np.inf, -np.inf
    scene = raster_from_values(values, CAMERA, name="gaps", wavelength_nm=WAVELENGTH)
    assert scene.filled_px == 2
    assert scene.planes[3, 4, 0] == np.median(values[..., 0][np.isfinite(values[..., 0])])
    values[..., 1] = np.nan
    assert (raster_from_values(values, CAMERA, name="gaps", wavelength_nm=WAVELENGTH).planes[..., 1] == 0).all()


def test_black_scene_keeps_scale_one() -> None:
    """Without positive light the scale is 1 and all values stay finite."""
    scene = raster_from_values(np.zeros((5, 5, 2)), CAMERA, name="black", wavelength_nm=WAVELENGTH)
    np.testing.assert_allclose(scene.electrons, 0.6 * CAMERA.full_scale_e, rtol=1e-6)
    assert (scene.values() == 0).all()


def test_key_follows_the_content() -> None:
    """Equal values have equal keys under any name; one changed pixel gives another key."""
    changed = picture()
    changed[0, 0, 0] ^= 1
    keys = [raster_from_values(v, CAMERA, name="p", wavelength_nm=WAVELENGTH).key for v in (picture(), changed)]
    assert keys[0] != keys[1]
    assert keys[0] == raster_from_values(picture(), CAMERA, name="q", wavelength_nm=WAVELENGTH).key


def test_bright_end_of_a_large_scene_is_sampled() -> None:
    """Above 2^24 values the percentile is read from a part of the pixels, and stays right to 0.1 %."""
    values = np.broadcast_to(np.linspace(0, 1, 6_000, dtype=np.float32)[:, None, None], (6_000, 3_000, 2))
    scene = raster_from_values(values, CAMERA, name="large", wavelength_nm=WAVELENGTH, key="k")
    np.testing.assert_allclose(scene.white_reference * 0.6, 0.999, rtol=1e-3)


def test_unusable_scenes_are_refused() -> None:
    """The errors name missing axes, values without a finite one, and labels or wavelengths of another size."""
    with pytest.raises(SceneError, match=r"\(y, x, band\)"):
        raster_from_values(picture(shape=(4, 5)), CAMERA, name="flat", wavelength_nm=WAVELENGTH)
    with pytest.raises(SceneError, match="no finite value"):
        raster_from_values(np.full((2, 2, 2), np.nan), CAMERA, name="void", wavelength_nm=WAVELENGTH)
    labels = np.zeros((3, 3), np.uint8)
    with pytest.raises(SceneError, match="crop or pad"):
        raster_from_values(picture(), CAMERA, name="p", wavelength_nm=WAVELENGTH, labels=labels)
    with pytest.raises(ShapeError, match="2 components to 3 bands"):
        raster_from_values(picture(), CAMERA, name="p", wavelength_nm=np.arange(3.0))


def test_raster_is_drawn_on_first_use() -> None:
    """Size and labels are stated before; the drawn planes and labels must match them."""
    draw = Mock(return_value=(np.ones((4, 5, 2), np.float32), np.zeros((4, 5), np.uint8)))
    light = Once.of(SceneRadiance(np.ones(2, np.float32), np.ones(2, np.float32)))
    raster = SceneRaster((4, 5, 2), labelled=True, draw=draw)
    scene = RasterScene("s", "k", raster, light, np.ones(2, np.float32), WAVELENGTH)
    assert (scene.shape, scene.labelled, draw.call_count) == ((4, 5), True, 0)
    assert scene.labels.shape == scene.planes.shape[:2]
    assert replace(scene, key="other").planes is scene.planes
    assert draw.call_count == 1
    for other in (SceneRaster((4, 6, 2), labelled=True, draw=draw), SceneRaster((4, 5, 2), labelled=False, draw=draw)):
        with pytest.raises(SceneError, match="crop or pad"):
            other.drawn()
    with pytest.raises(SceneError, match="not empty"):
        SceneRaster((0, 5, 2), labelled=False, draw=draw)


@pytest.mark.parametrize("value", [1e30, -1e20, 2e9, 1e300])
def test_values_that_no_sensor_gives_are_refused(value: float) -> None:
    """All light is scaled by the brightest value: one message names the first place, the value and the remedy."""
    values = np.ones((4, 5, 2))
    values[1, 3, 0], values[2, 0, 1], values[0, 0, 0], values[0, 1, 0] = value, value, np.nan, np.inf
    with pytest.raises(SceneError, match=r"scene p has 2 values, the first \S+ at y 1, x 3, band 0, .*; put NaN"):
        raster_from_values(values, CAMERA, name="p", wavelength_nm=WAVELENGTH)


def test_values_too_small_for_float32_are_refused() -> None:
    """Values of 1e-38 would give infinite electrons per unit."""
    with pytest.raises(SceneError, match="brightest values of scene p are 1e-38, too small for float32"):
        raster_from_values(np.full((4, 5, 2), 1e-38), CAMERA, name="p", wavelength_nm=WAVELENGTH)


def test_pixels_without_most_bands_are_missing_and_unlabelled() -> None:
    """A pixel with half of its bands is kept; a scene with every value has no missing pixels."""
    values = np.ones((4, 5, 2))
    labels = np.zeros((4, 5), np.uint8)
    values[0, 0], values[1, 1, 0], values[2, 2] = np.nan, np.nan, np.inf
    scene = raster_from_values(values, CAMERA, name="p", wavelength_nm=WAVELENGTH, labels=labels)
    assert np.argwhere(scene.missing).tolist() == [[0, 0], [2, 2]]
    assert np.argwhere(scene.labels == 255).tolist() == [[0, 0], [2, 2]]
    assert scene.filled_px == 3
    assert not labels.any()
    assert raster_from_values(np.ones((4, 5, 2)), CAMERA, name="p", wavelength_nm=WAVELENGTH).missing is None


def test_large_array_is_stored_in_a_file(monkeypatch: pytest.MonkeyPatch):
    """The array is zero at first, and keeps written values."""
    assert scratch((4, 5)).base is None
    monkeypatch.setattr(scene_module, "MOST_BYTES", 64)
    held = scratch((4, 5))
    assert held.base is not None
    assert not held.any()
    held[2] = 7
    assert held.sum() == 35


def test_a_full_disk_is_an_error(monkeypatch: pytest.MonkeyPatch):
    """Space is allocated before anything is written: a sparse file would end the process later, with a signal."""
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    monkeypatch.setattr(scene_module, "MOST_BYTES", 64)
    monkeypatch.setattr(os, "posix_fallocate", Mock(side_effect=full))
    with pytest.raises(OSError, match="No space left"):
        scratch((4, 5))


def test_farm_does_not_depend_on_the_rows_drawn_at_once(monkeypatch: pytest.MonkeyPatch):
    """Noise, weeds, ponds, shadows and trees cross the borders of row blocks; each block fills its own pixels."""
    whole, parted = farm_scene(3, (300, 400)), farm_scene(3, (300, 400))
    for rows, scene in ((300, whole), (7, parted)):
        monkeypatch.setattr(land, "ROWS_AT_ONCE", rows)
        scene.raster.drawn()
    np.testing.assert_array_equal(parted.planes, whole.planes)
    np.testing.assert_array_equal(parted.labels, whole.labels)
    assert {"water", "tree", "weed"} <= {whole.class_names[number] for number in np.unique(whole.labels)}


def test_farm_stored_in_files_equals_one_in_memory(monkeypatch: pytest.MonkeyPatch):
    """Planes, labels and thinned planes have the same values."""
    here, there = farm_scene(3, (300, 200)), farm_scene(3, (300, 200))
    want = here.planes, here.labels, here.raster.thinned(2)
    monkeypatch.setattr(scene_module, "MOST_BYTES", 1000)
    found = there.planes, there.labels, there.raster.thinned(2)
    assert found[0].base is not None
    assert all(np.array_equal(one, other) for one, other in zip(want, found, strict=True))
