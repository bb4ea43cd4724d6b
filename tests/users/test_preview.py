"""Before going out: hectares in the plan."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pyproj
import pytest
import shapely

from flows.archive.plan_command import plan_content
from flows.settings.load import load_settings
from tests.conftest import Flags
from tests.users.zone_sketches import sketch

pytestmark = pytest.mark.usefixtures("no_effects")
DOWN = {"pose.lon_deg": 7.6, "pose.lat_deg": 51.96, "pose.height_m": 100, "pose.heading_deg": 0, "pose.tilt_deg": 90}


def planned(flags_png: Flags, out: Path, **flags: Any) -> dict[str, Any]:
    """What `plan --json` gives of the small picture."""
    return plan_content(load_settings(None, flags_png(out, budget="0.8") | flags))


def test_hectares_are_those_of_the_area(flags_png: Flags, tmp_path: Path) -> None:
    """With an area of interest the ground, and what is scanned in an hour, is that of the area."""
    whole = planned(flags_png, tmp_path, **DOWN)["field"]
    place = {"type": "name", "properties": {"name": "EPSG:32632"}}
    at = pyproj.Transformer.from_crs(4326, 32632, always_xy=True).transform(7.6, 51.96)
    path = Path(sketch(tmp_path / "half.geojson", {"half": shapely.box(at[0] - 5, at[1], at[0] + 5, at[1] + 5)}))
    path.write_text(json.dumps(json.loads(path.read_text()) | {"crs": place}))
    assert whole["hectares"] == pytest.approx(128 * 96 * (100 * 7.4e-3 / 70) ** 2 / 1e4, rel=1e-6)
    half = planned(flags_png, tmp_path, **DOWN, **{"zones.area": str(path)})["field"]
    assert half["hectares"] == pytest.approx(whole["hectares"] / 2, rel=0.05)
    assert half["kept_fraction"] == pytest.approx(0.5, abs=0.03)
