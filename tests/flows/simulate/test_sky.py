"""The sky over a survey: less light under clouds, longer exposures, and the light in the network's input."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from spectralzoom.flows.cli.simulate_command import open_simulation
from spectralzoom.flows.opening.open_field import open_field
from spectralzoom.flows.opening.scene import open_scene
from spectralzoom.flows.planning.plan_survey import plan_survey
from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.pipeline.errors import SettingsError

SMALL: dict[str, Any] = {"scene": "scouting", "size": "96x64", "bands": "20,80,140,200", "engine": "plain"}


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        ({"sky.light": "cloudy"}, "--sky.light must be one of clear, overcast; got 'cloudy'"),
        ({"sky.light_fraction": 0.001}, "--sky.light-fraction must be a number from 0.01 to 1"),
        ({"sky.light_fraction": 2}, "--sky.light-fraction must be a number from 0.01 to 1"),
        ({"interest": 1.2}, "--interest must be a number from 0 to 1"),
        ({"scene": "farm", "interest": 0.2}, "--interest = 0.2 is for the scene scouting, and the scene is farm"),
        (
            {"scene": "field.png", "sky.light": "overcast"},
            "--sky.light is of a camera, and the scene field.png is a raster",
        ),
    ],
)
def test_bad_sky_settings_are_refused(flags: dict[str, Any], words: str) -> None:
    """The message has the flag, its value and the allowed values."""
    with pytest.raises(SettingsError) as found:
        load_settings(None, SMALL | {"size": None, "bands": None} | flags)
    assert str(found.value).startswith(words)


def test_a_sky_is_a_fraction_of_the_light() -> None:
    """An overcast sky leaves an eighth, or the given fraction; the scene's key has it, but not for a clear sky."""
    given = [{}, {"sky.light": "overcast"}, {"sky.light": "overcast", "sky.light_fraction": 0.5}]
    clear, overcast, half = (open_scene(load_settings(None, SMALL | one))[0] for one in given)
    assert [one.light_fraction for one in (clear, overcast, half)] == [1.0, 0.125, 0.5]
    assert [one.key.removeprefix(clear.key) for one in (clear, overcast, half)] == ["", "/light=0.125", "/light=0.5"]
    np.testing.assert_array_equal(overcast.electrons, clear.electrons / 8)


def test_a_field_at_night_has_a_warning(tmp_path: Path) -> None:
    """The sun is 15 degrees below the horizon at the start of the survey; a simulation has it as its first note."""
    noon, night = ({"sky": {"started": f"2026-06-01T{hour}:00:00Z"}} for hour in (12, "00"))
    dark = "the sun is 15 degrees below the horizon at sky.started: the field is dark"
    for started, warned in ((noon, ()), (night, (dark,))):
        settings = load_settings(None, SMALL | started | {"out": str(tmp_path)})
        assert open_simulation(settings)[1] == warned
        assert (dark in open_field(settings, planning=True).warnings) == bool(warned)


def test_scans_expose_longer_under_clouds(tmp_path: Path) -> None:
    """Without a time limit the expected mIoU is that of a clear sky; within 4 s it is lower."""
    planned = {"scene": "scouting", "size": "160x128", "out": str(tmp_path)}
    for asked, same in (({}, True), ({"seconds": 4}, False)):
        clear, dim = (
            plan_survey(open_field(load_settings(None, planned | asked | sky), planning=True))
            for sky in ({}, {"sky.light": "overcast"})
        )
        assert clear.scans.chosen is not None
        assert dim.scans.chosen is not None
        assert dim.capture.light == pytest.approx(dim.scans.chosen.exposure_ms / 100 / 8)
        if same:
            assert dim.scans.chosen.exposure_ms > clear.scans.chosen.exposure_ms
            assert dim.scans.chosen.expected["mIoU"] == pytest.approx(clear.scans.chosen.expected["mIoU"], abs=0.005)
        else:
            assert dim.scans.chosen.seconds <= 4
            assert dim.scans.chosen.expected["mIoU"] < clear.scans.chosen.expected["mIoU"]
        assert max(scan.exposure_ms for scan in dim.scans.offered) == 800


def test_a_scan_by_hand_scores_by_its_light(tmp_path: Path) -> None:
    """200 ms under an overcast sky have the expected score of 25 ms under a clear one."""
    planned = {"scene": "scouting", "size": "160x128", "out": str(tmp_path), "scan_step": 2}
    asked = ({"scan_exposure_ms": 25}, {"scan_exposure_ms": 200, "sky.light": "overcast"})
    clear, dim = (plan_survey(open_field(load_settings(None, planned | one), planning=True)) for one in asked)
    assert clear.capture == dim.capture
    assert dim.scans.chosen.expected == pytest.approx(dict(clear.scans.chosen.expected))
    assert dim.scans.chosen.seconds > clear.scans.chosen.seconds
