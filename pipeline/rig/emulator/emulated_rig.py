"""A whole emulated rig: mirror and camera on one clock, the camera's exposures at the mirror's trigger, and a scene.

A planned sweep that is announced (by a capture's prefix, :func:`pipeline.rig.capture.capture_paths.capture_prefix`),
loaded and played gives the simulated source's lines, bit for bit:

- The mirror's vector unit takes the first cell as it is run, and one more at each rising edge. A path that is played by
  trigger therefore begins with a lead-in cell; line 0's first position is its second.
- A line that holds several positions gets as many pulses, evenly over its exposure, or what ``wired`` says. Without
  trigger the path is run at (positions of a line) / (frame period), and is the planned one where it begins within half
  a held position of the first exposure.
- Frames count as the line whose planned positions the mirror holds. See :mod:`pipeline.rig.emulator.scene_camera`.
- The frames hold all samples of the camera; binning is the reader's. A capture with the prefix ``references`` has dark
  and white cubes beside its frames.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Sequence
from dataclasses import dataclass

from pipeline.errors import SettingsError
from pipeline.geometry.mirror import STRAIGHT, Mounting
from pipeline.rig.camera.camera_settings import FileServer
from pipeline.rig.camera.headwall_camera import HeadwallCamera
from pipeline.rig.camera.headwall_control import HeadwallControl
from pipeline.rig.clock import SYSTEM_CLOCK, Clock, ManualClock
from pipeline.rig.emulator.camera_device import CameraFaults, CameraUnit
from pipeline.rig.emulator.camera_server import CameraServer, InProcessCameraLine
from pipeline.rig.emulator.mirror_device import MirrorDevice
from pipeline.rig.emulator.mirror_faults import Fault
from pipeline.rig.emulator.mirror_ports import EmulatedPort, InProcessTransport
from pipeline.rig.emulator.mirror_state import MirrorUnit
from pipeline.rig.emulator.scene_camera import Look, SceneCamera, SceneView
from pipeline.rig.survey_rig import Pulses
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
        Of both devices: one turned by hand for :meth:`in_process`, a ``FastClock`` for :meth:`serve`.
    wired
        What pulses the mirror's trigger input gets: one for each held ``position``, each ``frame``, or ``none``.
    look
        Whether frames are seen from where the mirror was sent, or from where its motion has it; see ``SceneCamera``.
    kept
        So many finished captures keep their files; 0 is all.
    mounting
        How the mirror is mounted, whatever drivers believe.
    """

    def __init__(
        self,
        source: SimulatedSource,
        clock: Clock | None = None,
        *,
        mirror_faults: Sequence[Fault] = (),
        camera_faults: CameraFaults | None = None,
        wired: Pulses = "position",
        look: Look = "sent",
        kept: int = 0,
        mirror: MirrorUnit | None = None,
        camera: CameraUnit | None = None,
        mounting: Mounting = STRAIGHT,
    ) -> None:
        self.clock = ManualClock() if clock is None else clock
        self.mirror = MirrorDevice(self.clock, mirror_faults, unit=mirror)
        self.camera = SceneCamera(
            SceneView(source, mounting),
            self.mirror,
            self.clock,
            wired=wired,
            look=look,
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

    def in_process(self, *, baud: int = 0) -> InProcessRig:
        """Give lines to both devices without ports; only the camera's files go through a socket of this machine."""
        return InProcessRig(self, InProcessTransport(self.mirror, self.clock, baud), CameraServer(self.camera))

    def serve(self, *, baud: int = 0, host: str = "127.0.0.1", camera_port: int = 0, file_port: int = 0) -> ServedRig:
        """Open a pty for the mirror, and the camera's sockets; use it as a context, or close it.

        Raises
        ------
        RigError : this system has no ptys, or a port is taken.
        """
        return ServedRig(self, baud, (host, camera_port, file_port))


@dataclass
class InProcessRig:
    """Lines to an emulated rig on a clock that waiting moves. Close it: a thread serves the camera's files."""

    rig: EmulatedRig
    transport: InProcessTransport
    server: CameraServer

    def __enter__(self) -> InProcessRig:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    @property
    def clock(self) -> Clock:
        """Clock of the devices, and of drivers that talk to them."""
        return self.rig.clock

    @property
    def files(self) -> FileServer:
        """Where the camera's files are."""
        return FileServer(self.server.host, self.server.file_port)

    def camera_line(self) -> InProcessCameraLine:
        """Connect to the camera's control."""
        return InProcessCameraLine(self.rig.camera, self.clock)

    def camera(self) -> HeadwallCamera:
        """Give a driver that is connected to the camera."""
        return HeadwallCamera(HeadwallControl(self.camera_line, clock=self.clock), self.files, self.clock)

    def close(self) -> None:
        """Let go of the port for files."""
        self.server.close()


class ServedRig:
    """An emulated rig behind a pty and sockets, from its making to :meth:`close`.

    ``port`` is the mirror's, to be opened as a serial port; the camera listens at ``host``, ``camera_port`` and
    ``file_port``.
    """

    def __init__(self, rig: EmulatedRig, baud: int, address: tuple[str, int, int]) -> None:
        self.rig = rig
        self.host, camera_port, file_port = address
        self._port = EmulatedPort(rig.mirror, baud=baud)
        self.port = self._port.open()
        try:
            self._server = CameraServer(rig.camera, host=self.host, port=camera_port, file_port=file_port)
        except BaseException:
            self._port.close()
            raise
        self.camera_port, self.file_port = self._server.port, self._server.file_port
        rig.camera.aside = True
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._look, name="emulated camera's eye", daemon=True)
        self._thread.start()

    def __enter__(self) -> ServedRig:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

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
