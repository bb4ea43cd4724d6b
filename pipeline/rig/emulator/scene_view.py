"""What the emulated camera sees of a simulated scene: the lines that a planned sweep has there, as the mirror plays it.

Noise and drifts of the simulator are keyed by a sweep's name and a line's number, so the camera has to know both. The
name, with the sweep's geometry, is in the capture's prefix (:mod:`pipeline.rig.capture_names`). The number is that of
the line whose planned position is nearest to the one the mirror holds at mid exposure: what the vector index says where
the path is the planned one, and still right where it was loaded in parts, begins with a lead-in, or lost an edge.

Where the mirror holds what was planned, to the last bit of the wire's float32, a line is that of the simulated source,
bit for bit. Elsewhere it is looked at from where the mirror is. A capture that announces nothing has streams of its
own, by its folder and frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.mirror import direction_to_scene, position_to_direction
from pipeline.rig.capture_names import Announced
from pipeline.rig.steering import wire_positions
from pipeline.scan import Sweep, sweep_positions
from pipeline.simulator.block import SweepBlock
from pipeline.simulator.effects.effect import Aim, Bound
from pipeline.simulator.effects.probe import Probe
from pipeline.simulator.instrument import render_lines
from pipeline.simulator.render import Choice
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.simulated import SimulatedSource
from pipeline.source import AT_REST

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Raw = NDArray[np.uint16]


@dataclass(frozen=True)
class Beside(Aim):
    """An aim of the chain: how far lines lie beside their plan, (line, step, 2) from line ``first`` on. [px]"""

    shift_px: Floats
    first: int
    name = "beside"
    cost_ns = MappingProxyType({"exact": 0.2})

    def aim(self, block: SweepBlock, variant: str) -> Floats:
        """Give the shifts of a block's lines, along the line and the scan. [px]"""
        return self.shift_px[block.numbers - self.first]

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Nothing is known beforehand of where an emulated mirror goes."""
        return Bound(0.0, "follows the emulated mirror")


@dataclass(frozen=True)
class SceneView:
    """A simulated source, looked at from where an emulated mirror is."""

    source: SimulatedSource

    def lines(self, told: Announced, held: Floats, times_ms: tuple[float, float], started_s: float) -> Raw:
        """Give raw lines (line, sample, band) of a sweep, not binned.

        Parameters
        ----------
        held
            (line, step, 2) positions during each exposure.
        times_ms
            Exposure and frame period.
        started_s
            When the sweep began, for what drifts, unless the source's own clock knows.
        """
        sweep = replace(told.sweep, binning=1)
        rig = self._rig(times_ms)
        number = self.numbers(sweep, held)
        planned = sweep_positions(sweep, rig.camera)[number]
        wired = wire_positions(planned.reshape(-1, 2)).reshape(planned.shape)
        as_planned = (held.astype(np.float32) == wired).all(axis=(1, 2))
        raw = []
        for run in _runs(number, as_planned):
            lines = range(int(number[run][0]), int(number[run][-1]) + 1)
            choice = self.source.choice
            if not as_planned[run][0]:
                choice = _aimed(choice, Beside(self._off(held[run], planned[run]), lines.start))
            raw.append(self._render(rig, choice, sweep, lines, started_s))
        return np.concatenate(raw)

    def alone(self, name: str, held: Floats, times_ms: tuple[float, float], started_s: float) -> Raw:
        """Give one raw line (1, sample, band) along x of a position (2,) that belongs to no sweep."""
        place = direction_to_scene(position_to_direction(held)) / self.source.camera.ifov_rad
        sweep = Sweep(name, "fine", "x", float(place[0]), float(place[1]), 1)
        return self._render(self._rig(times_ms), self.source.choice, sweep, range(1), started_s)

    def numbers(self, sweep: Sweep, held: Floats) -> Ints:
        """Give the line (line,) of the sweep that each exposure is nearest to."""
        scan = self._place(held)[..., 1].mean(axis=1)
        number = np.rint((scan - sweep.start_px - (sweep.step - 1) / 2) / sweep.step)
        lines: Ints = np.clip(number, 0, sweep.lines - 1).astype(np.int64)
        return lines

    def references(self, times_ms: tuple[float, float], frames: int) -> dict[str, Raw]:
        """Dark and white frames (frame, sample, band) whose means are the source's, to half of 1 / ``frames`` DN."""
        taken = replace(self.source, rig=self._rig(times_ms)).references(AT_REST)
        dither = ((np.arange(frames) + 0.5) / frames)[:, None, None]
        return {
            name: np.clip(np.floor(mean[None] + dither), 0, 65535).astype(np.uint16)
            for name, mean in (("darkReference", taken.dark), ("whiteReference", taken.white))
        }

    def _place(self, held: Floats) -> Floats:
        """Along the line and the scan, (..., 2). [px]"""
        return direction_to_scene(position_to_direction(held)) / self.source.camera.ifov_rad

    def _off(self, held: Floats, planned: Floats) -> Floats:
        return self._place(held) - self._place(planned)

    def _rig(self, times_ms: tuple[float, float]) -> Rig:
        """The source's rig, or one whose camera was told other times."""
        camera = self.source.camera
        if np.allclose(times_ms, (camera.exposure_ms, camera.frame_ms), rtol=1e-9):
            return self.source.rig
        exposure, period = times_ms
        rate = max(camera.max_rate_hz, 1000 / period)
        told = replace(camera, exposure_ms=exposure, readout_ms=period - exposure, max_rate_hz=rate)
        return replace(self.source.rig, camera=told)

    def _render(self, rig: Rig, choice: Choice, sweep: Sweep, lines: range, started_s: float) -> Raw:
        source = self.source
        known = source.clock is not None and sweep.name in source.clock
        started_s = source.started_s(sweep) if known else started_s
        return render_lines(source.scene, rig, choice, sweep, lines, seed=source.seed, started_s=started_s)


def _aimed(choice: Choice, beside: Beside) -> Choice:
    return Choice(((beside, "exact"), *choice.effects))


def _runs(number: Ints, alike: NDArray[np.bool_]) -> Iterator[slice]:
    """Exposures in a row whose lines follow each other and that are all as planned, or all not."""
    edges = np.flatnonzero((np.diff(number) != 1) | (np.diff(alike.astype(np.int8)) != 0)) + 1
    for start, stop in zip([0, *edges], [*edges, len(number)], strict=True):
        yield slice(int(start), int(stop))
