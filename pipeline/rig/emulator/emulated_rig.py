"""A whole emulated rig: mirror and camera on one clock, pulses at the mirror's trigger input, and a simulated scene.

The simulator derives noise and drifts from a sweep's name and a line's number. The name, with the sweep's geometry, is
in the capture's prefix (:func:`pipeline.rig.capture_paths.announced`). The number is that of the line whose
planned position is nearest to the mirror's at mid exposure. That also holds for a path that was loaded in parts, begins
with a lead-in cell, or lost an edge.

A line is that of the simulated source, bit for bit, where the mirror holds the planned position to the last bit of
float32. Elsewhere the scene is imaged from where the mirror is. A capture whose prefix announces no sweep has lines at
rest. A capture with the prefix ``references`` has dark and white cubes.

The trigger input gets one pulse for each held position of the announced sweep, evenly over the exposure, as a pulse
generator would give them. It may also get one as each exposure begins, or none. A path that is played by trigger begins
with a lead-in cell. Without trigger the path runs at (positions of a line) / (frame period). It is the planned one
where it begins within half a held position of the first exposure.
"""

from __future__ import annotations

import logging
import os
import select
import threading
import tty
from contextlib import suppress
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from pipeline.errors import RigError, SettingsError
from pipeline.geometry.mirror import STRAIGHT, Mounting, direction_to_scene, position_to_direction, wire_positions
from pipeline.geometry.scan import Sweep, sweep_positions
from pipeline.rig.capture_paths import REFERENCES, Announced, announced
from pipeline.rig.device_settings import Pulses
from pipeline.rig.emulator.camera_device import CameraDevice, CameraServer, EmulatedCapture, Floats, Raw
from pipeline.rig.emulator.mirror_device import MirrorDevice
from pipeline.rig.transports import BITS_PER_BYTE, SYSTEM_CLOCK, Clock, Closing
from pipeline.simulator.effects.effect import Aim, Bound, SweepBlock
from pipeline.simulator.effects.probe import Probe
from pipeline.simulator.render import Choice
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.simulated import REFERENCE_FRAMES, SimulatedSource, render_lines
from pipeline.source import AT_REST


@dataclass(frozen=True)
class OffPlanAim(Aim):
    """An effect that shifts lines from their plan: (line, step, 2) from line ``first`` on. [px]"""

    shift_px: Floats
    first: int
    name = "beside"
    cost_ns = MappingProxyType({"exact": 0.2})

    def aim(self, block: SweepBlock, variant: str) -> Floats:
        """Return the shifts of a block's lines, along the line and the scan. [px]"""
        return self.shift_px[block.numbers - self.first]

    def missed(self, probe: Probe, rig: Rig, variant: str) -> Bound:
        """Return a bound of 0: the error of an emulated mirror is not known beforehand."""
        return Bound(0.0, "follows the emulated mirror")


@dataclass(frozen=True)
class SceneView:
    """A simulated source, imaged from where an emulated mirror is, with the mounting of that mirror."""

    source: SimulatedSource
    mounting: Mounting = STRAIGHT

    def lines(self, sweep: Sweep, held: Floats, times_ms: tuple[float, float], started_s: float) -> Raw:
        """Return raw lines (line, sample, band) of a sweep, not binned.

        ``held`` are (line, step, 2) positions of the device during each exposure, ``times_ms`` exposure and frame
        period. Drifts count from ``started_s``, the sweep's start, unless the source's own clock has it.
        """
        sweep = replace(sweep, binning=1)
        rig = self._rig(times_ms)
        position = self.mounting.to_model(held)
        scan = self._place(position)[..., 1].mean(axis=1)
        nearest = np.rint((scan - sweep.start_px - (sweep.positions - 1) / 2) / sweep.step)
        number = np.clip(nearest, 0, sweep.lines - 1).astype(np.int64)  # of the planned line nearest to each exposure
        planned = sweep_positions(sweep, rig.camera)[number]
        wired = wire_positions(planned.reshape(-1, 2), self.mounting).reshape(planned.shape)
        as_planned = (held.astype(np.float32) == wired).all(axis=(1, 2))
        source = self.source
        raw = []
        known = source.clock is not None and sweep.name in source.clock
        started_s = source.started_s(sweep) if known else started_s
        edges = np.flatnonzero((np.diff(number) != 1) | (np.diff(as_planned.astype(np.int8)) != 0)) + 1
        for start, stop in zip([0, *edges], [*edges, len(number)], strict=True):
            run = slice(start, stop)  # lines that follow each other and are all as planned, or all not
            lines = range(int(number[start]), int(number[stop - 1]) + 1)
            choice = source.choice
            if not as_planned[start]:
                aim = OffPlanAim(self._place(position[run]) - self._place(planned[run]), lines.start)
                choice = Choice(((aim, "exact"), *choice.effects))
            raw.append(render_lines(source.scene, rig, choice, sweep, lines, seed=source.seed, started_s=started_s))
        return np.concatenate(raw)

    def references(self, times_ms: tuple[float, float]) -> dict[str, Raw]:
        """Return dark and white frames (frame, sample, band) whose means are the source's."""
        taken = replace(self.source, rig=self._rig(times_ms)).references(AT_REST)
        dither = ((np.arange(REFERENCE_FRAMES) + 0.5) / REFERENCE_FRAMES)[:, None, None]
        return {
            name: np.clip(np.floor(mean[None] + dither), 0, 65535).astype(np.uint16)
            for name, mean in (("darkReference", taken.dark), ("whiteReference", taken.white))
        }

    def _place(self, position: Floats) -> Floats:
        """Return the position along the line and the scan, (..., 2). [px]"""
        return direction_to_scene(position_to_direction(position)) / self.source.camera.ifov_rad

    def _rig(self, times_ms: tuple[float, float]) -> Rig:
        """Return the source's rig with the exposure and frame period of the emulated camera."""
        camera = self.source.camera
        if np.allclose(times_ms, (camera.exposure_ms, camera.frame_ms), rtol=1e-9):
            return self.source.rig
        exposure, period = times_ms
        rate = max(camera.max_rate_hz, 1000 / period)
        return replace(
            self.source.rig,
            camera=replace(camera, exposure_ms=exposure, readout_ms=period - exposure, max_rate_hz=rate),
        )


