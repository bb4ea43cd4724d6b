"""The ground pixel and the hectares are the same in settings, plans, pages, receipts and texts."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pyproj
import pytest
import shapely

from spectralzoom.flows.archive.plan_command import plan_content
from spectralzoom.flows.opening.zones import place_of_field
from spectralzoom.flows.publish.receipt_table import finding_rows
from spectralzoom.flows.settings.load import declared
from spectralzoom.flows.settings.settings import Settings, load_settings
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.ground.field_places import scale_of_pixels, scale_of_view
from spectralzoom.pipeline.ground.view import GroundView, RigPose
from spectralzoom.pipeline.simulator.scenes.farm.farm_scene import farm_scene
from spectralzoom.pipeline.simulator.scenes.laws import FARM_PIXEL_M
from tests.conftest import Flags, Survey
from tests.users.zone_sketches import sketch

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "ground-and-zones.md"


def test_example_poses_see_the_farms_ground_pixel() -> None:
    """The settings' examples, by height and by range, and the page on the ground agree within 1 % (hectares 3 %)."""
    shape = (1024, 1280)
    camera = LineCamera()
    told = {name: one["example"] for name, one in declared(Settings)["pose"].items()}
    common = {name: told[name] for name in ("lon_deg", "lat_deg", "heading_deg", "tilt_deg")}
    (block,) = re.findall(r"```toml\n(\[pose\].*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    own = scale_of_pixels(shape, camera.ifov_rad, FARM_PIXEL_M)
    from_settings = [{**common, name: told[name]} for name in ("height_m", "range_m")]
    for asked in (*from_settings, tomllib.loads(block)["pose"]):
        seen = scale_of_view(GroundView(RigPose(**asked), camera.ifov_rad), shape)
        assert seen.pixel_m == pytest.approx(FARM_PIXEL_M, rel=0.01)
        assert seen.hectares == pytest.approx(own.hectares, rel=0.03)


def test_the_farm_has_its_own_scale() -> None:
    """Without a pose the farm's own ground pixel gives its hectares."""
    scene = farm_scene(1, (20, 50), bands=2)
    scale = place_of_field(load_settings(), scene).scale(LineCamera().ifov_rad)
    assert (scale.pixel_m, scale.hectares) == (FARM_PIXEL_M, pytest.approx(20 * 50 * FARM_PIXEL_M**2 / 1e4))


def test_a_receipt_without_a_place_has_no_metres(surveyed_png: Survey, tmp_path: Path) -> None:
    """A picture without a place is described in pixels and view angles only."""
    receipt = surveyed_png(tmp_path / "archive").receipt
    assert receipt["field"]["ground_pixel_m"] is None
    assert receipt["field"]["size_px"] == [128, 96]
    assert dict(finding_rows(receipt))["field"] == "view 0.775 x 0.581 degrees"


def test_the_field_row_has_the_values_of_the_receipt() -> None:
    """View, range, hectares, ground pixel and pace are in one row."""
    field = {
        "view_deg": [7.74, 6.2],
        "ground_pixel_m": 0.12,
        "range_m": {"nearest": 799.0, "median": 860.0, "farthest": 935.0},
        "hectares": 1.887,
        "hectares_per_hour": 1.887 / 24.5 * 3600,
    }
    ((_, said),) = finding_rows({"field": field})
    assert said == "view 7.74 x 6.2 degrees; range 860 m; 1.89 ha; ground pixel 12 cm; hectares per hour 277"


DOWN = {"pose.lon_deg": 7.6, "pose.lat_deg": 51.96, "pose.height_m": 100, "pose.heading_deg": 0, "pose.tilt_deg": 90}


@pytest.mark.usefixtures("no_effects")
def test_hectares_are_those_of_the_area(flags_png: Flags, tmp_path: Path) -> None:
    """Half of the field as area of interest halves the hectares and gives a kept fraction of 0.5."""
    asked = flags_png(tmp_path, budget="0.8") | DOWN
    whole = plan_content(load_settings(None, asked))["field"]
    at = pyproj.Transformer.from_crs(4326, 32632, always_xy=True).transform(7.6, 51.96)
    path = sketch(tmp_path / "half.geojson", {"half": shapely.box(at[0] - 5, at[1], at[0] + 5, at[1] + 5)}, 32632)
    assert whole["hectares"] == pytest.approx(128 * 96 * (100 * 7.4e-3 / 70) ** 2 / 1e4, rel=1e-6)
    half = plan_content(load_settings(None, asked | {"area": path}))["field"]
    assert half["hectares"] == pytest.approx(whole["hectares"] / 2, rel=0.05)
    assert half["kept_fraction"] == pytest.approx(0.5, abs=0.03)
