"""Synthetic images far finer than a px, convolved exactly through their transform: bounds are held against them.

Axis 0 lies along the line, axis 1 along the scan; the images are periodic.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import j1

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep
from pipeline.simulator.effects.probe import Probe
from tests.pipeline.simulator.made_up_effects import even_probe

Floats = NDArray[np.float64]
Transfer = Floats | complex

PER_PX, SIZE_PX = 16, 24
_CYCLES = np.fft.fftfreq(PER_PX * SIZE_PX, 1 / PER_PX)
ALONG, SCAN = np.meshgrid(_CYCLES, _CYCLES, indexing="ij")  # frequency [1/px]
_PLACE = np.arange(PER_PX * SIZE_PX) / PER_PX
BOX = np.sinc(ALONG) * np.sinc(SCAN * LineCamera().slit_px)  # pixel and slit
SWEEP = Sweep("fine", "fine", "x", swath_px=0.0, start_px=-12.0, lines=24)


def convolved(image: Floats, transfer: NDArray[Any]) -> Floats:
    """Convolve with the kernel of this transfer function."""
    return np.fft.ifft2(np.fft.fft2(image) * transfer).real


@cache
def edges() -> Floats:
    """One bar across the scan, of contrast 1, and one along it, of 0.51; their edges are 0.063 px (sd) soft."""
    bar = (np.abs(_PLACE - 10) < 4).astype(np.float64)
    return convolved(0.51 * bar[:, None] + bar, gaussian(0.063, 0.063))


@cache
def texture(seed: int = 0) -> Floats:
    """Sines of random phase in all directions, of periods from 2 px on, standard deviation 0.05."""
    rng = np.random.default_rng(seed)
    wave = convolved(rng.standard_normal(ALONG.shape), (np.hypot(ALONG, SCAN) < 0.5).astype(np.float64))
    return 0.05 * wave / wave.std()


@cache
def points() -> Floats:
    """Nine bright points, 0.1 px (sd) wide, at different places within their px."""
    dots = np.zeros(ALONG.shape)
    for y, x in np.ndindex(3, 3):
        dots[(4 + 8 * y) * PER_PX + 3 * x, (4 + 8 * x) * PER_PX + 4 * y] = PER_PX**2
    return convolved(dots, gaussian(0.1, 0.1))


IMAGES: dict[str, Callable[[], Floats]] = {
    "edges": edges,
    "texture": texture,
    "points": points,
    "both": lambda: edges() + texture(),
}
FLAT: Floats = np.ones(ALONG.shape)


def gaussian(along_px: float, scan_px: float) -> Floats:
    """Transfer function of a Gaussian of these standard deviations."""
    exponent: Floats = -2 * np.pi**2 * ((along_px * ALONG) ** 2 + (scan_px * SCAN) ** 2)
    return np.exp(exponent)


def disc(along_px: float, scan_px: float) -> Floats:
    """Transfer function of an even ellipse of these axes."""
    z = np.pi * np.hypot(along_px * ALONG, scan_px * SCAN)
    z = np.where(z > 0, z, 1e-9)
    values: Floats = 2 * j1(z) / z
    return values


def airy(along_px: float, scan_px: float) -> Floats:
    """Transfer function of a whole Airy pattern, lambda / D being so much along either axis."""
    u = np.minimum(np.hypot(along_px * ALONG, scan_px * SCAN), 1.0)
    return airy_contrast(u)


def airy_contrast(u: Floats) -> Floats:
    """Contrast that a round pupil leaves of a frequency u, in units of D / lambda."""
    contrast: Floats = 2 / np.pi * (np.arccos(u) - u * np.sqrt(1 - u * u))
    return contrast


def shifted(along_px: float, scan_px: float) -> NDArray[np.complex128]:
    """Transfer function of looking so much further."""
    return np.exp(2j * np.pi * (along_px * ALONG + scan_px * SCAN))


def probe_of(image: Floats, wavelength_nm: Floats | None = None, lines: int = 24) -> Probe:
    """Summary of an image as the footprint shows it, the same in all bands; its unit is 1."""
    seen = convolved(image, BOX)
    nm = np.array([700.0]) if wavelength_nm is None else wavelength_nm
    waves = (2j * np.pi * ALONG, 2j * np.pi * SCAN)
    slope = [np.abs(convolved(seen, wave)).max() for wave in waves]
    curvature = [np.abs(convolved(seen, wave**2)).max() for wave in waves]
    one, no = np.ones(len(nm)), np.zeros(len(nm))
    return even_probe(
        unit="dn",
        sweeps=(SWEEP,),
        wavelength_nm=nm,
        level=one * np.abs(seen).max(),
        spread=one * np.abs(seen - seen.mean(axis=0)).max(),
        span=one * np.ptp(seen),
        slope=np.outer(slope, one),
        curvature=np.outer(curvature, one),
        spectral_slope=no,
        spectral_curvature=no,
        brightest_e=0.0,
        darkest_e=0.0,
        unit_least_dn=1.0,
        lines=lines,
        seconds=1.0,
    )


def change(image: Floats, transfer: NDArray[Any]) -> float:
    """Greatest change that a kernel makes to an image that the footprint has seen."""
    seen = convolved(image, BOX)
    return float(np.abs(convolved(seen, transfer) - seen).max())