class SceneCamera(CameraDevice):
    """A camera that images a scene where a mirror was sent.

    The mirror's motion to that position is an effect of the simulator, so it is not emulated again.

    Parameters
    ----------
    wired
        Pulses at the mirror's trigger input: one for each ``position``, one for each ``frame``, or ``none``.

    With ``aside`` a thread calls :meth:`keep_looking`; the camera counts as capturing until all frames are made.
    """

    def __init__(self, view: SceneView, mirror: MirrorDevice, clock: Clock, *, wired: Pulses = "position") -> None:
        super().__init__(self._scene_lines, clock, wavelength_nm=view.source.wavelength_nm.tolist())
        self.view = view
        self.mirror = mirror
        self.wired = wired
        self.aside = False

    def pulses(self, from_s: float, to_s: float) -> Floats:
        """Return when trigger pulses rise (pulse,), from ``from_s`` on and before ``to_s``."""
        if self.wired == "none":
            return np.zeros(0)
        found = []
        for capture in self.captures[-2:]:  # one may just have ended
            known = announced(_prefix(capture)) if self.wired == "position" else None
            steps = 1 if known is None else known.sweep.positions
            begins = capture.begins(from_s - capture.exposure_s, to_s)[:, None]
            rises = (begins + np.arange(steps) * (capture.exposure_s / steps)).ravel()
            found.append(rises[(rises >= from_s) & (rises < to_s)])
        return np.concatenate([np.zeros(0), *found])

    def is_capturing(self) -> bool:
        """Return whether a capture runs, or its frames are still being written."""
        if super().is_capturing():
            return True
        return self.aside and any(len(capture.pending(self.clock.now())) for capture in self.captures[-1:])

    def _poll(self) -> None:
        if not self.aside:
            super()._poll()

    def _begun(self, folder: str, frames: int) -> EmulatedCapture:
        capture = super()._begun(folder, frames)
        if _prefix(capture) == REFERENCES:
            capture.references = self.view.references((self.exposure_ms, self.period_ms))
        return capture

    def _scene_lines(self, middle_s: Floats) -> Raw:
        """Return the raw lines (line, sample, band) of exposures by their mid times."""
        capture = next(one for one in reversed(self.captures) if one.began_s <= middle_s[0])
        known = announced(_prefix(capture)) or Announced(AT_REST, 0)
        step = known.sweep.positions  # positions during each exposure
        moments = (np.arange(step) + 0.5) * (capture.exposure_s / step)
        held = self.mirror.positions(middle_s[:, None] - capture.exposure_s / 2 + moments)
        whole_began_s = capture.began_s - known.first * capture.period_s  # as if taken in one capture
        return self.view.lines(known.sweep, held, (capture.exposure_s * 1e3, capture.period_s * 1e3), whole_began_s)


def _prefix(capture: EmulatedCapture) -> str:
    """Return the name of a capture's folder, without its number."""
    return capture.folder.rsplit("/", 1)[-1].rpartition("_")[0]


LOG = logging.getLogger(__name__)
_MOST_READ = 4096  # bytes
_SLICE_S = 0.05  # how soon the thread sees that it is to end
_NAP_S = 0.01


