"""The camera's driver: control socket and files together, as a line camera for surveys."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.errors import RigError
from pipeline.rig.camera.camera_cubes import CapturedLines, Read, read_capture, read_references
from pipeline.rig.camera.camera_files import fetch_files
from pipeline.rig.camera.camera_references import MeanFrame, mean_frame
from pipeline.rig.camera.camera_settings import CameraLimits
from pipeline.rig.camera.file_claims import FrameClaim, bounded
from pipeline.rig.camera.file_session import FileServer
from pipeline.rig.camera.headwall_control import ControlPatience, HeadwallControl
from pipeline.rig.camera.kept_files import Kept, Progress, RemoteFile
from pipeline.rig.camera.line_camera import Capture
from pipeline.rig.clock import SYSTEM_CLOCK, Clock
from pipeline.rig.socket_transport import SocketTransport


@dataclass(frozen=True)
class CameraAddress:
    """Where the camera is; as its maker sets it, unless changed there."""

    host: str = "10.0.65.50"
    port: int = 8100
    connect_s: float = 3.0


class HeadwallCamera:
    """A :class:`pipeline.rig.camera.line_camera.LineCameraDevice`. Nothing is connected before the first command."""

    def __init__(self, control: HeadwallControl, server: FileServer, clock: Clock = SYSTEM_CLOCK) -> None:
        self.control = control
        self.server = server
        self.clock = clock

    @classmethod
    def at(
        cls, address: CameraAddress, server: FileServer, *, patience: ControlPatience | None = None,
        limits: CameraLimits | None = None, clock: Clock = SYSTEM_CLOCK,
    ) -> HeadwallCamera:  # fmt: skip
        """A camera on the network."""

        def connect() -> SocketTransport:
            return SocketTransport(address.host, address.port, clock, connect_s=address.connect_s)

        return cls(HeadwallControl(connect, clock=clock, patience=patience, limits=limits), server, clock)

    def configure(self, exposure_ms: float, frame_period_ms: float) -> None:
        """Set both times [ms]; see :meth:`HeadwallControl.configure`."""
        self.control.configure(exposure_ms, frame_period_ms)

    def capture(self, frames: int, *, cubes: int = 1, prefix: str = "") -> Capture:
        """Begin to take lines, once; see :meth:`HeadwallControl.capture`."""
        return self.control.capture(frames, cubes=cubes, prefix=prefix)

    def is_capturing(self) -> bool:
        """Whether lines are being taken."""
        return self.control.is_capturing()

    def stop(self) -> bool:
        """End a capture; False where none ran."""
        return self.control.stop_capture()

    def fetch(
        self, folder: str, kept: Kept, progress: Progress | None = None, *, claim: FrameClaim | None = None
    ) -> CapturedLines:
        """Get a finished capture's files, small ones first, and give its lines; a later call continues.

        Raises
        ------
        RigError : the capture still runs, its files do not belong together, or are larger than ``claim`` lets them be.
        DeviceRefused, DeadlinePassed, DeviceGone
        """
        files = self._finished(folder, claim)
        fetch_files(self.server, sorted(files, key=_rawness), kept, progress, clock=self.clock)
        return read_capture([file.name for file in files], _reader(kept))

    def references(self, folder: str, kept: Kept, *, claim: FrameClaim | None = None) -> dict[str, MeanFrame]:
        """Mean frames of the reference cubes in a capture's folder, by ``dark`` and ``white``; empty without any.

        Raises
        ------
        RigError, DeviceRefused, DeadlinePassed, DeviceGone
        """
        files = [file for file in self._finished(folder, claim) if _base(file).lower().startswith(("dark", "white"))]
        fetch_files(self.server, files, kept, clock=self.clock)
        cubes = read_references([file.name for file in files], _reader(kept))
        return {kind: mean_frame(cube.values) for kind, cube in cubes.items()}

    def close(self) -> None:
        """Hang up; a capture goes on."""
        self.control.close()

    def _finished(self, folder: str, claim: FrameClaim | None) -> list[RemoteFile]:
        """Files of a folder, as two listings in a row have them: one that lost an entry on its way looks whole."""
        if self.is_capturing():
            raise RigError(f"a capture still runs, so files of {folder} may grow; wait for its end, or stop it")
        listed = self.control.list_files(folder)
        for _ in range(self.control.patience.retries + 1):
            before, listed = listed, self.control.list_files(folder)
            if listed == before:
                files = [file for file in listed if not file.folder]
                return files if claim is None else bounded(files, claim)
        raise RigError(f"{folder} was listed differently each time; look at the camera's network, then run again")


def _base(file: RemoteFile) -> str:
    return file.name.rsplit("/", 1)[-1]


def _rawness(file: RemoteFile) -> tuple[bool, str]:
    base = _base(file).lower()
    return base.startswith("raw_") and not base.endswith(".hdr"), file.name


def _reader(kept: Kept) -> Read:
    return lambda name: kept.read(name, 0, kept.size(name))
