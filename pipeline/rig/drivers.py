"""Protocols of a rig's two devices: all that a survey asks of a mirror and of a camera of any maker.

`MirrorController` and `HeadwallCamera` implement them. Times are those of the clock that a driver was opened with.
Methods raise `RigError` or one of its kinds in :mod:`pipeline.rig.transports`; besides those every method may raise
`DeviceGone` and `DeadlinePassed`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from numpy.typing import ArrayLike

from pipeline.rig.camera.camera_cubes import CapturedLines, MeanFrame
from pipeline.rig.camera.camera_files import Kept
from pipeline.rig.camera.camera_files import Progress as FetchProgress
from pipeline.rig.mirror.mirror_controller import MotionLog
from pipeline.rig.mirror.mirror_controller import Progress as LoadProgress
from pipeline.rig.mirror.pro_mode import Trigger


class MirrorDriver(Protocol):
    """A two-axis mirror that holds a position, or plays a list of them.

    Positions are X and Y on the unit disk, 1 at the rim, of a mirror mounted straight. A driver turns them into the
    device's own by ``rig.mounting``. `load_path` gets at most ``cost.vector_pairs`` of them.
    """

    def goto(self, x: float, y: float) -> None:
        """Send the mirror to a position and hold it there; return once it is acknowledged, not at rest.

        Raises
        ------
        PoseError : the position lies outside the disk; nothing was sent.
        StateUnknown : the motion was sent and not acknowledged.
        """

    def settle(self, within_s: float) -> None:
        """Wait at most ``within_s`` seconds until the mirror is at rest.

        Raises
        ------
        RigError : it is not at rest by then, or not where it was sent.
        """

    def load_path(self, positions: ArrayLike, *, progress: LoadProgress | None = None) -> None:
        """Store positions (position, 2) for `run`. Nothing moves.

        Parameters
        ----------
        progress
            Called with cells done and cells in all; cells are X and Y of each position.

        Raises
        ------
        PoseError : a position lies outside the disk.
        SettingsError : the device holds fewer positions.
        """

    def run(self, first: int, stop: int, rate_hz: float, cycles: int = 1, trigger: Trigger = Trigger.OFF) -> None:
        """Play the loaded positions ``first`` to ``stop``, half open, ``cycles`` times.

        Parameters
        ----------
        rate_hz
            Positions a second by the device's own clock, where ``trigger`` is OFF.
        trigger
            Which edges at the trigger input step to the next position instead; the first is taken at once.

        Raises
        ------
        StateUnknown : the motion was sent and not acknowledged.
        """

    def halt(self) -> None:
        """Stop playing; the mirror stays where it is. A mirror that plays nothing is left alone."""

    def index(self) -> int:
        """Return the loaded position that plays now, or played last, counted from 0."""

    def start_log(self, rate_hz: float) -> None:
        """Start to log measured positions ``rate_hz`` times a second."""

    def read_log(self) -> MotionLog:
        """End the log and return it: positions (sample, 2), their rate, and when the first was taken.

        Raises
        ------
        RigError : no log was started.
        """

    def close(self) -> None:
        """Close the connection to the device."""


@dataclass(frozen=True)
class Capture:
    """A capture that the camera acknowledged."""

    folder: str
    sent_s: float  # when the command was sent, by the clock of the rig's drivers
    acknowledged_s: float  # when its reply was whole: exposures began between the two, or soon after


@dataclass(frozen=True)
class FrameClaim:
    """The size that was asked for: frames, in all files of a capture, of so many numbers of 16 bits."""

    frames: int
    samples: int
    bands: int

    @property
    def frame_bytes(self) -> int:
        """Bytes of a frame."""
        return 2 * self.samples * self.bands


class CameraDriver(Protocol):
    """A line camera that captures a number of frames at a steady rate and keeps them until they are fetched."""

    def configure(self, exposure_ms: float, frame_period_ms: float) -> None:
        """Set exposure and frame period of later captures. [ms]

        Raises
        ------
        SettingsError : the camera does not take such times.
        """

    def capture(self, frames: int, *, prefix: str = "") -> Capture:
        """Begin a capture of ``frames`` frames; return once the camera acknowledged it.

        Parameters
        ----------
        prefix
            Up to 64 letters, digits, - and _ that the capture's name begins with. ``references`` asks for dark and
            white frames beside it, see `references`.

        Raises
        ------
        StateUnknown : it was asked for and not acknowledged; it may run.
        """

    def is_capturing(self) -> bool:
        """Return whether a capture runs, or is still being written."""

    def stop(self) -> bool:
        """End a capture; return False where none ran."""

    def fetch(
        self, folder: str, kept: Kept, progress: FetchProgress | None = None, *, claim: FrameClaim | None = None
    ) -> CapturedLines:
        """Return a finished capture's lines (line, sample, band) uint16, with their frames' numbers and stamps [us].

        Parameters
        ----------
        folder
            As `capture` returned it; it may have been captured by an earlier process.
        kept
            Where a driver may keep what it fetches, so that a later call continues.
        progress
            Called with a file's name, bytes held and bytes in all.
        claim
            The size that the capture can have.

        Raises
        ------
        RigError : the capture still runs, is damaged, or is larger than ``claim``.
        DeviceRefused : the camera does not have it any more.
        """

    def references(self, folder: str, kept: Kept, *, claim: FrameClaim | None = None) -> dict[str, MeanFrame]:
        """Return the mean frames (sample, band) beside a capture, by ``dark`` and ``white``; empty without any."""

    def close(self) -> None:
        """Close the connection to the camera; a capture continues."""
