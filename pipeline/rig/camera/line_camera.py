"""What a line camera's driver does for a survey, whatever the camera: configure, capture, poll, fetch, references."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from pipeline.rig.camera.camera_cubes import CapturedLines
from pipeline.rig.camera.camera_files import Kept, Progress
from pipeline.rig.camera.camera_references import MeanFrame
from pipeline.rig.device_errors import StateUnknown


@dataclass(frozen=True)
class Capture:
    """A capture that the camera acknowledged."""

    folder: str
    sent_s: float  # when the command was sent, by the clock of the rig's drivers
    acknowledged_s: float  # when its reply was whole: exposures began between the two, or soon after
    frames: int  # asked for in each cube; 0: the camera's own number
    cubes: int  # asked for; 0: until it is stopped


class CaptureUnknown(StateUnknown):
    """A capture was sent and not acknowledged; what was found on asking stands in the message and here."""

    def __init__(self, message: str, *, capturing: bool | None = None, folders: tuple[str, ...] = ()) -> None:
        super().__init__(message)
        self.capturing = capturing  # None where the camera did not say
        self.folders = folders  # that were not there before


@dataclass(frozen=True)
class FrameClaim:
    """What a capture was asked for: frames, in all its cubes, of so many numbers of 16 bits."""

    frames: int
    samples: int
    bands: int

    @property
    def frame_bytes(self) -> int:
        """Bytes of a frame."""
        return 2 * self.samples * self.bands


class LineCameraDevice(Protocol):
    """A line camera behind a driver."""

    def configure(self, exposure_ms: float, frame_period_ms: float) -> None:
        """Set both times; refused before the wire where they cannot be meant."""

    def capture(self, frames: int, *, cubes: int = 1, prefix: str = "") -> Capture:
        """Begin to take lines. Sent once, whatever happens."""

    def is_capturing(self) -> bool:
        """Whether lines are being taken."""

    def stop(self) -> bool:
        """End a capture; False where none ran."""

    def fetch(
        self, folder: str, kept: Kept, progress: Progress | None = None, *, claim: FrameClaim | None = None
    ) -> CapturedLines:
        """Get a finished capture's files, from where an earlier try ended, and give its lines; none beyond a claim."""

    def references(self, folder: str, kept: Kept, *, claim: FrameClaim | None = None) -> dict[str, MeanFrame]:
        """Mean frames of the reference cubes that lie in a capture's folder, by ``dark`` and ``white``."""

    def close(self) -> None:
        """Let go of the camera; a capture goes on."""
