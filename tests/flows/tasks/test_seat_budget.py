"""Budgets of multiply-adds and bytes for a plain scan: which seats they buy, what that takes, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from flows.archive.plan_command import kept_words, plan_content
from flows.settings.load import load_settings, parse_settings
from flows.tasks.reading_costs import ReadingCosts
from flows.tasks.seat_budget import SeatBudget
from models.network.sizes import SegmenterConfig
from models.weights.files import save_weights
from pipeline.errors import BudgetError, SettingsError
from pipeline.geometry.grid import SceneGrid
from tests.conftest import RGB_NM, Survey, random_weights

COSTS = ReadingCosts(SegmenterConfig(classes=5), SceneGrid(192, 256, 16, 4), 30)
SEATS = 12 * 16
SCAN: dict[str, Any] = {"budget": None, "scan_step": "2", "scan_exposure_ms": "25"}
shares = st.floats(5, 100).map(lambda percent: f"{percent!r}%")
scores = st.integers(0, 2**32 - 1).map(lambda seed: np.random.default_rng(seed).normal(0.1, 0.1, SEATS))


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Tiny weights."""
    path = tmp_path_factory.mktemp("weights") / "weights.safetensors"
    save_weights(random_weights(RGB_NM), path)
    return path


def _asked(shown: NDArray[np.bool_] | None = None, **limits: object) -> SeatBudget | None:
    return SeatBudget.asked(parse_settings({"scan_step": 1, **limits}), COSTS, shown)


def _budget(**limits: object) -> SeatBudget:
    found = _asked(**limits)
    assert found is not None
    return found


@given(scores, st.floats(12, 99), st.floats(10, 99), st.sampled_from(["gain", "sobel"]))
def test_no_budget_is_exceeded_and_no_seat_more_is_paid_for(
    given_scores: NDArray[np.float64], compute: float, kept: float, policy: str
) -> None:
    """Multiply-adds with the scores and bytes with the means are within their shares; one seat more breaks one."""
    budget = _budget(compute=f"{compute}%", bytes_kept=f"{kept}%", policy=policy)
    bought, promising = budget.choose(given_scores), np.argsort(-given_scores)[: np.count_nonzero(given_scores > 0)]

    def pays(seats: NDArray[np.intp]) -> bool:
        read = budget.operations_of(seats) <= compute / 100 * budget.everything
        return read and budget.bytes_of(len(seats)) <= kept / 100 * budget.every_byte

    assert pays(bought)
    assert len(bought) == len(promising) or not pays(promising[: len(bought) + 1])
    np.testing.assert_array_equal(bought, promising[: len(bought)])


@given(scores, st.floats(12, 99), st.floats(12, 99))
def test_a_larger_budget_buys_what_a_smaller_one_does_and_more(
    given_scores: NDArray[np.float64], one: float, other: float
) -> None:
    """Choices are nested."""
    less, more = (_budget(compute=f"{percent}%").choose(given_scores) for percent in sorted((one, other)))
    np.testing.assert_array_equal(less, more[: len(less)])


@given(scores, st.floats(0.001, 0.5))
def test_a_least_gain_buys_by_price_whatever_the_number(given_scores: NDArray[np.float64], least: float) -> None:
    """All seats that promise as much are bought, and none that promises less."""
    bought = _budget(least_gain=least).choose(given_scores)
    assert sorted(bought) == np.flatnonzero(given_scores >= least).tolist()


@pytest.mark.parametrize("worthless", [0.0, -1.0, np.nan, -np.inf])
def test_what_promises_nothing_is_not_bought(worthless: float) -> None:
    """Whatever the budget pays for: a field of which all is known is read from its means alone; inf comes first."""
    given_scores = np.full(SEATS, worthless)
    assert len(_budget(compute="90%").choose(given_scores)) == 0
    given_scores[[3, 7]] = 0.5, np.inf
    assert _budget(compute="90%").choose(given_scores).tolist() == [7, 3]


def test_zones_leave_fewer_seats_to_share() -> None:
    """Only seats of which zones leave something are chosen, and shares are of reading those."""
    shown = np.arange(SEATS) < SEATS // 2
    budget = _asked(shown, compute="60%")
    assert budget is not None
    assert budget.everything < _budget(compute="60%").everything
    assert max(budget.choose(np.ones(SEATS))) < SEATS // 2


@pytest.mark.parametrize("limits", [{}, {"compute": "100%"}, {"bytes_kept": "100%"}, {"compute": "1e12"}])
def test_who_pays_for_everything_chooses_nothing(limits: dict[str, str]) -> None:
    """Then no seat is scored either: the scan is read whole, as without a budget."""
    assert _asked(**limits) is None


@pytest.mark.parametrize("name", ["compute", "bytes_kept"])
def test_the_least_that_a_refusal_names_is_the_least(name: str) -> None:
    """What it names is enough, and a little less is refused again."""
    with pytest.raises(BudgetError, match=f"--{name.replace('_', '-')} 0.5% .*the least is") as refused:
        _asked(**{name: "0.5%"})
    least = str(refused.value).split()[-1]
    assert _asked(**{name: least}) is not None
    with pytest.raises(BudgetError, match="the least is"):
        _asked(**{name: f"{float(least.removesuffix('%')) - 0.01:.2f}%"})


