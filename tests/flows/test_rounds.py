"""Surveys of two rounds and with a threshold: what they buy, leave and say, and what a single round keeps."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from flows.archive.forecast import StageForecast, forecast
from flows.archive.stage_costs import PastCosts
from flows.archive.stale_runs import asked_again
from flows.publish.finding_words import sentences
from flows.publish.receipt import comparable
from flows.publish.run_folder import Published
from flows.settings.survey_settings import load_settings
from flows.survey.run import open_run
from flows.survey.survey import OF_ROUND_TWO, STAGES
from pipeline.errors import SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import CostModel, Sweep
from storage.archive.archive import Archive
from storage.archive.lineage import Catalogue
from tests.conftest import Survey

# of a mirror that is reloaded fast: half of what a scene so small leaves then buys lines
RELOAD_S = 0.1
FLAGS: dict[str, Any] = {"budget": "0.9", "cost.reload_s": str(RELOAD_S)}
AGAIN = ["attend_again", "capture_again", "cut_again"]


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory, survey_png: Survey) -> tuple[Published, Path]:
    """A survey of two rounds and its archive."""
    out = tmp_path_factory.mktemp("two")
    return survey_png(out, rounds="2", **FLAGS), out


@pytest.fixture(scope="module")
def one(tmp_path_factory: pytest.TempPathFactory, survey_png: Survey) -> tuple[Published, Path]:
    """The same survey of one round, in an archive of its own."""
    out = tmp_path_factory.mktemp("one")
    return survey_png(out, **FLAGS), out


def _open(done: tuple[Published, Path], product: str) -> xr.Dataset:
    receipt: Any = done[0].receipt
    found: xr.Dataset = xr.open_zarr(done[1] / receipt["products"][product], consolidated=False)
    return found


def _states(receipt: Any) -> dict[str, str]:
    return {stage["name"]: stage["state"] for stage in receipt["stages"]}


def _sweeps(done: tuple[Published, Path], product: str) -> list[Sweep]:
    receipt: Any = done[0].receipt
    folder = done[1] / receipt["products"][product]
    cubes = (xr.open_zarr(path, consolidated=False) for path in sorted(folder.glob("*.zarr")))
    return [Sweep(**cube.attrs["sweep"]) for cube in cubes]


def test_two_rounds_run_their_stages_in_order(two: tuple[Published, Path]) -> None:
    """The second round's stages stand between the first patches and the map; without them nothing else is named so."""
    names = list(_states(two[0].receipt))
    at = names.index("cut_patches") + 1
    assert names[at : at + 4] == list(OF_ROUND_TWO)
    assert names[at + 4] == "draw_map"
    assert all(_states(two[0].receipt)[name] == "ran" for name in AGAIN)
    assert Archive.open(two[1]).verify_all()
    assert all(finding.problem is None for finding in Archive.open(two[1]).verify_all())


def test_captured_seats_are_never_bought_twice(two: tuple[Published, Path]) -> None:
    """Every seat has one patch and one rank; the second round's seats are others than the first's, and follow them."""
    receipt: Any = two[0].receipt
    seats, rank = _open(two, "patches")["seat"].values, _open(two, "attention")["rank"].values.ravel()
    rounds = receipt["plan"]["rounds"]
    assert len(np.unique(seats)) == len(seats) == sum(row["seats"] for row in rounds)
    np.testing.assert_array_equal(np.sort(rank[rank >= 0]), np.arange(len(seats)))
    np.testing.assert_array_equal(np.sort(seats), np.flatnonzero(rank >= 0))
    assert all(row["seats"] > 0 for row in rounds)


def test_the_first_rounds_patches_are_kept_as_they_were(two: tuple[Published, Path]) -> None:
    """In the store of both rounds the first ones have the same values and validity, bit by bit."""
    archive, receipt = two[1], two[0].receipt
    keys = {stage["name"]: stage["key"] for stage in receipt["stages"]}
    first = xr.open_zarr(archive / "stages" / "patches" / keys["cut_patches"] / "patches.zarr", consolidated=False)
    both = _open(two, "patches")
    place = {seat: number for number, seat in enumerate(both["seat"].values.tolist())}
    entries = [place[seat] for seat in first["seat"].values.tolist()]
    assert 0 < len(entries) < both.sizes["patch"]
    np.testing.assert_array_equal(both["values"].values[entries], first["values"].values)
    np.testing.assert_array_equal(both["valid"].values[entries], first["valid"].values)
    assert both["valid"].values.any(axis=(1, 2)).all()


