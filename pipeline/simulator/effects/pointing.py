"""Pointing errors of the simulated mirror: where it really looks while it reports the planned positions.

Beside the mirror's own faults (jitter, hysteresis and thermal drift, which follow from a rig's numbers) these put whole
sweeps, each by itself, beside their places: what registration is there to find.
"""

from __future__ import annotations

import zlib
from abc import ABC, abstractmethod
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SettingsError
from pipeline.simulator.block import SweepBlock
from pipeline.simulator.effects.effect import Aim, Bound
from pipeline.simulator.effects.mirror_pointing import at_line_ends
from pipeline.simulator.effects.probe import Probe
from pipeline.simulator.rig_model import Rig

ACCURACY_PX = 50.0  # 0.15 deg mechanical, as quoted by the vendor: systematic, unknown before registration
REPEATABILITY_PX = 0.8  # 40 urad mechanical: anew for every line
_MOST_DEVIATES = 6.0  # beyond, one line in 5e8 lies
Floats = NDArray[np.float64]


class Pointing(Aim, ABC):
    """How far a mirror looks beside the places that it reports: an aim of the chain, on wherever there is one."""

    name = "pointing"
    cost_ns = MappingProxyType({"exact": 0.2})

    @property
    @abstractmethod
    def reach_px(self) -> tuple[float, float]:
        """How far it looks beside at most, along the line and the scan [px]."""

    @abstractmethod
    def of_lines(self, sweep_name: str, lines: range) -> Floats:
        """Give the error of some lines of a sweep, (line, 2) along the line and the scan [px]."""

    def aim(self, block: SweepBlock, variant: str) -> Floats:
        """Give the error of a block's lines, (line, 1, 2) along the line and the scan. [px]"""
        return self.of_lines(block.sweep.name, block.lines)[:, None]

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Bound by slope times the greatest error."""
        along, scan = self.reach_px
        if along == scan == 0:
            return Bound(0.0, "the mirror looks where it reports")
        why = f"the mirror looks up to {along:.2g} px beside along the line and {scan:.2g} px along the scan"
        return Bound(probe.moved(*at_line_ends(probe.sweeps, rig.camera, along, scan)), why)


@dataclass(frozen=True)
class PointingErrors(Pointing):
    """How far the mirror looks beside the place that it reports, in px of the scene along the line and the scan.

    Every sweep has an offset drawn evenly from ``-offset_px`` to ``offset_px`` in either axis, and every line a
    normal deviate of ``jitter_px`` rms in either. Each is drawn from a stream of its own, keyed (seed, sweep name) and
    (seed, sweep name, line number): no line's error depends on which others were asked for.
    """

    offset_px: float = ACCURACY_PX
    jitter_px: float = REPEATABILITY_PX
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("offset_px", "jitter_px"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise SettingsError(f"{name} of the pointing errors must be finite and not negative, got {value}")

    @property
    def reach_px(self) -> tuple[float, float]:
        """Greatest offset and six deviates of jitter, in either axis [px]."""
        most = self.offset_px + _MOST_DEVIATES * self.jitter_px
        return most, most

    def offset(self, sweep_name: str) -> Floats:
        """Give the systematic error of a sweep, (2,) along the line and the scan [px]."""
        return self._stream(sweep_name).uniform(-self.offset_px, self.offset_px, 2)

    def of_lines(self, sweep_name: str, lines: range) -> Floats:
        """Give the whole error of some lines of a sweep, (line, 2) along the line and the scan [px]."""
        jitter = np.array([self._stream(sweep_name, number).standard_normal(2) for number in lines]).reshape(-1, 2)
        return self.offset(sweep_name) + self.jitter_px * jitter

    def _stream(self, sweep_name: str, *line: int) -> np.random.Generator:
        key = np.random.SeedSequence(entropy=self.seed, spawn_key=(zlib.crc32(sweep_name.encode()), *line))
        return np.random.Generator(np.random.Philox(key))


@dataclass(frozen=True)
class CommonOffset(Pointing):
    """A mirror that looks beside every reported place by the same (along, scan) px."""

    offset_px: tuple[float, float]

    @property
    def reach_px(self) -> tuple[float, float]:
        """Its size [px]."""
        return abs(self.offset_px[0]), abs(self.offset_px[1])

    def of_lines(self, sweep_name: str, lines: range) -> Floats:
        """Give the error of some lines, (line, 2) along the line and the scan [px]."""
        return np.tile(np.array(self.offset_px, np.float64), (len(lines), 1))
