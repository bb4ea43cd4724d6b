"""Protocols of a rig's two devices, for a mirror and a camera of any make, and the functions that open their drivers.

`MirrorController` and `HeadwallCamera` implement them, and the fakes of `pipeline.rig.fakes`. The table [rig] may name
the drivers of another make by their import path. Times are those of the clock that a driver was opened with. Every
method may raise `DeviceGone` and `DeadlinePassed`, besides the errors that it states; all are kinds of `RigError`. Any
other exception of a driver of another make is raised as `DriverFailed`.
"""

from __future__ import annotations

import logging
import pkgutil
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import ArrayLike

from spectralzoom.pipeline.errors import PipelineError, RigError, SettingsError
from spectralzoom.pipeline.rig.camera.camera_cubes import CapturedLines, MeanFrame
from spectralzoom.pipeline.rig.camera.camera_files import Capture, Kept, Progress
from spectralzoom.pipeline.rig.camera.headwall_camera import HeadwallCamera
from spectralzoom.pipeline.rig.device_settings import CONTROL_PORT, FAKE, SurveyRig
from spectralzoom.pipeline.rig.fakes import FakeCamera, FakeClock, FakeMirror
from spectralzoom.pipeline.rig.mirror_controller import MirrorController
from spectralzoom.pipeline.rig.transports import SYSTEM_CLOCK, Clock, SerialTransport, SocketTransport, check_port
from spectralzoom.pipeline.simulator.simulated import SimulatedSource

__all__ = ["CameraDriver", "Capture", "MirrorDriver", "RigDevices", "open_devices"]
LOG = logging.getLogger(__name__)
NO_PORT = "none"  # cannot be opened


class MirrorDriver(Protocol):
    """A two-axis mirror that holds a position, or plays a list of them.

    Positions are X and Y on the unit disk, 1 at the rim, of a mirror mounted straight. A driver turns them into the
    device's own by ``rig.mounting``. `load_path` gets at most ``cost.vector_pairs`` of them.
    """

    def goto(self, x: float, y: float) -> None:
        """Send the mirror to a position and hold it there; return once it is acknowledged, not at rest.

        Raises PoseError: the position lies outside the disk; nothing was sent. Raises StateUnknown: the motion was sent
        and not acknowledged.
        """

    def settle(self, within_s: float) -> None:
        """Wait at most ``within_s`` seconds until the mirror is at rest.

        Raises RigError: it is not at rest by then, or not where it was sent.
        """

    def load_path(self, positions: ArrayLike) -> None:
        """Store positions (position, 2) for `run`. Nothing moves; a path that plays is halted.

        Raises PoseError: a position lies outside the disk. Raises SettingsError: the device holds fewer positions.
        """

    def run(self, rate_hz: float) -> None:
        """Play the loaded positions once, ``rate_hz`` a second by the device's own clock.

        Raises StateUnknown: the motion was sent and not acknowledged.
        """

    def halt(self) -> None:
        """Stop playing; the mirror stays where it is. A mirror that plays nothing is left alone."""

    def close(self) -> None:
        """Close the connection to the device."""


class CameraDriver(Protocol):
    """A line camera that captures a number of frames at a steady rate and keeps them until they are fetched."""

    def configure(self, exposure_ms: float, frame_period_ms: float) -> None:
        """Set exposure and frame period of later captures. [ms]

        Raises SettingsError: the camera does not take such times.
        """

    def capture(self, frames: int, *, prefix: str = "") -> Capture:
        """Begin a capture of ``frames`` frames; return once the camera acknowledged it.

        Its name begins with ``prefix``, up to 128 letters, digits, - and _. ``references`` asks for dark and white
        frames beside it, see `references`.

        Raises StateUnknown: it was asked for and not acknowledged; it may run.
        """

    def is_capturing(self) -> bool:
        """Return whether a capture runs, or is still being written."""

    def stop(self) -> None:
        """End a capture, if one runs."""

    def fetch(self, folder: str, kept: Kept, progress: Progress | None = None) -> CapturedLines:
        """Return a finished capture's lines (line, sample, band) uint16, with their frames' numbers and stamps [us].

        ``folder`` is as `capture` returned it, maybe in an earlier process. A driver may keep in ``kept`` what it
        fetches, so that a later call continues. ``progress`` gets a file's name, bytes held and bytes in all.

        Raises RigError: the capture still runs, or is damaged. Raises DeviceRefused: the camera does not have it any
        more.
        """

    def references(self, folder: str, kept: Kept) -> dict[str, MeanFrame]:
        """Return the mean frames (sample, band) beside a capture, by ``dark`` and ``white``; empty without any."""

    def close(self) -> None:
        """Close the connection to the camera; a capture continues."""


@dataclass(frozen=True)
class RigDevices:
    """Both devices, connected, and the clock of their drivers."""

    steering: MirrorDriver
    camera: CameraDriver
    clock: Clock

    def close(self) -> None:
        """Close both devices, whatever either raises."""
        for device in (self.steering, self.camera):
            try:
                device.close()
            except RigError as error:
                LOG.warning("while closing the rig: %s", error)


def open_devices(rig: SurveyRig, vector_pairs: int, seen: SimulatedSource | None = None) -> RigDevices:
    """Connect to mirror and camera. Nothing moves. ``seen`` is the scene before a fake camera.

    Raises SettingsError: a driver of another make cannot be imported, or is none. Raises DeviceGone: there is no such
    port, it is in use, or the camera is not there. Raises DeadlinePassed: nothing answers. Raises RigError: another
    device answers.
    """
    clock = FakeClock() if rig.mirror_driver == rig.camera_driver == FAKE else SYSTEM_CLOCK
    with ExitStack() as opened:
        mirror = open_mirror_driver(rig, vector_pairs, clock)
        opened.callback(mirror.close)
        camera = open_camera_driver(rig, clock, seen)
        opened.callback(camera.close)
        camera.is_capturing()
        opened.pop_all()
    return RigDevices(mirror, camera, clock)


