"""The emulated camera of a rig: it looks at a simulated scene over the emulated mirror, and gives it trigger pulses.

Noise and drifts of the simulator are keyed by a sweep's name and a line's number, so the camera has to know both. The
name, with the sweep's geometry, is in the capture's prefix (:func:`pipeline.rig.capture.capture_paths.announced`). The
number is that of the line whose planned position is nearest to the one the mirror holds at mid exposure: what the
vector index says where the path is the planned one, and still right where it was loaded in parts, begins with a
lead-in, or lost an edge.

Where the mirror holds what was planned, to the last bit of the wire's float32, a line is that of the simulated source,
bit for bit. Elsewhere it is looked at from where the mirror is. A capture that announces nothing has streams of its
own, by its folder and frame.

Pulses, as the cable has it: one for each held position of the sweep that a capture announces, evenly over the exposure
(a pulse generator between camera and mirror would give them; cameras have none); one as each exposure begins; or none.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.mirror import STRAIGHT, Mounting, direction_to_scene, position_to_direction
from pipeline.geometry.scan import Sweep, sweep_positions
from pipeline.rig.capture.capture_paths import REFERENCES, Announced, announced
from pipeline.rig.device_settings import Pulses
from pipeline.rig.devices import Clock
from pipeline.rig.emulator.camera_device import CameraDevice, CameraUnit, EmulatedCapture, Floats, Ints, Raw
from pipeline.rig.emulator.mirror_device import MirrorDevice
from pipeline.rig.mirror.mirror_controller import wire_positions
from pipeline.simulator.effects.effect import Aim, Bound, SweepBlock
from pipeline.simulator.effects.probe import Probe
from pipeline.simulator.render import Choice
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.simulated import SimulatedSource, render_lines
from pipeline.source import AT_REST

REFERENCE_FRAMES = 32
_AT_ONCE = 8  # frames looked at while nobody else may speak to the camera


@dataclass(frozen=True)
class OffPlanAim(Aim):
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
    """A simulated source, looked at from where an emulated mirror is, which is mounted somehow."""

    source: SimulatedSource
    mounting: Mounting = STRAIGHT

    def lines(self, told: Announced, held: Floats, times_ms: tuple[float, float], started_s: float) -> Raw:
        """Give raw lines (line, sample, band) of a sweep, not binned.

        ``held`` are (line, step, 2) positions of the device during each exposure, ``times_ms`` exposure and frame
        period; ``started_s`` is when the sweep began, for what drifts, unless the source's own clock knows.
        """
        sweep = replace(told.sweep, binning=1)
        rig = self._rig(times_ms)
        seen = self.mounting.to_model(held)
        number = self.numbers(sweep, seen)
        planned = sweep_positions(sweep, rig.camera)[number]
        wired = wire_positions(planned.reshape(-1, 2), self.mounting).reshape(planned.shape)
        as_planned = (held.astype(np.float32) == wired).all(axis=(1, 2))
        raw = []
        for run in _runs(number, as_planned):
            lines = range(int(number[run][0]), int(number[run][-1]) + 1)
            choice = self.source.choice
            if not as_planned[run][0]:
                aim = OffPlanAim(self._place(seen[run]) - self._place(planned[run]), lines.start)
                choice = Choice(((aim, "exact"), *choice.effects))
            raw.append(self._render(rig, choice, sweep, lines, started_s))
        return np.concatenate(raw)

    def alone(self, name: str, held: Floats, times_ms: tuple[float, float], started_s: float) -> Raw:
        """Give one raw line (1, sample, band) along x of a position (2,) of the device that belongs to no sweep."""
        place = self._place(self.mounting.to_model(held))
        sweep = Sweep(name, "fine", "x", float(place[0]), float(place[1]), 1)
        return self._render(self._rig(times_ms), self.source.choice, sweep, range(1), started_s)

    def numbers(self, sweep: Sweep, seen: Floats) -> Ints:
        """Give the line (line,) of the sweep that each exposure (line, step, 2) is nearest to."""
        scan = self._place(seen)[..., 1].mean(axis=1)
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

    def _place(self, position: Floats) -> Floats:
        """Along the line and the scan, (..., 2). [px]"""
        return direction_to_scene(position_to_direction(position)) / self.source.camera.ifov_rad

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


def _runs(number: Ints, alike: NDArray[np.bool_]) -> Iterator[slice]:
    """Exposures in a row whose lines follow each other and that are all as planned, or all not."""
    edges = np.flatnonzero((np.diff(number) != 1) | (np.diff(alike.astype(np.int8)) != 0)) + 1
    for start, stop in zip([0, *edges], [*edges, len(number)], strict=True):
        yield slice(int(start), int(stop))


class SceneCamera(CameraDevice):
    """A camera that looks at a scene where a mirror sends it.

    The mirror counts as where it was sent: how it gets there is for the simulator's effects, so that it is in the lines
    once.

    Parameters
    ----------
    wired
        What comes at the mirror's trigger input: a pulse for each ``position``, each ``frame``, or ``none``.
    kept
        So many finished captures keep their files, and references always; 0 is all.

    With ``aside`` frames are looked at by calls of :meth:`keep_looking` alone, from a thread; until then it is capturing.
    """

    def __init__(
        self,
        view: SceneView,
        mirror: MirrorDevice,
        clock: Clock,
        *,
        wired: Pulses = "position",
        kept: int = 0,
        unit: CameraUnit | None = None,
    ) -> None:
        unit = CameraUnit() if unit is None else unit
        unit = replace(unit, wavelength_nm=tuple(view.source.wavelength_nm.tolist()))
        super().__init__(self._seen, clock, positions=mirror.sent, unit=unit)
        self.view, self.mirror, self.wired, self.kept = view, mirror, wired, kept
        self.aside = False

    def pulses(self, from_s: float, to_s: float) -> Floats:
        """Give rises and falls (pulse, 2) of the trigger pulses that rise from ``from_s`` on and before ``to_s``."""
        found = [np.zeros((0, 2))]
        if self.wired == "none":
            return found[0]
        for capture in self.captures[-2:]:  # one may just have ended
            told = announced(_prefix(capture)) if self.wired == "position" else None
            steps = 1 if told is None else told.sweep.step
            begins = capture.exposures(from_s - capture.exposure_s, to_s)[:, :1]
            rises = (begins + np.arange(steps) * (capture.exposure_s / steps)).ravel()
            rises = rises[(rises >= from_s) & (rises < to_s)]
            found.append(np.stack([rises, rises + capture.exposure_s / (2 * steps)], axis=-1))
        return np.concatenate(found)

    def is_capturing(self) -> bool:
        """Whether a capture runs, or its frames are still being written."""
        if super().is_capturing():
            return True
        return self.aside and any(len(capture.pending(self.clock.now(), 1)) for capture in self.captures[-1:])

    def keep_looking(self) -> bool:
        """Look at some frames that are over; False where there are none. Others may speak to the camera meanwhile."""
        with self._lock:
            waiting = ((one, one.pending(self.clock.now(), _AT_ONCE)) for one in self.captures[-2:])
            capture, numbers = next(((one, some) for one, some in waiting if len(some)), (None, np.zeros(0, np.int64)))
        if capture is None:
            return False
        middle_s = capture.middle_s(numbers)
        lines = self._seen(self._positions(middle_s), middle_s)
        with self._lock:
            capture.put(lines)
        return True

    def _poll(self) -> None:
        if not self.aside:
            super()._poll()

    def _begun(self, folder: str, frames: int, cubes: int) -> EmulatedCapture:
        for capture in self.captures[: -self.kept or None] if self.kept else ():
            if _prefix(capture) != REFERENCES:  # these are asked for again with every sweep
                capture.drop()
        capture = super()._begun(folder, frames, cubes)
        if _prefix(capture) == REFERENCES:
            capture.references = self.view.references((self.exposure_ms, self.period_ms), REFERENCE_FRAMES)
        return capture

    def _seen(self, positions: Floats, middle_s: Floats) -> Raw:
        """Raw lines (line, sample, band) of exposures by the middle of each."""
        capture = next((one for one in reversed(self.captures) if one.began_s <= middle_s[0]), None)
        if capture is None:
            return self.view.alone("no capture", positions[0], (self.exposure_ms, self.period_ms), 0.0)
        times_ms = capture.exposure_s * 1e3, capture.period_s * 1e3
        told = announced(_prefix(capture))
        if told is None:
            number = ((middle_s - capture.began_s) / capture.period_s).astype(int).tolist()
            names = [f"{capture.folder}-{one}" for one in number]
            scan_passes = zip(names, positions, strict=True)
            return np.concatenate(
                [self.view.alone(name, place, times_ms, capture.began_s) for name, place in scan_passes]
            )
        step = told.sweep.step  # positions during each exposure
        moments = (np.arange(step) + 0.5) * (capture.exposure_s / step)
        held = self.mirror.sent(middle_s[:, None] - capture.exposure_s / 2 + moments)
        whole_began_s = capture.began_s - told.first * capture.period_s  # had the sweep been taken at once
        return self.view.lines(told, held, times_ms, whole_began_s)


def _prefix(capture: EmulatedCapture) -> str:
    """What a capture's folder is called, without its number."""
    return capture.folder.rsplit("/", 1)[-1].rpartition("_")[0]
