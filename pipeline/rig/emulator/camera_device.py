"""The emulated camera: commands in, replies out, captures that look at whatever it is given. No sockets, no waiting.

It speaks what :mod:`pipeline.rig.camera.headwall_replies` reads; the texts of refusals are made up, since no document
tells them.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import RigError
from pipeline.rig.devices import Clock
from pipeline.rig.emulator import Chunk

Floats = NDArray[Any]  # float64
Ints = NDArray[np.int64]
Raw = NDArray[np.uint16]
Lines = Callable[[Floats, Floats], Raw]  # positions (line, 2), times (line,) of mid exposure -> (line, sample, band)
Positions = Callable[[Floats], Floats]  # times (line,) -> (line, 2)

_BLOCK = 64  # frames looked at together
PROMPT = b"\r\nhpi> "
MOST_LINE = 4096


@dataclass(frozen=True)
class FrameClock:
    """The camera's clock: what it shows at 0 of the emulator's, and how fast it goes."""

    origin_us: int = 1_500_000_000_000_000
    drift_ppm: float = 0.0
    delay_s: float = 0.01  # from the command to the first exposure

    def stamp_us(self, time_s: Floats) -> Ints:
        """Stamps of times of the emulator's clock."""
        passed: Ints = np.rint(time_s * (1 + self.drift_ppm * 1e-6) * 1e6).astype(np.int64)
        return self.origin_us + passed


@dataclass(frozen=True)
class IndexLayout:
    """How frame indices are written; versions of the camera's program differ."""

    between: str = "\t"
    end: str = "\n"
    restarts: bool = False  # numbers begin at 0 in each file, instead of going on


@dataclass
class EmulatedCapture:
    """Frames from ``began_s`` on, one each period, in cubes of ``frames_per_cube``."""

    folder: str
    began_s: float
    exposure_s: float
    period_s: float
    frames_per_cube: int
    most_frames: int | None  # None: until it is stopped
    clock: FrameClock
    layout: IndexLayout
    wavelength_nm: Sequence[float]
    references: dict[str, Raw] = field(default_factory=dict)  # name -> (frame, sample, band)
    _lines: list[Raw] = field(default_factory=list)
    _taken: int = 0
    _whole: dict[str, bytes] | None = None  # all files, once no frame is to come

    def due(self, now_s: float) -> int:
        """Frames whose exposure is over."""
        whole = int(np.floor((now_s - self.began_s - self.exposure_s) / self.period_s + 1e-9)) + 1
        return max(whole if self.most_frames is None else min(whole, self.most_frames), 0)

    def exposures(self, from_s: float, to_s: float) -> Floats:
        """Begin and end (exposure, 2) of exposures that begin at ``from_s`` or later and before ``to_s``."""
        bounds = np.ceil((np.array([from_s, to_s]) - self.began_s) / self.period_s - 1e-9).astype(np.int64)
        first, stop = np.clip(bounds, 0, self.most_frames)
        begins = self.began_s + np.arange(first, stop) * self.period_s
        return np.stack([begins, begins + self.exposure_s], axis=-1)

    def running(self, now_s: float) -> bool:
        """Whether frames are still to come."""
        return self.most_frames is None or self.due(now_s) < self.most_frames

    def stop(self, now_s: float) -> None:
        """Take no frame that is not over."""
        self.most_frames = self.due(now_s)

    def pending(self, now_s: float, most: int = _BLOCK) -> Ints:
        """Numbers of the next frames, ``most`` at most, that are over by now and not taken yet."""
        return np.arange(self._taken, max(min(self._taken + most, self.due(now_s)), self._taken))

    def middle_s(self, numbers: Ints) -> Floats:
        """Mid exposure of frames. [s]"""
        middle: Floats = self.began_s + numbers * self.period_s + self.exposure_s / 2
        return middle

    def put(self, lines: NDArray[Any]) -> None:
        """Take the next frames, (line, sample, band)."""
        self._lines.append(np.asarray(lines, np.uint16))
        self._taken += len(lines)

    def drop(self) -> None:
        """Have the files no longer; the capture is over."""
        self._lines, self._whole = [], {}

    def files(self) -> dict[str, bytes]:
        """Names without the folder, and contents, of what has been taken."""
        if self._whole is not None:
            return self._whole
        found: dict[str, bytes] = {
            "imu_gps.txt": f"Roll\tPitch\tYaw\tLat\tLon\tAlt\tTimestamp{self.layout.end}".encode()
        }
        for name, frames in self.references.items():
            found |= {name: _bil(frames), f"{name}.hdr": self._header(frames)}
        self._lines = [np.concatenate(self._lines)] if self._lines else []
        for first in range(0, self._taken, self.frames_per_cube):
            every = self._lines[0]
            cube = every[first : first + self.frames_per_cube]
            found |= {f"raw_{first}": _bil(cube), f"raw_{first}.hdr": self._header(cube)}
            found[f"frameIndex_{first}.txt"] = self._index(first, len(cube))
        if self._taken == self.most_frames:
            self._whole = found
        return found

    def _index(self, first: int, count: int) -> bytes:
        numbers = np.arange(first, first + count)
        stamps = self.clock.stamp_us(self.began_s + numbers * self.period_s)
        shown = numbers - first if self.layout.restarts else numbers
        rows = [f"{number}{self.layout.between}{stamp}" for number, stamp in zip(shown, stamps, strict=True)]
        return (self.layout.end.join([f"Frame#{self.layout.between}Timestamp", *rows]) + self.layout.end).encode()

    def _header(self, frames: Raw) -> bytes:
        lines, samples, bands = frames.shape
        text = (
            f"ENVI\ninterleave = bil\ndata type = 12\nlines = {lines}\nsamples = {samples}\nbands = {bands}\n"
            "byte order = 0\nheader offset = 0\n"
        )
        if bands and len(self.wavelength_nm) == bands:
            text += "wavelength = {\n" + ",\n".join(f"{value:.17g}" for value in self.wavelength_nm) + "\n}\n"
        return text.encode()


