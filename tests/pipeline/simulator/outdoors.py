"""Outdoor rigs, a white reference about as bright as the farm's, and lines of a sweep."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.simulator.effects.effect import SweepBlock
from spectralzoom.pipeline.simulator.rig_model import Air, Rig, Sky

Floats = NDArray[np.float64]
WAVELENGTH = np.linspace(400.0, 1000.0, 61)
BANDS = len(WAVELENGTH)
CAMERA = LineCamera()
SWEEP = Sweep("fine", "fine", "x", swath_px=0.0, start_px=-30.0, lines=60)
SHAPE = (400, 640)


def rig_with(air: Air | None = None, exposure_ms: float = 100.0, **sky: Any) -> Rig:
    """Return a rig with this sky and air."""
    return Rig(camera=LineCamera(exposure_ms=exposure_ms), air=air or Air(), sky=Sky(**sky))


def white_e(exposure_ms: float = 100.0) -> Floats:
    """Return the electrons of the white reference in an exposure, (band,), close to those of the farm."""
    knots = [400, 450, 550, 600, 700, 760, 800, 900, 940, 1000]
    light = np.interp(WAVELENGTH, knots, [0.25, 0.58, 0.95, 1.0, 0.83, 0.6, 0.6, 0.3, 0.1, 0.1])
    return 0.94 * CAMERA.full_scale_e * exposure_ms / 100 * light


def block_of(rig: Rig, lines: range = range(60), *, sweep: Sweep = SWEEP, **more: Any) -> SweepBlock:
    """Return lines of a sweep as a block."""
    more.setdefault("white_e", white_e(rig.camera.exposure_ms))
    return SweepBlock(rig, sweep, lines, WAVELENGTH, SHAPE, **more)
