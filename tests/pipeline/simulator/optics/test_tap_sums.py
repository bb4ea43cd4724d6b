"""Light through a footprint: tap weights in closed form, and light against thousands of rays of the footprint."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtr

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.mirror import position_to_normal
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.simulator.compiled_loops import read_weights
from spectralzoom.pipeline.simulator.effects.blurs import ABERRATION, KEYSTONE
from spectralzoom.pipeline.simulator.effects.effect import SweepBlock
from spectralzoom.pipeline.simulator.effects.line import ROTATION, SLIT
from spectralzoom.pipeline.simulator.optics.kernel_fit import TapTable, blurred_weight, box_weight
from spectralzoom.pipeline.simulator.optics.rays import exact_views, middle_normal
from spectralzoom.pipeline.simulator.render import expected_light
from spectralzoom.pipeline.simulator.rig_model import Optics, Rig
from spectralzoom.pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene
from tests.pipeline.simulator.small_scenes import image_scene, seen_at

CAMERA = LineCamera()
RIG = Rig(camera=CAMERA, optics=Optics(keystone_px=0.3))
BLURS: dict[Any, str] = {ABERRATION: "gaussian", KEYSTONE: "linear"}
CORNER = Sweep("corner", "fine", "x", swath_px=960.0, start_px=-1279.0, lines=2560)
MIDDLE = Sweep("middle", "fine", "y", swath_px=0.0, start_px=-1279.0, lines=2560)


def error(sweep: Sweep, line: int, variant: str, blurs: dict[Any, str]) -> float:
    """Return the greatest difference from the rays, over the light's standard deviation."""
    grain = np.random.default_rng(0).uniform(0.05, 1, (120, 160, 3))  # independent pixels, the roughest possible
    scene = image_scene(grain, CAMERA, np.linspace(400, 1000, 3))
    # The scene moves to the line: the shape of a block sets the place of the scene's first pixel.
    block = SweepBlock(RIG, sweep, range(line, line + 1), scene.wavelength_nm, scene.shape)
    moved = Moved.to(block, scene)
    light = expected_light(scene, block, {moved: "only", ROTATION: "rays", SLIT: variant, **blurs})[:, ::10]
    wanted = fine_light(scene, block, moved, blurs)
    return float(np.abs(light - wanted).max() / wanted.std())


@dataclass(frozen=True)
class Moved:
    """A displacement of all points of a block by whole px, onto a small scene."""

    along: float
    scan: float
    name: str = "moved"
    variants: tuple[str, ...] = ("only",)

    @staticmethod
    def to(block: SweepBlock, scene: RasterScene) -> Moved:
        """Return the displacement from the middle of a block's line to the middle of the scene."""
        return Moved(-float(block.sweep.swath_px), -float(np.rint(block.scan_px.mean())))

    def displaced(self, block: SweepBlock, along_px: Any, scan_px: Any, variant: str) -> tuple[Any, Any]:
        """Return the px to add."""
        return np.full_like(along_px, self.along), np.full_like(scan_px, self.scan)


@pytest.mark.parametrize(
    ("sweep", "line", "variant", "sharp", "blurred"),
    [
        (MIDDLE, 1280, "1x1", 1e-3, 2e-3),
        (MIDDLE, 1280, "9x3", 1e-3, 2e-3),
        (CORNER, 2, "9x3", 1e-3, 1e-2),
        (CORNER, 2, "3x1", 3e-3, 1e-2),
    ],
)
def test_closed_form_matches_many_rays(sweep: Sweep, line: int, variant: str, sharp: float, blurred: float) -> None:
    """The middle of a survey and its corner, with lines rotated by 9 deg, are compared with and without blurs.

    Tables displace 1e-4 of the light, and grain ranges over 6 of its standard deviations: .0003 for either axis.
    With blurs, boxes at the corner are moved for the covariance of the Gaussian as well as their own. That leaves its
    fourth moments wrong, by .008 of the standard deviation.
    """
    assert error(sweep, line, variant, {}) < sharp
    assert error(sweep, line, variant, BLURS) < blurred


DISTANCE = np.linspace(-5, 5, 401)


@pytest.mark.parametrize("width", [0.3, 1.0, 2.7, 4.4])
def test_box_weight_is_the_mean_of_the_kernel(width: float) -> None:
    """The closed form is the mean of linear interpolation's kernel over a thousand points of the box."""
    inside = (np.arange(1000) + 0.5) / 1000 - 0.5
    wanted = np.interp(DISTANCE[:, None] + inside * width, [-1, 0, 1], [0, 1, 0]).mean(axis=1)
    np.testing.assert_allclose(box_weight(DISTANCE, width), wanted, atol=2e-6)


