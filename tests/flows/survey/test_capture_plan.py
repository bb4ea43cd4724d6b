"""What a survey lays out before it starts, where the mirror may look beside the plan."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from flows.settings.load import parse_settings
from flows.survey.run import plan_capture
from pipeline.errors import SettingsError
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Sweep
from pipeline.planning.coverage import coarse_sweeps, full_sweeps, reach_px

GRID = SceneGrid(300, 1500, 16, 4)
OFF = 20.0


def shared_px(sweeps: list[Sweep]) -> float:
    """The least that neighbouring strips share [px]."""
    camera = parse_settings({}).camera
    reach = [one.strip_px + reach_px(one.strip_px, GRID.height, camera, one.binning) for one in sweeps]
    return min(float(left[1] - right[0]) for left, right in pairwise(reach))


def test_either_pass_overlaps_by_what_it_needs() -> None:
    """64 pixels of its own are left where neighbours look as far apart as they can; the full scan pays for no more."""
    plan = plan_capture(parse_settings({"pointing_px": OFF, "budget": 1.0}), GRID)
    assert plan.along == "x"
    assert plan.overlap_px == 2 * OFF + 64 * 4
    assert shared_px(plan.coarse) >= plan.overlap_px - 1e-3
    assert shared_px(plan.full) >= 2 * OFF + 64 - 1e-3
    assert len(plan.full) == int(np.ceil(1500 / (640 - 2 * OFF - 64)))


def test_sweeps_reach_beyond_the_field_by_twice_the_error() -> None:
    """The sweep that is held may look one way and its neighbour the other: both ends of the map are seen by both."""
    plan = plan_capture(parse_settings({"pointing_px": OFF, "budget": 1.0}), GRID)
    for sweep in (*plan.coarse, *plan.full):
        held = sweep.held_px()
        assert held[0, 0] <= -GRID.height / 2 - 2 * OFF
        assert held[-1, -1] >= GRID.height / 2 + 2 * OFF


def test_a_mirror_that_is_believed_costs_nothing() -> None:
    """Without a pointing error there are neither overlaps nor margins."""
    settings = parse_settings({"budget": 1.0})
    plan = plan_capture(settings, GRID)
    assert plan.overlap_px == 0
    assert plan.full == full_sweeps(GRID, settings.camera, plan.along)
    assert plan.coarse == coarse_sweeps(GRID, settings.camera, plan.along)


def test_overlaps_of_a_whole_line_are_refused() -> None:
    """The message names the flag and the error that could still be put right."""
    with pytest.raises(SettingsError, match=r"^--pointing-px 192: .* overlap by 640 px .* give less than 192$"):
        plan_capture(parse_settings({"pointing_px": 192.0}), GRID)
