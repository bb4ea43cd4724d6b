"""A fake mirror and a fake camera in front of a simulated scene, for tests and for people without a rig.

They are drivers like those of real devices: ``mirror_driver = "fake"`` and ``camera_driver = "fake"`` name them. The
camera sees the lines that its capture's prefix announces, where the mirror's plan has them. So the lines of a fake rig
are those of the simulated source, bit for bit. With both fakes no time passes but by sleeping.

The name of a capture holds all that its lines depend on, so that another process fetches them too.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spectralzoom.pipeline.errors import RigError, SettingsError
from spectralzoom.pipeline.frame_indices import LineTimes
from spectralzoom.pipeline.geometry.mirror import wire_positions
from spectralzoom.pipeline.rig.camera.camera_cubes import CapturedLines, MeanFrame
from spectralzoom.pipeline.rig.camera.camera_files import Capture, Kept, Progress
from spectralzoom.pipeline.rig.capture_paths import announced
from spectralzoom.pipeline.rig.device_settings import FAKE
from spectralzoom.pipeline.rig.transports import Clock, DeviceRefused
from spectralzoom.pipeline.simulator.simulated import SimulatedSource
from spectralzoom.pipeline.source import AT_REST

STARTED_US = 1_500_000_000_000_000  # by the fake camera's clock, of a capture's first frame
_FOLDER = re.compile(r"/fake/(.*)_\d+-(\d+)-([\d.e+-]+)-([\d.e+-]+)")  # prefix, frames, exposure and period [ms]


class FakeClock:
    """A clock that advances only by sleeping, which takes no time."""

    def __init__(self, start: float = 0.0) -> None:
        self._now = start

    def now(self) -> float:
        return self._now

    def sleep(self, seconds: float) -> None:
        self._now += max(seconds, 0.0)


class FakeMirror:
    """A `pipeline.rig.drivers.MirrorDriver` that is at once where it is sent; ``position`` is its last one."""

    def __init__(self, clock: Clock, vector_pairs: int = 1500) -> None:
        self.clock = clock
        self.vector_pairs = vector_pairs
        self.position: tuple[float, float] = (0.0, 0.0)
        self.path: NDArray[np.float32] = np.zeros((0, 2), np.float32)
        self.runs: list[tuple[float, float]] = []  # the clock's time and the rate of each path that was played

    def goto(self, x: float, y: float) -> None:
        (position,) = wire_positions([(x, y)])
        self.position = (float(position[0]), float(position[1]))

    def settle(self, within_s: float) -> None:
        pass

    def load_path(self, positions: ArrayLike) -> None:
        path = wire_positions(positions)
        if len(path) > self.vector_pairs:
            raise SettingsError(f"the vector memory holds {self.vector_pairs} positions, got {len(path)}")
        self.path = path

    def run(self, rate_hz: float) -> None:
        if not len(self.path):
            raise SettingsError("no path is loaded on the fake mirror; load one first")
        self.runs.append((self.clock.now(), rate_hz))
        self.position = (float(self.path[-1, 0]), float(self.path[-1, 1]))

    def halt(self) -> None:
        pass

    def close(self) -> None:
        pass


class FakeCamera:
    """A `pipeline.rig.drivers.CameraDriver` that looks at the scene of ``source``; without one it has no lines."""

    def __init__(self, clock: Clock, source: SimulatedSource | None = None) -> None:
        self.clock = clock
        self.source = source
        self.times_ms = (10.0, 10.0)  # exposure and frame period
        self.captures: list[str] = []
        self._until_s = -np.inf  # end of the latest capture
        self._numbers: Iterator[int] = itertools.count()

    def configure(self, exposure_ms: float, frame_period_ms: float) -> None:
        self.times_ms = (exposure_ms, frame_period_ms)

    def capture(self, frames: int, *, prefix: str = "") -> Capture:
        if self.is_capturing():
            raise DeviceRefused("the fake camera still captures; wait for its end, or stop it")
        exposure_ms, period_ms = self.times_ms
        folder = f"/fake/{prefix}_{next(self._numbers)}-{frames}-{exposure_ms!r}-{period_ms!r}"
        self.captures.append(folder)
        now = self.clock.now()
        self._until_s = now + frames * period_ms * 1e-3
        return Capture(folder, now, now)

    def is_capturing(self) -> bool:
        return self.clock.now() < self._until_s

    def stop(self) -> None:
        self._until_s = -np.inf

    def fetch(self, folder: str, kept: Kept, progress: Progress | None = None) -> CapturedLines:
        """Render the lines of a capture; the sweep in its name says which."""
        source, (prefix, frames, exposure_ms, period_ms) = self._seen(), _parts(folder)
        found = announced(prefix)
        if found is None:
            raise RigError(f"{folder} announces no lines; the fake camera sees those of a survey's sweeps only")
        sweep = replace(found[0], binning=1, exposure_ms=exposure_ms)
        lines = range(found[1], min(found[1] + frames, sweep.lines))
        number = np.arange(len(lines))
        stamps = STARTED_US + np.rint(number * period_ms * 1e3).astype(np.int64)
        return CapturedLines(source.render(sweep, lines), 0, LineTimes(number, stamps))

    def references(self, folder: str, kept: Kept) -> dict[str, MeanFrame]:
        """Return the frames of the simulated source, with the mirror at rest."""
        taken = self._seen().references(replace(AT_REST, exposure_ms=_parts(folder)[2]))
        whole = np.zeros(taken.dark.shape, np.bool_)
        return {"dark": MeanFrame(taken.dark, whole), "white": MeanFrame(taken.white, whole)}

    def close(self) -> None:
        pass

    def _seen(self) -> SimulatedSource:
        if self.source is None:
            raise RigError(f"rig.camera_driver = {FAKE!r} has no scene here; it sees lines in a survey only")
        return self.source


def _parts(folder: str) -> tuple[str, int, float, float]:
    """Return prefix, frames, exposure and period [ms] of a capture. Raises DeviceRefused: it has another name."""
    found = _FOLDER.fullmatch(folder)
    if found is None:
        raise DeviceRefused(f"the fake camera has no capture {folder}")
    prefix, frames, exposure_ms, period_ms = found.groups()
    return prefix, int(frames), float(exposure_ms), float(period_ms)
