"""The emulated camera of a rig: it looks at a simulated scene over the emulated mirror, and gives it trigger pulses.

Pulses, as the cable has it: one for each held position of the sweep that a capture announces, evenly over the exposure
(a pulse generator between camera and mirror would give them; cameras have none); one as each exposure begins; or none.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from pipeline.rig.capture.capture_names import REFERENCES, Announced, announced
from pipeline.rig.clock import Clock
from pipeline.rig.emulator.camera_capture import EmulatedCapture
from pipeline.rig.emulator.camera_device import CameraDevice, CameraUnit
from pipeline.rig.emulator.camera_faults import CameraFaults
from pipeline.rig.emulator.scene_view import Floats, Raw, SceneView
from pipeline.rig.emulator.triggered_mirror import TriggeredMirror
from pipeline.rig.survey_rig import Pulses

Look = Literal["sent", "measured"]
REFERENCE_FRAMES = 32
_AT_ONCE = 8  # frames looked at while nobody else may speak to the camera
_MOMENTS = 8  # within a held position


class SceneCamera(CameraDevice):
    """A camera that looks at a scene where a mirror sends it.

    Parameters
    ----------
    wired
        What comes at the mirror's trigger input: a pulse for each ``position``, each ``frame``, or ``none``.
    look
        ``sent``: the mirror counts as where it was sent; how it gets there is for the simulator's effects, so that it
        is in the lines once. ``measured``: where its motion has it.
    aside
        Frames are looked at by calls of :meth:`look_on` alone, from a thread; until then the camera is capturing.
    kept
        So many finished captures keep their files, and references always; 0 is all.
    """

    def __init__(
        self, view: SceneView, mirror: TriggeredMirror, clock: Clock, *, wired: Pulses = "position",
        look: Look = "sent", aside: bool = False, kept: int = 0, unit: CameraUnit | None = None,
        faults: CameraFaults | None = None,
    ) -> None:  # fmt: skip
        unit = CameraUnit() if unit is None else unit
        unit = replace(unit, wavelength_nm=tuple(view.source.wavelength_nm.tolist()))
        super().__init__(self._seen, clock, positions=mirror.sent, unit=unit, faults=faults)
        self.view, self.mirror, self.wired, self.look, self.aside, self.kept = view, mirror, wired, look, aside, kept

    def pulses(self, from_s: float, to_s: float) -> Floats:
        """Give rises and falls (pulse, 2) of the trigger pulses that rise from ``from_s`` on and before ``to_s``."""
        found = [np.zeros((0, 2))]
        if self.wired == "none":
            return found[0]
        for capture in self.captures[-2:]:  # one may just have ended
            steps = _steps(capture) if self.wired == "position" else 1
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

    def files(self) -> dict[str, bytes]:
        """All files by their whole names, as they are now."""
        with self._lock:
            found: dict[str, bytes] = {}
            for capture in self.captures:
                if not self.aside:
                    capture.take(self.clock.now(), self._positions, self._lines)
                found |= {f"{capture.folder}/{name}": data for name, data in capture.files().items()}
            return found

    def look_on(self) -> bool:
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
            looks = zip(names, positions, strict=True)
            return np.concatenate([self.view.alone(name, place, times_ms, capture.began_s) for name, place in looks])
        held = self._held(middle_s, told.sweep.step, capture.exposure_s)
        return self.view.lines(told, held, times_ms, _began_s(capture, told))

    def _held(self, middle_s: Floats, step: int, exposure_s: float) -> Floats:
        """Positions (line, step, 2) during each exposure."""
        begins = middle_s[:, None] - exposure_s / 2
        if self.look == "sent":
            return self.mirror.sent(begins + (np.arange(step) + 0.5) * (exposure_s / step))
        moments = (np.arange(step * _MOMENTS) + 0.5) * (exposure_s / (step * _MOMENTS))
        places = self.mirror.positions(begins + moments)
        mean: Floats = places.reshape(len(middle_s), step, _MOMENTS, 2).mean(axis=2)
        return mean


def _prefix(capture: EmulatedCapture) -> str:
    """What a capture's folder is called, without its number."""
    return capture.folder.rsplit("/", 1)[-1].rpartition("_")[0]


def _steps(capture: EmulatedCapture) -> int:
    told = announced(_prefix(capture))
    return 1 if told is None else told.sweep.step


def _began_s(capture: EmulatedCapture, told: Announced) -> float:
    """When the whole sweep began, had it been taken at once. [s]"""
    return capture.began_s - told.first * capture.period_s
