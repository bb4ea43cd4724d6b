"""What an effect is: a name, variants from exact to cheap, a bound on the error of each, a cost, and what it does.

An effect does its work at one of six places of the chain, in this order: the mirror looks elsewhere (``Aim``), rays
meet the scene elsewhere (``Displacement``), the footprint is blurred or shifted band by band (``Blur``), light is
multiplied (``Gain``) or changed (``LightChange``), electrons are read out (``readout.py``). All before that are linear
in the light.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.block import SweepBlock
from pipeline.simulator.effects.probe import Probe
from pipeline.simulator.optics.kernel_fit import Moments
from pipeline.simulator.rig_model import Rig

Floats = NDArray[np.float64]
Light = NDArray[np.float32]
OFF = "off"


@dataclass(frozen=True)
class Bound:
    """The most that leaving an effect out, or taking a variant for the exact one, changes any number; and why.

    ``value`` is in the unit of the probe that it was asked with. ``why`` is for the user: the magnitude in numbers.
    """

    value: float
    why: str


class Merged(NamedTuple):
    """What an effect costs beside a variant of another, with which it shares a draw, or kernels. [ns]"""

    other: str
    variant: str
    cost_ns: float


class Effect(Protocol):
    """What the decision needs to know, by name. Variants go from exact to cheap; off is none of them.

    One that shares its work with another's says so by ``merged(rig)``; one whose cost depends on the light gives it by
    ``cost_at(probe, rig)``, like ``cost_ns``.
    """

    @property
    def name(self) -> str:
        """What flags, manifest and streams call it."""

    @property
    def cost_ns(self) -> Mapping[str, float]:
        """Measured cost of each variant per px and band, the exact one first [ns]."""

    @property
    def variants(self) -> tuple[str, ...]:
        """Ways to compute it, the exact one first."""
        return tuple(self.cost_ns)

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound the error of leaving it out, or of a variant against the exact one; 0 where the rig lacks it."""
        return Bound(0.0, "exact") if variant == self.variants[0] else self.missed(probe, rig, variant)

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound the error of leaving it out, or of a variant that is not the exact one."""


class Aim(Effect, Protocol):
    """The mirror looks beside its plan."""

    def aim(self, block: SweepBlock, variant: str) -> Floats:
        """Give how far, (line, step, 2) along the line and the scan at every held position; step may be 1. [px]"""


class Displacement(Effect, Protocol):
    """Rays meet the scene elsewhere than at its plane's own place."""

    def displaced(self, block: SweepBlock, along_px: Floats, scan_px: Floats, variant: str) -> tuple[Floats, Floats]:
        """Give what to add to scene points (line, sample): along the line and the scan. [px]"""


class Blur(Effect, Protocol):
    """The footprint is blurred by a kernel that is not negative and sums to 1; kernels of all blurs are folded."""

    def moments(self, rig: Rig, wavelength_nm: Floats, variant: str, normal: Floats | None = None) -> Moments:
        """Give what it does to each band; ``normal`` (3,) is the mirror's in the camera frame, None at rest."""


class Gain(Effect, Protocol):
    """Light is multiplied."""

    def gain(self, block: SweepBlock, variant: str) -> Light:
        """Give the factor, an array that broadcasts to (line, sample, band)."""


class LightChange(Effect, Protocol):
    """Light is changed in another linear way: spectra mixed, light added."""

    def change(self, light: Light, block: SweepBlock, variant: str) -> Light:
        """Give the changed light of a block, (line, sample, band) [e-]; may work in place."""
