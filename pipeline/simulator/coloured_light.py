"""How blurs and shifts of each band's own colour edges: light changes over wavelength where the scene's does not."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.band_differences import second_difference, steepest_difference
from pipeline.simulator.effects.diffraction import airy_gaussians
from pipeline.simulator.effects.effect import Moments
from pipeline.simulator.effects.pupil import normals_met
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

Floats = NDArray[np.float64]
# Half of the integrals of |s dG/ds| and |s^2 d^2G/ds^2| for either axis, and, for both, of 2 |s^2 d^2G/ds dx|.
_PER_LOG, _PER_LOG_TWICE, _PER_LOG_AND_PX = 0.5, 1.1, 2.3
FINEST_PER_PX = 8.0  # derivatives along the image grow by no more per order: they are differences a quarter px apart


def light_through(probe: Probe, rig: Rig, blurs: Iterable[Any]) -> Probe:
    """Give the probe of light that has passed blurs (their exact variants), with the spectral differences they make.

    A kernel of shift s and variance v makes I(x + s) blurred, whose derivative over wavelength is s' I_x + v' I_xx / 2
    beside the scene's own (the heat equation in v), and its second one s'' I_x + v'' I_xx / 2 + (s' + v' d/dx / 2)^2
    I_xx. At a step or a point, where I_xx has no end, v' I_xx / 2 is at most I_x times the change of the width.

    Diffraction is a sum of Gaussians whose widths grow with the wavelength. What a wide one shows hardly depends on I_x
    any more: its derivatives over the width's logarithm are at most certain parts of the span, whatever the image.
    """
    passed = list(blurs)
    if not passed or len(probe.wavelength_nm) < 2:
        return probe
    steep, bend = np.zeros((2, *probe.slope.shape))
    for normal in normals_met(probe, rig):
        first, second = _differences(probe, rig, passed, normal)
        steep, bend = np.maximum(steep, first), np.maximum(bend, second)
    return replace(
        probe,
        spectral_slope=probe.spectral_slope + steep.sum(axis=0),
        spectral_curvature=probe.spectral_curvature + bend.sum(axis=0),
    )


def _differences(probe: Probe, rig: Rig, blurs: list[Any], normal: Floats) -> tuple[Floats, Floats]:
    """Greatest first and second differences over wavelength, (2, band) each for either axis of the image."""
    nm = np.asarray(probe.wavelength_nm, np.float64)
    blurred = Moments.together([blur.moments(rig, nm, blur.variants[0], normal) for blur in blurs], len(nm))
    steep, bend = np.zeros((2, *probe.slope.shape))
    for share, waves in _patterns(blurred):
        first, second = _by_gaussian(probe, nm, blurred.shift, blurred.variance + waves**2, waves)
        steep, bend = steep + share * first, bend + share * second
    return steep, bend


def _patterns(blurred: Moments) -> list[tuple[float, Floats]]:
    """Shares and widths (2, band) of the Gaussians that diffraction is a sum of; one of no width without it."""
    if blurred.waves is None:
        return [(1.0, np.zeros_like(blurred.variance))]
    shares, sizes = airy_gaussians()
    return [(float(share), size * blurred.waves) for share, size in zip(shares, sizes, strict=True)]


def _by_gaussian(probe: Probe, nm: Floats, shift: Floats, variance: Floats, width: Floats) -> tuple[Floats, Floats]:
    """Greatest differences through Gaussians of a shift and variance in each band, (2, band) each.

    ``width`` (2, band) is the part of it that grows in proportion to the wavelength.
    """
    moved, spread, wider = (_first(values, nm) for values in (shift, variance, np.sqrt(variance)))
    steep = probe.slope * moved + np.minimum(probe.curvature * spread / 2, probe.slope * wider)
    bend = probe.slope * _second(shift, nm) + probe.curvature * (
        _second(variance, nm) / 2 + (moved + spread * FINEST_PER_PX / 2) ** 2
    )
    if not width.any():
        return steep, bend
    grown = _first(width, nm) / width
    by_span = probe.slope * moved + _PER_LOG * probe.span * grown
    across = probe.slope * _second(shift, nm) + probe.curvature * moved**2
    bend_by_span = across + probe.span * grown * (_PER_LOG_AND_PX * moved / width + _PER_LOG_TWICE * grown)
    return np.minimum(steep, by_span), np.minimum(bend, bend_by_span)


def _first(values: Floats, nm: Floats) -> Floats:
    steep: Floats = steepest_difference(values, nm)  # type: ignore[arg-type, assignment]
    return steep


def _second(values: Floats, nm: Floats) -> Floats:
    bent: Floats = np.abs(second_difference(values, nm))  # type: ignore[arg-type]
    return bent
