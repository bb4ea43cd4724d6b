"""Budgets of multiply-adds for a uniform scan: the patches that they pay for, their costs, and refused budgets."""

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

from spectralzoom.flows.archive.plan_command import plan_content
from spectralzoom.flows.opening.open_field import open_field
from spectralzoom.flows.planning.patch_budget import PatchBudget, ReadingCosts
from spectralzoom.flows.planning.plan_survey import plan_survey
from spectralzoom.flows.settings.settings import load_settings, parse_settings
from spectralzoom.models.network.sizes import SegmenterConfig, multiply_adds
from spectralzoom.models.policies.policies import score_multiply_adds
from spectralzoom.pipeline.errors import BudgetError, SettingsError
from spectralzoom.pipeline.geometry.grid import SceneGrid
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
def test_budgets_are_spent_and_not_exceeded(given_scores: NDArray[np.float64], macs: float, policy: str) -> None:
    """Multiply-adds, with those of the scores, stay within the fraction; one patch more would exceed it."""
    budget = _budget(macs=f"{macs}%", policy=policy)
    bought = budget.choose(given_scores)
    promising = np.argsort(-given_scores)[: np.count_nonzero(given_scores > 0)]

    def pays(patch_index: NDArray[np.intp]) -> bool:
        return budget.operations_of(patch_index) <= macs / 100 * budget.everything

    assert pays(bought)
    assert len(bought) == len(promising) or not pays(promising[: len(bought) + 1])
    np.testing.assert_array_equal(bought, promising[: len(bought)])


@given(scores, st.floats(40, 99), st.floats(40, 99))
def test_a_larger_budget_buys_all_of_a_smaller_one(given_scores: NDArray[np.float64], one: float, other: float) -> None:
    """The patches of the smaller budget are the first ones of the larger."""
    less, more = (_budget(macs=f"{percent}%").choose(given_scores) for percent in sorted((one, other)))
    np.testing.assert_array_equal(less, more[: len(less)])


@pytest.mark.parametrize("worthless", [0.0, -1.0, np.nan, -np.inf])
def test_patches_without_gain_are_not_read(worthless: float) -> None:
    """Zero, negative and NaN scores are left out even within the budget; infinity ranks first."""
    given_scores = np.full(PATCHES, worthless)
    assert len(_budget(macs="90%").choose(given_scores)) == 0
    given_scores[[3, 7]] = 0.5, np.inf
    assert _budget(macs="90%").choose(given_scores).tolist() == [7, 3]


