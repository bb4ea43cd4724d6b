"""Materials as bright as the farm's, and how much an outdoor effect changes them, in standard deviations."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep
from pipeline.simulator.effects.effect import OFF, SweepBlock
from pipeline.simulator.effects.probe import Probe
from pipeline.simulator.rig_model import Air, Rig, Sky
from tests.pipeline.simulator.made_up_effects import even_probe

Floats = NDArray[np.float64]
WAVELENGTH = np.linspace(400.0, 1000.0, 61)
BANDS = len(WAVELENGTH)
CAMERA = LineCamera()
SWEEP = Sweep("fine", "fine", "x", swath_px=0.0, start_px=-30.0, lines=60)
SHAPE = (400, 640)
NOON, MORNING, NIGHT = (
    datetime(2026, 6, 21, *clock, tzinfo=UTC) for clock in ((11, 22), (5, 34), (0, 20))
)  # at 10 deg E


def rig_with(air: Air | None = None, exposure_ms: float = 100.0, **sky: Any) -> Rig:
    """A rig under some sky, in some air."""
    return Rig(camera=LineCamera(exposure_ms=exposure_ms), air=air or Air(), sky=Sky(**sky))


def white_e(exposure_ms: float = 100.0) -> Floats:
    """Electrons of the white reference in an exposure, (band,): near the farm's."""
    knots = [400, 450, 550, 600, 700, 760, 800, 900, 940, 1000]
    light = np.interp(WAVELENGTH, knots, [0.25, 0.58, 0.95, 1.0, 0.83, 0.6, 0.6, 0.3, 0.1, 0.1])
    return 0.94 * CAMERA.full_scale_e * exposure_ms / 100 * light


def materials(exposure_ms: float = 100.0) -> NDArray[np.float32]:
    """Electrons of shade, water, soil, crop and straw in an exposure, (material, band)."""
    red_edge = 1 / (1 + np.exp(-(WAVELENGTH - 715) / 15))
    ramp = (WAVELENGTH - 400) / 600
    reflectance = [0.006 + 0 * ramp, 0.04 - 0.03 * ramp, 0.05 + 0.3 * ramp, 0.04 + 0.46 * red_edge, 0.1 + 0.4 * ramp]
    return (np.stack(reflectance) * white_e(exposure_ms)).astype(np.float32)


def probe_of(rig: Rig, *sweeps: Sweep, seconds: float = 6.0) -> Probe:
    """The materials' greatest signals over the noise of shot and read; nothing moves, so that all slopes are 0."""
    light = materials(rig.camera.exposure_ms)
    span = np.ptp(light, axis=0) / _sigma(light.min(axis=0))
    flat, both = np.zeros(BANDS), np.zeros((2, BANDS))
    return even_probe(
        sweeps=sweeps or (SWEEP,),
        wavelength_nm=WAVELENGTH,
        level=(light / _sigma(light)).max(axis=0),
        span=span,
        **dict.fromkeys(("spread", "spectral_slope", "spectral_curvature"), flat),
        **dict.fromkeys(("slope", "curvature"), both),
        brightest_e=float(light.max()),
        darkest_e=float(light.min()),
        unit_least_dn=float(_sigma(light).min()) / CAMERA.electrons_per_dn,
        lines=SWEEP.lines,
        seconds=seconds,
        white_e=white_e(rig.camera.exposure_ms),
    )


def block_of(rig: Rig, lines: range = range(60), *, sweep: Sweep = SWEEP, **more: Any) -> SweepBlock:
    """Lines of a sweep."""
    more.setdefault("white_e", white_e(rig.camera.exposure_ms))
    return SweepBlock(rig, sweep, lines, WAVELENGTH, SHAPE, **more)


def result(effect: Any, light: NDArray[np.float32], block: SweepBlock, variant: str) -> NDArray[np.float32]:
    """What an effect makes of the light."""
    if variant == OFF:
        return light
    if hasattr(effect, "gain"):
        return light * effect.gain(block, variant)
    return effect.change(light.copy(), block, variant)


def measured(effect: Any, rig: Rig, variant: str = OFF, **more: Any) -> float:
    """Greatest difference of a variant to the exact one, each sample in turn of each material, in its own sigmas."""
    block = block_of(rig, range(0, 60, 59), **more)
    worst = 0.0
    for spectrum in materials(rig.camera.exposure_ms):
        light = np.tile(spectrum, (2, block.rig.camera.samples, 1))
        missed = result(effect, light, block, variant) - result(effect, light, block, effect.variants[0])
        worst = max(worst, float((np.abs(missed) / _sigma(spectrum)).max()))
    return worst


def _sigma(light: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.sqrt(light + np.float32(CAMERA.read_noise_e**2))