def open_mirror_driver(rig: SurveyRig, vector_pairs: int, clock: Clock = SYSTEM_CLOCK) -> MirrorDriver:
    """Connect to the mirror, as `open_devices`."""
    if rig.mirror_driver == FAKE:
        return FakeMirror(clock, vector_pairs)
    if rig.mirror_driver:
        return cast("MirrorDriver", _open_other(rig, "mirror_driver", MirrorDriver, clock))
    mirror = MirrorController(SerialTransport(rig.port, clock), rig, clock, vector_pairs=vector_pairs)
    with ExitStack() as opened:
        opened.callback(mirror.close)
        mirror.connect()
        opened.pop_all()
    return mirror


def open_camera_driver(
    rig: SurveyRig, clock: Clock = SYSTEM_CLOCK, seen: SimulatedSource | None = None
) -> CameraDriver:
    """Return the camera's driver; raises as `open_devices`. The shipped one connects at its first command."""
    if rig.camera_driver == FAKE:
        return FakeCamera(clock, seen)
    if rig.camera_driver:
        return cast("CameraDriver", _open_other(rig, "camera_driver", CameraDriver, clock))
    return HeadwallCamera(lambda: SocketTransport(rig.host, CONTROL_PORT, clock), rig.files, clock=clock)


def check_devices(rig: SurveyRig) -> None:
    """Import the drivers of another make, and check the form of the port; nothing is opened.

    `NO_PORT` is of a survey whose lines are stored. Raises SettingsError: a driver cannot be imported, or the text
    names no port.
    """
    if not rig.mirror_driver and rig.port != NO_PORT:
        check_port(rig.port)
    for setting in ("mirror_driver", "camera_driver"):
        if getattr(rig, setting) not in ("", FAKE):
            _imported(rig, setting)


def _imported(rig: SurveyRig, setting: str) -> Callable[[SurveyRig, Clock], object]:
    name: str = getattr(rig, setting)
    try:
        return cast("Callable[[SurveyRig, Clock], object]", pkgutil.resolve_name(name))
    except Exception as error:  # whatever the module of another make does as it is imported
        raise SettingsError(
            f"rig.{setting} = {name!r} cannot be imported ({type(error).__name__}: {error}). Expected module:function "
            "of a package that is installed or of a file in a folder of PYTHONPATH"
        ) from error


def _open_other(rig: SurveyRig, setting: str, protocol: type, clock: Clock) -> object:
    """Open a driver of another make, and check that it has every method of its protocol."""
    factory, name = _imported(rig, setting), getattr(rig, setting)
    try:
        device = factory(rig, clock)
    except PipelineError:
        raise
    except Exception as error:
        raise (SettingsError if isinstance(error, TypeError) else DriverFailed)(
            f"rig.{setting} = {name!r} does not open a driver ({type(error).__name__}: {error}). Expected a function "
            "of the table [rig] and a clock, and a device that answers"
        ) from error
    missing = [one for one in vars(protocol) if not one.startswith("_") and not callable(getattr(device, one, None))]
    if missing:
        raise SettingsError(
            f"rig.{setting} = {name!r} gives a {type(device).__name__} without {', '.join(missing)}. Expected every "
            f"method of {protocol.__name__} in {protocol.__module__}"
        )
    return OtherMake(device, name)


class DriverFailed(RigError):  # noqa: N818 - the name states the case
    """A driver of another make raised an exception of its own, or returned what its protocol does not allow."""


@dataclass(frozen=True)
class OtherMake:
    """A driver of another make, ``name`` as in the settings, that is named where it fails or answers wrongly."""

    device: object
    name: str

    def __getattr__(self, method: str) -> Callable[..., object]:
        return partial(_call, self.name, method, getattr(self.device, method))


def _call(name: str, method: str, called: Callable[..., object], *given: object, **named: object) -> object:
    """Call a driver's method; DriverFailed in place of any exception that has no message for the user."""
    try:
        answer = called(*given, **named)
        _check_answer(method, answer)
    except PipelineError:
        raise
    except Exception as error:
        cause = f"{type(error).__name__}: {error}"
        raise DriverFailed(f"{name}: {method} failed ({cause}); look at the device, or mend the driver") from error
    return answer


_TYPES: dict[str, Any] = {"capture": Capture, "is_capturing": bool, "fetch": CapturedLines, "references": dict}


def _check_answer(method: str, answer: object) -> None:
    """Check type, shape and numbers of an answer of a driver; TypeError where the protocol does not allow them."""
    if not isinstance(answer, expected := _TYPES.get(method, object)):
        raise TypeError(f"expected {expected.__name__}, got {type(answer)}")
    if isinstance(answer, CapturedLines):
        values, times = answer.values, answer.times
        if values.ndim != 3 or values.dtype != np.uint16:
            raise TypeError(f"expected (line, sample, band) uint16, got {values.shape} {values.dtype.str}")
        for one in (times.frame, times.stamp_us):
            if one.shape != values.shape[:1] or one.dtype.kind != "i":
                raise TypeError(f"expected {len(values)} int64 numbers and stamps, got {one.shape} {one.dtype}")
    for kind, one in answer.items() if isinstance(answer, dict) else ():
        if not isinstance(one, MeanFrame) or one.mean.ndim != 2 or one.stuck.shape != one.mean.shape:
            raise TypeError(f"expected a MeanFrame (sample, band) of {kind}, got {type(one)}")
