"""A survey without noise stores the scene convolved with the slit, the pixel and the coarse pass's smear."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import convolve1d

from pipeline.geometry.camera import LineCamera, footprint_kernel
from storage.arrays.mosaics import open_mosaic
from storage.arrays.signal_cubes import open_signal_cubes
from tests.conftest import Survey, WeightsMaker

SLIT_PX = LineCamera().slit_px
SAMPLES = 144  # samples of a line; a narrow camera is quick to simulate
BOUND = 0.005  # of the scene's standard deviation


@dataclass(frozen=True)
class Waves:
    """Plane waves around 0.5: two bands, evenly spaced periods, amplitudes proportional to the period."""

    shape: tuple[int, int]
    frequency: NDArray[np.float64]  # (wave, 2) of y and x [1/px]
    phase: NDArray[np.float64]
    height: NDArray[np.float64]

    def values(self, y: NDArray[np.float64], x: NDArray[np.float64], left: Any = 1.0) -> NDArray[np.float64]:
        """Return values at (y, x) positions, (..., 2); each wave is multiplied by its fraction ``left``."""
        turns = np.multiply.outer(y, self.frequency[:, 0]) + np.multiply.outer(x, self.frequency[:, 1])
        waves = np.cos(2 * np.pi * turns + self.phase) * self.height * left
        return 0.5 + np.stack([waves[..., ::2].sum(axis=-1), waves[..., 1::2].sum(axis=-1)], axis=-1)

    def raster(self) -> NDArray[np.float64]:
        """Return the scene's pixels."""
        return self.values(*np.mgrid[: self.shape[0], : self.shape[1]].astype(float))

    def seen(self, along: str) -> NDArray[np.float64]:
        """Return the waves behind the footprint, in closed form, at the scene's pixels."""
        scan, line = self.frequency.T if along == "x" else self.frequency.T[::-1]
        left = through(scan, SLIT_PX) * through(line, 1.0)
        return self.values(*np.mgrid[: self.shape[0], : self.shape[1]].astype(float), left)


def through(frequency: NDArray[np.float64], width: float) -> NDArray[np.float64]:
    """Return the gain of a box, at pixel centres, for waves linear between pixels: with all images, in phase."""
    images = frequency + np.arange(-200, 201)[:, None]
    return (np.sinc(images) ** 2 * np.sinc(images * width)).sum(axis=0)


def waves(shape: tuple[int, int], shortest_px: float, longest_px: float) -> Waves:
    """Return twelve waves of seeded directions."""
    rng = np.random.default_rng(11)
    period = np.linspace(shortest_px, longest_px, 12)
    angle = rng.uniform(0, np.pi, 12)
    frequency = np.stack([np.sin(angle), np.cos(angle)], axis=1) / period[:, None]
    return Waves(shape, frequency, rng.uniform(0, 2 * np.pi, 12), 0.8 * period / period.sum())


def error_fraction(got: NDArray[np.floating], truth: NDArray[np.floating]) -> float:
    """Return the RMS error over the truth's standard deviation, the worse of two bands; NaN in ``got`` is left out."""
    spread = truth.std(axis=(0, 1))
    return float((np.sqrt(np.nanmean((got - truth) ** 2, axis=(0, 1))) / spread).max())


@pytest.mark.usefixtures("no_effects")
@pytest.mark.parametrize(("shape", "along"), [((64, 96), "x"), ((112, 64), "y")])
def test_survey_equals_the_scene_behind_the_footprint(
    shape: tuple[int, int], along: str, survey_png: Survey, make_weights: WeightsMaker, tmp_path: Path
) -> None:
    """For waves of 4 to 40 px the mosaic equals the convolved pixels, and inside it the waves' closed form."""
    scene = waves(shape, 4, 40)
    archive = tmp_path / "archive"
    np.save(tmp_path / "waves.npy", scene.raster())
    flags = {"labels": None, "wavelengths": "500,700", "weights": str(make_weights((500.0, 700.0))), "budget": None}
    flags |= {"effects": "rotation,slit,smear", "tol": "0", "camera.samples": SAMPLES, "scan_step": "1"}
    products = survey_png(archive, scene=str(tmp_path / "waves.npy"), **flags).receipt["products"]
    assert open_signal_cubes(archive / products["signal_coarse"])[0].sweep.along == along
    mosaic = open_mosaic(archive / products["mosaic"]).values()
    blurred = convolve1d(scene.raster(), footprint_kernel(SLIT_PX), axis="xy".index(along), mode="nearest")
    pixels = convolve1d(blurred, footprint_kernel(1.0), axis="yx".index(along), mode="nearest")  # along the line
    assert np.isfinite(mosaic).all()
    assert error_fraction(mosaic, pixels) < BOUND
    inner = np.s_[8:-8, 8:-8]  # the scene ends at its border, but the waves do not
    assert error_fraction(mosaic[inner], scene.seen(along)[inner]) < BOUND
    assert error_fraction(mosaic, scene.raster()) > 4 * BOUND  # the bound distinguishes footprints