@pytest.mark.parametrize("held", [1, 4])
def test_blurred_weight_is_the_mean_over_a_gaussian(held: int) -> None:
    """Kernels with Gaussians are means of the sharp kernel over thousands of even steps."""
    step = np.arange(-8, 8, 0.002)
    fraction = np.exp(-(step**2) / 2)
    variance = np.array([0.0, 0.08, 0.5])
    distance, weight = blurred_weight(2.7, variance, held)
    some = slice(0, len(distance), 37)
    for one, row in zip(variance, weight[:, some], strict=True):
        wanted = box_weight(distance[some, None] + step * np.sqrt(one), 2.7, held) @ (fraction / fraction.sum())
        np.testing.assert_allclose(row, wanted, atol=1e-7)


@settings(max_examples=15, deadline=None)
@given(width=st.sampled_from([0.0, 0.9, 2.7]), blur=st.floats(0, 1), scale=st.floats(0.99, 1.04), off=st.floats(-1, 1))
def test_table_matches_the_kernel_at_any_place_and_scale(width: float, blur: float, scale: float, off: float) -> None:
    """Weights from the table sum to 1 and match those of the kernel to 0.002."""
    variance = np.array([0.0, blur**2])
    table = TapTable.of(width, variance, 1, (0.99, 1.04), 0.5)
    weight = np.empty((2, table.weight.shape[1], 1), np.float32)
    places = np.full((2, 1, 1), off, np.float32)
    for kernel in range(2):
        read_weights(table, kernel, np.full((2, 1), scale), places, 0, 0, weight[kernel])
    weight = weight[..., 0].T
    apart = table.left + off - np.arange(table.weight.shape[1])
    distance, kernels = blurred_weight(width * scale, variance * scale**2)
    wanted = np.stack([np.interp(apart, distance, kernel, 0.0, 0.0) for kernel in kernels], axis=1)
    np.testing.assert_allclose(weight.sum(axis=0), 1, atol=1e-6)
    np.testing.assert_allclose(weight, wanted, atol=2e-3)


PER_PX = 24  # steps of the explicit sums


def fine_light(scene: RasterScene, block: SweepBlock, moved: Any, blurs: dict[Any, str]) -> np.ndarray:
    """Return electrons (line, every tenth sample, band) of a diagonal scene; ``moved`` displaces points."""
    rig = block.rig
    bands = len(block.wavelength_nm)
    ifov = rig.camera.ifov_rad
    size = scene.shape if block.sweep.along == "y" else scene.shape[::-1]
    normals = position_to_normal(block.middle)[:, None]
    centres = block.slopes[::10, None]
    found = np.zeros((len(block.lines), len(centres), bands))
    for band, (shift, variance) in enumerate(zip(*_moments(block, blurs), strict=True)):
        if band and not blurs:
            break
        runs, weights = _axis(1.0, variance[0])
        slopes = centres + (runs + shift[0]) * ifov
        for turn, one in zip(*_axis(rig.camera.slit_px, variance[1]), strict=True):
            views = exact_views(normals, (turn + shift[1]) * ifov, slopes.ravel())
            along, scan = views.along / ifov, views.scan / ifov
            beside = moved.displaced(block, along, scan, "only")
            along, scan = along + beside[0] + (size[0] - 1) / 2, scan + beside[1] + (size[1] - 1) / 2
            y, x = (along, scan) if block.sweep.along == "y" else (scan, along)
            seen = seen_at(scene, y, x).reshape(len(block.lines), *slopes.shape, bands)
            which = slice(None) if not blurs else slice(band, band + 1)
            found[..., which] += one * np.einsum("lsrb,r->lsb", seen[..., which], weights)
    return found * scene.electrons * (rig.camera.exposure_ms / DEFAULT_EXPOSURE_MS)


def _moments(block: SweepBlock, blurs: dict[Any, str]) -> tuple[np.ndarray, np.ndarray]:
    """Return shift and variance, (band, 2) each."""
    nm = block.wavelength_nm
    normal = middle_normal(block.sweep, block.rig.camera)
    found = [blur.moments(block.rig, nm, variant, normal) for blur, variant in blurs.items()]
    none = np.zeros((2, len(nm)))
    return sum((one.shift for one in found), none).T, sum((one.variance for one in found), none).T


def _axis(width: float, variance: float) -> tuple[np.ndarray, np.ndarray]:
    """Return even steps over a box and their weights; with a Gaussian, over the convolution of both."""
    if variance == 0:
        count = int(np.ceil(PER_PX * width))
        return ((np.arange(count) + 0.5) / count - 0.5) * width, np.full(count, 1 / count)
    sd = np.sqrt(variance)
    steps = 2 * PER_PX // 3
    half = int(np.ceil((width / 2 + 5 * sd) * steps))
    place = np.arange(-half, half + 1) / steps
    weight = ndtr((place + width / 2) / sd) - ndtr((place - width / 2) / sd)
    return place, weight / weight.sum()
