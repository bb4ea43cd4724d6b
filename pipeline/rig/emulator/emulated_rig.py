"""A whole emulated rig: mirror and camera on one clock, the camera's exposures at the mirror's trigger, and a scene.

A planned sweep that is announced (by a capture's prefix, :func:`pipeline.rig.capture.capture_paths.capture_prefix`),
loaded and played gives the simulated source's lines, bit for bit; see :mod:`pipeline.rig.emulator.scene_camera`. A path
that is played by trigger begins with a lead-in cell: the mirror takes the first as it is run, and one more at each
rising edge. Without trigger it is run at (positions of a line) / (frame period), and is the planned one where it begins
within half a held position of the first exposure. A capture with the prefix ``references`` has dark and white cubes.

The mirror's controller hangs on a pty, which is opened as a real port is.
"""

from __future__ import annotations

import heapq
import logging
import os
import select
import threading
import tty
from dataclasses import dataclass
from itertools import count

from pipeline.errors import RigError, SettingsError
from pipeline.geometry.mirror import STRAIGHT, Mounting
from pipeline.rig.device_settings import Pulses
from pipeline.rig.devices import SYSTEM_CLOCK, Clock, Closing
from pipeline.rig.emulator import Chunk
from pipeline.rig.emulator.camera_device import CameraUnit
from pipeline.rig.emulator.camera_server import CameraServer
from pipeline.rig.emulator.mirror_device import MirrorDevice
from pipeline.rig.emulator.mirror_state import MirrorUnit
from pipeline.rig.emulator.scene_camera import SceneCamera, SceneView
from pipeline.rig.transports import BITS_PER_BYTE
from pipeline.simulator.simulated import SimulatedSource

LOG = logging.getLogger(__name__)
_AT_ONCE = 4096  # bytes
_RETRY_S = 0.005  # of a user who does not read
_NAP_S = 0.01


class EmulatedPort(Closing):
    """A pty and the thread that serves it, from :meth:`open` to :meth:`close`; use it as a context.

    The device's clock paces the bytes, too. ``baud`` is the speed in both directions; 0 lets bytes through as they
    come: USB ports do that whatever their speed says.
    """

    def __init__(self, device: MirrorDevice, *, baud: int = 0) -> None:
        self.device, self.baud = device, baud
        self.path = ""
        self._master = self._slave = self._wake = -1
        self._thread: threading.Thread | None = None

    def __enter__(self) -> EmulatedPort:
        self.open()
        return self

    def open(self) -> str:
        """Make the pty, serve it, and give the name that users open; RigError where this system has no ptys."""
        if self._thread is not None:
            raise RigError(f"the emulated port {self.path} is open; close it first")
        try:
            self._master, self._slave = os.openpty()
            tty.setraw(self._slave)  # else line discipline would echo, and turn CR into LF
        except OSError as error:
            raise RigError(f"no pty for the emulated port: {error}; ptys are there on Linux and macOS") from error
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        read_end, self._wake = os.pipe()
        self._thread = threading.Thread(target=self._serve, args=(read_end,), name="emulated mirror port", daemon=True)
        self._thread.start()
        return self.path

    def close(self) -> None:
        """End the thread and let go of the pty; users of the port see the device go. Nothing where it is closed."""
        if self._thread is None:
            return
        os.close(self._wake)
        self._thread.join()
        self._thread = None

    def _serve(self, read_end: int) -> None:
        try:
            _Line(self.device, self._master, self.baud).serve(read_end)
        except OSError as error:
            LOG.info("%s: the device went away (%s)", self.path, error)
        except Exception:
            LOG.exception("the emulated controller on %s failed", self.path)
        finally:
            for descriptor in (self._master, self._slave):
                os.close(descriptor)
            select.select([read_end], [], [])  # until close() is called
            os.close(read_end)


