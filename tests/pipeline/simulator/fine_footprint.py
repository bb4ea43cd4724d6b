"""The light of a block by rays alone: thousands of places of slit, pixel and blur, each through the mirror."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.special import ndtr

from pipeline.geometry.mirror import position_to_normal
from pipeline.simulator.effects.effect import SweepBlock
from pipeline.simulator.optics.rays import exact_views, middle_normal
from pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene

Places = tuple[np.ndarray, np.ndarray]


def fine_light(
    scene: RasterScene, block: SweepBlock, moved: Any, blurs: dict[Any, str], per_px: int = 24
) -> np.ndarray:
    """Electrons (line, sample, band) of a diagonal scene; ``moved`` displaces points."""
    rig, bands = block.rig, len(block.wavelength_nm)
    ifov, size = rig.camera.ifov_rad, scene.shape if block.sweep.along == "y" else scene.shape[::-1]
    normals = position_to_normal(block.middle)[:, None]
    found = np.zeros((len(block.lines), len(block.columns), bands))
    for band, (shift, variance) in enumerate(zip(*_moments(block, blurs), strict=True)):
        if band and not blurs:
            break
        runs, weights = _axis(1.0, variance[0], per_px)
        slopes = block.slopes[:, None] + (runs + shift[0]) * ifov
        for turn, one in zip(*_axis(rig.camera.slit_px, variance[1], per_px), strict=True):
            views = exact_views(normals, (turn + shift[1]) * ifov, slopes.ravel())
            along, scan = views.along / ifov, views.scan / ifov
            beside = moved.displaced(block, along, scan, "only")
            along, scan = along + beside[0] + (size[0] - 1) / 2, scan + beside[1] + (size[1] - 1) / 2
            y, x = (along, scan) if block.sweep.along == "y" else (scan, along)
            seen = scene.sample(y.ravel(), x.ravel()).reshape(len(block.lines), *slopes.shape, bands)
            which = slice(None) if not blurs else slice(band, band + 1)
            found[..., which] += one * np.einsum("lsrb,r->lsb", seen[..., which], weights)
    return found * scene.electrons * (rig.camera.exposure_ms / DEFAULT_EXPOSURE_MS)


def _moments(block: SweepBlock, blurs: dict[Any, str]) -> tuple[np.ndarray, np.ndarray]:
    """Shift and variance, (band, 2) each."""
    nm, normal = block.wavelength_nm, middle_normal(block.sweep, block.rig.camera)
    found = [blur.moments(block.rig, nm, variant, normal) for blur, variant in blurs.items()]
    none = np.zeros((2, len(nm)))
    return sum((one.shift for one in found), none).T, sum((one.variance for one in found), none).T


def _axis(width: float, variance: float, per_px: int) -> Places:
    """Even steps over a box; with a Gaussian steps over both, as heavy as both together are there."""
    if variance == 0:
        count = int(np.ceil(per_px * width))
        return ((np.arange(count) + 0.5) / count - 0.5) * width, np.full(count, 1 / count)
    sd, steps = np.sqrt(variance), 2 * per_px // 3
    half = int(np.ceil((width / 2 + 5 * sd) * steps))
    place = np.arange(-half, half + 1) / steps
    weight = ndtr((place + width / 2) / sd) - ndtr((place - width / 2) / sd)
    return place, weight / weight.sum()