def _bil(frames: Raw) -> bytes:
    return np.ascontiguousarray(frames.transpose(0, 2, 1), "<u2").tobytes()


@dataclass(frozen=True)
class CameraUnit:
    """What the emulated camera is like."""

    root: str = "/captured"
    usual_frames: int = 2000  # of a cube, where the command says 0
    disk_bytes: int = 480 * 10**9
    clock: FrameClock = field(default_factory=FrameClock)
    layout: IndexLayout = field(default_factory=IndexLayout)
    wavelength_nm: tuple[float, ...] = ()
    references: dict[str, NDArray[np.uint16]] = field(default_factory=dict)  # such as darkReference, in each folder


class CameraDevice:
    """One camera. Frames are looked at when somebody asks, so ``positions`` must answer for times gone by.

    ``lines`` gives lines (line, sample, band) uint16 of mirror positions (line, 2) and times (line,) by ``clock``;
    ``positions`` gives mirror positions of times, at rest where none is given.
    """

    def __init__(
        self,
        lines: Lines,
        clock: Clock,
        *,
        positions: Positions = lambda times_s: np.zeros((len(times_s), 2)),
        unit: CameraUnit | None = None,
    ) -> None:
        self.unit = CameraUnit() if unit is None else unit
        self.clock = clock
        self.exposure_ms, self.period_ms = 10.0, 10.0
        self.captures: list[EmulatedCapture] = []
        self.commands: list[str] = []  # as they came, for tests
        self._lines, self._positions = lines, positions
        self._lock = threading.RLock()

    def greet(self) -> list[Chunk]:
        """What a new connection is sent."""
        return [Chunk(0.0, b"Hyperspec control" + PROMPT)]

    def command(self, line: str) -> list[Chunk] | None:
        """Do one command and return its reply, or None where the connection ends."""
        with self._lock:
            self.commands.append(line)
            if line == "exit":
                return None
            try:
                said = {"success": True, "response": self._do(line), "errorMessage": ""}
            except RigError as error:
                said = {"success": False, "response": None, "errorMessage": str(error)}
            return [Chunk(0.0, f"{line}\r\n{json.dumps(said)}".encode() + PROMPT)]

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
            self._poll()
            return {f"{one.folder}/{name}": data for one in self.captures for name, data in one.files().items()}

    def folders(self) -> set[str]:
        """All folders."""
        every = {"/", self.unit.root, *(capture.folder for capture in self.captures)}
        return every | {
            "/" + "/".join(name.split("/")[1:end]) for name in every for end in range(2, name.count("/") + 1)
        }

    def _poll(self) -> None:
        """Look at all frames that are over by now."""
        for capture in self.captures:
            while len(numbers := capture.pending(self.clock.now())):
                middle_s = capture.middle_s(numbers)
                capture.put(self._lines(self._positions(middle_s), middle_s))

    def _do(self, line: str) -> Any:
        name, _, rest = line.partition("(")
        argument: Any = None
        if rest:
            try:
                argument = json.loads(rest.rstrip().removesuffix(")"))
            except ValueError:
                raise RigError(f"argument of {name} is not JSON") from None
        match name.strip():
            case "configure":
                return self._configure(argument)
            case "capture":
                return self._capture(argument)
            case "listFiles":
                return self._list(argument)
            case "isCapturing":
                return self.is_capturing()
            case "stopCapture":
                if runs := self.is_capturing():
                    self.captures[-1].stop(self.clock.now())
                return runs
        raise RigError(f"unknown command {name}")

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
        if self.is_capturing():
            raise RigError("busy capturing")
        held = sum(map(len, self.files().values()))
        if held >= self.unit.disk_bytes:
            raise RigError("disk full")
        frames = argument.get("maxFramesPerCube", 0) or self.unit.usual_frames
        cubes = argument.get("maxCubes", 0)
        prefix = argument.get("prefix", "")
        folder = f"{self.unit.root}/{prefix + '_' if prefix else ''}{len(self.captures):06d}"
        self.captures.append(self._begun(folder, frames, cubes))
        return {"folder": folder}

    def _begun(self, folder: str, frames: int, cubes: int) -> EmulatedCapture:
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
        )

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
