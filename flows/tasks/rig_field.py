"""Open the rig of a survey. Imported only for a rig, since drivers import pyserial."""

from __future__ import annotations

import errno
import hashlib
import os
import socket
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from spectralzoom.flows.settings.settings import Settings
from spectralzoom.flows.settings.values import RIG
from spectralzoom.flows.stage import inside_flow
from spectralzoom.flows.tasks.scene import FieldSource
from spectralzoom.pipeline.errors import RigError
from spectralzoom.pipeline.geometry.mirror import STRAIGHT
from spectralzoom.pipeline.geometry.scan import Sweep, exposing, sweep_positions
from spectralzoom.pipeline.rig import drivers
from spectralzoom.pipeline.rig.camera.camera_files import KeptInMemory
from spectralzoom.pipeline.rig.device_settings import FAKE, check_times
from spectralzoom.pipeline.rig.drivers import RigDevices
from spectralzoom.pipeline.rig.rig_source import RigSource
from spectralzoom.pipeline.simulator.effects.effect import Effect
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene
from spectralzoom.pipeline.simulator.simulated import SimulatedSource
from spectralzoom.pipeline.source import Source
from spectralzoom.storage.arrays.spool import FetchedFiles
from spectralzoom.storage.store import array_digest

FETCHED = "camera"  # folder within a capture's spool
RIG_LIMIT = "rig"  # Prefect's global concurrency limit, where the server has one of that name
LEASE_S = 60  # until a lost process frees that limit
TRY_S = 10  # between two tries to get it


class RigHold:
    """The rig of this machine, which a survey locks at its first capture until it ends."""

    def __init__(self, port: str | None) -> None:
        self.port = port  # None: nothing to lock
        self._held: ExitStack | None = None
        self._taken = False
        self._note: Callable[[str], None] = lambda text: None

    @contextmanager
    def released(self, note: Callable[[str], None]) -> Iterator[None]:
        """Release the rig when the block ends, if it was taken."""
        self._note = note
        with ExitStack() as self._held:
            yield
        self._held, self._taken = None, False

    def take(self) -> None:
        """Lock the rig, unless this survey has it. Raises RigError: another survey uses the rig.

        Inside a flow, the survey first waits for the global concurrency limit ``rig`` of the Prefect server, if there
        is one.
        """
        if self._held is None or self._taken or self.port is None:
            return
        while inside_flow():  # signals are handled between tries
            from prefect.concurrency.sync import concurrency

            try:
                limit = concurrency(RIG_LIMIT, occupy=1, lease_duration=LEASE_S, timeout_seconds=TRY_S)
                self._held.enter_context(limit)
                break
            except TimeoutError:
                self._note(f"waits for the rig: another survey has it, or was killed less than {LEASE_S} s ago")
        self._held.enter_context(rig_to_oneself(self.port))
        self._taken = True


@dataclass(frozen=True)
class RigField(FieldSource):
    """Rig of the settings; files of its camera are kept beside the lines."""

    rig: RigSource
    hold: RigHold
    name = RIG

    def key(self, field: str) -> dict[str, Any]:
        rig = self.rig.rig
        white = {"white_reference": rig.white_reference, "white_at_rest": rig.white_at_rest}
        bands = {"wavelengths": array_digest(np.asarray(self.rig.wavelength_nm, np.float64))}
        return {"field": field, **white, **bands} | (
            {} if rig.mounting == STRAIGHT else {"mounting": asdict(rig.mounting)}
        )

    def check(self, sweeps: Sequence[Sweep]) -> None:
        """Check that camera and mirror allow the sweeps.

        Raises SettingsError: the camera does not allow an exposure or frame time; PoseError: the field exceeds the
        mirror's range.
        """
        camera, mounting = self.rig.camera, self.rig.rig.mounting
        for exposed in {exposing(camera, sweep) for sweep in sweeps} | {camera}:
            check_times(exposed.exposure_ms, exposed.frame_ms, camera.max_rate_hz)
        for sweep in sweeps if mounting != STRAIGHT else ():
            mounting.to_device(sweep_positions(sweep, camera))

    def saying(self, say: Callable[[str], None]) -> RigField:
        return replace(self, rig=self.rig.saying(say))

    @contextmanager
    def to_oneself(self, note: Callable[[str], None]) -> Iterator[None]:
        with self.hold.released(note):
            yield

    @contextmanager
    def opened(self, spool: Path) -> Iterator[Source]:
        self.hold.take()
        source = self.rig.keeping(FetchedFiles(spool / FETCHED))
        with source.session():
            yield source


@dataclass(frozen=True)
class SimulatedRigField(RigField):
    """Rig with a fake camera, which sees the light of a simulated scene."""

    settings: Settings
    simulated: SimulatedSource
    simulates = True

    def lit(self, chosen: Mapping[Effect, str], clock: Mapping[str, float]) -> RigField:
        seen = replace(self.simulated, chosen=chosen, clock=clock)
        return RigField(self.rig.opening(lambda: open_devices(self.settings, seen=seen)), self.hold)


def rig_field(scene: RasterScene, settings: Settings, simulated: SimulatedSource) -> RigField:
    """Return the rig, not connected and no driver imported. A fake camera sees the scene and its white reference."""
    fake = settings.rig.camera_driver == FAKE
    white = float(scene.white_reference.mean()) if fake else settings.rig.white_reference
    rig = RigSource(
        settings.camera,
        scene.wavelength_nm,
        scene.shape,
        lambda: open_devices(settings),
        KeptInMemory(),
        rig=replace(settings.rig, white_reference=round(white, 6)),
        vector_pairs=settings.cost.vector_pairs,
    )
    hold = RigHold(settings.rig.port if settings.on_hardware else None)
    return SimulatedRigField(rig, hold, settings, simulated) if fake else RigField(rig, hold)


@contextmanager
def rig_to_oneself(port: str) -> Iterator[None]:
    """Lock the rig at a port for the block; the same rig for all names of one device.

    The lock is an abstract socket of Linux (unix(7)), without a file. All users of the machine see it, and the kernel
    releases it when the process ends. Drivers also lock a serial port itself. Raises RigError: another
    survey has the lock, or the kernel does not support it.
    """
    device = os.path.realpath(port) if port.startswith("/") else port.lower()
    name = f"\0spectralzoom-rig-{hashlib.sha256(device.encode()).hexdigest()[:32]}"
    with ExitStack() as held:
        try:
            held.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)).bind(name.encode())
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                raise RigError(
                    f"the rig at {port} is in use by another survey; wait until that has ended, or end it"
                ) from error
            raise RigError(
                f"cannot lock the rig at {port}: {error.strerror}; surveys of a rig need Linux's abstract sockets"
            ) from error
        yield


def open_devices(settings: Settings, seen: SimulatedSource | None = None) -> RigDevices:
    """Connect to mirror and camera, as `pipeline.rig.drivers.open_devices` does. Nothing moves."""
    return drivers.open_devices(settings.rig, settings.cost.vector_pairs, seen=seen)
