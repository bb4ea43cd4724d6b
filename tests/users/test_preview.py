"""Before going out: figures of field and captures in the plan."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import shapely

from flows.archive.plan_command import format_field, plan_content
from flows.settings.load import load_settings
from tests.users.zone_sketches import sketch

pytestmark = pytest.mark.usefixtures("no_effects")
DOWN = {"pose.lon_deg": 7.6, "pose.lat_deg": 51.96, "pose.height_m": 100, "pose.heading_deg": 0, "pose.tilt_deg": 90}


def planned(scene_files: Path, weights: Path, out: Path, **flags: Any) -> dict[str, Any]:
    """What `plan --json` gives of the small picture."""
    given = {
        "scene": str(scene_files / "scene.png"),
        "source": "sim",
        "weights": str(weights),
        "out": str(out),
        "budget": "0.8",
    }
    return plan_content(load_settings(None, given | flags))


def test_figures_of_a_posed_field_are_those_of_its_geometry(scene_files: Path, weights: Path, tmp_path: Path) -> None:
    """Straight down from 100 m, 128 x 96 px of 0.1057 mrad are 1.353 x 1.015 m."""
    field = planned(scene_files, weights, tmp_path, **DOWN)["field"]
    step = 100 * 7.4e-3 / 70
    assert field["ground_pixel_m"] == pytest.approx(step, rel=1e-4)
    assert list(field["footprint_m"].values()) == pytest.approx([128 * step, 96 * step])
    assert field["range_m"]["nearest"] == pytest.approx(100)
    assert field["hectares"] == pytest.approx(128 * 96 * step**2 / 1e4, rel=1e-6)
    seconds = field["camera_s"]
    assert seconds["all"] == pytest.approx(seconds["coarse"] + seconds["fine"])
    assert field["hectares_per_hour"] == pytest.approx(field["hectares"] / seconds["all"] * 3600)
    assert field["camera_s"]["full_scan"] > seconds["all"]


def test_without_a_place_there_are_pixels_and_degrees(scene_files: Path, weights: Path, tmp_path: Path) -> None:
    """No metres are made up, and the words say what gives them."""
    field = planned(scene_files, weights, tmp_path)["field"]
    assert field["size_px"] == [128, 96]
    assert field["view_deg"] == pytest.approx(np.rad2deg(2 * np.arctan(np.array([64, 48]) * 7.4e-3 / 70)))
    assert [field[name] for name in ("ground_pixel_m", "range_m", "hectares", "hectares_per_hour")] == [None] * 4
    assert "[pose]" in format_field(field)


def test_hectares_are_those_of_the_area(scene_files: Path, weights: Path, tmp_path: Path) -> None:
    """With an area of interest the ground, and what is scanned in an hour, is that of the area."""
    whole = planned(scene_files, weights, tmp_path, **DOWN)["field"]
    place = {"type": "name", "properties": {"name": "EPSG:32632"}}
    at = pyproj.Transformer.from_crs(4326, 32632, always_xy=True).transform(7.6, 51.96)
    path = Path(sketch(tmp_path / "half.geojson", {"half": shapely.box(at[0] - 5, at[1], at[0] + 5, at[1] + 5)}))
    path.write_text(json.dumps(json.loads(path.read_text()) | {"crs": place}))
    half = planned(scene_files, weights, tmp_path, **DOWN, **{"zones.area": str(path)})["field"]
    assert half["hectares"] == pytest.approx(whole["hectares"] / 2, rel=0.05)
    assert half["kept_fraction"] == pytest.approx(0.5, abs=0.03)
