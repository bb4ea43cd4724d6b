"""How blurs and shifts of each band's own colour edges: light changes over wavelength where the scene's does not."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.band_differences import second_difference, steepest_difference
from pipeline.simulator.effects.pupil import normals_met
from pipeline.simulator.probe import Probe
from pipeline.simulator.rig_model import Rig

Floats = NDArray[np.float64]
FINEST_PER_PX = 8.0  # derivatives along the image grow by no more per order: they are differences a quarter px apart


def light_through(probe: Probe, rig: Rig, blurs: Iterable[Any]) -> Probe:
    """Give the probe of light that has passed blurs (their exact variants), with the spectral differences they make.

    A kernel of shift s and variance v makes I(x + s) blurred, whose derivative over wavelength is s' I_x + v' I_xx / 2
    beside the scene's own (the heat equation in v), and its second one s'' I_x + v'' I_xx / 2 + (s' + v' d/dx / 2)^2
    I_xx. At a step or a point, where I_xx has no end, v' I_xx / 2 is at most I_x times the change of the width.
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
    found = [blur.moments(rig, nm, blur.variants[0], normal) for blur in blurs]
    shift = np.sum([one.shift for one in found], axis=0)
    variance = np.sum([one.variance for one in found], axis=0)
    moved, spread, wider = (_first(values, nm) for values in (shift, variance, np.sqrt(variance)))
    steep = probe.slope * moved + np.minimum(probe.curvature * spread / 2, probe.slope * wider)
    bend = probe.slope * _second(shift, nm) + probe.curvature * (
        _second(variance, nm) / 2 + (moved + spread * FINEST_PER_PX / 2) ** 2
    )
    return steep, bend


def _first(values: Floats, nm: Floats) -> Floats:
    steep: Floats = steepest_difference(values, nm)  # type: ignore[arg-type, assignment]
    return steep


def _second(values: Floats, nm: Floats) -> Floats:
    bent: Floats = np.abs(second_difference(values, nm))  # type: ignore[arg-type]
    return bent
