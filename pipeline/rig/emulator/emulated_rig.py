"""A whole emulated rig: mirror and camera on one clock, the camera's exposures at the mirror's trigger, and a scene.

A planned sweep that is announced (by a capture's prefix, :func:`pipeline.rig.capture.capture_paths.capture_prefix`),
loaded and played gives the simulated source's lines, bit for bit; see :mod:`pipeline.rig.emulator.scene_camera`. A path
that is played by trigger begins with a lead-in cell: the mirror takes the first as it is run, and one more at each
rising edge. Without trigger it is run at (positions of a line) / (frame period), and is the planned one where it begins
within half a held position of the first exposure. A capture with the prefix ``references`` has dark and white cubes.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Sequence
from dataclasses import dataclass

from pipeline.errors import SettingsError
from pipeline.geometry.mirror import STRAIGHT, Mounting
from pipeline.rig.device_settings import Pulses
from pipeline.rig.devices import SYSTEM_CLOCK, Clock, Closing
from pipeline.rig.emulator.camera_device import CameraUnit
from pipeline.rig.emulator.camera_server import CameraServer
from pipeline.rig.emulator.fault_names import CameraFaults
from pipeline.rig.emulator.mirror_device import Fault, MirrorDevice
from pipeline.rig.emulator.mirror_ports import EmulatedPort
from pipeline.rig.emulator.mirror_state import MirrorUnit
from pipeline.rig.emulator.scene_camera import SceneCamera, SceneView
from pipeline.simulator.simulated import SimulatedSource

LOG = logging.getLogger(__name__)
_NAP_S = 0.01


class FastClock:
    """Monotonic time, ``speed`` times as fast as it is, from 0 on. Sleeping takes as much less."""

    def __init__(self, speed: float = 1.0) -> None:
        if not 0 < speed < float("inf"):
            raise SettingsError(f"a speed of {speed:g}: expected how many times as fast time goes, above 0 (--speed)")
        self.speed = speed
        self._began = SYSTEM_CLOCK.now()

    def now(self) -> float:
        return (SYSTEM_CLOCK.now() - self._began) * self.speed

    def sleep(self, seconds: float) -> None:
        SYSTEM_CLOCK.sleep(seconds / self.speed)


@dataclass(frozen=True)
class RigState:
    """What both devices do at a moment."""

    position: tuple[float, float]  # device X and Y
    mode: str  # simple, pro, pro with requests checked; or gone, or hung, by a fault
    last: str  # that the mirror was asked to do
    capturing: bool
    captures: int


class EmulatedRig:
    """Mirror and camera that look at what ``source`` looks at.

    Parameters
    ----------
    clock
        Of both devices; a ``FastClock`` for :meth:`serve`.
    wired
        What pulses the mirror's trigger input gets: one for each held ``position``, each ``frame``, or ``none``.
    kept
        So many finished captures keep their files; 0 is all.
    mounting
        How the mirror is mounted, whatever drivers believe.
    """

    def __init__(
        self,
        source: SimulatedSource,
        clock: Clock,
        *,
        mirror_faults: Sequence[Fault] = (),
        camera_faults: CameraFaults | None = None,
        wired: Pulses = "position",
        kept: int = 0,
        mirror: MirrorUnit | None = None,
        camera: CameraUnit | None = None,
        mounting: Mounting = STRAIGHT,
    ) -> None:
        self.clock = clock
        self.mirror = MirrorDevice(self.clock, mirror_faults, unit=mirror)
        self.camera = SceneCamera(
            SceneView(source, mounting),
            self.mirror,
            self.clock,
            wired=wired,
            kept=kept,
            unit=camera,
            faults=camera_faults,
        )
        self.mirror.pulses = self.camera.pulses

    def seen(self) -> RigState:
        """Say what both devices do now."""
        x, y = self.mirror.positions(self.clock.now())
        last = self.mirror.acts[-1].request.words if self.mirror.acts else ""
        mode = "gone" if self.mirror.gone else "hung" if self.mirror.hung else self.mirror.mode.value
        return RigState((float(x), float(y)), mode, last, self.camera.is_capturing(), len(self.camera.captures))

    def serve(self, *, baud: int = 0) -> ServedRig:
        """Open a pty for the mirror, and the camera's sockets (else RigError); use it as a context, or close it."""
        return ServedRig(self, baud)


class ServedRig(Closing):
    """An emulated rig behind a pty and sockets, from its making to :meth:`close`.

    ``port`` is the mirror's, to be opened as a serial port; the camera listens at ``host``, ``camera_port`` and
    ``file_port``.
    """

    def __init__(self, rig: EmulatedRig, baud: int) -> None:
        self.rig = rig
        self._port = EmulatedPort(rig.mirror, baud=baud)
        self.port = self._port.open()
        try:
            self._server = CameraServer(rig.camera)
        except BaseException:
            self._port.close()
            raise
        self.host, self.camera_port, self.file_port = self._server.host, self._server.port, self._server.file_port
        rig.camera.aside = True
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._look, name="emulated camera's eye", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Let go of the pty and the sockets; whoever is connected sees the devices go."""
        self._ended.set()
        self._thread.join()
        self._server.close()
        self._port.close()

    def _look(self) -> None:
        """Look at frames as they are over."""
        try:
            while not self._ended.is_set():
                self.rig.mirror.take_pulses()
                if not self.rig.camera.look_on():
                    SYSTEM_CLOCK.sleep(_NAP_S)
        except Exception:
            LOG.exception("the emulated camera failed")
