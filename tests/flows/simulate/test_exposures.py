"""A coarse pass of its own exposure: what it costs, what is stored, and what it leaves for the fine pass."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

pytestmark = pytest.mark.usefixtures("no_effects")


def _cubes(archive: Path) -> dict[str, xr.Dataset]:
    return {path.stem: xr.open_zarr(path, consolidated=False) for path in archive.glob("stages/condense*/*/*.zarr")}


def test_a_faster_coarse_pass_leaves_its_seconds_to_the_fine_one(survey_png: Any, tmp_path: Path) -> None:
    """Cubes say which exposure a line had; the budget is the same, and the fine pass gets what the coarse one saves."""
    usual = survey_png(tmp_path / "usual", budget="0.6").receipt
    fast = survey_png(tmp_path / "fast", budget="0.6", coarse_exposure_ms="25").receipt
    cubes = _cubes(tmp_path / "fast")
    coarse = [cube for name, cube in cubes.items() if name.startswith("coarse")]
    assert {value for cube in coarse for value in cube["exposure_ms"].values.tolist()} == {25.0}
    assert {len(set(np.diff(cube["time"].values).round(6).tolist())) for cube in coarse} == {1}
    fine = [cube for name, cube in cubes.items() if name.startswith("fine")]
    assert {value for cube in fine for value in cube["exposure_ms"].values.tolist()} == {100.0}
    fine_s = [receipt["plan"]["seconds"] for receipt in (usual, fast)]
    coarse_s = [one["savings"]["capture_s"]["done"] - fine for one, fine in zip((usual, fast), fine_s, strict=True)]
    spared_s = (sum(cube.sizes["line"] for cube in coarse) + 2 * len(coarse)) * 0.075  # lines, and frames to settle
    assert coarse_s[0] - coarse_s[1] == pytest.approx(spared_s)
    assert fine_s[1] > fine_s[0] + spared_s / 2
    seconds = [receipt["savings"]["capture_s"] for receipt in (usual, fast)]
    assert seconds[0]["full"] == seconds[1]["full"]
    assert all(one["done"] <= 0.6 * one["full"] for one in seconds)
