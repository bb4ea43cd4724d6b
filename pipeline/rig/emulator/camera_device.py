"""The emulated camera: commands in, replies out, captures that look at whatever it is given. No sockets, no waiting.

It speaks what :mod:`pipeline.rig.camera.headwall_replies` reads; the texts of refusals are made up, since no document
tells them.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import RigError
from pipeline.rig.clock import Clock
from pipeline.rig.emulator.camera_capture import EmulatedCapture, FrameClock, IndexLayout, Lines, Positions
from pipeline.rig.emulator.exchange import Chunk

PROMPT = b"\r\nhpi> "
MOST_LINE = 4096


class CameraFault(Enum):
    """A fault of the camera, and what happens where it strikes."""

    words: str

    SLOW = "slow", "a reply comes late, and in time"
    LATE = "late", "a reply comes after any deadline"
    SILENT = "silent", "a command is done and its reply is lost"
    SPLIT = "split", "a reply comes in pieces"
    MERGED = "merged", "a reply comes together with one to a command that nobody sent"
    STALE = "stale", "a reply to another command comes before the right one"
    NOT_JSON = "not-json", "a reply is no JSON"
    HANGS_UP = "hangs-up", "a command is done, and the connection closed without a reply"
    FULL = "full", "a capture is refused: the disk is full"
    BUSY = "busy", "a capture is refused: the camera is busy"
    CUT_CUBE = "cut-cube", "a cube ends within a line"
    BREAKS_OFF = "breaks-off", "a transfer of a file is closed half way"
    REFUSES_FILES = "refuses-files", "a connection for files is closed at once"

    def __new__(cls, name: str, words: str) -> CameraFault:
        fault = object.__new__(cls)
        fault._value_, fault.words = name, words
        return fault


@dataclass
class CameraFaults:
    """Faults still to come, each so many times, after ``passes`` occasions; where pieces are cut is by the seed."""

    left: dict[CameraFault, int] = field(default_factory=dict)
    seed: int = 0
    passes: int = 0
    slow_s: float = 1.0
    late_s: float = 60.0

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)

    def strikes(self, fault: CameraFault) -> bool:
        """Whether the fault strikes now; it is then one less to come."""
        if self.left.get(fault, 0) < 1:
            return False
        if self.passes > 0:
            self.passes -= 1
            return False
        self.left[fault] -= 1
        return True


@dataclass(frozen=True)
class CameraUnit:
    """What the emulated camera is like."""

    root: str = "/captured"
    echoes: bool = True
    greeting: str = "Hyperspec control"
    usual_frames: int = 2000  # of a cube, where the command says 0
    disk_bytes: int = 480 * 10**9
    clock: FrameClock = field(default_factory=FrameClock)
    layout: IndexLayout = field(default_factory=IndexLayout)
    wavelength_nm: tuple[float, ...] = ()
    references: dict[str, NDArray[np.uint16]] = field(default_factory=dict)  # such as darkReference, in each folder


def at_rest(times_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions of a mirror that never moves."""
    return np.zeros((len(times_s), 2))


