"""Open the rig of a survey, and keep other surveys from it."""

from __future__ import annotations

import errno
import hashlib
import os
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from typing import TYPE_CHECKING

from spectralzoom.flows.local_server import server_answers
from spectralzoom.flows.observer import current_observer
from spectralzoom.flows.settings.settings import Settings
from spectralzoom.flows.stage import inside_flow
from spectralzoom.pipeline.errors import RigError
from spectralzoom.pipeline.geometry.mirror import STRAIGHT
from spectralzoom.pipeline.geometry.scan import Sweep, exposing, sweep_positions
from spectralzoom.pipeline.rig.device_settings import FAKE, check_times
from spectralzoom.pipeline.simulator.simulated import SimulatedSource
from spectralzoom.storage.arrays.spool import FetchedFiles

if TYPE_CHECKING:
    from spectralzoom.pipeline.rig.rig_source import RigSource

RIG_LIMIT = "rig"  # Prefect's global concurrency limit, where the server has one of that name
LEASE_S = 60  # until a lost process frees that limit
TRY_S = 10  # between two tries to get it


class RigHold:
    """The rig of this machine, which a survey locks at its first capture until the end of the block.

    Without a ``port`` there is nothing to lock. ``note`` gets what the survey waits for.
    """

    def __init__(self, port: str | None, note: Callable[[str], None]) -> None:
        self.port = port
        self._note = note
        self._held = ExitStack()
        self._taken = False

    def __enter__(self) -> RigHold:
        return self

    def __exit__(self, *_: object) -> None:
        self._held.close()
        self._taken = False

    def take(self) -> None:
        """Lock the rig, unless this survey has it. Raises RigError: another survey uses the rig.

        Inside a flow, the survey first waits for the global concurrency limit ``rig`` of the Prefect server, if there
        is one and the server answers.
        """
        if self._taken or self.port is None:
            return
        while inside_flow() and server_answers():  # signals are handled between tries
            from prefect.concurrency.sync import concurrency

            self._held.enter_context(suppress(Exception))  # the server frees the limit of one that cannot leave
            try:
                limit = concurrency(RIG_LIMIT, occupy=1, lease_duration=LEASE_S, timeout_seconds=TRY_S)
                self._held.enter_context(limit)
                break
            except TimeoutError:
                self._note(f"waits for the rig: another survey has it, or was killed less than {LEASE_S} s ago")
        self._held.enter_context(rig_to_oneself(self.port))
        self._taken = True


def check_rig(settings: Settings, sweeps: Sequence[Sweep]) -> None:
    """Check that camera and mirror of a rig allow the sweeps.

    Raises SettingsError: the camera does not allow an exposure or frame time; PoseError: the field exceeds the
    mirror's range.
    """
    camera, mounting = settings.camera, settings.rig.mounting
    for exposed in {exposing(camera, sweep) for sweep in sweeps} | {camera}:
        check_times(exposed.exposure_ms, exposed.frame_ms, camera.max_rate_hz)
    for sweep in sweeps if mounting != STRAIGHT else ():
        mounting.to_device(sweep_positions(sweep, camera))


def rig_source(settings: Settings, name: str, simulated: SimulatedSource, hold: RigHold) -> RigSource:
    """Return the rig before the field ``name``, not connected and no driver imported.

    A fake camera sees what ``simulated`` does, and its white reference.
    """
    from spectralzoom.pipeline.rig import drivers  # imports pyserial
    from spectralzoom.pipeline.rig.rig_source import RigSource

    rig, scene = settings.rig, simulated.scene
    fake = rig.camera_driver == FAKE

    def connect(seen: SimulatedSource | None) -> drivers.RigDevices:
        hold.take()
        return drivers.open_devices(rig, settings.cost.vector_pairs, seen=seen)

    return RigSource(
        settings.camera,
        scene.wavelength_nm,
        connect,
        FetchedFiles,
        rig=replace(rig, white_reference=round(float(scene.white_reference.mean()), 6)) if fake else rig,
        vector_pairs=settings.cost.vector_pairs,
        field_name=name,
        seen=simulated if fake else None,
        say=current_observer().say,
        note=current_observer().note,
    )


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
