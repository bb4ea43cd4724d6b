"""Other libraries that resample an image: each reads the points of one rotated grid, in its fastest layout."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

SIDE = 256  # px of the sweep
BANDS = 270
WAVES = 24
EDGE = 176  # px of the output grid, which stays inside when rotated
TURN_DEG = 14.0
CRS = "EPSG:32631"
ORIGIN_M = (500_000.0, 5_000_000.0)  # one metre a pixel, for libraries that need georeferenced data
FEW = 18  # bands for slow libraries that take one band at a time


@dataclass(frozen=True)
class Peer:
    """One library: its timed call, the function that gives its result as (y * x, band), and its number of bands."""

    name: str
    call: Callable[[], Any]
    by_pixel: Callable[[Any], NDArray[np.float32]]
    bands: int


@dataclass(frozen=True)
class Turned:
    """A sweep of waves and a grid rotated against it; ``truth`` has the waves' values at the grid's points."""

    samples: NDArray[np.float32]  # (line, sample, band)
    coordinates: NDArray[np.float64]  # (y * x, 2) line and sample
    affine: NDArray[np.float64]  # (2, 3): (line, sample) of grid pixel (y, x) is affine @ (y, x, 1)
    truth: NDArray[np.float64]  # (y * x, band)

    @property
    def planes(self) -> NDArray[np.float32]:
        """Return the sweep band by band, (band, line, sample)."""
        return np.ascontiguousarray(np.moveaxis(self.samples, 2, 0))

    def error(self, out: NDArray[np.floating]) -> float:
        """Return the RMSE over the standard deviation, for the first bands, which all libraries give."""
        truth = self.truth[:, :FEW]
        return float(np.sqrt(np.mean((out[:, :FEW] - truth) ** 2)) / np.std(truth))


def turned_waves(falloff: float, bands: int = BANDS) -> Turned:
    """Return waves of 4 to 40 px, sampled on a sweep, with a grid rotated by 14 degrees about the centre.

    The amplitude is the period to the power of ``falloff``: 1 as in images of natural scenes, 0 for equal amplitudes.
    """
    rng = np.random.default_rng(0)
    period = np.exp(rng.uniform(np.log(4.0), np.log(40.0), WAVES))
    angle = rng.uniform(0, np.pi, WAVES)
    frequency = np.stack([np.sin(angle), np.cos(angle)], axis=-1) / period[:, None]
    size = period[:, None] ** falloff
    cosine, sine = rng.standard_normal((WAVES, bands)) * size, rng.standard_normal((WAVES, bands)) * size

    def waves(at: NDArray[np.float64]) -> NDArray[np.float64]:
        phase = 2 * np.pi * at @ frequency.T
        return np.cos(phase) @ cosine + np.sin(phase) @ sine

    cos, sin = np.cos(np.deg2rad(TURN_DEG)), np.sin(np.deg2rad(TURN_DEG))
    turn = np.array([[cos, -sin], [sin, cos]])
    middle = np.array([SIDE / 2 + 0.2, SIDE / 2 - 0.3])
    affine = np.column_stack([turn, middle - turn @ np.full(2, (EDGE - 1) / 2)])
    coordinates = np.argwhere(np.ones((EDGE, EDGE), bool)) @ turn.T + affine[:, 2]
    lines = np.argwhere(np.ones((SIDE, SIDE), bool)).astype(np.float64)
    samples = waves(lines).astype(np.float32).reshape(SIDE, SIDE, bands)
    return Turned(samples, coordinates, affine, waves(coordinates))


def peers(scene: Turned, order: int, only: str | None = None) -> list[Peer]:
    """Return each library at one order (0 nearest, 1 linear, 3 cubic convolution), or ``only`` one of them."""
    makers = {
        "cv2.remap": _cv2_remap,
        "torch grid_sample": _grid_sample,
        "skimage warp": _skimage_warp,
        "rasterio reproject": _rasterio_reproject,
        "scipy map_coordinates": _map_coordinates,
    }
    made = {name: maker for name, maker in makers.items() if only in (None, name)}
    return [maker(scene, order) for name, maker in made.items() if order < 3 or name != "scipy map_coordinates"]


def _by_pixel(planes: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.reshape(planes, (len(planes), -1)).T


def _cv2_remap(scene: Turned, order: int) -> Peer:
    """Split the sweep into groups of bands before the timing; the result is joined, as the other libraries give it."""
    parts = cv2_parts(scene, order)
    out = np.empty((EDGE, EDGE, BANDS), np.float32)
    return Peer("cv2.remap", lambda: np.concatenate(parts(), axis=2, out=out), lambda _: out.reshape(-1, BANDS), BANDS)


def cv2_parts(scene: Turned, order: int) -> Callable[[], list[NDArray[np.float32]]]:
    """Return cv2.remap by groups of bands: 90 are faster than 4 and 1 if it takes as many; for cubic 4 than 1."""
    import cv2

    cv2.setNumThreads(1)
    size, flag = {0: (90, cv2.INTER_NEAREST), 1: (90, cv2.INTER_LINEAR), 3: (4, cv2.INTER_CUBIC)}[order]
    y, x = scene.coordinates.T.astype(np.float32).reshape(2, EDGE, EDGE)
    parts = [np.ascontiguousarray(scene.samples[..., at : at + size]) for at in range(0, BANDS, size)]
    outs = [np.empty((EDGE, EDGE, part.shape[2]), np.float32) for part in parts]

    def call() -> list[NDArray[np.float32]]:
        for part, out in zip(parts, outs, strict=True):
            cv2.remap(part, x, y, flag, dst=out, borderMode=cv2.BORDER_REFLECT_101)
        return outs

    return call


def _grid_sample(scene: Turned, order: int) -> Peer:
    mode = {0: "nearest", 1: "bilinear", 3: "bicubic"}[order]
    grid = (scene.coordinates[:, ::-1] / (SIDE - 1) * 2 - 1).astype(np.float32).reshape(1, EDGE, EDGE, 2)
    image = torch.from_numpy(scene.planes)[None].contiguous(memory_format=torch.channels_last)  # half the time of NCHW
    return Peer(
        "torch grid_sample",
        lambda: torch.nn.functional.grid_sample(image, torch.from_numpy(grid), mode=mode, align_corners=True),
        lambda out: _by_pixel(out[0].numpy()),
        BANDS,
    )


def _map_coordinates(scene: Turned, order: int) -> Peer:
    from scipy.ndimage import map_coordinates

    planes = scene.planes[:FEW]
    at = scene.coordinates.T
    return Peer(
        "scipy map_coordinates",
        lambda: [map_coordinates(plane, at, order=order, mode="mirror") for plane in planes],
        lambda out: np.stack(out, axis=1),
        FEW,
    )


def _skimage_warp(scene: Turned, order: int) -> Peer:
    from skimage.transform import AffineTransform, warp

    planes = scene.planes[:FEW]
    (yy, yx, y0), (xy, xx, x0) = scene.affine  # skimage's matrix takes (x, y)
    turn = AffineTransform(matrix=np.array([[xx, xy, x0], [yx, yy, y0], [0, 0, 1]]))
    return Peer(
        "skimage warp",
        lambda: [warp(plane, turn, output_shape=(EDGE, EDGE), order=order, preserve_range=True) for plane in planes],
        lambda out: _by_pixel(np.stack(out)),
        FEW,
    )


def _rasterio_reproject(scene: Turned, order: int) -> Peer:
    from rasterio.transform import Affine
    from rasterio.warp import Resampling, reproject

    kernel = {0: Resampling.nearest, 1: Resampling.bilinear, 3: Resampling.cubic}[order]
    planes = scene.planes
    out = np.zeros((BANDS, EDGE, EDGE), np.float32)
    (yy, yx, y0), (xy, xx, x0) = scene.affine
    # Its coordinates start at the corner of the first pixel, with y upwards.
    grid = Affine(xx, xy, x0 + 0.5 - (xx + xy) / 2, -yx, -yy, -(y0 + 0.5 - (yx + yy) / 2))
    origin, down = Affine.translation(*ORIGIN_M), Affine.scale(1, -1)
    place = {"src_transform": origin @ down, "dst_transform": origin @ grid, "src_crs": CRS, "dst_crs": CRS}
    # To GDAL a rotated grid seems coarser, so it widens its kernels: three times slower, and less exact.
    same_scale = {"XSCALE": 1, "YSCALE": 1}
    return Peer(
        "rasterio reproject",
        lambda: reproject(planes, out, resampling=kernel, num_threads=1, **place, **same_scale),
        lambda _: _by_pixel(out),
        BANDS,
    )
