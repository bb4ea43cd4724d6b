"""Sweeps that cover a field, the lines of a patch, swaths at any offset, and the samples on the scene."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spectralzoom.pipeline.errors import PoseError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.geometry.mirror import direction_to_scene, position_to_normal, reflect
from spectralzoom.pipeline.geometry.scan import CostModel, Sweep, line_positions, scene_to_sweep
from spectralzoom.pipeline.planning.coverage import (
    cheapest_full,
    full_sweeps,
    on_scene,
    reach_px,
    uniform_sweeps,
    with_margin,
)

CAMERA = LineCamera()
COST = CostModel()


def unseen(sweeps: list[Sweep], grid: SceneGrid) -> int:
    """Return the number of (coarse) pixel centres that no sweep sees with all their resampling taps."""
    step = sweeps[0].step
    across, scan = (grid.width, grid.height) if sweeps[0].along == "x" else (grid.height, grid.width)
    centres = [np.arange(-(-size // step)) * step + (step - 1) / 2 - (size - 1) / 2 for size in (across, scan)]
    along = np.broadcast_to(centres[0][:, None], (len(centres[0]), len(centres[1])))
    seen = np.zeros(along.shape, bool)
    for sweep in sweeps:
        at = scene_to_sweep(sweep, CAMERA, along, centres[1][None, :])
        low, high = np.floor(at[..., 0] + 1e-6) - 1, np.floor(at[..., 0] + 1e-6) + 2
        inside = (at[..., 1] >= -0.5 - 1e-6) & (at[..., 1] <= CAMERA.samples // step - 0.5 + 1e-6)
        seen |= inside & (low >= 0) & (high <= sweep.lines - 1)
    return int(np.count_nonzero(~seen))


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 1500), st.integers(1, 300), st.sampled_from(["x", "y"]))
def test_full_scan_sees_every_pixel(height: int, width: int, along: str):
    """A full scan has the resampling taps of every pixel of its grid, for any size."""
    grid = SceneGrid(height, width, 16)
    assert unseen(full_sweeps(grid, CAMERA, along), grid) == 0


@pytest.mark.parametrize(("size", "swaths"), [(1, 1), (640, 1), (641, 2), (1280, 2), (1281, 3), (1920, 3)])
def test_swaths_are_the_fewest_that_cover_the_field(size: int, swaths: int):
    """A line of 640 samples covers 640 px, and slightly more away from the axis. Swaths lie symmetrically."""
    sweeps = full_sweeps(SceneGrid(200, size, 16), CAMERA, "x")
    assert len(sweeps) == swaths
    assert [sweep.swath_px for sweep in sweeps] == pytest.approx([-sweep.swath_px for sweep in sweeps[::-1]], abs=1e-6)


def test_swaths_on_the_axis_scan_only_the_scene_and_its_taps():
    """Without rotation a full scan has the scene's rows and three lines for taps, and its lines lie on the rows."""
    (sweep,) = full_sweeps(SceneGrid(480, 600, 16), CAMERA, "x")
    assert sweep.lines == 483
    assert sweep.start_px == -479 / 2 - 1
    (coarse,) = uniform_sweeps(SceneGrid(480, 600, 16), CAMERA, "x", step=4)
    assert coarse.lines == 123


def test_known_fields_need_their_known_lines():
    """A field of 1280 x 1024 needs 2098 full or 528 coarse lines; 1296 x 966 is cheaper with lines along y."""
    along, sweeps, seconds = cheapest_full(SceneGrid(1024, 1280, 16), CAMERA, COST)
    assert (along, sum(s.lines for s in sweeps), round(seconds, 1)) == ("x", 2098, 213.9)
    assert sum(s.lines for s in uniform_sweeps(SceneGrid(1024, 1280, 16), CAMERA, "x", step=4)) == 528
    along, sweeps, _ = cheapest_full(SceneGrid(966, 1296, 32), CAMERA, COST)
    assert (along, len(sweeps)) == ("y", 2)


def test_fields_beyond_the_mirror_range_are_refused():
    """The error names the sweep, the mirror's range and the remedy."""
    with pytest.raises(PoseError, match=r"sweep full-0 .* beyond the mirror's range.*smaller scene"):
        full_sweeps(SceneGrid(23_000, 640, 32), CAMERA, "x")
    with pytest.raises(PoseError, match="beyond the mirror's range"):
        cheapest_full(SceneGrid(24_000, 24_000, 32), CAMERA, COST)
    for shape in ((1024, 1280), (4000, 64)):  # neither several swaths nor a single line of such a lens reach them
        with pytest.raises(PoseError, match="beyond the mirror's range"):
            cheapest_full(SceneGrid(*shape, 16), LineCamera(focal_length_mm=3.0), COST)


@pytest.mark.parametrize("along", ["x", "y"])
@pytest.mark.parametrize("binning", [1, 4])
def test_samples_on_the_scene_follow_the_rays(along: str, binning: int):
    """Far off the axis the mask has exactly the samples whose reflected ray meets a pixel of the scene."""
    sweep = Sweep("s", "fine", along, swath_px=2300.3, start_px=-1100.2, lines=90, binning=binning)
    slopes = CAMERA.pixel_slopes(binning)
    rays = np.stack([np.zeros_like(slopes), slopes, np.ones_like(slopes)], axis=-1)
    normals = position_to_normal(line_positions(sweep, CAMERA))
    place = direction_to_scene(reflect(rays[None], normals[:, None])) / CAMERA.ifov_rad
    shape = (2100, 4700) if along == "x" else (4700, 2100)
    met = np.all((place >= [-2350, -1050]) & (place < [2350, 1050]), axis=-1)
    assert 0 < met.sum() < met.size
    np.testing.assert_array_equal(on_scene(shape, CAMERA, sweep), met)


@pytest.mark.parametrize("overlap_px", [0.0, 64.0, 164.0, 320.0])
def test_neighbouring_swaths_overlap_as_requested(overlap_px: float):
    """Neighbours overlap by at least the given width, with the fewest swaths. An overlap of 0 changes nothing."""
    grid = SceneGrid(300, 1100, 16)
    for cover in (full_sweeps, partial(uniform_sweeps, step=4)):
        sweeps = cover(grid, CAMERA, "x", overlap_px=overlap_px)
        reach = [sweep.swath_px + reach_px(sweep.swath_px, grid.height, CAMERA, sweep.binning) for sweep in sweeps]
        assert all(left[1] - right[0] >= overlap_px - 1e-3 for left, right in pairwise(reach))
        assert len(sweeps) == int(np.ceil(1100 / (640 - overlap_px)))
    assert full_sweeps(grid, CAMERA, "x", overlap_px=0) == full_sweeps(grid, CAMERA, "x")


@pytest.mark.parametrize(("margin_px", "lines"), [(0.0, 0), (0.5, 1), (8.0, 2), (9.0, 3)])
def test_margins_are_whole_lines_at_both_ends(margin_px: float, lines: int):
    """Every sweep gets the fewest lines that reach the margin at both ends, and keeps its own lines."""
    sweeps = uniform_sweeps(SceneGrid(300, 700, 16), CAMERA, "x", step=4)
    for sweep, grown in zip(sweeps, with_margin(sweeps, CAMERA, margin_px), strict=True):
        assert grown == replace(sweep, start_px=sweep.start_px - 4 * lines, lines=sweep.lines + 2 * lines)
        assert sweep.held_px()[0, 0] - grown.held_px()[0, 0] >= margin_px
        assert grown.held_px()[-1, -1] - sweep.held_px()[-1, -1] >= margin_px
