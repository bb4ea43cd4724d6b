"""Seats rendered alone: the bytes of the whole lines, and all that a patch is resampled from."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.camera import LineCamera
from pipeline.coverage import coarse_sweeps, full_sweeps
from pipeline.grid import SceneGrid
from pipeline.rectify.region import read_seats
from pipeline.scan import Axis
from pipeline.simulator.instrument import effects_on
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.image_scene import raster_from_values
from pipeline.simulator.seat_windows import render_seats, seat_window
from pipeline.simulator.simulated import SimulatedSource, SimulatedSweep

CAMERA = LineCamera(samples=96)
GRID = SceneGrid(100, 130, 16, 4)
NAMES = ("rotation", "slit", "smear", "vignetting", "prnu", "shot", "read-noise")


def source_of(*more: str) -> SimulatedSource:
    """A source over a scene that differs at every pixel."""
    values = np.random.default_rng(4).uniform(0.2, 1, (GRID.height, GRID.width, 3))
    scene = raster_from_values(values, CAMERA, name="t", wavelength_nm=np.array([500.0, 600.0, 700.0]))
    return SimulatedSource(scene, Rig(CAMERA), 7, effects_on(*NAMES, *more))


@pytest.mark.parametrize("along", ["x", "y"])
@pytest.mark.parametrize("more", [(), ("stray-light",)], ids=["windows", "whole lines"])
def test_windows_are_cut_out_of_whole_lines(along: Axis, more: tuple[str, ...]) -> None:
    """Every window of every sweep, coarse and fine, holds the numbers of the whole lines there."""
    source = source_of(*more)
    seats = [0, 10, 62]
    for sweep in (coarse_sweeps(GRID, CAMERA, along)[0], full_sweeps(GRID, CAMERA, along)[-1]):
        windows = list(render_seats(source, sweep, GRID, seats))
        assert windows
        for window in windows:
            whole = source.render(sweep, window.lines)
            cut = whole[:, window.samples.start : window.samples.stop]
            np.testing.assert_array_equal(window.raw, cut)
            assert window.raw.size < whole.size


@pytest.mark.parametrize("along", ["x", "y"])
def test_windows_hold_all_that_a_patch_needs(along: Axis) -> None:
    """A patch is the same where all numbers beside its windows are spoiled."""
    source, seat = source_of(), 19
    sweeps = full_sweeps(GRID, CAMERA, along)
    windows = {sweep.name: seat_window(sweep, CAMERA, GRID, seat) for sweep in sweeps}

    class Spoiled(SimulatedSweep):
        def read(self, start: int, stop: int) -> np.ndarray:
            """Lines with full scale beside the window."""
            raw = super().read(start, stop)
            kept = np.zeros(raw.shape, bool)
            if (window := windows[self.sweep.name]) is not None:
                lines, samples = window
                kept[max(lines.start - start, 0) : max(lines.stop - start, 0), samples.start : samples.stop] = True
            return np.where(kept, raw, np.uint16(4095))

    patches = [read_seats([kind(source, sweep) for sweep in sweeps], CAMERA, GRID, np.array([seat]))
               for kind in (SimulatedSweep, Spoiled)]  # fmt: skip
    assert patches[0][1].any()
    for one, other in zip(*patches, strict=True):
        np.testing.assert_array_equal(one, other)


def test_seats_that_a_sweep_does_not_show_are_left_out() -> None:
    """A strip at one side of the field has no window for seats at the other."""
    sweep = full_sweeps(GRID, CAMERA, "x")[0]
    assert sweep.strip_px < 0
    assert seat_window(sweep, CAMERA, GRID, 0) is not None
    last = GRID.seat_shape[1] - 1
    assert seat_window(sweep, CAMERA, GRID, last) is None
    assert [window.seat for window in render_seats(source_of(), sweep, GRID, [last, 0])] == [0]
