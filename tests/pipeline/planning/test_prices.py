"""Prices: the lines, samples, bytes and seconds of a sweep, savings, and the choice of patches."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.planning import coverage

CAMERA = LineCamera()


def test_saving_entries_have_a_ratio_unless_full_is_zero():
    """The ratio is done / full or None, and the receipt has four keys."""
    assert coverage.SavingEntry(3, 12).as_dict() == {"done": 3, "full": 12, "ratio": 0.25, "full_is": "predicted"}
    assert coverage.SavingEntry(3, 0).as_dict()["ratio"] is None


def test_samples_outside_of_the_scene_are_not_counted():
    """A line of 640 samples over a scene 100 px wide counts 100. Lines above and below the scene count none."""
    path = Sweep("a", "fine", "x", 0.0, -32.5, 66)
    assert coverage.count_samples([path], CAMERA, SceneGrid(60, 100, 16)) == 60 * 100
    assert coverage.count_samples([path], CAMERA, SceneGrid(60, 640, 16)) == 60 * 640
    beside = Sweep("a", "fine", "x", 0.0, 5000.0, 3)
    assert coverage.count_samples([beside], CAMERA, SceneGrid(60, 100, 16)) == 0
    assert coverage.raw_bytes([beside], CAMERA, 10) == 3 * 640 * 10 * 2


@given(st.integers(1, 90), st.integers(1, 45), st.sampled_from(["x", "y"]))
def test_a_full_scan_near_the_axis_samples_every_pixel_once(scan: int, half: int, along: str):
    """One swath through the axis has as many samples on the scene as the scene has pixels."""
    height, width = (scan, 2 * half) if along == "x" else (2 * half, scan)
    grid = SceneGrid(height, width, 8)
    assert coverage.count_samples(coverage.full_sweeps(grid, CAMERA, along), CAMERA, grid) == height * width


def test_savings_are_relative_to_the_full_scan():
    """The full scan relative to itself is 1 in every entry, no sweep relative to it is 0."""
    grid = SceneGrid(100, 700, 16)
    full = coverage.full_sweeps(grid, CAMERA, "x")
    same = coverage.capture_savings(full, full, CAMERA, grid)
    assert list(same) == ["lines", "samples"]
    assert [entry.as_dict()["ratio"] for entry in same.values()] == [1, 1]
    none = coverage.capture_savings([], full, CAMERA, grid)
    assert [entry.as_dict()["ratio"] for entry in none.values()] == [0, 0]


@given(st.lists(st.sampled_from([0.0, 1.0, 2.0, -1.0, np.nan, np.inf, -np.inf]), min_size=1, max_size=30), st.data())
def test_a_smaller_choice_of_patches_begins_a_larger_one(values: list[float], data: st.DataObject):
    """The best K patches begin the best K + 1 for any scores, NaN included, and no patch occurs twice."""
    large = data.draw(st.integers(0, len(values)))
    small = data.draw(st.integers(0, large))
    chosen = coverage.select_patches(np.array(values), large)
    assert coverage.select_patches(np.array(values), small).tolist() == chosen[:small].tolist()
    assert len(set(chosen.tolist())) == large


@given(st.floats(0, 1), st.integers(0, 500))
def test_patch_counts_follow_the_fraction(fraction: float, valid: int):
    """The count is within half a patch of the fraction and at most the number of patches."""
    count = len(coverage.frame_patches(np.zeros(valid), fraction))
    assert abs(count - fraction * valid) <= 0.5 + 1e-9
    assert 0 <= count <= valid
