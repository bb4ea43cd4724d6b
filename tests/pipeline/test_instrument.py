"""The simulated instrument: footprints along exact rays, against closed forms and against rays traced one by one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.camera import LineCamera, look
from pipeline.mirror import direction_to_scene, mirror_throughput, position_to_normal, reflect
from pipeline.once import Once
from pipeline.scan import Sweep, line_positions, sweep_positions
from pipeline.simulator.instrument import ALL_EFFECTS, expected_lines
from pipeline.simulator.raster import Light
from pipeline.simulator.scene import RasterScene, raster_from_values

CAMERA = LineCamera()
OPTICS = ALL_EFFECTS - {"throughput"}
SWEEP = Sweep("s", "fine", "x", strip_px=0.0, start_px=-19.5, lines=40)


def scene_of(values: np.ndarray) -> RasterScene:
    """A scene of given values (y, x, band)."""
    return raster_from_values(values, CAMERA, name="t", wavelength_nm=np.linspace(400, 900, values.shape[2]))


def smooth(shape: tuple[int, int, int], seed: int = 0) -> np.ndarray:
    """Random waves of 6 to 60 px around 1."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: shape[0], : shape[1]]
    values = np.ones(shape)
    for _ in range(12):
        fy, fx = rng.normal(size=2) / rng.uniform(6, 60)
        values += 0.03 * np.cos(2 * np.pi * (fy * y + fx * x) + rng.uniform(0, 6))[..., None]
    return values


def test_flat_scene_gives_flat_lines() -> None:
    """At any pose a flat scene gives each sample the same electrons but for the mirror, by exposure."""
    scene = scene_of(np.full((30, 30, 2), 4.0))
    far = Sweep("far", "coarse", "y", strip_px=2000.0, start_px=-3000.0, lines=5, step=4, binning=4)
    expected = np.broadcast_to(4 * scene.electrons, (5, 640, 2))
    np.testing.assert_allclose(expected_lines(scene, CAMERA, far, range(5), effects=OPTICS), expected, rtol=1e-5)
    longer = expected_lines(scene, replace(CAMERA, exposure_ms=250.0), far, range(5), effects=OPTICS)
    np.testing.assert_allclose(longer, 2.5 * expected, rtol=1e-5)


@pytest.mark.parametrize("step", [1, 4])
def test_mirror_passes_its_share_at_every_held_position(step: int) -> None:
    """A flat scene shows the mirror's throughput, averaged over the positions held in each exposure."""
    scene = scene_of(np.full((30, 30, 1), 4.0))
    far = Sweep("far", "fine", "x", strip_px=-1500.0, start_px=2000.0, lines=6, step=step)
    lines = expected_lines(scene, CAMERA, far, range(6), effects=frozenset({"smear", "throughput"}))[..., 0]
    share = mirror_throughput(sweep_positions(far, CAMERA)).mean(axis=1)
    assert abs(share[0] - 1) > 0.05
    np.testing.assert_allclose(lines / (4 * scene.electrons[0]), np.broadcast_to(share[:, None], (6, 640)), rtol=1e-5)


def test_shifted_lines_see_the_shifted_place() -> None:
    """A line looked at beside its plan is the line planned there."""
    scene = scene_of(smooth((200, 700, 1)))
    sweep = Sweep("s", "fine", "x", strip_px=10.0, start_px=-50.0, lines=20, step=2)
    moved = replace(sweep, strip_px=17.0, start_px=-38.5)
    shifted = expected_lines(scene, CAMERA, sweep, range(3, 9), shift_px=np.tile([7.0, 11.5], (6, 1)))
    np.testing.assert_allclose(shifted, expected_lines(scene, CAMERA, moved, range(3, 9)), rtol=1e-5)


@pytest.mark.parametrize("step", [1, 4])
def test_undeflected_sweep_is_the_operator_on_the_grid(step: int) -> None:
    """Around the undeflected direction lines equal the closed-form operator that training uses, slit and smear."""
    values = smooth((40, 640, 1))
    scene = scene_of(values)
    sweep = replace(SWEEP, lines=40 // step, step=step)
    lines = expected_lines(scene, CAMERA, sweep, range(sweep.lines), effects=OPTICS)
    exact = replace(CAMERA, electrons_per_dn=1.0, bits=16)  # four of its samples still fit uint16
    looked = look(values.astype(np.float32) * scene.electrons, exact, step=step, rng=None)
    binned = lines.reshape(sweep.lines, 640 // step, step, 1).mean(axis=2)
    assert np.abs(binned - looked).max() < 0.02 * looked.std()


def test_rays_are_those_of_the_mirror() -> None:
    """Without slit and smear a sample sees the point that the reflected ray of its centre meets."""
    scene = scene_of(smooth((200, 700, 1)))
    sweep = Sweep("s", "fine", "x", strip_px=150.0, start_px=-50.0, lines=20)
    line = expected_lines(scene, CAMERA, sweep, range(7, 8), effects=frozenset())[0, :, 0]
    slope = CAMERA.pixel_slopes()
    ray = np.stack([0 * slope, slope, 1 + 0 * slope], axis=-1)
    normal = position_to_normal(line_positions(sweep, CAMERA)[7])
    x, y = direction_to_scene(reflect(ray, normal)).T / CAMERA.ifov_rad
    expected = scene.sample(y + 99.5, x + 349.5)[:, 0] * scene.electrons[0]
    np.testing.assert_allclose(line, expected, rtol=1e-5)


def test_line_does_not_depend_on_its_block() -> None:
    """Lines rendered one by one and together are the same bit by bit."""
    scene = scene_of(np.random.default_rng(1).random((40, 300, 5)))
    together = expected_lines(scene, CAMERA, SWEEP, range(40))
    apart = np.concatenate([expected_lines(scene, CAMERA, SWEEP, range(k, k + 1)) for k in range(40)])
    np.testing.assert_array_equal(together, apart)


def test_diagonal_and_full_electrons_agree() -> None:
    """A diagonal given as a vector gives what the matrix gives."""
    scene = scene_of(np.random.default_rng(2).random((20, 50, 4)))
    full = replace(scene, light=Once.of(Light(np.diag(scene.electrons), scene.panel_electrons)))
    lines = [expected_lines(s, CAMERA, SWEEP, range(10, 14)) for s in (scene, full)]
    np.testing.assert_allclose(lines[0], lines[1], rtol=1e-5)


def test_turned_rig_sees_the_turned_scene() -> None:
    """A line along y over a scene is the line along x over the scene with its axes swapped."""
    values = np.random.default_rng(3).random((90, 60, 2))
    turned = expected_lines(scene_of(values), CAMERA, replace(SWEEP, along="y"), range(5))
    straight = expected_lines(scene_of(values.swapaxes(0, 1)), CAMERA, SWEEP, range(5))
    np.testing.assert_allclose(turned, straight, rtol=1e-6)


def test_samples_off_the_scene_see_its_edge() -> None:
    """A scene smaller than the line fills it with its edge pixels."""
    values = np.ones((40, 100, 1))
    values[:, :50] = 3
    scene = scene_of(values)
    middle = expected_lines(scene, CAMERA, SWEEP, range(20, 21), effects=OPTICS)[0, :, 0] / scene.electrons[0]
    np.testing.assert_allclose(middle[:260], 3, rtol=1e-5)
    np.testing.assert_allclose(middle[380:], 1, rtol=1e-5)


def test_no_lines_give_none() -> None:
    """An empty range of lines has the shape of the camera."""
    assert expected_lines(scene_of(np.ones((4, 4, 3))), CAMERA, SWEEP, range(0)).shape == (0, 640, 3)
