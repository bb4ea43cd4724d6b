"""A mirror controller from its settings: the port opened, the controller there greeted."""

from __future__ import annotations

from pipeline.rig.clock import SYSTEM_CLOCK, Clock
from pipeline.rig.mirror.mirror_controller import MirrorController
from pipeline.rig.mirror.mirror_settings import MirrorSettings
from pipeline.rig.transports import SerialTransport


def open_mirror(settings: MirrorSettings, clock: Clock = SYSTEM_CLOCK, *, known: bool = False) -> MirrorController:
    """Open the port that the settings name and connect to the controller there, see its connect. Nothing moves.

    Raises
    ------
    DeviceGone : no such port, in use, or not permitted. DeadlinePassed : nothing answers. RigError : another device.
    """
    mirror = MirrorController(SerialTransport(settings.port, settings.baud, clock), settings, clock)
    try:
        mirror.connect(known=known)
    except BaseException:
        mirror.close()
        raise
    return mirror