class _Line:
    """Bytes between the master's end of a pty and a device, at the pace of the device's clock."""

    def __init__(self, device: MirrorDevice, master: int, baud: int) -> None:
        self._device, self._master = device, master
        self._byte_s = BITS_PER_BYTE / baud if baud else 0.0
        self._order = count()
        self._in: list[tuple[float, int, bytes]] = []  # when it reached the device
        self._out: list[tuple[float, int, bytes]] = []
        self._in_free_s = self._out_free_s = 0.0

    def serve(self, stop: int) -> None:
        """Carry bytes until ``stop`` is closed at its other end; OSError where the device goes away."""
        while True:
            ready, _, _ = select.select([stop, self._master], [], [], self._patience())
            if stop in ready:
                return
            if self._master in ready:
                self._take(os.read(self._master, _AT_ONCE))
            while self._in and self._in[0][0] <= self._device.clock.now():
                due, _, data = heapq.heappop(self._in)
                self._schedule(self._device.receive(data), due)  # not from now: waking late is not the device's doing
            self._deliver()

    def _take(self, data: bytes) -> None:
        self._in_free_s = max(self._device.clock.now(), self._in_free_s) + len(data) * self._byte_s
        heapq.heappush(self._in, (self._in_free_s, next(self._order), data))

    def _schedule(self, chunks: list[Chunk], since_s: float) -> None:
        for delay_s, data in chunks:
            due = since_s + delay_s
            if self._byte_s:
                due = self._out_free_s = max(due, self._out_free_s) + len(data) * self._byte_s
            heapq.heappush(self._out, (due, next(self._order), data))

    def _deliver(self) -> None:
        """Write what is due; what a user does not take waits."""
        while self._out and self._out[0][0] <= self._device.clock.now():
            due, order, data = heapq.heappop(self._out)
            try:
                written = os.write(self._master, data)
            except BlockingIOError:
                written = 0
            if written < len(data):
                heapq.heappush(self._out, (due, order, data[written:]))
                return

    def _patience(self) -> float | None:
        """Real time until something is due; None where nothing is."""
        waiting = [queue[0][0] for queue in (self._in, self._out) if queue]
        if not waiting:
            return None
        left = (min(waiting) - self._device.clock.now()) / getattr(self._device.clock, "speed", 1.0)
        return left if left > 0 else _RETRY_S if self._out and self._out[0][0] <= min(waiting) else 0.0


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
    mode: str  # simple, pro, or pro with requests checked
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

    A subclass may have devices and servers of other kinds, such as ones that fail.
    """

    mirror_kind = MirrorDevice
    camera_kind = SceneCamera
    server_kind = CameraServer

    def __init__(
        self,
        source: SimulatedSource,
        clock: Clock,
        *,
        wired: Pulses = "position",
        kept: int = 0,
        mirror: MirrorUnit | None = None,
        camera: CameraUnit | None = None,
        mounting: Mounting = STRAIGHT,
    ) -> None:
        self.clock = clock
        self.mirror = self.mirror_kind(self.clock, unit=mirror)
        view = SceneView(source, mounting)
        self.camera = self.camera_kind(view, self.mirror, self.clock, wired=wired, kept=kept, unit=camera)
        self.mirror.pulses = self.camera.pulses

    def seen(self) -> RigState:
        """Say what both devices do now."""
        x, y = self.mirror.positions(self.clock.now())
        last = self.mirror.acts[-1].request.words if self.mirror.acts else ""
        return RigState(
            (float(x), float(y)), self.mirror.mode.value, last, self.camera.is_capturing(), len(self.camera.captures)
        )

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
            self._server = rig.server_kind(rig.camera)
        except BaseException:
            self._port.close()
            raise
        self.host, self.camera_port, self.file_port = self._server.host, self._server.port, self._server.file_port
        rig.camera.aside = True
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._poll, name="emulated camera's eye", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Let go of the pty and the sockets; whoever is connected sees the devices go."""
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
