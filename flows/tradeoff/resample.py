"""Trade-off of the resampling kernel: an analytic scene, known at every point, read between its samples."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from flows.tradeoff.entries import Level, Setting, Tradeoff, register
from pipeline.geometry.camera import LineCamera
from pipeline.rectify.kernels import Kernel
from pipeline.rectify.resample import resample

SIDE, BANDS, POINTS = 256, 64, 40_000
PERIODS_PX = (4.0, 40.0)
WAVES = 24
CONTRAST = 0.2  # standard deviation of the scene over its mean, which fills half of the converter's range
RAW_AND_RESULT = 6.0  # bytes: a uint16 read and a float32 written


@dataclass(frozen=True)
class Waves:
    """Sum of plane waves of 4 to 40 px, in every band with other phases and amplitudes."""

    frequency: NDArray[np.float64]  # (wave, 2) cycles per px down and across
    cosine: NDArray[np.float64]  # (wave, band)
    sine: NDArray[np.float64]

    def at(self, coordinates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Exact values at (n, 2) positions [px], (n, band)."""
        phase = 2 * np.pi * coordinates @ self.frequency.T
        values: NDArray[np.float64] = np.cos(phase) @ self.cosine + np.sin(phase) @ self.sine
        return values


@dataclass(frozen=True)
class Scattered:
    """Samples on a grid, points between them, and what is true there."""

    samples: NDArray[np.float32]  # (line, sample, band)
    valid: NDArray[np.bool_]
    coordinates: NDArray[np.float64]  # (n, 2)
    truth: NDArray[np.float64]  # (n, band)


def draw_waves(seed: int, bands: int = BANDS, periods_px: tuple[float, float] = PERIODS_PX) -> Waves:
    """Waves of random directions, their periods even in logarithm."""
    rng = np.random.default_rng(seed)
    period = np.exp(rng.uniform(np.log(periods_px[0]), np.log(periods_px[1]), WAVES))
    angle = rng.uniform(0, np.pi, WAVES)
    frequency = np.stack([np.sin(angle), np.cos(angle)], axis=-1) / period[:, None]
    return Waves(frequency, rng.standard_normal((WAVES, bands)), rng.standard_normal((WAVES, bands)))


def _prepare(seed: int) -> Scattered:
    """Point samples of the waves, and points at least 2 px inside, in the order of lines as a lookup gives them."""
    waves, rng = draw_waves(seed), np.random.default_rng([seed, 1])
    grid = np.argwhere(np.ones((SIDE, SIDE), bool)).astype(np.float64)
    samples = waves.at(grid).astype(np.float32).reshape(SIDE, SIDE, BANDS)
    coordinates = rng.uniform(2, SIDE - 3, (POINTS, 2))
    coordinates = coordinates[np.lexsort((coordinates[:, 1], np.floor(coordinates[:, 0])))]
    return Scattered(samples, np.ones((SIDE, SIDE), bool), coordinates, waves.at(coordinates))


def _run(state: Scattered, kernel: Setting) -> NDArray[np.float32]:
    return resample(state.samples, state.valid, state.coordinates, cast("Kernel", kernel))[0]


def _judge(state: Scattered, _kernel: Setting, out: NDArray[np.float32]) -> float:
    return float(np.sqrt(np.mean((out - state.truth) ** 2)) / np.std(state.truth))


def noise_levels(camera: LineCamera) -> tuple[Level, ...]:
    """A tenth of the noise and half a step of the converter, over the scene's standard deviation."""
    electrons = camera.full_well_e / 2
    scene = CONTRAST * electrons
    noise = np.sqrt(electrons + camera.read_noise_e**2)
    return (
        Level("0.1 σ of noise", 0.1 * float(noise) / scene),  # noqa: RUF001
        Level("0.5 LSB", 0.5 * camera.electrons_per_dn / scene),
    )


RESAMPLE = register(
    Tradeoff(
        stage="rectify",
        knob="kernel",
        error="rmse / standard deviation",
        unit="px*band",
        reference=f"waves of {PERIODS_PX[0]:g} to {PERIODS_PX[1]:g} px, evaluated at the output pixels",
        settings=("nearest", "bilinear", "catmull-rom"),
        prepare=_prepare,
        run=_run,
        judge=_judge,
        work=lambda state, _kernel: float(state.truth.size),
        levels=lambda _state: noise_levels(LineCamera()),
        moved_bytes=RAW_AND_RESULT,
    )
)
