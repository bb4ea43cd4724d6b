"""Two views of one place, shifted: random waves, and crop rows. Lines whose scores are their bands."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.rectify.registration.overlaps import BroadSweep
from spectralzoom.pipeline.signal.calibrate import calibrate
from spectralzoom.pipeline.signal.components import Components
from spectralzoom.pipeline.source import SweepLines

Floats = NDArray[np.float64]
ROW_PX = 12.0


def wave_views(
    seed: int, shape: tuple[int, int], shift: Floats, snr: float, periods: tuple[float, float]
) -> tuple[Floats, Floats]:
    """Return two views of sixty random waves with log-uniform periods; ``snr`` is their deviation over the noise's."""
    rng = np.random.default_rng(seed)
    period = np.exp(rng.uniform(*np.log(periods), 60))
    turn, phase = rng.uniform(0, 2 * np.pi, (2, 60))
    y, x = np.arange(shape[0])[:, None], np.arange(shape[1])[None, :]

    def view(dy: float, dx: float) -> Floats:
        seen = np.zeros(shape)
        for down, right, start in zip(np.sin(turn) / period, np.cos(turn) / period, phase, strict=True):
            seen += np.cos(2 * np.pi * (down * (y + dy) + right * (x + dx)) + start)
        return seen / np.sqrt(30) + rng.normal(size=shape) / snr

    return view(0.0, 0.0), view(*shift)


def row_views(seed: int, shape: tuple[int, int], shift: Floats, snr: float, gaps: float) -> tuple[Floats, Floats]:
    """Return two views of crop rows 12 px apart along axis 0, ``gaps`` of them bare; shifts of up to 50 px."""
    rng = np.random.default_rng(seed)
    stand = np.ones((int(shape[1] / ROW_PX) + 12, shape[0] + 120))
    for row in stand:
        start = 0
        while start < len(row):
            stop = start + int(rng.integers(5, 40))
            row[start:stop] = rng.random() >= gaps
            start = stop
    stand = gaussian_filter1d(stand, 1.2, axis=1)
    first = rng.uniform(0, ROW_PX)

    def view(dy: float, dx: float) -> Floats:
        along, across = np.arange(shape[0]) + dy + 60, np.arange(shape[1]) + dx + 60 - first
        plants = np.exp(-0.5 * ((across[None, :] - ROW_PX * np.arange(len(stand))[:, None]) / 2.5) ** 2)
        lengths = np.stack([np.interp(along, np.arange(stand.shape[1]), row) for row in stand])
        seen = lengths.T @ plants
        return seen / seen.std() + rng.normal(size=shape) / snr

    return view(0.0, 0.0), view(*shift)


def broad_sweep(lines: SweepLines, camera: LineCamera, usable: NDArray[np.bool_] | None = None) -> BroadSweep:
    """Return the broad-band image of a sweep of raw lines."""
    values, valid = calibrate(
        lines.read(0, lines.sweep.lines),
        lines.references,
        saturated_dn=camera.full_scale_dn * lines.sweep.binning,
        position=lines.position,
    )
    bands = values.shape[2]
    scores: Any = SimpleNamespace(
        sweep=lines.sweep,
        position=lines.position,
        components=Components(np.zeros(bands), np.eye(bands), np.ones(bands)),
        step=1.0,
        usable=valid & lines.valid_line[:, None],
        read=lambda start, stop: values[start:stop],
    )
    return BroadSweep.read(scores, usable=lines.valid_line if usable is None else usable)
