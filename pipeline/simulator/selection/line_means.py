"""The mean light of every line that sweeps take: what stray light spreads over a line."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep, points_of_scan
from pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene

Light = NDArray[np.float32]
_LINES_AT_ONCE = 256


def line_means(
    scene: RasterScene, camera: LineCamera, sweeps: Sequence[Sweep], beside_px: Sequence[float] = (0.0,)
) -> Light:
    """Give the mean over samples and bands of every position that any sweep holds, (position,) [e-].

    Of the pixels that middle rays meet: a slit, and positions that one line holds, give means between these. Positions
    go on beyond a sweep's ends as far as its slit reaches, and as far as ``beside_px``: by so much the lines lie beside
    their strip as well.
    """
    spectra = scene.electrons * np.float32(camera.exposure_ms / DEFAULT_EXPOSURE_MS)
    mean = spectra / spectra.shape[0] if spectra.ndim == 1 else spectra.mean(axis=1)
    grey = (scene.planes.reshape(-1, scene.planes.shape[2]) @ mean.astype(np.float32)).reshape(scene.shape)
    beyond, found = np.ceil(camera.slit_px / 2 + 1) + max(beside_px), []
    courses = sorted({_course(sweep) for sweep in sweeps if sweep.lines})
    for along_y, strip, lines in ((one[0], one[1] + beside, one[2]) for one in courses for beside in beside_px):
        pixels, middle = (grey.T if along_y else grey), (np.array(scene.shape) - 1) / 2
        down, right = middle[::-1] if along_y else middle
        held = np.arange(lines[0] - beyond, lines[1] + beyond)
        for first in range(0, len(held), _LINES_AT_ONCE):
            some = held[first : first + _LINES_AT_ONCE]
            along, scan = points_of_scan(strip, camera, some[:, None], camera.pixel_slopes())
            row = np.rint(scan + down).clip(0, pixels.shape[0] - 1).astype(np.intp)
            column = np.rint(along + right).clip(0, pixels.shape[1] - 1).astype(np.intp)
            found.append(pixels[row, column].mean(axis=1))
    return np.concatenate(found)


def _course(sweep: Sweep) -> tuple[bool, float, tuple[float, float]]:
    """Orientation, strip, and the first held position and the one after the last: what tells paths apart."""
    return sweep.along == "y", sweep.strip_px, (sweep.start_px, sweep.start_px + sweep.lines * sweep.step)
