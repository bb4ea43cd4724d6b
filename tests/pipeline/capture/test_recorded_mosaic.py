"""Mosaics of recordings use the positions of the recorded lines, not those of the plan."""

from __future__ import annotations

from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.capture.recorded import RecordedSweep
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.rectify.region import mosaic_rows
from spectralzoom.pipeline.simulator.rig_model import Rig
from spectralzoom.pipeline.simulator.simulated import SimulatedSource
from tests.pipeline.capture.recordings import CAMERA, FULL, record, recording_of
from tests.pipeline.simulator.small_scenes import image_scene

GRID = SceneGrid(80, 64, 16)
COARSE = Sweep("coarse-0", "coarse", "x", 0.0, -39.5, 20, step=4)


def _ramp() -> SimulatedSource:
    """Return a rig without noise in front of a field whose reflectance grows by 0.01 a row."""
    values = np.broadcast_to(0.1 + 0.01 * np.arange(80)[:, None, None], (80, 64, 2))
    return SimulatedSource(image_scene(values, CAMERA, np.array([500.0, 700.0])), Rig(CAMERA), chosen={})


def _mosaic(recorded: RecordedSweep) -> NDArray[np.float32]:
    facts = {one.name: getattr(recorded, one.name) for one in fields(recorded)}
    lines: Any = SimpleNamespace(
        **facts, read=lambda start, stop, at: recorded.read_lines(np.arange(start, stop))[:, at]
    )
    return np.concatenate(list(mosaic_rows([lines], CAMERA, GRID, rows=80)))


def test_a_coarse_pass_of_single_recorded_lines_is_not_displaced() -> None:
    """Recorded lines lie half a pixel before the planned ones. The mosaic of a ramp is still right to 0.1 px.

    Rows next to the border are left out, because the footprint of their lines reaches beyond the field.
    """
    source = _ramp()
    recorded = recording_of(source, [record(source, FULL)])
    lines = list(recorded.lines(COARSE))
    captured = RecordedSweep(
        COARSE,
        recorded.references(COARSE),
        np.array([[line.mirror_x, line.mirror_y] for line in lines]),
        np.array([line.time_s for line in lines]),
        np.array([line.exposure_ms for line in lines]),
        np.array([line.valid for line in lines]),
        lambda numbers: np.stack([lines[number].data for number in numbers]),
    )
    found = _mosaic(captured)[8:-8, 8:-8, 0]
    expected = 0.1 + 0.01 * np.arange(80)
    np.testing.assert_allclose(found, np.broadcast_to(expected[8:-8, None], found.shape), atol=1e-3)
    np.testing.assert_allclose(found, _mosaic(record(source, COARSE))[8:-8, 8:-8, 0], atol=1e-3)


def test_mosaics_use_recorded_positions_not_the_planned_swath() -> None:
    """A sweep with another swath and start, but the same positions, gives the same mosaic bit for bit."""
    one = record(_ramp(), FULL)
    other = replace(one, sweep=replace(one.sweep, swath_px=3.0, start_px=11.0))
    np.testing.assert_array_equal(_mosaic(other), _mosaic(one))


def test_lines_beyond_a_gap_do_not_change_rows_before_it() -> None:
    """Rows before two lost lines keep their bits when the lines behind the gap are four times as bright."""
    one = record(_ramp(), replace(FULL, start_px=FULL.start_px - 0.4))
    one = replace(one, valid_line=~np.isin(np.arange(FULL.lines), (40, 41)))

    def other(numbers: NDArray[np.intp]) -> NDArray[np.uint16]:
        return np.where(numbers[:, None, None] > 41, 4 * one.read_lines(numbers), one.read_lines(numbers))

    plain, bright = (_mosaic(lines)[:40] for lines in (one, replace(one, read_lines=other)))
    assert np.isfinite(plain[36:40]).all()
    np.testing.assert_array_equal(bright, plain)