@pytest.mark.parametrize("name", ["compute", "bytes_kept"])
def test_numbers_are_limits_too(name: str) -> None:
    """Half of everything, given as a number, buys what 50 % does; a number that is too small is told the least."""
    half = _budget(**{name: "50%"})
    whole = half.everything if name == "compute" else half.every_byte
    one = np.linspace(1, 2, SEATS)
    np.testing.assert_array_equal(_budget(**{name: str(whole // 2)}).choose(one), half.choose(one))
    with pytest.raises(BudgetError, match=r"the least is --\S+ \d+$"):
        _asked(**{name: "10"})


@pytest.mark.parametrize(
    ("limits", "error", "words"),
    [
        ({"compute": "0%"}, BudgetError, "above 0% and at most 100%"),
        ({"compute": "101%"}, BudgetError, "above 0% and at most 100%"),
        ({"compute": "0.25"}, BudgetError, "for 25 % write 25%"),
        ({"compute": "nan"}, BudgetError, "such as 25%"),
        ({"compute": "a lot"}, BudgetError, "such as 25%"),
        ({"compute": True}, BudgetError, "such as 25%"),
        ({"bytes_kept": "-3%"}, BudgetError, "such as 40%"),
        ({"bytes_kept": "inf%"}, BudgetError, "such as 40%"),
        ({"bytes_kept": "some"}, BudgetError, "such as 40%"),
        ({"least_gain": -1}, SettingsError, "from 0 to 100"),
        ({"least_gain": 0.1, "policy": "sobel"}, SettingsError, "scores in a unit of its own"),
        ({"compute": "50%", "scan_step": None}, SettingsError, "is for a raster or a plain scan.*give --seconds"),
        ({"compute": "50%", "look": "0:1-9"}, SettingsError, "a whole field, and 'look' looks at a part"),
    ],
)
def test_what_is_no_budget_is_refused_in_a_sentence(
    limits: dict[str, object], error: type[Exception], words: str
) -> None:
    """The message says what it must be, or what to leave out."""
    with pytest.raises(error, match=words):
        _asked(**limits)


def test_a_part_of_the_scan_is_kept_and_read(survey_png: Survey, tmp_path: Path) -> None:
    """Patches are those of the best seats, receipt and page tell what they take, and what everything would have."""
    published = survey_png(tmp_path, **SCAN, compute="40%", policy="sobel", controls=True)
    (patches,) = tmp_path.glob("**/patches.zarr")
    (attention,) = tmp_path.glob("**/attention.zarr")
    seats = xr.open_zarr(patches, consolidated=False)["seat"].values
    seen = xr.open_zarr(attention, consolidated=False)
    best = np.argsort(-seen["score"].values.ravel(), kind="stable")[: len(seats)]
    assert sorted(seats) == sorted(best)
    kept, costs = published.receipt["kept"], published.receipt["savings"]["multiply_adds"]
    assert (kept["seats"], kept["of_seats"]) == (len(seats), 12 * 16)
    assert 0.3 < costs["ratio"] <= 0.4
    assert kept["multiply_adds"] == {"done": costs["done"], "everything": costs["full"]}
    assert kept["asked"]["compute"] == "40%"
    accuracy = published.receipt["accuracy"]
    assert accuracy["controls_share"] == len(seats) / 192
    assert accuracy["controls"]["sobel"]["miou"] == pytest.approx(accuracy["miou"], abs=0.02)
    page = (published.folder / "report.html").read_text(encoding="utf-8")
    assert "kept in detail" in page
    assert "of the multiply-adds of reading everything" in page
    assert "looked twice" not in page


def test_a_budget_is_refused_before_anything_is_captured(survey_png: Survey, tmp_path: Path) -> None:
    """No archive is begun for what cannot be paid for."""
    with pytest.raises(BudgetError, match=r"--compute 1% does not pay for the coarse look"):
        survey_png(tmp_path / "out", **SCAN, compute="1%")
    assert not (tmp_path / "out").exists()


def test_a_plan_tells_what_the_budgets_pay_for(scene_files: Path, tiny: Path, tmp_path: Path) -> None:
    """Before the first line: the most seats, and what they take."""
    given_settings = {
        "scene": str(scene_files / "scene.png"),
        "source": "sim",
        "weights": str(tiny),
        "out": str(tmp_path),
    }
    content = plan_content(load_settings(None, {**given_settings, "scan_step": "1", "bytes_kept": "50%"}))
    assert 0.49 < content["kept"]["bytes"]["done"] / content["kept"]["bytes"]["everything"] <= 0.5
    assert f"detail: at most {content['kept']['seats']} of 192 seats" in kept_words(content["kept"])


@pytest.mark.parametrize(
    ("asked", "policy"),
    [
        ({}, "gain"),
        ({"compute": "25%"}, "sobel"),
        ({"compute": "25%", "policy": "entropy"}, "entropy"),
        ({"compute": "25%", "least_gain": "0.1"}, "gain"),
        ({"bytes_kept": "40%"}, "gain"),
    ],
)
def test_scores_are_cheap_where_multiply_adds_are_short(asked: dict[str, str], policy: str) -> None:
    """By default; who names a policy gets it, and a least gain is asked of scores that are gains."""
    assert load_settings(None, {"seconds": "5", **asked}).policy == policy


def test_scores_without_a_glance_cost_no_glance() -> None:
    """Edges of the coarse image ask nothing of the network, which then reads the coarse look for the map alone."""
    seats = np.arange(9)
    assert COSTS.with_scores(seats, "sobel").glance == COSTS.of_map(seats).glance
    assert COSTS.with_scores(seats, "gain").glance == 2 * COSTS.of_map(seats).glance
    assert replace(COSTS.with_scores(seats, "sobel"), score=0) == COSTS.of_map(seats)
