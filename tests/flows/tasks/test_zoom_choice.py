"""Which fields the planner captures in two passes, if a time budget is given and nobody asks for either way."""

from __future__ import annotations

from pathlib import Path

import pytest

from flows.settings.load import load_settings
from flows.tasks.run import SurveyRun, open_run

WIDE = {"camera.samples": "80", "seconds": "27"}  # eight swaths; the usual camera covers the field by one


def planned(out: Path, **flags: str) -> SurveyRun:
    """An opened survey of the farm."""
    return open_run(load_settings(None, {"scene": "farm", "size": "640x512", "out": str(out), **flags}), planning=True)


@pytest.mark.parametrize(
    ("flags", "zooms"),
    [
        (WIDE, True),
        ({**WIDE, "seconds": "182", "sky.light_fraction": "0.0625"}, True),
        ({**WIDE, "camera.samples": "160", "seconds": "14"}, False),  # four swaths
        ({**WIDE, "camera.samples": "640", "seconds": "6"}, False),
        ({**WIDE, "seconds": "200"}, False),  # a uniform scan is as good as the best
        ({"camera.samples": "80"}, False),
        ({**WIDE, "zoom": "never"}, False),
        ({**WIDE, "macs": "60%"}, False),
        ({**WIDE, "kept_bytes": "8MB"}, False),
        ({"size": "5120x4096", "seconds": "150"}, True),
        ({"size": "5120x4096", "seconds": "150", "pointing_px": "2"}, False),
        ({"camera.samples": "80", "goal": "85"}, False),
    ],
    ids=str,
)
def test_two_passes_are_taken_on_wide_fields_in_short_times(tmp_path: Path, flags: dict[str, str], zooms: bool) -> None:
    """The settings of the run say which way was taken, and no limit of a uniform scan is dropped."""
    run = planned(tmp_path, **flags)
    assert (run.settings.zoom, run.plan.plain) == ("always" if zooms else "never", not zooms)
    assert (run.scans.chosen is None) == zooms
    assert any(note.startswith("two passes: every 4th line") for note in run.notes) == zooms


def test_the_choice_is_the_plan_that_one_may_ask_for(tmp_path: Path) -> None:
    """First pass and time left are those of `--zoom always`; a receipt's settings plan the same again."""
    chosen, asked = planned(tmp_path, **WIDE), planned(tmp_path, **WIDE, zoom="always")
    assert (chosen.plan, chosen.settings) == (asked.plan, asked.settings)
    assert chosen.plan.coarse_s + chosen.plan.fine_s == pytest.approx(27)


def test_the_line_spacing_of_the_first_pass_may_be_given(tmp_path: Path) -> None:
    """Its exposure is then the best one for that spacing; without it the weights choose every 4th line."""
    given, usual = (planned(tmp_path, **WIDE, zoom="always", **step) for step in ({"scan_step": "8"}, {}))
    assert (given.settings.scan_step, usual.settings.scan_step) == (8, 4)
    assert given.plan.coarse_s < usual.plan.coarse_s
    assert given.plan.coarse_s + given.plan.fine_s == pytest.approx(27)
