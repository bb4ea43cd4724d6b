"""A survey without noise stores the scene convolved with the slit, the pixel and the coarse pass's smear."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import convolve1d

from spectralzoom.pipeline.geometry.camera import LineCamera, footprint_kernel
from spectralzoom.storage.arrays.mosaics import open_mosaic
from spectralzoom.storage.arrays.signal_cubes import open_signal_cubes
from tests.conftest import Survey, WeightsMaker
from tests.pipeline.rectify.test_analytic_scene import waves

SLIT_PX = LineCamera().slit_px
SAMPLES = 144  # samples of a line; a narrow camera is quick to simulate
BOUND = 0.005  # of the scene's standard deviation


def through(frequency: NDArray[np.float64], width: float) -> NDArray[np.float64]:
    """Return the gain of a box, at pixel centres, for waves linear between pixels: with all images, in phase."""
    images = frequency + np.arange(-200, 201)[:, None]
    return (np.sinc(images) ** 2 * np.sinc(images * width)).sum(axis=0)


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
    scene = waves(shape, (4, 40), 1.0)
    places = np.mgrid[: shape[0], : shape[1]]
    raster = scene.field_of(*places)
    archive = tmp_path / "archive"
    np.save(tmp_path / "waves.npy", raster)
    flags = {"labels": None, "wavelengths": "500,700", "weights": str(make_weights((500.0, 700.0))), "budget": None}
    flags |= {"effects": "rotation,slit,smear", "tol": "0", "camera.samples": SAMPLES, "scan_step": "1"}
    products = survey_png(archive, scene=str(tmp_path / "waves.npy"), **flags).receipt["products"]
    assert open_signal_cubes(archive / products["signal_coarse"])[0].sweep.along == along
    mosaic = open_mosaic(archive / products["mosaic"]).values()
    blurred = convolve1d(raster, footprint_kernel(SLIT_PX), axis="xy".index(along), mode="nearest")
    pixels = convolve1d(blurred, footprint_kernel(1.0), axis="yx".index(along), mode="nearest")  # along the line
    assert np.isfinite(mosaic).all()
    assert error_fraction(mosaic, pixels) < BOUND
    inner = np.s_[8:-8, 8:-8]  # the scene ends at its border, but the waves do not
    scan, line = scene.frequency.T if along == "x" else scene.frequency.T[::-1]
    closed = scene.field_of(*places, through(scan, SLIT_PX) * through(line, 1.0))
    assert error_fraction(mosaic[inner], closed[inner]) < BOUND
    assert error_fraction(mosaic, raster) > 4 * BOUND  # the bound distinguishes footprints
