"""Effects in general: a name, variants from exact to cheap, a bound on the error of each, a cost, and an action.

It works at one of six places of the chain, in this order. The mirror looks elsewhere (``Aim``); rays meet the scene
elsewhere (``Displacement``). The footprint is blurred or shifted band by band (``Blur``); light is multiplied
(``Gain``) or changed (``LightChange``); electrons are read out. All before the readout are linear in the light.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry.mirror import position_to_normal
from spectralzoom.pipeline.geometry.scan import Floats, Sweep, line_positions, sweep_positions
from spectralzoom.pipeline.simulator.effects.probe import GainRange, Probe
from spectralzoom.pipeline.simulator.optics.kernel_fit import Moments
from spectralzoom.pipeline.simulator.rig_model import Rig

Radiance = NDArray[np.float32]
OFF = "off"
Chosen = Mapping[Any, str]  # effects that are on, each with its variant, in the order of the chain


@dataclass(frozen=True)
class Bound:
    """The most that leaving an effect out, or taking a variant for the exact one, changes any number; and why."""

    value: float  # in the unit of the probe that it was asked with
    why: str  # for the user: the magnitude in numbers


class Effect(Protocol):
    """Interface of an effect to the decision, by name. Variants go from exact to cheap; off is none of them."""

    name: str  # in flags, manifest and streams
    cost_ns: Mapping[str, float]  # measured cost of each variant per px and band, the exact one first [ns]

    @property
    def variants(self) -> tuple[str, ...]:
        """Return ways to compute it, the exact one first."""
        return tuple(self.cost_ns)

    def bound(self, probe: Probe, rig: Rig, variant: str = OFF) -> Bound:
        """Bound the error of leaving it out, or of a variant against the exact one; 0 where the rig lacks it."""
        return Bound(0.0, "exact") if variant == self.variants[0] else self.missed(probe, rig, variant)

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound the error of leaving it out, or of a variant that is not the exact one."""

    def __eq__(self, other: object) -> bool:
        """Return whether both are the same effect, also in another process."""
        return type(self) is type(other) and vars(self) == vars(other)

    def __hash__(self) -> int:
        return hash(self.name)


class Aim(Effect, Protocol):
    """The mirror looks beside its plan."""

    def aim(self, block: SweepBlock, variant: str) -> Floats:
        """Return the displacement, (line, step, 2) along line and scan at every held position [px]; step may be 1."""


class Displacement(Effect, Protocol):
    """Rays meet the scene elsewhere than at its plane's own place."""

    def displaced(self, block: SweepBlock, along_px: Floats, scan_px: Floats, variant: str) -> tuple[Floats, Floats]:
        """Return the displacement to add to scene points (line, sample): along the line and the scan [px]."""


class Blur(Effect, Protocol):
    """The footprint is blurred by a kernel that is not negative and sums to 1; kernels of all blurs are folded."""

    def moments(self, rig: Rig, wavelength_nm: Floats, variant: str, normal: Floats | None = None) -> Moments:
        """Return what it does to each band; ``normal`` (3,) is the mirror's in the camera frame, None at rest."""


class Gain(Effect, Protocol):
    """Light is multiplied."""

    def gain_range(self, probe: Probe, rig: Rig) -> GainRange:
        """Return the factors that it has anywhere in the survey: they multiply the errors of other effects."""

    def gain(self, block: SweepBlock, variant: str) -> Radiance:
        """Return the factor, an array that broadcasts to (line, sample, band)."""


class LightChange(Effect, Protocol):
    """Light is changed in another linear way: spectra mixed, light added."""

    def change(self, light: Radiance, block: SweepBlock, variant: str) -> Radiance:
        """Return the changed light of a block, (line, sample, band) [e-]; may work in place."""


@dataclass(frozen=True)
class SweepBlock:
    """Lines with all samples of the camera. A result never depends on which other lines are in the block."""

    rig: Rig
    sweep: Sweep
    lines: range  # numbers within the sweep
    wavelength_nm: Floats  # (band,)
    shape: tuple[int, int]  # of the scene [px]
    seed: int = 0
    started_s: float = 0.0  # since the survey's start
    fwhm_nm: Floats | None = None  # (band,) of the scene's own bands; None where not known
    white_e: Floats | float = 0.0  # (band,) electrons of the white reference in one exposure

    @property
    def numbers(self) -> NDArray[np.int64]:
        """Return the numbers of the lines within the sweep."""
        return np.arange(self.lines.start, self.lines.stop, self.lines.step, dtype=np.int64)

    @property
    def slopes(self) -> Floats:
        """Return the tangent of each sample's ray along the line."""
        return self.rig.camera.pixel_slopes()

    @property
    def time_s(self) -> Floats:
        """Return the time of each line at mid exposure, since the survey's start [s]."""
        return self.started_s + self.rig.camera.mid_exposure_s(self.numbers.astype(np.float64))

    @cached_property
    def positions(self) -> Floats:
        """Return device X and Y that are held, as planned, (line, step, 2)."""
        return sweep_positions(self.sweep, self.rig.camera)[self.numbers]

    @cached_property
    def middle(self) -> Floats:
        """Return device X and Y of each line at mid exposure, as planned."""
        return line_positions(self.sweep, self.rig.camera)[self.numbers]

    @cached_property
    def normals(self) -> Floats:
        """Return the mirror's normals at mid exposure, as planned, (line, 3); ``-n_z`` is the cosine of incidence."""
        # for the whole sweep: the product with the axes rounds otherwise for a single line than for several.
        return np.asarray(position_to_normal(line_positions(self.sweep, self.rig.camera))[self.numbers])

    @property
    def scan_px(self) -> Floats:
        """Return the scan coordinate of each line at mid exposure [px]."""
        return self.sweep.line_px()[self.numbers]

    def stream(self, effect: str, number: int) -> np.random.Generator:
        """Return an effect's random stream at one line: blocks, order and other effects never change it."""
        return stream_of(self.seed, self.sweep.name, effect, number)


def survey_stream(seed: int, effect: str) -> np.random.Generator:
    """Return the stream of one effect for a whole survey: under no sweep's name."""
    return stream_of(seed, "", effect)


def stream_of(entropy: int, *key: str | int) -> np.random.Generator:
    """Return a stream by a survey's seed, or by the unit of a rig for its fixed patterns, and the hash of a key.

    Words of SFC64 take half the time of a counter-based Philox.
    """
    words = [zlib.crc32(one.encode()) if isinstance(one, str) else one for one in key]
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(entropy=entropy, spawn_key=words)))