def test_zones_limit_patches_and_their_fraction() -> None:
    """Only patches within the zones are chosen, and fractions refer to those patches."""
    budget = _asked(np.arange(PATCHES) < PATCHES // 2, macs="80%")
    assert budget.everything < _budget(macs="80%").everything
    assert max(budget.choose(np.ones(PATCHES))) < PATCHES // 2


@pytest.mark.parametrize("limits", [{"macs": "100%"}, {"macs": "1e12"}])
def test_a_budget_for_everything_makes_no_choice(limits: dict[str, str]) -> None:
    """The scan is read whole and no patch is scored, as without a budget."""
    assert _asked(**limits) is None


def test_a_refusal_names_the_smallest_budget() -> None:
    """The named fraction is accepted, and 0.01 % less is refused."""
    with pytest.raises(BudgetError, match=r"--macs 0\.5% .*the least is") as refused:
        _asked(macs="0.5%")
    least = str(refused.value).split()[-1]
    assert _asked(macs=least) is not None
    with pytest.raises(BudgetError, match="the least is"):
        _asked(macs=f"{float(least.removesuffix('%')) - 0.01:.2f}%")


def test_a_budget_may_be_a_number_of_multiply_adds() -> None:
    """Half of all multiply-adds chooses the same patches as 50 %; a number too small is refused with the minimum."""
    half = _budget(macs="50%")
    one = np.linspace(1, 2, PATCHES)
    np.testing.assert_array_equal(_budget(macs=str(half.everything // 2)).choose(one), half.choose(one))
    with pytest.raises(BudgetError, match=r"the least is --\S+ \d+$"):
        _asked(macs="10")


@pytest.mark.parametrize(
    ("limits", "error", "words"),
    [
        ({"macs": "0%"}, BudgetError, "above 0% and at most 100%"),
        ({"macs": "0.25"}, BudgetError, "such as 50%"),
        ({"macs": "a lot"}, BudgetError, "such as 50%"),
        ({"macs": True}, BudgetError, "such as 50%"),
        (
            {"macs": "50%", "scan_step": None, "budget": 0.5},
            SettingsError,
            "leave it out, or --budget and --zoom always",
        ),
        ({"macs": "50%", "extent": "0:1-9"}, SettingsError, "a whole field, 'extent' covers a part"),
    ],
)
def test_invalid_budgets_are_refused(limits: dict[str, object], error: type[Exception], words: str) -> None:
    """The message gives the allowed form, or the flag to leave out."""
    with pytest.raises(error, match=words):
        _asked(**limits)


def test_the_best_patches_are_read_within_the_budget(survey_png: Survey, tmp_path: Path) -> None:
    """Receipt and page give the multiply-adds done and those of everything."""
    published = survey_png(tmp_path, **SCAN, macs="80%", policy="sobel")
    (attention,) = tmp_path.glob("stages/score/*/attention.zarr")
    patch_index = json.loads(attention.with_name("plan.json").read_text())["patch_index"]
    seen = xr.open_zarr(attention, consolidated=False)
    assert np.flatnonzero(seen["rank"].values.ravel() >= 0).tolist() == patch_index  # which the map reads in detail
    best = np.argsort(-seen["score"].values.ravel(), kind="stable")[: len(patch_index)]
    assert sorted(patch_index) == sorted(best)
    kept = published.receipt["kept"]
    costs = published.receipt["savings"]["multiply_adds"]
    assert (kept["patches"], kept["of_patches"]) == (len(patch_index), 12 * 16)
    assert 0.7 < costs["ratio"] <= 0.8
    assert kept["multiply_adds"] == {"done": costs["done"], "everything": costs["full"]}
    assert kept["asked"]["macs"] == "80%"
    page = (published.folder / "report.html").read_text(encoding="utf-8")
    assert "patches read in full" in page
    assert "captured again" not in page


def test_a_plan_shows_the_patches_of_the_budget(flags_png: Flags, tmp_path: Path) -> None:
    """Before the first line is captured it gives the maximum of patches and their multiply-adds."""
    content = plan_content(load_settings(None, flags_png(tmp_path, scan_step="1", macs="80%")))
    costs = content["kept"]["multiply_adds"]
    assert 0.75 < costs["done"] / costs["everything"] <= 0.8
    assert content["kept"]["of_patches"] == 192


def test_a_large_field_is_counted_region_by_region() -> None:
    """16 times the field reads 16 times the detail; halos raise the overview by less than 10 %."""
    small, large = (
        costs.of_map(costs.grid.every_patch())
        for costs in (replace(COSTS, grid=SceneGrid(side, side, 16)) for side in (2560, 10240))
    )
    assert large.detail == 16 * small.detail
    assert 16 * small.overview < large.overview < 16 * 1.1 * small.overview


def test_a_zoomed_survey_reads_the_overview_twice(tmp_path: Path) -> None:
    """It reads it to choose lines and again with all lines; a uniform scan reads it once, for the map."""
    flags = {"scene": "farm", "size": "320x256", "seconds": "12", "out": str(tmp_path)}
    both = (load_settings(None, {**flags, "zoom": zoom}) for zoom in ("never", "always"))
    never, always = (plan_survey(open_field(one, planning=True)) for one in both)
    assert always.reading.least_gain is not None
    assert always.reading.work_done(np.arange(5)).overview == 2 * never.reading.work_done(np.arange(5)).overview


@pytest.mark.parametrize(("policy", "again"), [("gain", True), ("entropy", True), ("sobel", False)])
def test_only_the_surroundings_of_new_lines_are_read_again(policy: str, again: bool) -> None:
    """Gain and entropy score by the overview, whose regions around changed patches are computed a second time."""
    read = np.array([3, 8])
    score = score_multiply_adds(policy, COSTS.config, COSTS.grid)
    closed = multiply_adds(COSTS.config, COSTS.grid, 2, COSTS.bands, score=score)
    assert COSTS.with_scores(read, policy) == closed
    one = COSTS.with_scores(read, policy, np.array([0]))
    assert (one.overview > closed.overview) == again
    assert one.overview < 1.5 * closed.overview
    whole = COSTS.with_scores(read, policy, COSTS.grid.every_patch())
    assert whole.overview == (2 if again else 1) * closed.overview
    assert (whole.score, whole.detail) == (closed.score, closed.detail)
