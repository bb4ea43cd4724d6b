"""Lines with many bands and their probe, to check the bounds of the spectrometer's effects."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.simulator.effects.effect import SweepBlock
from spectralzoom.pipeline.simulator.effects.probe import Probe, Unit, steepest_difference
from spectralzoom.pipeline.simulator.rig_model import Optics, Rig

Floats = NDArray[np.float64]
Radiance = NDArray[np.float32]

SAMPLES = 64
SWEEP = Sweep("fine", "fine", "x", swath_px=0.0, start_px=-320.0, lines=640)
READ_E = LineCamera().read_noise_e


def rig_with(samples: int = SAMPLES, **optics: float) -> Rig:
    """Return a rig of few samples with these settings of the optics."""
    return Rig(camera=replace(LineCamera(), samples=samples), optics=replace(Optics(), **optics))


def random_light(seed: int, bands: int = 90, samples: int = SAMPLES, lines: int = 6) -> tuple[Floats, Radiance]:
    """Return uneven wavelengths [nm], and patches of a few spectra with edges and absorption lines [e-]."""
    rng = np.random.default_rng(seed)
    wavelength = 400 + np.cumsum(rng.uniform(1.5, 3.0, bands))
    place = wavelength[None, :]
    spectra = np.full((4, bands), 300.0)
    for _ in range(5):
        centre, width = rng.uniform(400, 620, (4, 1)), np.exp(rng.uniform(np.log(2), np.log(80), (4, 1)))
        spectra = spectra + rng.uniform(0, 3000, (4, 1)) / (1 + np.exp(-(place - centre) / width))
        spectra = spectra * (1 - rng.uniform(0, 0.3, (4, 1)) * np.exp(-(((place - centre) / width) ** 2)))
    which = rng.integers(0, 4, (lines, -(-samples // 8))).repeat(8, axis=1)[:, :samples]
    return wavelength, (spectra[which] * rng.uniform(0.6, 1.4, (lines, samples, 1))).astype(np.float32)


def block_of(
    rig: Rig, wavelength_nm: Floats, lines: range = range(6), fwhm_nm: Floats | None = None, **more: Any
) -> SweepBlock:
    """Return some lines of the usual sweep as a block."""
    return SweepBlock(rig, SWEEP, lines, wavelength_nm, (640, 640), fwhm_nm=fwhm_nm, **more)


def units(light: Radiance, unit: Unit) -> Floats:
    """Return the unit at every sample [e-]: shot and read noise, or one DN."""
    electrons = np.asarray(light, np.float64)
    return np.sqrt(electrons + READ_E**2) if unit == "sigma" else np.full(light.shape, LineCamera().electrons_per_dn)


def probe_of(
    light: Radiance, wavelength_nm: Floats, unit: Unit = "sigma", fwhm_nm: Floats | None = None, sweep: Sweep = SWEEP
) -> Probe:
    """Return the probe of all samples of some lines."""
    signal = np.asarray(light, np.float64)
    one = units(light, unit)
    most = tuple(range(light.ndim - 1))
    none = np.zeros((2, len(wavelength_nm)))
    return Probe(
        unit=unit,
        sweeps=(sweep,),
        wavelength_nm=wavelength_nm,
        fwhm_nm=fwhm_nm,
        level=(signal / one).max(axis=most),
        span=np.ptp(signal / one, axis=most),
        slope=none,
        curvature=none,
        spectral_slope=(steepest_difference(signal, wavelength_nm) / one).max(axis=most),
        brightest_e=float(signal.max()),
        darkest_e=float(signal.min()),
        unit_least_dn=float(one.min()) / LineCamera().electrons_per_dn,
        lines=sweep.lines,
        seconds=64.0,
    )


def worst(changed: Radiance, light: Radiance, unit: Unit, like: Radiance | None = None) -> float:
    """Return the greatest difference over the unit, which is taken from ``like`` or from ``light``."""
    way = np.abs(np.asarray(changed, np.float64) - light)
    return float((way / units(light if like is None else like, unit)).max())
