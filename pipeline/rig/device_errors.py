"""What devices of the rig fail with; all are RigErrors, and none of them means that a motion may be sent again.

==================  =======================================================================================
error               when
==================  =======================================================================================
DeviceGone          the port is not there, is in use, may not be opened, or went away
DeadlinePassed      no whole answer before the deadline, and nothing can have moved
DeviceRefused       the device answered that it did not do it; ``code`` is its number where it gave one
StateUnknown        a motion was sent and not acknowledged: it may have happened. Motions stay frozen: a person
                    has to look, and to connect anew
NotKept             the disk here did not take what a device sent; the device still has it
RigError            everything else: an answer that is not one, a wrong device, a path that was not kept
==================  =======================================================================================
"""

from __future__ import annotations

from pipeline.errors import RigError


class DeviceGone(RigError):  # noqa: N818 - the name says what is the case
    """A device is not there, or went away."""


class DeadlinePassed(RigError):  # noqa: N818 - the name says what is the case
    """A device did not answer in time, and nothing can have moved; ``silent`` says that not a byte came."""

    def __init__(self, message: str, *, silent: bool = False) -> None:
        super().__init__(message)
        self.silent = silent


class DeviceRefused(RigError):  # noqa: N818 - the name says what is the case
    """A device answered that it did not do what was asked; ``code`` is the number it gave.

    ``garbled`` says that it did not get the request whole: what only reads may be asked again.
    """

    def __init__(self, message: str, code: int | None = None, *, garbled: bool = False) -> None:
        super().__init__(message)
        self.code = code
        self.garbled = garbled


class StateUnknown(RigError):  # noqa: N818 - the name says what is the case
    """A device may or may not have moved; motions are frozen until somebody connects anew."""


class NotKept(RigError):  # noqa: N818 - the name says what is the case
    """What a device sent could not be kept here: the disk refuses. The device still has it."""