def test_rounds_are_priced_apart_and_within_the_budget(two: tuple[Published, Path]) -> None:
    """Capture seconds are those of the coarse pass and of each round; the second move is what one go would spare."""
    receipt: Any = two[0].receipt
    passes = [_sweeps(two, name) for name in ("raw_coarse", "raw_fine", "raw_again")]
    cost, camera = CostModel(reload_s=RELOAD_S), LineCamera()
    seconds = [cost.seconds(sweeps, camera) for sweeps in passes]
    assert receipt["savings"]["capture_s"]["done"] == pytest.approx(sum(seconds))
    assert receipt["savings"]["capture_s"]["ratio"] <= 0.9 + 1e-9
    assert receipt["savings"]["lines"]["done"] == sum(sweep.lines for sweeps in passes for sweep in sweeps)
    plan = receipt["plan"]
    assert [row["seconds"] for row in plan["rounds"]] == pytest.approx(seconds[1:])
    assert plan["second_move_s"] == pytest.approx(sum(seconds[1:]) - cost.seconds([*passes[1], *passes[2]], camera))
    assert plan["seconds"] == pytest.approx(sum(seconds[1:]))
    assert 0 < plan["score_share"] <= 1
    assert len({sweep.name for sweeps in passes for sweep in sweeps}) == sum(map(len, passes))


def test_a_round_of_nothing_is_told_as_such(two: tuple[Published, Path]) -> None:
    """No seat in no run of no line is nothing; what a turned line would show is not told of nothing."""
    plan = dict(two[0].receipt["plan"])
    first, second = ({**one, "lines": 0, "seats": 0, "sweeps": 0} for one in plan["rounds"])
    told = " ".join(sentences({"plan": {**plan, "rounds": [first, plan["rounds"][1]]}}))
    assert "The first round showed nothing, the second" in told
    assert "to go back" not in told
    none = " ".join(sentences({"plan": {**plan, "lines": 0, "rounds": [first, second]}}))
    assert none.endswith("The first round showed nothing, the second nothing.")


def test_the_receipt_tells_of_both_rounds(two: tuple[Published, Path], one: tuple[Published, Path]) -> None:
    """What each showed and what the second move took is said in words; the second look's own work is counted."""
    told = " ".join(sentences(two[0].receipt))
    assert "The first round showed" in told
    assert "to go back a second time took" in told
    scores = [done[0].receipt["savings"]["multiply_adds"]["score"] for done in (one, two)]
    assert scores[1] > scores[0]
    assert "rounds" not in one[0].receipt["plan"]
    assert "The first round" not in " ".join(sentences(one[0].receipt))


def test_two_rounds_again_make_nothing_and_the_same(
    two: tuple[Published, Path], survey_png: Survey, tmp_path: Path
) -> None:
    """A rerun finds every stage; in another archive it is the same survey."""
    rerun = survey_png(two[1], rounds="2", **FLAGS).receipt
    assert set(_states(rerun).values()) <= {"cached", "skipped"}
    fresh = survey_png(tmp_path / "fresh", rounds="2", **FLAGS).receipt
    assert comparable(fresh) == comparable(two[0].receipt)


