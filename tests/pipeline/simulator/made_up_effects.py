"""Made-up effects with given bounds and costs, and probes to evaluate them with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.simulator.effects.effect import OFF, Bound, Radiance, SweepBlock
from spectralzoom.pipeline.simulator.effects.probe import GainRange, Probe
from spectralzoom.pipeline.simulator.rig_model import Rig

SWEEP = Sweep("fine-0", "fine", "x", 0.0, -50.0, 100)
RIG = Rig()


@dataclass(frozen=True)
class MadeUp:
    """An effect; ``ways`` are (variant, bound, cost) from exact to cheap, with bounds per unit of the scene's level."""

    name: str
    left_out: float
    ways: tuple[tuple[str, float, float], ...] = (("exact", 0.0, 1.0),)

    @property
    def variants(self) -> tuple[str, ...]:
        return tuple(way[0] for way in self.ways)

    @property
    def cost_ns(self) -> Mapping[str, float]:
        return MappingProxyType({way[0]: way[2] for way in self.ways})

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        bounds = {OFF: self.left_out} | {way[0]: way[1] for way in self.ways}
        return Bound(bounds[variant] * float(probe.level.max()), f"{self.name} as {variant}")


@dataclass(frozen=True)
class Brightening(MadeUp):
    """A gain of 1 + ``fraction``; ``left_out`` is its stated bound, right or wrong."""

    fraction: float = 0.0

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        return GainRange.between(1 - self.left_out, 1 + self.left_out, len(probe.wavelength_nm))

    def gain(self, block: SweepBlock, variant: str) -> Radiance:
        return np.full((1, 1, 1), 1 + self.fraction, np.float32)


@dataclass(frozen=True)
class Shift(MadeUp):
    """A shift along the line by ``left_out`` px."""

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Return slope times displacement."""
        return Bound(probe.moved(self.left_out if variant == OFF else 0.0, 0.0), f"{self.left_out:g} px aside")


def even_probe(**values: object) -> Probe:
    """Return a probe of one band and level 1 without detail, with ``values`` changed."""
    zeros, ones = np.zeros(1), np.ones(1)
    probe = Probe(
        unit="sigma",
        sweeps=(SWEEP,),
        wavelength_nm=np.array([550.0]),
        fwhm_nm=None,
        level=ones,
        span=ones,
        slope=np.zeros((2, 1)),
        curvature=np.zeros((2, 1)),
        spectral_slope=zeros,
        brightest_e=1e4,
        darkest_e=1e2,
        unit_least_dn=20.0,
        lines=100,
        seconds=10.0,
    )
    return replace(probe, **values)


def steep_probe(
    slope: tuple[float, float] = (0.0, 1.0), sweeps: tuple[Sweep, ...] = (SWEEP,), span: float = 1e9, **values: object
) -> Probe:
    """Return a probe of one band with a slope and ``curvature``, each as (along the line, along the scan)."""
    both = np.array(values.pop("curvature", (0.0, 0.0)))[:, None]
    lines = sum(sweep.lines for sweep in sweeps)
    known = {"sweeps": sweeps, "slope": np.array(slope)[:, None], "curvature": both, "span": np.full(1, span)}
    return even_probe(**{**known, "darkest_e": 0.0, "unit_least_dn": 1.0, "lines": lines, "seconds": 60.0, **values})
