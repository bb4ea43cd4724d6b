"""Overlaps of sweeps: broad-band images, windows of neighbours, and a pass registered and compared with the truth."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.geometry.scan import Axis, Sweep, points_of_scan, sweep_to_scene
from spectralzoom.pipeline.once import Once
from spectralzoom.pipeline.planning.coverage import full_sweeps, uniform_sweeps
from spectralzoom.pipeline.rectify.registration.alignment import no_shifts
from spectralzoom.pipeline.rectify.registration.overlaps import PlacedImage, overlap_windows
from spectralzoom.pipeline.rectify.registration.seams import Registration, place_images, register_sweeps
from spectralzoom.pipeline.simulator.effects.pointing import PointingErrors
from spectralzoom.pipeline.simulator.rig_model import Rig
from spectralzoom.pipeline.simulator.scenes.scene import SceneRadiance, raster_from_values
from spectralzoom.pipeline.simulator.simulated import SimulatedSource, SimulatedSweep
from tests.pipeline.rectify.made_views import broad_sweep
from tests.pipeline.simulator.small_scenes import effects_on, seen_at

CAMERA = LineCamera(samples=160)
GRID = SceneGrid(260, 300, 16)


def source_of(pointing: PointingErrors | None = None, bands: int = 2, *, turned: bool = False) -> SimulatedSource:
    """Return a source over random waves of 6 to 60 px, wider than the grid by 40 px on each side."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[: GRID.height + 80, : GRID.width + 80].astype(float)
    values = np.full(y.shape, 1.0)
    for _ in range(30):
        period, angle, phase = np.exp(rng.uniform(*np.log((6, 60)))), *rng.uniform(0, 2 * np.pi, 2)
        values += 0.06 * np.cos(2 * np.pi * (np.sin(angle) * y + np.cos(angle) * x) / period + phase)
    values = values.T if turned else values
    cube = np.repeat(values[..., None], bands, axis=2)
    scene = raster_from_values(cube, CAMERA, name="t", wavelength_nm=np.linspace(500, 800, bands))
    return SimulatedSource(scene, Rig(CAMERA), 0, effects_on("rotation", "read-noise"), pointing=pointing)


def registered(pointing: PointingErrors, along: Axis, **options: Any) -> tuple[list[Sweep], Registration]:
    """Return the sweeps of a full pass over the grid with an overlap of 84 px, and their registration."""
    grid = GRID if along == "x" else replace(GRID, height=GRID.width, width=GRID.height)
    sweeps = full_sweeps(grid, CAMERA, along, overlap_px=84)
    source = source_of(pointing, turned=along == "y")
    broad = [broad_sweep(SimulatedSweep(source, sweep), CAMERA) for sweep in sweeps]
    return sweeps, register_sweeps(broad, CAMERA, **{"prior_px": 10, "window_px": 130, **options})


@pytest.mark.parametrize("along", ["x", "y"])
def test_a_pass_is_registered_to_a_fifth_of_a_pixel(along: Axis):
    """Sweeps with pointing errors of up to 10 px are registered to 0.2 px."""
    pointing = PointingErrors(offset_px=10, seed=2)
    sweeps, found = registered(pointing, along)
    assert len(sweeps) == 4
    assert (found.untied, found.narrow) == ((), ())
    held = pointing.offset(found.reference or "")
    for sweep in sweeps:
        assert np.abs(found.of(sweep.name).offset - (pointing.offset(sweep.name) - held)).max() < 0.2
    assert np.nanmax(np.abs([window.residual_px for window in found.windows])) < 0.2


def test_narrow_overlaps_are_reported():
    """Overlaps below 64 px beyond the prior are named with their width, and no sweep is moved."""
    sweeps, found = registered(PointingErrors(5), "x", prior_px=15)
    narrow = {(one.reference, one.moving): one for one in found.narrow}
    for one, other in pairwise(sweeps):
        assert 80 < narrow[one.name, other.name].width_px < narrow[one.name, other.name].needed_px == 94
    assert len(found.untied) == len(sweeps) - 1
    assert all((shift.offset == 0).all() for shift in found.shifts)


