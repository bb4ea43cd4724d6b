"""Opens the drivers that the table [rig] names: the shipped ones, or those of another make by their import path."""

from __future__ import annotations

import inspect
import pkgutil
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, Literal, cast

from pipeline.errors import SettingsError
from pipeline.rig.camera.headwall_camera import HeadwallCamera
from pipeline.rig.capture.capture_runner import RigDevices
from pipeline.rig.device_settings import CameraLimits, SurveyRig
from pipeline.rig.drivers import CameraDriver, MirrorDriver
from pipeline.rig.mirror.mirror_controller import open_mirror
from pipeline.rig.transports import SYSTEM_CLOCK, Clock

Setting = Literal["mirror_driver", "camera_driver"]
Factory = Callable[[SurveyRig, Clock], Any]
_PROTOCOLS: dict[Setting, type] = {"mirror_driver": MirrorDriver, "camera_driver": CameraDriver}


def open_devices(rig: SurveyRig, vector_pairs: int, limits: CameraLimits, clock: Clock = SYSTEM_CLOCK) -> RigDevices:
    """Connect to mirror and camera. Nothing moves.

    Raises
    ------
    SettingsError : a driver of another make cannot be imported, or is none.
    DeviceGone : there is no such port, it is in use, or the camera is not there.
    DeadlinePassed : nothing answers.
    RigError : another device answers.
    """
    with ExitStack() as opened:
        mirror = open_mirror_driver(rig, vector_pairs, clock, known=True)
        opened.callback(mirror.close)
        camera = open_camera_driver(rig, limits, clock)
        opened.callback(camera.close)
        camera.is_capturing()
        opened.pop_all()
    return RigDevices(mirror, camera, clock)


def open_mirror_driver(
    rig: SurveyRig, vector_pairs: int, clock: Clock = SYSTEM_CLOCK, *, known: bool = False
) -> MirrorDriver:
    """Connect to the mirror, as `open_devices`; ``known`` refuses models that the shipped driver does not know."""
    factory = factory_of(rig, "mirror_driver")
    if factory is None:
        return open_mirror(rig.mirror(vector_pairs), clock, known=known)
    return cast("MirrorDriver", _checked(rig, "mirror_driver", factory(rig, clock)))


def open_camera_driver(rig: SurveyRig, limits: CameraLimits, clock: Clock = SYSTEM_CLOCK) -> CameraDriver:
    """Return the camera's driver; raises as `open_devices`. The shipped one connects at its first command."""
    factory = factory_of(rig, "camera_driver")
    if factory is None:
        return HeadwallCamera.at(rig.camera, rig.files, limits=limits, clock=clock)
    return cast("CameraDriver", _checked(rig, "camera_driver", factory(rig, clock)))


def factory_of(rig: SurveyRig, setting: Setting) -> Factory | None:
    """Import the function that opens a driver of another make; None where the settings name the shipped one.

    Raises
    ------
    SettingsError : it cannot be imported, or does not take the table [rig] and a clock.
    """
    name: str = getattr(rig, setting)
    if not name:
        return None
    try:
        factory = pkgutil.resolve_name(name)
    except Exception as error:  # whatever the module of another make does as it is imported
        raise SettingsError(
            f"rig.{setting} = {name!r} cannot be imported ({type(error).__name__}: {error}). Expected module:function "
            "of a package that is installed or of a file in a folder of PYTHONPATH"
        ) from error
    try:
        inspect.signature(factory).bind(rig, SYSTEM_CLOCK)
    except TypeError as error:
        raise SettingsError(
            f"rig.{setting} = {name!r} does not open a driver ({error}). Expected a function of the table [rig] and a "
            "clock"
        ) from error
    return cast("Factory", factory)


def _checked(rig: SurveyRig, setting: Setting, device: object) -> object:
    """Return the device where it has every method of its protocol."""
    protocol = _PROTOCOLS[setting]
    methods = [name for name in vars(protocol) if not name.startswith("_")]
    missing = [name for name in methods if not callable(getattr(device, name, None))]
    if missing:
        raise SettingsError(
            f"rig.{setting} = {getattr(rig, setting)!r} gives a {type(device).__name__} without {', '.join(missing)}. "
            f"Expected every method of {protocol.__name__} in {protocol.__module__}"
        )
    return device
