"""What blurs and shifts bring to samples from beside the sweeps, for the bounds of all that acts on the same light."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from pipeline.simulator.effects.air import greatest_share, sway_gradient
from pipeline.simulator.effects.blurs import airy_gaussians
from pipeline.simulator.effects.effect import OFF, Effect
from pipeline.simulator.effects.probe import WIDE_PX, Detail, Probe, lights_within, unit_electrons
from pipeline.simulator.optics.kernel_fit import Moments
from pipeline.simulator.optics.rays import normals_met
from pipeline.simulator.rig_model import Rig

Floats = NDArray[np.float64]
_ENDLESS = 1e9  # span and curvature of an image whose shifts show as they are


def blended_surroundings(probe: Probe, rig: Rig, moving: Sequence[Effect]) -> Probe:
    """Give the probe of an image that all blurs and shifts of a rig have passed, with what they bring from beside.

    Shifts bring what lies within their way; each part of a blur has the greatest derivatives of what it reaches, and
    the image has the mean of its parts'. The same probe where nothing lies beside the sweeps.
    """
    if probe.anywhere is None:
        return probe
    probe = _turned(probe, sway_gradient(rig) + greatest_share(rig.air))
    blurs = [one for one in moving if hasattr(one, "moments")]
    way, parts = greatest_way_px(probe, rig, moving), _blur_parts(probe, rig, blurs)
    own = _blended(probe, 0.0, way, parts)
    beside = [_blended(probe, one.reach_px - way, way, parts) for one in probe.beside if one.reach_px > way]
    return replace(probe.with_detail(own), beside=tuple(beside))


def _blended(probe: Probe, reach_px: float, way_px: float, parts: Sequence[tuple[float, float]]) -> Detail:
    """What lies within a reach once the image has been moved by so much and blurred by parts (share, sd)."""
    near = probe.within(reach_px + way_px)
    slope, curvature, span = near.slope, near.curvature, near.span
    spectral = near_spectral = np.stack([near.spectral_slope, near.spectral_curvature])
    for share, sd in parts:
        seen = _seen_through(probe, reach_px + way_px, sd)
        slope = slope + share * np.maximum(seen.slope - near.slope, 0.0)
        curvature = curvature + share * np.maximum(seen.curvature - near.curvature, 0.0)
        span = span + share * np.maximum(seen.span - near.span, 0.0)
        spectral = spectral + share * np.maximum(seen.spectral - near_spectral, 0.0)
    return Detail(reach_px, span, slope, curvature, spectral)


def _seen_through(probe: Probe, beside_px: float, sd_px: float) -> Detail:
    """The least of what bounds derivatives and span of an image that a Gaussian has blurred, up to so far beside."""
    assert probe.anywhere is not None
    last = max((one.reach_px for one in probe.beside), default=0.0)
    found = []
    for reach in (0.0, *(one.reach_px for one in probe.beside)):
        near = probe.within(max(beside_px, min(beside_px + reach, last)))
        beyond = 4 * scipy.special.ndtr(-reach / sd_px if sd_px else -np.inf)
        far, own = beyond * probe.anywhere, np.stack([near.spectral_slope, near.spectral_curvature])
        spectral = own if probe.anywhere_spectral is None else own + beyond * probe.anywhere_spectral
        found.append((near.span + far, near.slope + far, near.curvature + 4 * far, spectral))
    if probe.afar is not None and sd_px > WIDE_PX:
        found.append((probe.afar.span, probe.afar.slope, probe.afar.curvature, probe.afar.spectral))
    return Detail(beside_px, *(np.min(some, axis=0) for some in zip(*found, strict=True)))


def _turned(probe: Probe, turn: float) -> Probe:
    """The probe of an image that shifts turn a little, so that what rises along one axis rises along the other."""
    beside = tuple(replace(one, slope=one.slope + turn * one.slope[::-1]) for one in probe.beside)
    return replace(probe, slope=probe.slope + turn * probe.slope[::-1], beside=beside)


def greatest_way_px(probe: Probe, rig: Rig, effects: Sequence[Effect]) -> float:
    """Give how far all that moves the image moves it together at most. [px]"""
    return _greatest_way(probe, rig, [one for one in effects if any(hasattr(one, act) for act in ("aim", "displaced"))])


def _greatest_way(probe: Probe, rig: Rig, moving: Sequence[Effect]) -> float:
    """How far all that moves the image moves it together at most, told by its bounds on one that rises evenly. [px]"""
    bands = len(probe.wavelength_nm)
    rising = replace(
        probe,
        beside=(),
        afar=None,
        anywhere=None,
        own_e=None,
        slit_errors={},
        span=np.full(bands, _ENDLESS),
        slope=np.ones((2, bands)),
        curvature=np.full((2, bands), _ENDLESS),
    )
    return math.fsum(one.bound(rising, rig, OFF).value for one in moving)


def _blur_parts(probe: Probe, rig: Rig, blurs: Sequence[Any]) -> list[tuple[float, float]]:
    """Shares and sizes (sd) of the Gaussians that a rig's blurs are the sum of, as wide as in any band. [px]"""
    nm = np.asarray(probe.wavelength_nm, np.float64)
    sizes, waves = [0.0], [0.0]
    for normal in normals_met(probe.sweeps, rig.camera):
        both = Moments.together([one.moments(rig, nm, one.variants[0], normal) for one in blurs], len(nm))
        sizes.append(float(np.sqrt(both.spread.max(initial=0.0)) + np.abs(both.shift).max(initial=0.0)))
        waves.append(0.0 if both.waves is None else float(both.waves.max(initial=0.0)))
    shares, widths = airy_gaussians() if max(waves) > 0 else (np.ones(1), np.zeros(1))
    return [
        (float(share), math.hypot(width * max(waves), max(sizes))) for share, width in zip(shares, widths, strict=True)
    ]


def light_brought(probe: Probe, rig: Rig, moving: Iterable[Effect]) -> Probe:
    """Give the probe of light to which blurs and shifts have brought some from beside what the sweeps see.

    They change no signal by more than their bounds, and none to what is nowhere in the scene. The same probe where
    nothing lies beside.
    """
    if probe.anywhere is None or probe.ends_e is None:
        return probe
    brought = min(math.fsum(one.bound(probe, rig, OFF).value for one in moving), float(probe.anywhere.max()))
    low, high = lights_within(probe, rig)
    change = brought * unit_electrons(high, probe, rig)
    brighter = np.maximum(np.minimum(high + change, probe.ends_e[1]) - high, 0.0)
    darker = np.maximum(low - np.maximum(low - change, probe.ends_e[0]), 0.0)
    least = unit_electrons(low - darker, probe, rig)
    return replace(
        probe,
        level=np.maximum(probe.level, (high + brighter) / unit_electrons(high + brighter, probe, rig)),
        span=np.maximum(probe.span, (high + brighter - low + darker) / least),
        spread=probe.spread + float((np.maximum(brighter, darker) / least).max(initial=0.0)),
        brightest_e=probe.brightest_e + float(brighter.max(initial=0.0)),
        darkest_e=probe.darkest_e - float(darker.max(initial=0.0)),
        own_e=np.stack([low - darker, high + brighter]),
    )
