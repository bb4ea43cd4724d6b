"""Faults of the emulated camera: replies, captures, cubes and transfers that go wrong."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from itertools import pairwise
from typing import Any

import numpy as np

from pipeline.errors import RigError
from pipeline.rig.emulator import Chunk
from pipeline.rig.emulator.camera_device import PROMPT, CameraDevice, CameraServer, EmulatedCapture, FileHandler
from pipeline.rig.emulator.emulated_rig import EmulatedRig, SceneCamera
from pipeline.simulator.simulated import SimulatedSource
from tests.pipeline.rig.mirror_faults import Fault, FaultyMirror

SLOW_S, LATE_S = 1.0, 60.0


class CameraFault(StrEnum):
    """Kinds of faults of the camera."""

    SLOW = "a reply comes late, and in time"
    LATE = "a reply comes after any deadline"
    SILENT = "a command is done and its reply is lost"
    SPLIT = "a reply comes in pieces"
    NOT_JSON = "a reply is no JSON"
    HANGS_UP = "a command is done, and the connection closed without a reply"
    FULL = "a capture is refused: the disk is full"
    BUSY = "a capture is refused: the camera is busy"
    CUT_CUBE = "a cube ends within a line"
    BREAKS_OFF = "a transfer of a file is closed half way"
    REFUSES_FILES = "a connection for files is closed at once"


@dataclass
class CameraFaults:
    """Pending faults and their counts, which strike after ``passes`` occasions; the seed draws the cuts of replies."""

    left: dict[CameraFault, int] = field(default_factory=dict)
    seed: int = 0
    passes: int = 0

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)

    def strikes(self, fault: CameraFault) -> bool:
        """Return whether the fault strikes now, and count it down."""
        if self.left.get(fault, 0) < 1:
            return False
        if self.passes > 0:
            self.passes -= 1
            return False
        self.left[fault] -= 1
        return True


class FaultyCamera(CameraDevice):
    """A camera with faults."""

    def __init__(self, *given: Any, faults: CameraFaults | None = None, **named: Any) -> None:
        self.faults = CameraFaults() if faults is None else faults
        self.commands: list[str] = []  # in order of arrival
        self._cut: set[str] = set()  # folders whose last cube is truncated
        super().__init__(*given, **named)

    def greet(self) -> list[Chunk]:
        """Greet, possibly in pieces."""
        return self._in_pieces(b"".join(data for _, data in super().greet()))

    def command(self, line: str) -> list[Chunk] | None:
        """Execute a command, and reply unless a fault prevents it."""
        with self._lock:
            self.commands.append(line)
            said = super().command(line)
            if said is None or self.faults.strikes(CameraFault.HANGS_UP):
                return None
            if self.faults.strikes(CameraFault.SILENT):
                return []
            data = b"".join(data for _, data in said)
            if self.faults.strikes(CameraFault.NOT_JSON):
                data = f"{line}\r\nSegmentation fault".encode() + PROMPT
            if self.faults.strikes(CameraFault.LATE):
                return [Chunk(LATE_S, data)]
            if self.faults.strikes(CameraFault.SLOW):
                return [Chunk(SLOW_S, data)]
            return self._in_pieces(data)

    def files(self) -> dict[str, bytes]:
        """Return the files, with truncated cubes."""
        found = super().files()
        for folder in self._cut:
            cube = f"{folder}/raw_0"
            if cube in found:
                lines = int(found[f"{cube}.hdr"].partition(b"lines = ")[2].split()[0])
                found[cube] = found[cube][: -3 * len(found[cube]) // (2 * lines)]  # a line and a half
        return found

    def _in_pieces(self, data: bytes) -> list[Chunk]:
        if not self.faults.strikes(CameraFault.SPLIT):
            return [Chunk(0.0, data)]
        rng = self.faults.rng
        most = max(len(data) - 1, 0)
        ends = sorted(int(end) + 1 for end in rng.permutation(most)[: int(rng.integers(1, 7))])
        return [Chunk(0.002, data[start:stop]) for start, stop in pairwise([0, *ends, len(data)])]

    def _capture(self, argument: Any) -> Any:
        for fault, why in {CameraFault.BUSY: "busy capturing", CameraFault.FULL: "disk full"}.items():
            if self.faults.strikes(fault):
                raise RigError(why)
        return super()._capture(argument)

    def _begun(self, folder: str, frames: int) -> EmulatedCapture:
        self._cut.discard(folder)
        if self.faults.strikes(CameraFault.CUT_CUBE):
            self._cut.add(folder)
        return super()._begun(folder, frames)


class FaultySceneCamera(FaultyCamera, SceneCamera):
    """A camera in front of a scene, with faults."""


class _HalfOf:
    """Producer of half of the remaining file, which then closes the session."""

    def __init__(self, producer: Any, transfer: Any) -> None:
        rest = producer.file.read()
        self._data = rest[: len(rest) // 2]
        self._transfer = transfer

    def more(self) -> bytes:
        data: bytes = self._data[:65536]
        self._data = self._data[65536:]
        if not data:
            self._transfer.cmd_channel.close()
        return data


class _FaultyTransfer(FileHandler.dtp_handler):  # type: ignore[misc, name-defined]
    def push_with_producer(self, producer: Any) -> None:
        if self.cmd_channel.device.faults.strikes(CameraFault.BREAKS_OFF):
            producer = _HalfOf(producer, self)
        super().push_with_producer(producer)


class _FaultyHandler(FileHandler):
    dtp_handler = _FaultyTransfer

    def handle(self) -> None:
        if self.device.faults.strikes(CameraFault.REFUSES_FILES):
            self.close()
            return
        super().handle()


class FaultyServer(CameraServer):
    """A camera's ports, whose transfers fail by the camera's faults."""

    handler = _FaultyHandler


class FaultyRig(EmulatedRig):
    """An emulated rig whose devices have faults."""

    mirror_kind, camera_kind, server_kind = FaultyMirror, FaultySceneCamera, FaultyServer
    mirror: FaultyMirror
    camera: FaultySceneCamera

    def __init__(
        self,
        source: SimulatedSource,
        clock: Any,
        *,
        mirror_faults: tuple[Fault, ...] | list[Fault] = (),
        camera_faults: CameraFaults | None = None,
        **given: Any,
    ) -> None:
        super().__init__(source, clock, **given)
        self.mirror.have(mirror_faults)
        self.camera.faults = camera_faults or self.camera.faults
