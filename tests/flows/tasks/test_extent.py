"""How much there is to do in a survey: laws of the units that costs grow with, and what its model computes."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from math import ceil
from types import SimpleNamespace
from typing import Any, cast, get_args

import numpy as np
import pytest

from flows.tasks.extent import Extent, work_done, work_of_map
from flows.tasks.run import SurveyRun
from flows.tasks.stage import Unit
from models.network.sizes import SegmenterConfig, multiply_adds
from models.policies.policies import score_multiply_adds
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import CostModel, Sweep

SMALL = Extent(
    SegmenterConfig(4, patch=16), SceneGrid(640, 1280, 16, 4), LineCamera(), CostModel(), "x", 30, 160, 200, 4
)
BY_BANDS = {"scene values", "mosaic values", "coarse values", "fine values", "patch values"}


def _larger(times: int) -> Extent:
    """A field of so many times the side, with lines to match."""
    grid = replace(SMALL.grid, height=SMALL.grid.height * times, width=SMALL.grid.width * times)
    return replace(SMALL, grid=grid, coarse_lines=160 * times**2, fine_lines=200 * times**2)


@pytest.mark.parametrize("unit", get_args(Unit))
def test_units_grow_with_the_field(unit: Unit) -> None:
    """With its pixels, exactly; the model's own operations by no less, for attention is over all tokens of a region."""
    grown = _larger(2).work(unit) / SMALL.work(unit)
    if unit == "surveys":
        assert grown == 1
    elif unit.startswith("operations"):
        assert 4 <= grown < 16
    else:
        assert grown == 4


@pytest.mark.parametrize("unit", sorted(BY_BANDS))
def test_values_grow_with_the_bands(unit: Unit) -> None:
    """Twice the bands, twice the values."""
    assert replace(SMALL, bands=60).work(unit) == 2 * SMALL.work(unit)


def test_operations_of_the_map_are_those_of_its_regions() -> None:
    """Beyond one region they grow with the field; without fine lines they are a glance's."""
    one, many = _larger(2), _larger(8)  # 2560 px a side at most, and 5 x that
    assert 1 < many.work("operations of the map") / (16 * one.work("operations of the map")) < 1.4
    assert replace(SMALL, fine_lines=0).work("operations of the map") == SMALL.work("operations of a glance") > 0
    coarse = replace(SMALL, fine_lines=None, fine_runs=None)
    assert [coarse.work(unit) for unit in ("fine values", "patch values", "operations of the map")] == [0, 0, 0]
    assert coarse.run_lines == SMALL.grid.height


@pytest.mark.parametrize(("seconds", "run_lines"), list(product((0.0, 0.5, 40.0, 1000.0), (20.0, 63.5, 700.0))))
def test_seconds_buy_no_more_lines_than_they_pay_for(seconds: float, run_lines: float) -> None:
    """The lines bought cost no more than the cost model's price of such runs allows, and one more does."""
    bought = SMALL.buying(seconds, run_lines=run_lines, most=100_000).fine_lines
    assert bought is not None

    def price(lines: int) -> float:
        each = [min(run_lines, lines - first * run_lines) for first in range(ceil(lines / run_lines))]
        sweeps = [Sweep(f"s{n}", "fine", "x", 0.0, 0.0, 1) for n in range(len(each))]
        whole = replace(sweeps[0], lines=lines) if sweeps else None
        if whole is None:
            return 0.0
        setups = (len(each) - 1) * SMALL.cost.setup_seconds(SMALL.camera)
        return SMALL.cost.seconds([whole], SMALL.camera) + setups

    assert price(bought) <= seconds
    assert price(bought + 1) > seconds


def test_a_large_field_is_counted_region_by_region() -> None:
    """Sixteen times the field takes as many fields and their halos, and no more lines than the full scan."""
    assert SMALL.buying(1e6, run_lines=50, most=321).fine_lines == 321
    small, large = (work_of_map(run, run.grid.valid_seats()) for run in (_run(2560, "gain"), _run(10240, "gain")))
    assert 16 * small.decode < large.decode < 16 * 1.3 * small.decode
    assert 16 * small.total < large.total < 16 * 1.3 * small.total


CONFIG, BANDS = SegmenterConfig(classes=4), 8


def _run(side: int, policy: str, *, plain: bool = False) -> SurveyRun:
    """As much of a survey as is asked for its sizes."""
    made: Any = SimpleNamespace(
        grid=SceneGrid(side, side, 16, 4),
        described=SimpleNamespace(config=CONFIG),
        vgg=None,
        scene=SimpleNamespace(wavelength_nm=np.linspace(400, 1000, BANDS)),
        settings=SimpleNamespace(policy=policy),
        plan=SimpleNamespace(plain=plain),
        prior=None,
        budget=None,
        chooses=not plain,
    )
    return cast("SurveyRun", made)


@pytest.mark.parametrize(
    ("policy", "looks"), [("gain", 2), ("entropy", 2), ("sobel", 1), ("random", 1), ("saliency", 1), ("vgg-static", 1)]
)
def test_a_policy_that_asks_the_glance_reads_the_coarse_look_once_more(policy: str, looks: int) -> None:
    """The map reads it anyway, from what is stored; scores of the glance read it before that."""
    run = _run(256, policy)
    score = score_multiply_adds(policy, CONFIG, run.grid)
    done, closed = work_done(run, np.array([3, 8])), multiply_adds(CONFIG, run.grid, 2, BANDS, score=score)
    assert done.glance == looks * closed.glance
    assert (done.score, done.encode, done.decode) == (closed.score, closed.encode, closed.decode)


def test_a_plain_scan_is_read_and_nothing_scored() -> None:
    """What its map takes, whatever the policy of the settings is."""
    run, seats = _run(256, "gain", plain=True), np.arange(256)
    assert work_done(run, seats) == work_of_map(run, seats)
    assert work_done(run, seats).score == 0


def test_a_plain_scan_shows_every_pixel() -> None:
    """Patches and map grow with the field, not with lines of a fine pass."""
    scan = replace(SMALL, fine_lines=None, plain=True)
    assert scan.work("patch values") == SMALL.grid.height * SMALL.grid.width * SMALL.bands
    every = replace(SMALL, fine_lines=10**6)
    assert scan.work("operations of the map") == every.work("operations of the map")
