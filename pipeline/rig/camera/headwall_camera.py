"""The camera's driver: control socket and files together, as a line camera for surveys."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

from pipeline.errors import RigError
from pipeline.rig.camera.camera_cubes import CapturedLines, MeanFrame, Read, mean_frame, read_capture, read_references
from pipeline.rig.camera.camera_files import Kept, Progress, RemoteFile, fetch_files
from pipeline.rig.camera.headwall_control import HeadwallControl
from pipeline.rig.device_settings import CameraAddress, CameraLimits, ControlPatience, FileServer
from pipeline.rig.devices import SYSTEM_CLOCK, Clock
from pipeline.rig.transports import SocketTransport, Transport

MOST_TEXT = 1 << 26  # bytes of a header, a frame index or another text: an index of two million frames
MOST_OFFSET = 1 << 16  # bytes before the first frame of a cube; cameras write none
MOST_REFERENCE_FRAMES = 2048
MOST_FILES = 4096
_RAW = re.compile(r"raw_\d+", re.IGNORECASE)
_REFERENCE = re.compile(r"(dark|white)[a-z_]*", re.IGNORECASE)


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


class HeadwallCamera(HeadwallControl):
    """A line camera for surveys: its commands and its files. Nothing is connected before the first command."""

    def __init__(
        self,
        connect: Callable[[], Transport],
        server: FileServer,
        *,
        clock: Clock = SYSTEM_CLOCK,
        patience: ControlPatience | None = None,
        limits: CameraLimits | None = None,
    ) -> None:
        super().__init__(connect, clock=clock, patience=patience, limits=limits)
        self.server = server

    @classmethod
    def at(cls, address: CameraAddress, server: FileServer, *, clock: Clock = SYSTEM_CLOCK, **given: Any) -> Self:
        """A camera on the network."""

        def connect() -> SocketTransport:
            return SocketTransport(address.host, address.port, clock, connect_s=address.connect_s)

        return cls(connect, server, clock=clock, **given)

    def fetch(
        self, folder: str, kept: Kept, progress: Progress | None = None, *, claim: FrameClaim | None = None
    ) -> CapturedLines:
        """Get a finished capture's files, small ones first, and give its lines; a later call continues.

        RigError where the capture still runs, its files do not belong together, or are larger than ``claim`` lets them
        be; DeviceRefused, DeadlinePassed, DeviceGone.
        """
        files = self._finished(folder, claim)
        files.sort(key=lambda file: (bool(_RAW.fullmatch(file.base)), file.name))
        fetch_files(self.server, files, kept, progress, clock=self.clock)
        return read_capture([file.name for file in files], _reader(kept))

    def references(self, folder: str, kept: Kept, *, claim: FrameClaim | None = None) -> dict[str, MeanFrame]:
        """Mean frames of the reference cubes in a capture's folder, by ``dark`` and ``white``; empty without any."""
        files = [file for file in self._finished(folder, claim) if file.base.lower().startswith(("dark", "white"))]
        fetch_files(self.server, files, kept, clock=self.clock)
        cubes = read_references([file.name for file in files], _reader(kept))
        return {kind: mean_frame(cube.values) for kind, cube in cubes.items()}

    def _finished(self, folder: str, claim: FrameClaim | None) -> list[RemoteFile]:
        """Files of a folder, as two listings in a row have them: one that lost an entry on its way looks whole."""
        if self.is_capturing():
            raise RigError(f"a capture still runs, so files of {folder} may grow; wait for its end, or stop it")
        listed = self.list_files(folder)
        for _ in range(self.patience.retries + 1):
            before, listed = listed, self.list_files(folder)
            if listed == before:
                files = [file for file in listed if not file.folder]
                return files if claim is None else bounded(files, claim)
        raise RigError(f"{folder} was listed differently each time; look at the camera's network, then run again")


def _reader(kept: Kept) -> Read:
    return lambda name: kept.read(name, 0, kept.size(name))


def bounded(files: Sequence[RemoteFile], claim: FrameClaim) -> list[RemoteFile]:
    """Give the files with the most that each can have: cubes what was asked for, references and texts a fixed number.

    RigError where one claims more, or all cubes together do, or there are too many files.
    """
    if len(files) > MOST_FILES:
        raise RigError(f"the camera lists {len(files)} files in one capture, expected {MOST_FILES} at most; look there")
    found, cubes = [], []
    for file in files:
        most = MOST_TEXT
        if _RAW.fullmatch(file.base):
            most = claim.frames * claim.frame_bytes + MOST_OFFSET
            cubes.append(file)
        elif _REFERENCE.fullmatch(file.base):
            most = MOST_REFERENCE_FRAMES * claim.frame_bytes + MOST_OFFSET
        _check(file.name, file.size or 0, most)
        found.append(replace(file, most=most))
    if cubes:
        most = claim.frames * claim.frame_bytes + len(cubes) * MOST_OFFSET
        _check(f"{cubes[0].name} with the cubes beside it", sum(file.size or 0 for file in cubes), most)
    return found


def _check(name: str, size: int, most: int) -> None:
    if size > most:
        raise RigError(
            f"{name} is said to have {size} bytes, expected {most} at most; nothing of it is fetched: look at what the "
            "camera wrote, and at camera.samples and the wavelengths in the settings"
        )