def test_a_coarse_pass_is_registered_in_scene_pixels():
    """Lines 2 px apart give corrections in px of the scene, like fine lines."""
    pointing = PointingErrors(offset_px=6, seed=5)
    sweeps = uniform_sweeps(GRID, CAMERA, "x", step=2, overlap_px=84)
    source = source_of(pointing)
    broad = [broad_sweep(SimulatedSweep(source, sweep), CAMERA) for sweep in sweeps]
    found = register_sweeps(broad, CAMERA, prior_px=8, window_px=300)
    held = pointing.offset(found.reference or "")
    for sweep in sweeps:
        np.testing.assert_allclose(found.of(sweep.name).offset, pointing.offset(sweep.name) - held, atol=0.3)
    for window in found.windows:
        if window.found is not None and window.measured is not None:
            np.testing.assert_array_equal(window.measured.error_px, 2 * window.found.error_px[::-1])


def test_windows_lie_inside_of_both_sweeps():
    """Both sweeps see every window, except for 2 px at its borders."""
    sweeps = full_sweeps(GRID, CAMERA, "x", overlap_px=84)
    source = source_of()
    broad = [broad_sweep(SimulatedSweep(source, sweep), CAMERA) for sweep in sweeps]
    images = place_images(broad, no_shifts([sweep.name for sweep in sweeps]), CAMERA)
    windows = overlap_windows(images, window_px=100)
    assert {(window.reference, window.moving) for window in windows} >= {(0, 1), (1, 2), (2, 3)}
    for window in windows:
        inner = [np.linspace(low + 2, high - 2, 5) for low, high in (window.along_px, window.scan_px)]
        for number in (window.reference, window.moving):
            assert np.isfinite(images[number].seen_at(*inner)).all()


def test_a_broad_band_image_is_the_mean_of_the_bands():
    """Without noise it is the scene's mean over bands. Lost and unusable lines are NaN."""
    source = replace(source_of(bands=5), chosen=effects_on("rotation"))
    sweep = full_sweeps(GRID, CAMERA, "x")[0]
    lines = SimulatedSweep(source, sweep)
    kept = np.arange(sweep.lines) != 7
    position = np.where(kept[:, None], lines.position, np.nan)
    holed = SimpleNamespace(
        sweep=sweep, references=lines.references, valid_line=kept, position=position, read=lines.read
    )
    broad = broad_sweep(holed, CAMERA)  # type: ignore[arg-type]
    along, scan = sweep_to_scene(sweep, CAMERA)
    y, x = scan + (source.scene.shape[0] - 1) / 2, along + (source.scene.shape[1] - 1) / 2
    truth = seen_at(source.scene, y, x).mean(axis=-1)
    assert np.isnan(broad.image[7]).all()
    np.testing.assert_allclose(broad.image[kept], truth[kept], atol=2e-3)
    believed = np.arange(sweep.lines) != 9
    doubted = broad_sweep(lines, CAMERA, usable=believed)
    np.testing.assert_array_equal(np.isnan(doubted.image).all(axis=1), ~believed)


def test_saturated_samples_are_left_out():
    """Saturated samples are NaN in the broad-band image."""
    values = np.full((GRID.height, GRID.width, 1), 1.0)
    values[100:140, 120:180] = 2.0  # 60 % of the full well
    scene = raster_from_values(values, CAMERA, name="t", wavelength_nm=np.array([600.0]))
    bright = replace(scene, light=Once.of(SceneRadiance(scene.electrons * 2.4, scene.white_reference_electrons)))
    sweep = Sweep("s", "fine", "x", 0.0, -40.0, 80)
    source = SimulatedSource(bright, Rig(CAMERA), 0, effects_on("rotation"))
    broad = broad_sweep(SimulatedSweep(source, sweep), CAMERA)
    assert np.isnan(broad.image[broad.image.shape[0] // 2, broad.image.shape[1] // 2])
    assert np.isfinite(broad.image[0]).all()


def test_turn_is_the_derivative_of_places_by_the_swath():
    """Far off the axis it predicts the view of a sample whose swath lies 1 px further along."""
    broad = broad_sweep(SimulatedSweep(source_of(), Sweep("s", "fine", "x", 1500.0, -900.0, 3)), CAMERA)
    image = PlacedImage(broad, CAMERA, np.zeros((3, 2)))
    slope = CAMERA.pixel_slopes()[140:141]
    (here,) = np.stack(points_of_scan(1499.5, CAMERA, np.array([-899.0]), slope), axis=-1)
    (there,) = np.stack(points_of_scan(1500.5, CAMERA, np.array([-899.0]), slope), axis=-1)
    line, turn = image.line_and_turn(*(here + there) / 2)
    assert line == 1
    np.testing.assert_allclose(turn[:, 0], there - here, atol=1e-5)
    assert np.abs(turn - np.eye(2)).max() > 1e-3
    assert np.isfinite(place_images([broad], no_shifts(["s"]), CAMERA)[0].edges).all()
