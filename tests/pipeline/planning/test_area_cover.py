"""Sweeps cut to a part of a field: they still show all of it, and nothing is taken for nothing."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Axis, scene_to_sweep
from pipeline.planning.coverage import full_sweeps, lines_showing, patches_shown, sweeps_over, uniform_sweeps

GRID, CAMERA = SceneGrid(320, 416, 16, 4), LineCamera(samples=160)


def shown_of(top: int, left: int, rows: int, columns: int) -> np.ndarray:
    """Patches of a block, (patch,)."""
    shown = np.zeros(GRID.patch_shape, bool)
    shown[top : top + rows, left : left + columns] = True
    return (shown & (GRID.valid_fraction() > 0)).ravel()


blocks = st.builds(shown_of, st.integers(0, 19), st.integers(0, 25), st.integers(1, 8), st.integers(1, 8))


@given(blocks, st.sampled_from(["x", "y"]))
def test_every_patch_that_was_shown_still_is(shown: np.ndarray, along: Axis) -> None:
    """Of a full scan that is cut, each swath has the lines that show part of them."""
    sweeps = full_sweeps(GRID, CAMERA, along)
    cut = sweeps_over(sweeps, GRID, CAMERA, shown)
    before, after = (patches_shown(one, GRID, CAMERA) for one in (sweeps, cut))
    assert after[before & shown].all()
    assert sum(one.lines for one in cut) < sum(one.lines for one in sweeps)


@given(blocks)
def test_lines_stay_where_they_lie(shown: np.ndarray) -> None:
    """A coarse sweep that is cut holds positions that the whole one does, and no others."""
    whole = {sweep.name: sweep for sweep in uniform_sweeps(GRID, CAMERA, "x", step=4)}
    for sweep in sweeps_over(list(whole.values()), GRID, CAMERA, shown):
        assert np.isin(sweep.held_px(), whole[sweep.name].held_px()).all()


def test_swaths_beside_the_area_are_left_out() -> None:
    """A corner of the field needs one strip of three."""
    sweeps = full_sweeps(GRID, CAMERA, "x")
    assert len(sweeps) == 3
    assert [one.name for one in sweeps_over(sweeps, GRID, CAMERA, shown_of(0, 0, 3, 3))] == ["full-0"]
    assert sweeps_over(sweeps, GRID, CAMERA, np.zeros_like(shown_of(0, 0, 1, 1))) == []


def test_a_patch_has_all_lines_that_resampling_reads() -> None:
    """From the line before its first pixel to two lines after its last, where the sweep has them."""
    for sweep in full_sweeps(GRID, CAMERA, "x"):
        for patch in GRID.valid_patches()[::5]:
            down, across = GRID.patch_origin(np.array([patch]))[0]
            y, x = (place + np.arange(16) - (size - 1) / 2 for place, size in ((down, 320), (across, 416)))
            at = scene_to_sweep(sweep, CAMERA, x[None, :], y[:, None])
            line = np.floor(at[np.abs(at[..., 1] - 79.5) <= 80][:, 0])
            first, stop = lines_showing(sweep, GRID, CAMERA, np.array([patch])) or (sweep.lines, 0)
            assert first <= max(line.min(initial=np.inf) - 1, 0)
            assert stop > min(line.max(initial=-np.inf) + 2, sweep.lines - 1)