class EmulatedPort(Closing):
    """A pty and the thread that serves it, until :meth:`close`; users open ``path``. Also a context.

    The device's clock paces the bytes. ``baud`` is the speed in both directions; 0 sets no pace, as with USB ports.
    RigError where this system has no ptys.
    """

    def __init__(self, device: MirrorDevice, *, baud: int = 0) -> None:
        self.device = device
        self._byte_s = BITS_PER_BYTE / baud if baud else 0.0
        try:
            self._master, self._slave = os.openpty()
            tty.setraw(self._slave)  # else line discipline would echo, and turn CR into LF
        except OSError as error:
            raise RigError(f"no pty for the emulated port: {error}; ptys are there on Linux and macOS") from error
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="emulated mirror port", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread and close the pty; users of the port see the device go."""
        self._ended.set()
        self._thread.join()

    def _serve(self) -> None:
        try:
            while not self._ended.is_set():
                if select.select([self._master], [], [], _SLICE_S)[0]:
                    self._answer(os.read(self._master, _MOST_READ))
        except OSError as error:
            LOG.info("%s: the device went away (%s)", self.path, error)
        except Exception:
            LOG.exception("the emulated controller on %s failed", self.path)
        finally:
            for descriptor in (self._master, self._slave):
                os.close(descriptor)

    def _answer(self, data: bytes) -> None:
        """Hand bytes to the device, and send its replies when they are due; a full pty loses them, as a UART would."""
        clock = self.device.clock
        received_s = clock.now() + len(data) * self._byte_s
        clock.sleep(received_s - clock.now())
        for delay_s, reply in self.device.receive(data):
            clock.sleep(received_s + delay_s + len(reply) * self._byte_s - clock.now())
            with suppress(BlockingIOError):
                os.write(self._master, reply)


class FastClock:
    """Monotonic time from 0 on that runs ``speed`` times as fast; sleeping takes 1 / ``speed`` of the time."""

    def __init__(self, speed: float = 1.0) -> None:
        if not 0 < speed < float("inf"):
            raise SettingsError(f"--speed {speed:g}: expected a factor above 0; 2 runs the clock twice as fast")
        self.speed = speed
        self._began = SYSTEM_CLOCK.now()

    def now(self) -> float:
        return (SYSTEM_CLOCK.now() - self._began) * self.speed

    def sleep(self, seconds: float) -> None:
        SYSTEM_CLOCK.sleep(seconds / self.speed)


class EmulatedRig:
    """Mirror and camera in front of the scene of ``source``.

    Parameters
    ----------
    clock
        Of both devices; a ``FastClock`` for :meth:`serve`.
    wired
        Pulses at the mirror's trigger input: one for each held ``position``, one for each ``frame``, or ``none``.
    mounting
        The mounting of the mirror, whatever drivers assume.

    A subclass may use other kinds of devices and servers, such as ones that fail.
    """

    mirror_kind = MirrorDevice
    camera_kind = SceneCamera
    server_kind = CameraServer

    def __init__(
        self, source: SimulatedSource, clock: Clock, *, wired: Pulses = "position", mounting: Mounting = STRAIGHT
    ) -> None:
        self.clock = clock
        self.mirror = self.mirror_kind(self.clock)
        self.camera = self.camera_kind(SceneView(source, mounting), self.mirror, self.clock, wired=wired)
        self.mirror.pulses = self.camera.pulses

    @property
    def state(self) -> str:
        """Return the state of both devices as one line of text."""
        x, y = self.mirror.positions(self.clock.now())
        camera = "capturing" if self.camera.is_capturing() else "idle"
        mirror = f"mirror {x:+.4f}; {y:+.4f}, {self.mirror.mode.value}"
        return f"{mirror} | camera {camera}, {len(self.camera.captures)} captures"

    def serve(self, *, baud: int = 0) -> ServedRig:
        """Open a pty for the mirror, and the camera's sockets (else RigError); use it as a context, or close it."""
        return ServedRig(self, baud)


class ServedRig(Closing):
    """An emulated rig behind a pty and sockets, until :meth:`close`.

    ``port`` is the mirror's serial port; the camera listens at ``host``, ``camera_port`` and ``file_port``.
    """

    def __init__(self, rig: EmulatedRig, baud: int) -> None:
        self.rig = rig
        self._server = rig.server_kind(rig.camera)
        self._port = EmulatedPort(rig.mirror, baud=baud)
        self.port = self._port.path
        self.host, self.camera_port, self.file_port = self._server.host, self._server.port, self._server.file_port
        rig.camera.aside = True
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._poll, name="emulated camera's eye", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Close the pty and the sockets; clients see the devices go."""
        self._ended.set()
        self._thread.join()
        self._server.close()
        self._port.close()

    def _poll(self) -> None:
        """Look at frames as they are over."""
        try:
            while not self._ended.is_set():
                self.rig.mirror.take_pulses()
                if not self.rig.camera.keep_looking():
                    SYSTEM_CLOCK.sleep(_NAP_S)
        except Exception:
            LOG.exception("the emulated camera failed")
