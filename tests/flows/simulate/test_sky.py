"""The sky over a survey: overcast, exposures gather less light, scans expose longer, and the network knows of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flows.settings.load import load_settings
from flows.tasks.run import open_run
from flows.tasks.scene import open_scene
from pipeline.errors import SettingsError

SMALL: dict[str, Any] = {"scene": "scouting", "size": "96x64", "bands": "20,80,140,200", "engine": "plain"}


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        ({"sky.light": "cloudy"}, "--sky must be one of clear, overcast; got 'cloudy'"),
        ({"sky.light_fraction": 0.001}, "--light-fraction must be a number from 0.01 to 1"),
        ({"sky.light_fraction": 2}, "--light-fraction must be a number from 0.01 to 1"),
        ({"interest": 1.2}, "--interest must be a number from 0 to 1"),
        ({"scene": "farm", "interest": 0.2}, "--interest = 0.2 is for the scene scouting, and the scene is farm"),
        ({"scene": "field.png", "sky.light": "overcast"}, "--sky is of a camera, and the scene field.png is a raster"),
    ],
)
def test_wrong_skies_are_refused(flags: dict[str, Any], words: str) -> None:
    """With the flag, what came and what it may be."""
    with pytest.raises(SettingsError) as found:
        load_settings(None, SMALL | {"size": None, "bands": None} | flags)
    assert str(found.value).startswith(words)


def test_a_sky_is_a_fraction_of_the_light() -> None:
    """An eighth under an overcast sky, or what is said; the scene's key has it, and none under a clear one."""
    given = [{}, {"sky.light": "overcast"}, {"sky.light": "overcast", "sky.light_fraction": 0.5}]
    clear, overcast, half = (open_scene(load_settings(None, SMALL | one))[0] for one in given)
    assert [one.light_fraction for one in (clear, overcast, half)] == [1.0, 0.125, 0.5]
    assert [one.key.removeprefix(clear.key) for one in (clear, overcast, half)] == ["", "/light=0.125", "/light=0.5"]
    np.testing.assert_array_equal(overcast.electrons, clear.electrons / 8)


def test_a_field_at_night_is_noted() -> None:
    """Where the sun stands below the horizon when the survey begins."""
    noon, night = ({"sky": {"started": f"2026-06-01T{hour}:00:00Z"}} for hour in (12, "00"))
    assert open_scene(load_settings(None, SMALL | noon))[1] == ()
    (note,) = open_scene(load_settings(None, SMALL | night))[1]
    assert note == "the sun is 15 degrees below the horizon at sky.started: the field is dark"


def test_under_clouds_scans_expose_longer(tmp_path: Path) -> None:
    """The scan taken without a limit has the light of the one under a clear sky; the network reads both alike."""
    planned = {"scene": "scouting", "size": "160x128", "out": str(tmp_path)}
    for asked, same in (({}, True), ({"seconds": 4}, False)):
        clear, dim = (
            open_run(load_settings(None, planned | asked | sky), planning=True)
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
    """200 ms under an overcast sky are expected to score what 25 ms do under a clear one."""
    planned = {"scene": "scouting", "size": "160x128", "out": str(tmp_path), "scan_step": 2}
    asked = ({"scan_exposure_ms": 25}, {"scan_exposure_ms": 200, "sky.light": "overcast"})
    clear, dim = (open_run(load_settings(None, planned | one), planning=True) for one in asked)
    assert clear.capture == dim.capture
    assert dim.scans.chosen.expected == pytest.approx(dict(clear.scans.chosen.expected))
    assert dim.scans.chosen.seconds > clear.scans.chosen.seconds
