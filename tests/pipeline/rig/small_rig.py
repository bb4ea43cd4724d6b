"""A small scene in front of a fake rig, whose devices fail where a test wants, and the rig as a source of lines."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.rig.camera.camera_cubes import CapturedLines
from spectralzoom.pipeline.rig.camera.camera_files import Capture, Kept, KeptInMemory, Progress
from spectralzoom.pipeline.rig.device_settings import SurveyRig
from spectralzoom.pipeline.rig.drivers import RigDevices
from spectralzoom.pipeline.rig.fakes import FakeCamera, FakeClock, FakeMirror
from spectralzoom.pipeline.rig.rig_source import RigSource
from spectralzoom.pipeline.simulator.rig_model import Rig
from spectralzoom.pipeline.simulator.scenes.scene import raster_from_values
from spectralzoom.pipeline.simulator.simulated import SimulatedSource
from spectralzoom.pipeline.source import Line
from tests.pipeline.simulator.small_scenes import effects_on

CAMERA = LineCamera(samples=48)
NAMES = ("rotation", "slit", "smear", "vignetting", "shot", "read-noise")
COARSE = Sweep("coarse-0", "coarse", "x", 0.0, -21.5, 10, 4, 4)
FINE = Sweep("fine-3", "fine", "x", 3.25, -7.5, 17)


def small_source(**changed: Any) -> SimulatedSource:
    """Return a simulated source of 40 x 48 px and 3 bands, with usual effects."""
    values = np.random.default_rng(11).uniform(20, 200, (40, 48, 3))
    scene = raster_from_values(values, CAMERA, name="small", wavelength_nm=np.array([460.0, 550.0, 640.0]))
    return replace(SimulatedSource(scene, Rig(CAMERA), 5, effects_on(*NAMES)), **changed)


@cache
def simulated_lines(sweep: Sweep) -> list[Line]:
    """Return the simulated source's lines of a sweep, cached."""
    return list(small_source().lines(sweep))


def assert_simulated(found: Sequence[Line], sweep: Sweep, first: int = 0) -> None:
    """Assert the numbers of the simulated source's lines from ``first`` on, bit for bit and in order."""
    expected = simulated_lines(sweep)[first:]
    assert [line.number for line in found] == [line.number for line in expected]
    np.testing.assert_array_equal([line.data for line in found], [line.data for line in expected])


Act = Callable[[], object]


class FaultyCamera(FakeCamera):
    """A fake camera that calls the next of ``acts`` at a capture, a fetch or a request for its state.

    An act may raise. ``cuts`` has the lines that the next fetches bring; None: all. Captures of a ``late`` camera are
    written only after that time.
    """

    def __init__(self, clock: FakeClock, source: SimulatedSource) -> None:
        super().__init__(clock, source)
        self.acts: dict[str, list[Act]] = {"capture": [], "fetch": [], "is_capturing": []}
        self.cuts: list[int | None] = []
        self.late = 0.0
        self.stopped = 0

    def capture(self, frames: int, *, prefix: str = "") -> Capture:
        self._act("capture")
        return super().capture(frames, prefix=prefix)

    def is_capturing(self) -> bool:
        self._act("is_capturing")
        return super().is_capturing() or (bool(self.captures) and self.clock.now() < self.late)

    def stop(self) -> None:
        self.stopped += 1
        super().stop()

    def fetch(self, folder: str, kept: Kept, progress: Progress | None = None) -> CapturedLines:
        self._act("fetch")
        found = super().fetch(folder, kept, progress)
        cut = self.cuts.pop(0) if self.cuts else None
        if cut is None:
            return found
        times = replace(found.times, frame=found.times.frame[:cut], stamp_us=found.times.stamp_us[:cut])
        return replace(found, values=found.values[:cut], times=times)

    def _act(self, name: str) -> None:
        if self.acts[name]:
            self.acts[name].pop(0)()


@dataclass
class SmallRig:
    """A fake rig, and the settings of its sources."""

    seen: SimulatedSource = field(default_factory=small_source)
    settings: SurveyRig = field(default_factory=SurveyRig)
    vector_pairs: int = 1500
    opened: int = 0
    closed: int = 0

    def __post_init__(self) -> None:
        self.clock = FakeClock(50.0)
        self.mirror = FakeMirror(self.clock, self.vector_pairs)
        self.camera = FaultyCamera(self.clock, self.seen)
        self.wavelength_nm: NDArray[np.float64] = self.seen.wavelength_nm

    @property
    def captures(self) -> list[str]:
        """Return the captures that the camera began, without references."""
        return [folder for folder in self.camera.captures if "references" not in folder]

    def devices(self, seen: SimulatedSource | None = None) -> RigDevices:
        """Connect to both devices."""
        self.opened += 1
        rig = self

        class Devices(RigDevices):
            def close(self) -> None:
                rig.closed += 1

        return Devices(self.mirror, self.camera, self.clock)

    def source(self, kept: Kept | None = None, **more: Any) -> RigSource:
        """Return a source that captures with the rig; each call acts as another process."""
        more = {"rig": self.settings, "vector_pairs": self.vector_pairs, **more}
        source = RigSource(self.seen.camera, self.wavelength_nm, self.devices, **more)
        return source.keeping(KeptInMemory() if kept is None else kept)
