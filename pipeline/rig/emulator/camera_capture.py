"""One capture of the emulated camera: frames as time passes, and the files they are in."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[Any]  # float64
Ints = NDArray[np.int64]
Raw = NDArray[np.uint16]
Lines = Callable[[Floats, Floats], Raw]  # positions (line, 2), times (line,) of mid exposure -> (line, sample, band)
Positions = Callable[[Floats], Floats]  # times (line,) -> (line, 2)

_BLOCK = 64  # frames looked at together


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
    cut_bytes: int = 0  # missing at the end of the last cube
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
        found = self._written()
        if self._taken == self.most_frames:
            self._whole = found
        return found

    def _written(self) -> dict[str, bytes]:
        found: dict[str, bytes] = {
            "imu_gps.txt": f"Roll\tPitch\tYaw\tLat\tLon\tAlt\tTimestamp{self.layout.end}".encode()
        }
        for name, frames in self.references.items():
            found |= {name: _bil(frames), f"{name}.hdr": self._header(frames)}
        if not self._lines:
            return found
        if len(self._lines) > 1:
            self._lines = [np.concatenate(self._lines)]
        every = self._lines[0]
        for first in range(0, len(every), self.frames_per_cube):
            cube = every[first : first + self.frames_per_cube]
            data = _bil(cube)
            if first + len(cube) == len(every) and self.cut_bytes:
                data = data[: -self.cut_bytes]
            found |= {f"raw_{first}": data, f"raw_{first}.hdr": self._header(cube)}
            found[f"frameIndex_{first}.txt"] = self._index(first, len(cube))
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
