"""Surveys with a threshold: what they leave and say, and that one without it knows no word of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from flows.publish.receipt_table import sentences
from flows.publish.run_folder import Published
from flows.settings.load import load_settings
from pipeline.errors import SettingsError
from tests.conftest import Survey

# of a mirror that is reloaded fast: half of what a scene so small leaves then buys lines
RELOAD_S = 0.1
FLAGS: dict[str, Any] = {"budget": "0.9", "cost.reload_s": str(RELOAD_S)}


@pytest.fixture(scope="module")
def one(tmp_path_factory: pytest.TempPathFactory, survey_png: Survey) -> tuple[Published, Path]:
    """A survey without a threshold, and its archive."""
    out = tmp_path_factory.mktemp("one")
    return survey_png(out, **FLAGS), out


def test_a_threshold_leaves_seconds_and_says_so(
    one: tuple[Published, Path], survey_png: Survey, tmp_path: Path
) -> None:
    """Above what the plan shows a second less is bought; the receipt has what is left; the budget still holds."""
    mean = one[0].receipt["plan"]["score_per_second"]
    receipt: Any = survey_png(tmp_path, threshold=str(1.02 * mean), **FLAGS).receipt
    plan = receipt["plan"]
    assert plan["threshold"] == pytest.approx(1.02 * mean)
    assert plan["seconds"] < one[0].receipt["plan"]["seconds"]
    assert plan["spared_s"] > 0
    assert plan["spared_share"] == pytest.approx(plan["spared_s"] / receipt["savings"]["capture_s"]["full"])
    assert plan["spared_score"] > 0
    assert "unspent: no further run of lines pays" in " ".join(sentences(receipt))
    assert "threshold" not in one[0].receipt["plan"]


def test_a_threshold_above_all_gains_draws_the_coarse_map(survey_png: Survey, tmp_path: Path) -> None:
    """Nothing pays: no fine line, and the map is that of the coarse look alone."""
    done = survey_png(tmp_path, threshold="1e6", **FLAGS)
    receipt: Any = done.receipt
    assert done.looked_twice == 0
    assert receipt["plan"]["lines"] == 0
    assert receipt["accuracy"]["miou"] == receipt["accuracy"]["none"]["miou"]


def test_a_threshold_without_a_meaning_is_refused() -> None:
    """Scores that are no gain have no threshold."""
    with pytest.raises(SettingsError, match="policy 'margin' scores in a unit of its own: leave --threshold out"):
        load_settings(None, {"policy": "margin", "threshold": "0.5"})


def test_a_survey_without_a_threshold_stores_nothing_of_it(one: tuple[Published, Path]) -> None:
    """The plan, its keys and the receipt know no word of thresholds or rounds: old stores are found as they were."""
    receipt: Any = one[0].receipt
    key = next(stage["key"] for stage in receipt["stages"] if stage["name"] == "attend")
    folder = one[1] / "stages" / "attend" / key
    assert not {"threshold", "spared_s"} & set(json.loads((folder / "plan.json").read_text()))
    manifest = json.loads((folder / "manifest.json").read_text())
    assert not {"threshold", "rounds", "round"} & set(manifest["params"])
    assert not {"threshold", "spared_s"} & set(receipt["plan"])
