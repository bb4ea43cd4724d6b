"""Illumination of sweeps from their overlaps: drift is recovered, spectra are kept, and separate sweeps stay at 1."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.geometry.scan import Axis, Sweep
from spectralzoom.pipeline.planning.coverage import full_sweeps
from spectralzoom.pipeline.rectify.placed import PixelGrid, place
from spectralzoom.pipeline.rectify.region import mosaic_tile
from spectralzoom.pipeline.rectify.registration.illumination import LightRatio, light_ratio, overlap_light, solve_lights
from spectralzoom.pipeline.rectify.registration.overlaps import Window
from spectralzoom.pipeline.simulator.rig_model import Rig
from spectralzoom.pipeline.simulator.scenes.scene import raster_from_values
from spectralzoom.pipeline.simulator.simulated import SimulatedSource, SimulatedSweep
from tests.pipeline.simulator.small_scenes import effects_on

WAVELENGTH = np.linspace(400, 1000, 31)
PLACE = (WAVELENGTH - 700) / 300


def ratios_of(log_light: np.ndarray, error: float) -> list[LightRatio]:
    """Return light ratios of neighbouring sweeps with noise of a stated size."""
    rng = np.random.default_rng(0)
    return [
        LightRatio(one, one + 1, step + rng.normal(0, error, len(step)), np.full(len(step), error))
        for one, step in enumerate(np.diff(log_light, axis=0))
    ]


def smooth_lights(count: int) -> np.ndarray:
    """Return log lights that drift by colour and have a mean of 0 over the sweeps."""
    draws = np.random.default_rng(1).normal(0, [0.2, 0.1, 0.05, 0.02], (count, 4))
    lights = draws @ np.polynomial.legendre.legvander(PLACE, 3).T
    return lights - lights.mean(axis=0)


def test_smooth_drift_is_recovered():
    """With 1 % of noise per band the light of every sweep errs by 0.7 % rms, because smoothness averages the noise."""
    truth = smooth_lights(5)
    found = solve_lights(ratios_of(truth, 0.01), 5, WAVELENGTH)
    np.testing.assert_allclose(np.log(found.light), truth, atol=0.02)
    assert np.sqrt(np.mean((np.log(found.light) - truth) ** 2)) < 0.007
    np.testing.assert_allclose(np.log(found.light).mean(axis=0), 0, atol=1e-6)
    np.testing.assert_allclose(found.gain(2) * found.light[2], 1, rtol=1e-6)


def test_bands_without_light_are_ignored():
    """NaN ratios and bands of large error change neither their neighbours nor the rest."""
    truth = smooth_lights(3)
    ratios = ratios_of(truth, 1e-4)
    broken = [
        replace(
            ratio,
            log_ratio=np.where(PLACE < -0.8, np.nan, ratio.log_ratio + (PLACE > 0.9) * 2.0),
            error=np.where(PLACE < -0.8, np.inf, np.where(PLACE > 0.9, 50.0, ratio.error)),
        )
        for ratio in ratios
    ]
    np.testing.assert_allclose(np.log(solve_lights(broken, 3, WAVELENGTH).light), truth, atol=0.01)


def test_separate_sweeps_keep_a_mean_light_of_one():
    """A sweep without a ratio stays at 1 and is named. Separate groups have a mean log light of 0 each."""
    truth = np.array([[0.1], [-0.1], [0.0], [0.3], [-0.3]]) * np.ones((1, 31))
    ratios = [ratio for ratio in ratios_of(truth, 1e-6) if 2 not in (ratio.reference, ratio.moving)]
    found = solve_lights(ratios, 5, WAVELENGTH)
    assert found.untied == (2,)
    np.testing.assert_allclose(np.log(found.light), truth, atol=1e-4)
    assert (solve_lights([], 2, WAVELENGTH).light == 1).all()


def test_light_ratio_withstands_noise_and_changes():
    """Noise of a fifth of the light and a quarter of changed rows leave the ratio right to 2 %."""
    rng = np.random.default_rng(2)
    ground = rng.uniform(0.2, 1.0, (40, 60, 3))
    moving = ground * np.array([1.1, 0.9, 1.0]) + rng.normal(0, 0.1, ground.shape)
    moving[:10] *= 3.0
    moving[20:22], ground[:, 5] = np.nan, np.nan
    found = light_ratio(ground + rng.normal(0, 0.1, ground.shape), moving, pair=(0, 1))
    np.testing.assert_allclose(np.exp(found.log_ratio), [1.1, 0.9, 1.0], rtol=0.02)
    assert (found.error < 0.02).all()
    dark = light_ratio(np.zeros((40, 60, 3)), moving, pair=(0, 1))
    assert np.isnan(dark.log_ratio).all()
    assert np.isinf(dark.error).all()


def test_drift_between_captured_sweeps_is_removed():
    """Two simulated sweeps with different light and colour agree to 0.5 % in every band after correction."""
    camera = LineCamera(samples=120)
    values = np.kron(np.random.default_rng(3).uniform(0.3, 1, (15, 26, 8)), np.ones((8, 8, 1)))
    scene = raster_from_values(values, camera, name="t", wavelength_nm=np.linspace(400, 1000, 8))
    source = SimulatedSource(scene, Rig(camera), 0, effects_on("rotation", "shot", "read-noise"))
    sweeps = full_sweeps(SceneGrid(100, 150, 16), camera, "x", overlap_px=64)[:2]
    light = 1.2 + 0.1 * np.linspace(-1, 1, 8)

    plain, other = (SimulatedSweep(source, sweep) for sweep in sweeps)
    dark = other.references.dark

    def read(start: int, stop: int, samples: slice) -> np.ndarray:
        return np.rint((other.read(start, stop) - dark) * light * 0.8 + dark).astype(np.uint16)[:, samples]

    names = ("sweep", "references", "position", "time_s", "exposure_ms", "valid_line")
    told = {name: getattr(other, name) for name in names}
    placed = [place(plain, camera), place(SimpleNamespace(**told, read=read), camera)]  # type: ignore[arg-type]
    low, high = sweeps[1].swath_px - 59, sweeps[0].swath_px + 59
    (ratio,) = overlap_light(placed, camera, [Window(0, 1, (low, high), (-45.0, 45.0))])
    found = solve_lights([ratio], 2, scene.wavelength_nm)
    np.testing.assert_allclose(found.light[1] / found.light[0], light * 0.8, rtol=5e-3)
    grid = PixelGrid((-40.0, low), 1, (80, int(high - low)))
    means = []
    for number, one in enumerate(placed):
        lit = replace(one, gain=found.gain(number))
        tile, _ = mosaic_tile([lit], camera, grid, slice(0, 80), slice(0, grid.shape[1]))
        means.append(np.nanmean(tile, axis=(0, 1)))
    np.testing.assert_allclose(means[0], means[1], rtol=5e-3)


@pytest.mark.parametrize("period", [4.0, 8.0, 12.37])
@pytest.mark.parametrize("along", ["x", "y"])
def test_crop_rows_do_not_change_the_light_ratio(period: float, along: Axis):
    """Sweeps whose lines meet crop rows half a pixel apart have a ratio of 1, for any period and both orientations."""
    camera = LineCamera(samples=120)
    y, _ = np.mgrid[:150, :208].astype(float)
    rows = 0.3 + 0.25 * np.cos(2 * np.pi * y / period)
    scene = raster_from_values(rows[..., None], camera, name="t", wavelength_nm=np.array([700.0]))
    source = SimulatedSource(scene, Rig(camera), 0, effects_on("rotation"))
    sweeps = [Sweep(name, "fine", along, at, -64.0 + at, 56) for name, at in (("a", 0.0), ("b", 0.5))]
    placed = [place(SimulatedSweep(source, sweep), camera) for sweep in sweeps]
    (ratio,) = overlap_light(placed, camera, [Window(0, 1, (0.0, 50.0), (-60.0, -12.0))])
    assert abs(ratio.log_ratio[0]) < 0.003