class CameraDevice:
    """One camera. Frames are looked at when somebody asks, so ``positions`` must answer for times gone by.

    Parameters
    ----------
    lines
        Gives lines (line, sample, band) uint16 of mirror positions (line, 2) and times (line,) by ``clock``.
    positions
        Gives mirror positions of times; at rest where none is given.
    """

    def __init__(
        self,
        lines: Lines,
        clock: Clock,
        *,
        positions: Positions = at_rest,
        unit: CameraUnit | None = None,
        faults: CameraFaults | None = None,
    ) -> None:
        self.unit = CameraUnit() if unit is None else unit
        self.faults = CameraFaults() if faults is None else faults
        self.clock = clock
        self.exposure_ms, self.period_ms = 10.0, 10.0
        self.captures: list[EmulatedCapture] = []
        self.commands: list[str] = []  # as they came, for tests
        self._lines, self._positions = lines, positions
        self._lock = threading.RLock()

    def greet(self) -> list[Chunk]:
        """What a new connection is sent."""
        greeting = f"{self.unit.greeting}\r\n".encode() if self.unit.greeting else b""
        return self._cut(greeting + PROMPT[2:])

    def command(self, line: str) -> list[Chunk] | None:
        """Do one command; give its reply, in pieces and in time, or None where the connection ends."""
        with self._lock:
            self.commands.append(line)
            if line == "exit":
                return None
            try:
                said = {"success": True, "response": self._do(line), "errorMessage": ""}
            except RigError as error:
                said = {"success": False, "response": None, "errorMessage": str(error)}
            if self.faults.strikes(CameraFault.HANGS_UP):
                return None
            return self._spoken(line, json.dumps(said))

    def is_capturing(self) -> bool:
        """Whether a capture runs."""
        return bool(self.captures) and self.captures[-1].running(self.clock.now())

    def exposures(self, from_s: float, to_s: float) -> NDArray[np.float64]:
        """Give begin and end (exposure, 2) of exposures that begin in a span of time: pulses for a mirror's trigger."""
        with self._lock:
            spans = [capture.exposures(from_s, to_s) for capture in self.captures]
            return np.concatenate([np.zeros((0, 2)), *spans])

    def files(self) -> dict[str, bytes]:
        """All files by their whole names, as they are now."""
        with self._lock:
            self._look()
            return {
                f"{capture.folder}/{name}": data for capture in self.captures for name, data in capture.files().items()
            }

    def folders(self) -> set[str]:
        """All folders."""
        every = {"/", self.unit.root, *(capture.folder for capture in self.captures)}
        return every | {
            "/" + "/".join(name.split("/")[1:end]) for name in every for end in range(2, name.count("/") + 1)
        }

    def _look(self) -> None:
        """Look at all frames that are over by now."""
        for capture in self.captures:
            while len(numbers := capture.pending(self.clock.now())):
                middle_s = capture.middle_s(numbers)
                capture.put(self._lines(self._positions(middle_s), middle_s))

    def _spoken(self, line: str, reply: str) -> list[Chunk]:
        echo = f"{line}\r\n" if self.unit.echoes else ""
        if self.faults.strikes(CameraFault.SILENT):
            return []
        if self.faults.strikes(CameraFault.NOT_JSON):
            reply = "Segmentation fault"
        data = f"{echo}{reply}".encode() + PROMPT
        if self.faults.strikes(CameraFault.STALE):
            other = "listFiles" if not line.startswith("listFiles") else "isCapturing"
            return [Chunk(0.0, self._foreign(other)), Chunk(0.1, data)]
        if self.faults.strikes(CameraFault.MERGED):
            return [Chunk(0.0, self._foreign("stopCapture") + data)]
        if self.faults.strikes(CameraFault.LATE):
            return [Chunk(self.faults.late_s, data)]
        if self.faults.strikes(CameraFault.SLOW):
            return [Chunk(self.faults.slow_s, data)]
        return self._cut(data)

    def _foreign(self, name: str) -> bytes:
        """A reply to a command that was not sent, which can be told by its echo."""
        return f'{name}\r\n{{"success": true, "response": [], "errorMessage": ""}}'.encode() + PROMPT

    def _cut(self, data: bytes) -> list[Chunk]:
        if not self.faults.strikes(CameraFault.SPLIT):
            return [Chunk(0.0, data)]
        rng, most = self.faults.rng, max(len(data) - 1, 0)
        count = min(int(rng.integers(1, 7)), most)
        ends = sorted(int(end) + 1 for end in rng.permutation(most)[:count])
        return [Chunk(0.002, data[start:stop]) for start, stop in pairwise([0, *ends, len(data)])]

    def _do(self, line: str) -> Any:
        name, _, rest = line.partition("(")
        argument: Any = None
        if rest:
            try:
                argument = json.loads(rest.rstrip().removesuffix(")"))
            except ValueError:
                raise RigError(f"argument of {name} is not JSON") from None
        does: dict[str, Callable[[Any], Any]] = {
            "configure": self._configure,
            "capture": self._capture,
            "listFiles": self._list,
            "isCapturing": lambda _: self.is_capturing(),
            "stopCapture": self._stop,
        }
        if name.strip() not in does:
            raise RigError(f"unknown command {name}")
        return does[name.strip()](argument)

    def _configure(self, argument: Any) -> Any:
        if not isinstance(argument, dict) or not {"exposure", "framePeriod"} >= set(argument):
            raise RigError("configure takes exposure and framePeriod")
        if self.is_capturing():
            raise RigError("busy capturing")
        exposure, period = argument.get("exposure", self.exposure_ms), argument.get("framePeriod", self.period_ms)
        if not 0 < exposure <= period:
            raise RigError("exposure longer than frame period")
        self.exposure_ms, self.period_ms = float(exposure), float(period)
        return {"exposure": self.exposure_ms, "framePeriod": self.period_ms}

    def _capture(self, argument: Any) -> Any:
        if not isinstance(argument, dict) or not {"prefix", "maxCubes", "maxFramesPerCube"} >= set(argument):
            raise RigError("capture takes prefix, maxCubes and maxFramesPerCube")
        if self.is_capturing() or self.faults.strikes(CameraFault.BUSY):
            raise RigError("busy capturing")
        held = sum(map(len, self.files().values()))
        if held >= self.unit.disk_bytes or self.faults.strikes(CameraFault.FULL):
            raise RigError("disk full")
        frames = argument.get("maxFramesPerCube", 0) or self.unit.usual_frames
        cubes = argument.get("maxCubes", 0)
        prefix = argument.get("prefix", "")
        folder = f"{self.unit.root}/{prefix + '_' if prefix else ''}{len(self.captures):06d}"
        self.captures.append(self._begun(folder, frames, cubes))
        return {"folder": folder}

    def _begun(self, folder: str, frames: int, cubes: int) -> EmulatedCapture:
        cut = 0
        if self.faults.strikes(CameraFault.CUT_CUBE):
            probe = self._lines(self._positions(np.array([self.clock.now()])), np.array([self.clock.now()]))
            cut = probe[0].size * 3  # a line and a half of two bytes a number
        return EmulatedCapture(
            folder,
            began_s=self.clock.now() + self.unit.clock.delay_s,
            exposure_s=self.exposure_ms * 1e-3,
            period_s=self.period_ms * 1e-3,
            frames_per_cube=frames,
            most_frames=frames * cubes if cubes else None,
            clock=self.unit.clock,
            layout=self.unit.layout,
            wavelength_nm=self.unit.wavelength_nm,
            references=self.unit.references,
            cut_bytes=cut,
        )

    def _stop(self, argument: Any) -> bool:
        if not self.is_capturing():
            return False
        self.captures[-1].stop(self.clock.now())
        return True

    def _list(self, argument: Any) -> list[dict[str, Any]]:
        folder = "/" + str(argument or "").strip("/")
        if folder not in self.folders():
            raise RigError(f"no such folder {folder}")
        under = folder.rstrip("/") + "/"
        found = [(name, 0, True) for name in self.folders() if name != folder]
        found += [(name, len(data), False) for name, data in self.files().items()]
        return [
            {"name": name, "size": size, "mtime": 0, "isDirectory": is_folder}
            for name, size, is_folder in sorted(found)
            if name.startswith(under) and "/" not in name[len(under) :]
        ]


class CameraConnection:
    """One connection's own half of the talk: its bytes, cut into commands at carriage returns."""

    def __init__(self, device: CameraDevice) -> None:
        self._device = device
        self._held = b""

    def feed(self, data: bytes) -> tuple[list[Chunk], bool]:
        """Take bytes; give replies, and whether the connection goes on."""
        self._held += data
        chunks: list[Chunk] = []
        while (end := self._held.find(b"\r")) >= 0:
            line, self._held = self._held[:end], self._held[end + 1 :].removeprefix(b"\n")
            text = line.decode("utf-8", errors="replace").strip()
            if not text:
                chunks.append(Chunk(0.0, PROMPT))
                continue
            reply = self._device.command(text)
            if reply is None:
                return chunks, False
            chunks += reply
        return chunks, len(self._held) <= MOST_LINE
