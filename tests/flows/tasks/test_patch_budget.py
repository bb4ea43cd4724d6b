"""Budgets of multiply-adds and bytes for a uniform scan: the patches that they buy, the costs, the refusals."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from flows.archive.plan_command import plan_content
from flows.settings.load import load_settings, parse_settings
from flows.tasks.patch_budget import PatchBudget, ReadingCosts
from flows.tasks.run import open_run
from models.network.sizes import SegmenterConfig, multiply_adds
from models.policies.policies import score_multiply_adds
from pipeline.errors import BudgetError, SettingsError
from pipeline.geometry.grid import SceneGrid
from tests.conftest import Flags, Survey

COSTS = ReadingCosts(SegmenterConfig(classes=5), SceneGrid(192, 256, 16), 30)
PATCHES = 12 * 16
SCAN: dict[str, Any] = {"budget": None, "scan_step": "2", "scan_exposure_ms": "25"}
scores = st.integers(0, 2**32 - 1).map(lambda seed: np.random.default_rng(seed).normal(0.1, 0.1, PATCHES))


def _asked(shown: NDArray[np.bool_] | None = None, **limits: object) -> PatchBudget | None:
    found = parse_settings({"scan_step": 1, **limits})
    assert found.macs is not None
    return PatchBudget.asked(COSTS, shown, found.policy, found.macs)


def _budget(**limits: object) -> PatchBudget:
    found = _asked(**limits)
    assert found is not None
    return found


@given(scores, st.floats(40, 99), st.sampled_from(["gain", "sobel"]))
def test_no_budget_is_exceeded_or_left_unspent(given_scores: NDArray[np.float64], macs: float, policy: str) -> None:
    """Multiply-adds with the scores are within their fraction; one patch more is beyond it."""
    budget = _budget(macs=f"{macs}%", policy=policy)
    bought, promising = budget.choose(given_scores), np.argsort(-given_scores)[: np.count_nonzero(given_scores > 0)]

    def pays(patch_index: NDArray[np.intp]) -> bool:
        return budget.operations_of(patch_index) <= macs / 100 * budget.everything

    assert pays(bought)
    assert len(bought) == len(promising) or not pays(promising[: len(bought) + 1])
    np.testing.assert_array_equal(bought, promising[: len(bought)])


@given(scores, st.floats(40, 99), st.floats(40, 99))
def test_a_larger_budget_buys_all_of_a_smaller_one(given_scores: NDArray[np.float64], one: float, other: float) -> None:
    """Choices are nested."""
    less, more = (_budget(macs=f"{percent}%").choose(given_scores) for percent in sorted((one, other)))
    np.testing.assert_array_equal(less, more[: len(less)])


@pytest.mark.parametrize("worthless", [0.0, -1.0, np.nan, -np.inf])
def test_what_promises_nothing_is_not_bought(worthless: float) -> None:
    """Whatever the budget pays for: a field of which all is known is read from its means alone; inf comes first."""
    given_scores = np.full(PATCHES, worthless)
    assert len(_budget(macs="90%").choose(given_scores)) == 0
    given_scores[[3, 7]] = 0.5, np.inf
    assert _budget(macs="90%").choose(given_scores).tolist() == [7, 3]


def test_zones_leave_fewer_patches_to_fraction() -> None:
    """Only patches of which zones leave something are chosen, and shares are of reading those."""
    shown = np.arange(PATCHES) < PATCHES // 2
    budget = _asked(shown, macs="80%")
    assert budget.everything < _budget(macs="80%").everything
    assert max(budget.choose(np.ones(PATCHES))) < PATCHES // 2


@pytest.mark.parametrize("limits", [{"macs": "100%"}, {"macs": "1e12"}])
def test_who_pays_for_everything_chooses_nothing(limits: dict[str, str]) -> None:
    """Then no patch is scored either: the scan is read whole, as without a budget."""
    assert _asked(**limits) is None


def test_the_least_that_a_refusal_names_is_the_least() -> None:
    """What it names is enough, and a little less is refused again."""
    with pytest.raises(BudgetError, match=r"--macs 0\.5% .*the least is") as refused:
        _asked(macs="0.5%")
    least = str(refused.value).split()[-1]
    assert _asked(macs=least) is not None
    with pytest.raises(BudgetError, match="the least is"):
        _asked(macs=f"{float(least.removesuffix('%')) - 0.01:.2f}%")


def test_numbers_are_limits_too() -> None:
    """Half of everything, given as a number, buys what 50 % does; a number that is too small is told the least."""
    half, one = _budget(macs="50%"), np.linspace(1, 2, PATCHES)
    np.testing.assert_array_equal(_budget(macs=str(half.everything // 2)).choose(one), half.choose(one))
    with pytest.raises(BudgetError, match=r"the least is --\S+ \d+$"):
        _asked(macs="10")


@pytest.mark.parametrize(
    ("limits", "error", "words"),
    [
        ({"macs": "0%"}, BudgetError, "above 0% and at most 100%"),
        ({"macs": "0.25"}, BudgetError, "such as 25%"),
        ({"macs": "a lot"}, BudgetError, "such as 25%"),
        ({"macs": True}, BudgetError, "such as 25%"),
        ({"macs": "50%", "scan_step": None}, SettingsError, "is for a raster or a uniform scan.*give --seconds"),
        ({"macs": "50%", "scan_step": None, "budget": 0.5}, SettingsError, "without --budget and --zoom always"),
        ({"macs": "50%", "extent": "0:1-9"}, SettingsError, "a whole field, 'extent' covers a part"),
    ],
)
def test_what_is_no_budget_is_refused_in_words(limits: dict[str, object], error: type[Exception], words: str) -> None:
    """The message says what it must be, or what to leave out."""
    with pytest.raises(error, match=words):
        _asked(**limits)


def test_a_part_of_the_scan_is_read_in_detail(survey_png: Survey, tmp_path: Path) -> None:
    """The patches read are the best ones; receipt and page tell what they take, and what everything would have."""
    published = survey_png(tmp_path, **SCAN, macs="80%", policy="sobel", controls=True)
    (attention,) = tmp_path.glob("stages/score/*/attention.zarr")
    patch_index = json.loads(attention.with_name("plan.json").read_text())["patch_index"]
    seen = xr.open_zarr(attention, consolidated=False)
    assert np.flatnonzero(seen["rank"].values.ravel() >= 0).tolist() == patch_index  # which the map reads in detail
    best = np.argsort(-seen["score"].values.ravel(), kind="stable")[: len(patch_index)]
    assert sorted(patch_index) == sorted(best)
    kept, costs = published.receipt["kept"], published.receipt["savings"]["multiply_adds"]
    assert (kept["patches"], kept["of_patches"]) == (len(patch_index), 12 * 16)
    assert 0.7 < costs["ratio"] <= 0.8
    assert kept["multiply_adds"] == {"done": costs["done"], "everything": costs["full"]}
    assert kept["asked"]["macs"] == "80%"
    accuracy = published.receipt["accuracy"]
    assert accuracy["controls_fraction"] == len(patch_index) / 192
    assert accuracy["controls"]["sobel"]["miou"] == pytest.approx(accuracy["miou"], abs=0.02)
    page = (published.folder / "report.html").read_text(encoding="utf-8")
    assert "at full resolution" in page
    assert f"patches {len(patch_index)}; multiply-adds" in page
    assert "captured again" not in page


def test_a_plan_tells_what_the_budgets_pay_for(flags_png: Flags, tmp_path: Path) -> None:
    """Before the first line: the most patches, and what they take."""
    content = plan_content(load_settings(None, flags_png(tmp_path, scan_step="1", macs="80%")))
    costs = content["kept"]["multiply_adds"]
    assert 0.75 < costs["done"] / costs["everything"] <= 0.8
    assert content["kept"]["of_patches"] == 192


def test_a_large_field_is_counted_region_by_region() -> None:
    """Sixteen times the field takes as many fields and their halos, of which only the overview reads more."""
    small, large = (
        costs.of_map(costs.grid.every_patch())
        for costs in (replace(COSTS, grid=SceneGrid(side, side, 16)) for side in (2560, 10240))
    )
    assert large.detail == 16 * small.detail
    assert 16 * small.overview < large.overview < 16 * 1.1 * small.overview


def test_a_zoomed_survey_reads_the_overview_twice(tmp_path: Path) -> None:
    """Once to choose lines, once with all lines; a uniform scan reads it once, while the map is drawn."""
    flags = {"scene": "farm", "size": "320x256", "seconds": "12", "out": str(tmp_path)}
    never, always = (
        open_run(load_settings(None, {**flags, "zoom": zoom}), planning=True) for zoom in ("never", "always")
    )
    assert always.least_gain is not None
    assert always.work_done(np.arange(5)).overview == 2 * never.work_done(np.arange(5)).overview


@pytest.mark.parametrize(("policy", "scan_passes"), [("gain", 2), ("entropy", 2), ("sobel", 1), ("random", 1)])
def test_a_policy_that_asks_the_overview_reads_it_once_more(policy: str, scan_passes: int) -> None:
    """The map reads it anyway, from what is stored; scores of the coarse prediction read it before that."""
    score = score_multiply_adds(policy, COSTS.config, COSTS.grid)
    done = COSTS.with_scores(np.array([3, 8]), policy)
    closed = multiply_adds(COSTS.config, COSTS.grid, 2, COSTS.bands, score=score)
    assert done.overview == scan_passes * closed.overview
    assert (done.score, done.detail) == (closed.score, closed.detail)
