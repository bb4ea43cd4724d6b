"""Passes over one swath: later lines lie between those of the first pass, and are read in order of place."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import Sweep, line_positions
from spectralzoom.pipeline.planning.fine_pass import every_nth, lines_between
from spectralzoom.pipeline.rectify.placed import PixelGrid
from spectralzoom.pipeline.rectify.sweep_paths import capture_numbers, interlaced_paths, sweep_paths
from spectralzoom.pipeline.signal.components import Components
from spectralzoom.pipeline.source import References

CAMERA = LineCamera()
SCALE = 8  # steps of a stored score per pixel along the scan
FIRST = every_nth([Sweep("full-0", "fine", "x", 0.0, -40.0, 81)], 4, 50.0)  # lines at -40, -36 ... 40
RUN = Sweep("fine-0", "fine", "x", 0.0, -20.0, 21)


FRAME = np.zeros((CAMERA.samples, 1), np.float32)


def place_lines(sweep: Sweep, source: str = "sim") -> Any:
    """Return condensed lines whose score is their own place along the scan."""
    places = np.rint(sweep.line_px() * SCALE).astype(np.int32)[:, None, None].repeat(CAMERA.samples, axis=1)
    return SimpleNamespace(
        sweep=sweep,
        source=source,
        step=1 / SCALE,
        components=Components(np.zeros(1), np.eye(1), np.ones(1)),
        references=References(FRAME, FRAME + 1, FRAME[0] + 1),
        position=line_positions(sweep, CAMERA),
        time_s=0.1 * np.arange(sweep.lines),
        exposure_ms=np.full(sweep.lines, 100.0),
        valid_line=np.ones(sweep.lines, np.bool_),
        usable=np.ones((sweep.lines, CAMERA.samples), np.bool_),
        read=lambda start, stop, samples: places[start:stop, samples],
    )


@pytest.mark.parametrize("step", [1, 2])
def test_later_lines_and_first_pass_lines_become_one_sweep(step: int) -> None:
    """The run has every line of its spacing once, in order, with its own place and score and the mean exposure."""
    lines = [place_lines(sweep) for sweep in (*lines_between([RUN], FIRST, step=step, exposure_ms=100.0), *FIRST)]
    placed = interlaced_paths(sweep_paths(lines, CAMERA), CAMERA)
    assert [one.lines.sweep.kind for one in placed] == ["coarse", "fine"]
    run = placed[1].lines
    assert (run.sweep.step, run.sweep.start_px, run.sweep.lines) == (step, -20.0, 20 // step + 1)
    here = np.arange(-20, 1, step)
    np.testing.assert_array_equal(run.read(0, len(here))[:, 5, 0], here * SCALE)
    np.testing.assert_array_equal(run.read(3, 7)[:, 5, 0], here[3:7] * SCALE)
    wanted = Sweep("run", "fine", "x", 0.0, -20.0, len(here), step, held=1)
    np.testing.assert_allclose(run.position, line_positions(wanted, CAMERA), atol=1e-12)
    first = np.isin(here, FIRST[0].line_px())
    assert run.sweep.exposure_ms == pytest.approx((first.mean() / 50.0**2 + (1 - first.mean()) / 100.0**2) ** -0.5)


def test_a_run_that_repeats_first_pass_lines_stays_a_separate_sweep() -> None:
    """Such runs follow pointing errors, which registration then removes from each sweep separately."""
    lines = [place_lines(sweep) for sweep in (*FIRST, *lines_between([RUN], []))]
    placed = interlaced_paths(sweep_paths(lines, CAMERA), CAMERA)
    assert [(one.lines.sweep.kind, one.lines.sweep.step) for one in placed] == [("coarse", 4), ("fine", 1)]
    assert placed[1].lines.sweep.lines == RUN.lines


def test_a_pixel_belongs_to_the_pass_with_the_closest_lines() -> None:
    """Pixels within the run belong to it, all others to the first pass."""
    lines = [place_lines(sweep) for sweep in (*FIRST, *lines_between([RUN], FIRST))]
    placed = interlaced_paths(sweep_paths(lines, CAMERA), CAMERA)
    number = capture_numbers(placed, CAMERA, PixelGrid((-38.0, -50.0), 1, (76, 100)))
    assert number.shape == (76, 100)
    assert (number[20:36] == 1).all()
    assert (number[:16] == 0).all()
    assert (number[42:] == 0).all()


def test_corrections_are_matched_by_sweep_name() -> None:
    """The recorded offset, drift and gain apply to their sweep. Other sweeps have none."""
    found = {"coarse-0": {"offset_px": [1.0, -2.0], "drift_px_per_line": [0.0, 0.1], "gain": [2.0]}}
    one, other = sweep_paths([place_lines(FIRST[0]), place_lines(RUN)], CAMERA, found)
    np.testing.assert_allclose(one.shift_px[[0, -1]], [[1, -3], [1, -1]])
    assert one.gain.tolist() == [2.0]
    assert other.gain is None
    assert not other.shift_px.any()


@pytest.mark.parametrize(("source", "lost"), [("sim", 3), ("rig", 0)])
def test_pauses_of_a_rig_are_no_lost_lines(source: str, lost: int) -> None:
    """A rig pauses while it loads positions; its lost lines are marked as invalid rows instead."""
    lines = place_lines(RUN, source)
    lines.time_s[10:] += 0.3
    (path,) = sweep_paths([lines], CAMERA)
    assert path.facts()["lost"] == lost