def test_a_broken_second_round_goes_on_where_it_was(
    survey_png: Survey, tmp_path: Path, two: tuple[Published, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed between the second plan and its capture: what the first round captured stays, and the map is the same."""
    real = STAGES["capture_again"]

    def stop(*given: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setitem(STAGES, "capture_again", stop)
    with pytest.raises(KeyboardInterrupt):
        survey_png(tmp_path, rounds="2", **FLAGS)
    monkeypatch.setitem(STAGES, "capture_again", real)
    done = survey_png(tmp_path, rounds="2", **FLAGS)
    states = _states(done.receipt)
    assert (states["capture_fine"], states["cut_patches"], states["attend_again"]) == ("cached", "cached", "cached")
    np.testing.assert_array_equal(
        _open((done, tmp_path), "class_map")["classes"].values, _open(two, "class_map")["classes"].values
    )


def test_the_first_round_of_two_spends_half(two: tuple[Published, Path], one: tuple[Published, Path]) -> None:
    """Of the seconds that the fine pass has, and leaves the rest to the second round."""
    plans = [done[0].receipt["plan"] for done in (two, one)]
    assert plans[0]["rounds"][0]["seconds"] < 0.75 * plans[1]["seconds"]
    keys = [{stage["name"]: stage["key"] for stage in done[0].receipt["stages"]} for done in (two, one)]
    assert keys[0]["rectify"] == keys[1]["rectify"]
    assert keys[0]["attend"] != keys[1]["attend"]


def test_a_mirror_off_the_plan_is_found_in_both_rounds(survey_png: Survey, tmp_path: Path) -> None:
    """Each fine pass is registered by itself, and the receipt has both."""
    receipt: Any = survey_png(tmp_path, rounds="2", pointing_px="2", **{**FLAGS, "budget": "1"}).receipt
    assert _states(receipt)["register_again"] == "ran"
    assert {"fine", "second fine"} <= set(receipt["pointing"])
    assert "pointing_again" in receipt["products"]
    asked = asked_again(Catalogue.read(tmp_path).runs[0], tmp_path, None)
    costs = PastCosts(Catalogue.read(tmp_path), open_run(asked))
    costs.plan_fine("capture_again", receipt["plan"]["rounds"][1]["lines"])
    assert "times 1," in costs.estimate("register_again")[2]


def _asked_again(done: tuple[Published, Path], **changes: Any) -> dict[str, StageForecast]:
    """The plan of the same survey with changes, by stage."""
    asked = asked_again(Catalogue.read(done[1]).runs[0], done[1], None)
    return {row.stage: row for row in forecast(replace(asked, **changes)).stages}


def test_a_plan_of_two_rounds_shows_their_stages(one: tuple[Published, Path]) -> None:
    """Before the first round it waits; each round's capture is priced at less than that of a single round."""
    single, double = (_asked_again(one, rounds=rounds, budget=0.89) for rounds in (1, 2))
    seconds = {name: (row.seconds or 0.0) for name, row in double.items()}
    assert set(double) - set(single) == set(OF_ROUND_TWO)
    assert double["capture_again"].state == "blocked"
    assert seconds["capture_again"] == seconds["capture_fine"]
    assert 0 < seconds["capture_fine"] < (single["capture_fine"].seconds or 0.0)
    assert seconds["draw_map"] == single["draw_map"].seconds


def test_a_stored_plan_of_two_rounds_is_cached(two: tuple[Published, Path]) -> None:
    """Asked again, every stage of both rounds is stored."""
    rows = _asked_again(two)
    assert {row.state for row in rows.values()} <= {"cached", "skipped"}
    assert set(rows) >= set(OF_ROUND_TWO)


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
    """Nothing pays, in either round: no fine line, and the map is that of the coarse look alone."""
    done = survey_png(tmp_path, threshold="1e6", rounds="2", **FLAGS)
    receipt: Any = done.receipt
    assert done.looked_twice == 0
    assert [row["seats"] for row in receipt["plan"]["rounds"]] == [0, 0]
    assert receipt["accuracy"]["miou"] == receipt["accuracy"]["none"]["miou"]


def test_thresholds_and_rounds_without_a_meaning_are_refused() -> None:
    """Scores that are no gain have no threshold; placements that look at nothing have no second round."""
    with pytest.raises(SettingsError, match="policy 'margin' scores in a unit of its own: leave --threshold out"):
        load_settings(None, {"policy": "margin", "threshold": "0.5"})
    with pytest.raises(SettingsError, match="policy 'random' expects nothing: take --rounds 1"):
        load_settings(None, {"policy": "random", "rounds": "2"})


def test_one_round_without_a_threshold_stores_nothing_of_either(one: tuple[Published, Path]) -> None:
    """The plan, its keys and the receipt know no word of rounds or thresholds: old stores are found as they were."""
    receipt: Any = one[0].receipt
    key = next(stage["key"] for stage in receipt["stages"] if stage["name"] == "attend")
    folder = one[1] / "stages" / "attend" / key
    assert not {"threshold", "spared_s"} & set(json.loads((folder / "plan.json").read_text()))
    manifest = json.loads((folder / "manifest.json").read_text())
    assert not {"threshold", "rounds", "round"} & set(manifest["params"])
    assert not {"threshold", "spared_s", "rounds", "second_move_s"} & set(receipt["plan"])
    assert not {"raw_again", "plan_again", "pointing_again"} & set(receipt["products"])
