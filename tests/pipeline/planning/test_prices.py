"""Prices: what a sweep counts for in lines, samples, bytes and seconds, savings, and the least budget."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import CostModel, Sweep
from pipeline.planning import coverage

CAMERA, COST = LineCamera(), CostModel()


def test_entries_have_a_ratio_unless_full_is_nothing():
    """Done over full, or None, and the receipt's four keys."""
    assert coverage.SavingEntry(3, 12).as_dict() == {"done": 3, "full": 12, "ratio": 0.25, "full_is": "predicted"}
    assert coverage.SavingEntry(3, 0).ratio is None


def test_samples_beside_the_scene_are_not_counted():
    """A line of 640 samples over a scene 100 px wide counts 100; lines above and below the scene count none."""
    path = Sweep("a", "fine", "x", 0.0, -32.5, 66)
    assert coverage.count_samples([path], CAMERA, SceneGrid(60, 100, 16)) == 60 * 100
    assert coverage.count_samples([path], CAMERA, SceneGrid(60, 640, 16)) == 60 * 640
    beside = Sweep("a", "fine", "x", 0.0, 5000.0, 3)
    assert coverage.count_samples([beside], CAMERA, SceneGrid(60, 100, 16)) == 0
    assert coverage.raw_bytes([beside], CAMERA, 10) == 3 * 640 * 10 * 2


@given(st.integers(1, 90), st.integers(1, 45), st.sampled_from(["x", "y"]))
def test_a_full_scan_near_the_axis_samples_every_pixel_once(scan: int, half: int, along: str):
    """One strip through the axis takes as many samples on the scene as it has pixels."""
    height, width = (scan, 2 * half) if along == "x" else (2 * half, scan)
    grid = SceneGrid(height, width, 8)
    assert coverage.count_samples(coverage.full_sweeps(grid, CAMERA, along), CAMERA, grid) == height * width


def test_the_ledger_compares_like_with_like():
    """The full scan against itself is 1 in every entry; nothing against it is 0."""
    grid = SceneGrid(100, 700, 16)
    full = coverage.full_sweeps(grid, CAMERA, "x")
    same = coverage.capture_savings(full, full, CAMERA, grid)
    assert list(same) == ["lines", "samples"]
    assert [entry.ratio for entry in same.values()] == [1, 1]
    assert [entry.ratio for entry in coverage.capture_savings([], full, CAMERA, grid).values()] == [0, 0]


SCORES = st.lists(st.sampled_from([0.0, 1.0, 2.0, -1.0, np.nan, np.inf, -np.inf]), min_size=1, max_size=30)


@given(SCORES, st.data())
def test_a_smaller_choice_is_the_beginning_of_a_larger_one(values: list[float], data: st.DataObject):
    """Top K lies in top K + 1, whatever the scores, and no patch comes twice."""
    large = data.draw(st.integers(0, len(values)))
    small = data.draw(st.integers(0, large))
    chosen = coverage.select_patches(np.array(values), large)
    assert coverage.select_patches(np.array(values), small).tolist() == chosen[:small].tolist()
    assert len(set(chosen.tolist())) == large


def test_only_valid_patches_are_chosen():
    """Masked patches are neither chosen nor counted, however good."""
    valid = np.array([False, True, True, False])
    assert coverage.select_patches(np.array([9.0, 1, 2, 9]), 2, valid).tolist() == [2, 1]
    assert len(coverage.frame_patches(np.arange(64.0), 0.35, np.arange(64) < 20)) == 7


@given(st.floats(0, 1), st.integers(0, 500))
def test_counts_follow_fractions(fraction: float, valid: int):
    """The count is within half a patch of the fraction and within the patches."""
    count = len(coverage.frame_patches(np.zeros(valid), fraction))
    assert abs(count - fraction * valid) <= 0.5 + 1e-9
    assert 0 <= count <= valid
