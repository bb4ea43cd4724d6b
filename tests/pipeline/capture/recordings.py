"""Make recordings of small simulated fields for tests: the sweeps of a simulated rig, stored as recorded sweeps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.capture.recorded import RecordedSweep, Recording, line_runs
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.simulator.rig_model import Rig
from spectralzoom.pipeline.simulator.simulated import SimulatedSource, SimulatedSweep
from spectralzoom.pipeline.source import Line
from tests.pipeline.simulator.small_scenes import image_scene

CAMERA = replace(LineCamera(), samples=64)
FULL = Sweep("scan-0", "fine", "x", swath_px=0.0, start_px=-39.5, lines=80)


def simulated(camera: LineCamera = CAMERA) -> SimulatedSource:
    """Return a simulated rig in front of a small field of noise, (80, 64, 3)."""
    values = np.random.default_rng(5).random((80, 64, 3))
    return SimulatedSource(image_scene(values, camera, np.linspace(450, 850, 3)), Rig(camera), seed=3)


def record(source: SimulatedSource, sweep: Sweep, counted: list[int] | None = None) -> RecordedSweep:
    """Record one sweep of the simulated rig. Later reads append their line numbers to ``counted``."""
    lines = SimulatedSweep(source, sweep)
    exposure_ms = source.camera.exposure_ms if sweep.exposure_ms is None else sweep.exposure_ms

    def read(numbers: NDArray[np.intp]) -> NDArray[np.uint16]:
        if counted is not None:
            counted.extend(numbers.tolist())
        return np.concatenate([lines.read(first, stop) for first, stop in line_runs(numbers)])

    facts = lines.references, lines.position, lines.time_s, np.full(sweep.lines, exposure_ms), lines.valid_line
    return RecordedSweep(sweep, *facts, read)


def recording_of(source: SimulatedSource, sweeps: Sequence[RecordedSweep]) -> Recording:
    """Return recorded sweeps of the simulated rig's field as a source."""
    return Recording(sweeps, source.camera, source.wavelength_nm)


def assert_same(found: list[Line], expected: list[Line]) -> None:
    """Assert that lines are equal bit for bit: data, number, position, time, exposure and validity."""
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one.data, other.data)
        assert replace(one, data=other.data) == other
