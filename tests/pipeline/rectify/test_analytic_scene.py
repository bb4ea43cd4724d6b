"""Acceptance: a scene with a closed form is swept, calibrated, resampled, mosaicked and compared with its truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import Axis, Sweep
from spectralzoom.pipeline.rectify.mosaic import MosaicPart, edge_distance, mosaic
from spectralzoom.pipeline.rectify.placed import PixelGrid
from spectralzoom.pipeline.rectify.resample import resample
from spectralzoom.pipeline.signal.calibrate import calibrate
from spectralzoom.pipeline.simulator.rig_model import Rig
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene
from spectralzoom.pipeline.simulator.simulated import SimulatedSource
from tests.pipeline.rectify.aiming import geolocation
from tests.pipeline.simulator.small_scenes import effects_on, made_scene

CAMERA = LineCamera(bits=14, electrons_per_dn=1.0)  # finer steps than the rig's, so that rounding adds no error
FULL = 15_000.0
BESIDE = 24  # px


@dataclass(frozen=True)
class Waves:
    """Sinusoids around 0.5 in two bands, known at any point."""

    shape: tuple[int, int]
    frequency: np.ndarray  # (wave, 2) of y and x [1/px]
    phase: np.ndarray
    height: np.ndarray

    def pixels(self) -> RasterScene:
        """Return the scene in pixels, wider than the field by the margin that lines see next to it."""
        y, x = np.mgrid[-BESIDE : self.shape[0] + BESIDE, -BESIDE : self.shape[1] + BESIDE]
        return made_scene(self.field_of(y, x), np.full(2, FULL), [500.0, 700.0])

    def field_of(self, y: np.ndarray, x: np.ndarray, damping: np.ndarray | float = 1.0) -> np.ndarray:
        """Return values (..., 2) at points, each wave damped by a factor; even waves are in band 0, odd in band 1."""
        turns = np.multiply.outer(y, self.frequency[:, 0]) + np.multiply.outer(x, self.frequency[:, 1])
        waves = np.cos(2 * np.pi * turns + self.phase) * (self.height * damping)
        return 0.5 + np.stack([waves[..., ::2].sum(axis=-1), waves[..., 1::2].sum(axis=-1)], axis=-1)

    def damping(self, along: Axis, step: int) -> NDArray[np.float64]:
        """Return each wave's damping by pixels, slit, detector and held positions, in closed form."""
        scan, line = self.frequency.T if along == "x" else self.frequency.T[::-1]
        held = np.arange(step) - (step - 1) / 2
        smear = np.cos(2 * np.pi * np.outer(scan, held)).mean(axis=1)
        left: NDArray[np.float64] = np.sinc(scan * CAMERA.slit_px) * np.sinc(line) * smear
        left *= (np.sinc(scan) * np.sinc(line)) ** 2  # light is linear between pixels
        return left


def waves(shape: tuple[int, int], period_px: tuple[float, float], slope: float, count: int = 12) -> Waves:
    """Return waves of evenly spread periods and heights of period ** slope (1 is the spectrum of natural scenes)."""
    rng = np.random.default_rng(7)
    period = np.linspace(*period_px, count)
    angle = rng.uniform(0, np.pi, count)
    frequency = np.stack([np.sin(angle), np.cos(angle)], axis=1) / period[:, None]
    height = period**slope / (period**slope).sum() * 0.4
    return Waves(shape, frequency, rng.uniform(0, 2 * np.pi, count), height)


def rectified(scene: Waves, swaths: list[float], along: Axis, step: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the mosaic of noise-free sweeps and the closed-form truth at the same grid pixels, (y, x, 2) each."""
    shape = (scene.shape[0] // step, scene.shape[1] // step)
    parts = [rectified_swath(scene, swath, along, step) for swath in swaths]
    y, x = (axis.ravel() * step + (step - 1) / 2 for axis in np.mgrid[: shape[0], : shape[1]])
    truth = scene.field_of(y, x, scene.damping(along, step))
    return mosaic(parts)[0].reshape(*shape, 2), truth.reshape(*shape, 2)


def rectified_swath(scene: Waves, swath: float, along: Axis, step: int) -> MosaicPart:
    """Return one sweep on the scene's grid: captured, calibrated, geolocated and resampled."""
    source = SimulatedSource(scene.pixels(), Rig(CAMERA), chosen=effects_on("rotation", "slit", "smear"))
    length = scene.shape[0] if along == "x" else scene.shape[1]
    margin = (3 + int(abs(swath) * 330 * CAMERA.ifov_rad / step)) * step  # for the line's rotation, and for taps
    lines = (length + 2 * margin) // step
    sweep = Sweep(f"strip {swath}", "fine", along, swath, -(length - 1) / 2 - margin, lines, step)
    lines = list(source.lines(sweep))
    raw = np.stack([line.data for line in lines])
    position = np.array([(line.mirror_x, line.mirror_y) for line in lines])
    values, valid = calibrate(raw, source.references(sweep), saturated_dn=CAMERA.full_scale_dn)
    origin = (step - scene.shape[0]) / 2, (step - scene.shape[1]) / 2
    rows, columns = scene.shape[0] // step, scene.shape[1] // step
    points = PixelGrid(origin, step, (rows, columns)).points(slice(0, rows), slice(0, columns)).reshape(-1, 2)
    at = geolocation(position, CAMERA, points, along=along)
    return MosaicPart(*resample(values, valid, at), edge_distance(at, raw.shape[0], raw.shape[1]))


@pytest.mark.parametrize(
    ("shape", "along", "swaths", "periods", "slope", "step"),
    [
        ((60, 900), "x", [-200, 200], (4, 40), 1.0, 1),
        ((900, 60), "y", [-200, 200], (4, 40), 1.0, 1),
        ((40, 1800), "x", [-620, 0, 620], (4, 40), 1.0, 1),
        ((60, 900), "x", [-200, 200], (6, 40), 0.0, 1),  # equal heights; a 4-px wave alone is too short for four taps
        ((240, 900), "x", [-200, 200], (16, 160), 1.0, 4),  # 4 to 40 of the coarse pass's own pixels
    ],
)
def test_mosaic_equals_the_analytic_scene(
    shape: tuple[int, int], along: Axis, swaths: list[float], periods: tuple[float, float], slope: float, step: int
) -> None:
    """Waves with the spectrum of natural scenes, or of equal heights, err by less than 0.5 % of their spread."""
    got, truth = rectified(waves(shape, periods, slope), swaths, along, step)
    assert np.sqrt(((got - truth) ** 2).mean()) < 0.005 * truth.std(axis=(0, 1)).mean()
