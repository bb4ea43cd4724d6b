"""Trade-offs: what is timed and judged, which points win, which floors apply, and the entries of rectification."""

from __future__ import annotations

import io
import json
import math
import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from flows import tradeoff as tradeoff_module
from flows.tradeoff import (
    Level,
    Point,
    Result,
    Tradeoff,
    best_within,
    cheapest_within,
    find_tradeoffs,
    mark_pareto,
    measure_tradeoff,
    register,
    registered,
)
from flows.tradeoff_figures import draw_tradeoffs
from flows.tradeoff_line_model import LINE_MODEL
from flows.tradeoff_overlap import OVERLAP
from flows.tradeoff_resample import RESAMPLE, draw_waves, noise_levels
from flows.tradeoff_scan_step import SCAN_STEP
from flows.tradeoff_table import print_tradeoff
from flows.tradeoff_tie_spacing import TIE_SPACING
from pipeline.camera import LineCamera
from pipeline.errors import SettingsError


def make_point(error: float, price: float) -> Point:
    """A point whose price is processor time."""
    return Point("s", error, 1.0, price, price, price, price, 1.0, None)


def sum_series(terms: int) -> float:
    """The first terms of 1/n^2, one by one, so that time goes with their number."""
    total = 0.0
    for n in range(1, terms + 1):
        total += 1 / n**2
    return total


SERIES: Tradeoff[float, float] = Tradeoff(
    stage="series",
    knob="terms",
    error="absolute error",
    unit="sum",
    reference="pi^2 / 6",
    settings=(4000.0, 16000.0, 64000.0),
    prepare=lambda seed: math.pi**2 / 6,
    run=lambda truth, terms: sum_series(int(terms)),
    judge=lambda truth, terms, out: abs(out - truth),
    work=lambda truth, terms: 1.0,
)


def test_more_exact_settings_cost_more_and_all_win():
    """The error is the known remainder, the ratio follows the work, and no setting beats another."""
    result = measure_tradeoff(SERIES, repeats=5)
    for point in result.points:
        assert point.error == pytest.approx(1 / float(point.setting), rel=1e-3)
    assert result.points[0].ratio == 1.0
    assert 8 < result.points[2].ratio < 32
    assert all(point.pareto for point in result.points)


def test_only_run_is_timed():
    """Preparing and judging may take long without a setting's price knowing of it."""
    slow = replace(SERIES, settings=(10.0,), judge=lambda truth, terms, out: time.sleep(0.2) or 0.0)
    assert measure_tradeoff(slow, repeats=2).points[0].wall_min_s < 0.15


def test_repeats_are_interleaved():
    """Every round runs every setting once and starts at another one; one run of each comes before, to be judged."""
    seen: list[float] = []
    watched = replace(SERIES, settings=(1.0, 2.0, 3.0), run=lambda truth, terms: seen.append(float(terms)) or 0.0)
    measure_tradeoff(watched, repeats=2)
    assert seen == [1, 2, 3, 1, 2, 3, 2, 3, 1]


def test_modelled_seconds_are_the_price():
    """A stage whose time is not spent here is priced by its model, and the clock's figures stay beside it."""
    point = measure_tradeoff(replace(SERIES, modelled_s=lambda truth, terms, out: 60.0), repeats=1).points[0]
    assert point.price_s == 60.0
    assert 0 < point.wall_min_s < 1


@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=1, max_size=12))
def test_pareto_points_are_those_that_nobody_beats(pairs):
    """Marked points do not beat each other, and every other point is beaten by a marked one."""
    points = mark_pareto([make_point(error, price) for error, price in pairs])
    front = {(point.error, point.price_s) for point in points if point.pareto}
    assert front
    for point in points:
        better = [
            f for f in front if f[0] <= point.error and f[1] <= point.price_s and f != (point.error, point.price_s)
        ]
        assert bool(better) != point.pareto


def test_point_without_an_error_never_wins():
    """A setting that failed (NaN) is not on the front and is never recommended."""
    points = mark_pareto([make_point(math.nan, 0.1), make_point(0.5, 1.0)])
    assert [point.pareto for point in points] == [False, True]
    result = replace(measure_tradeoff(SERIES, repeats=1), points=points)
    assert best_within(result, 10) is points[1]


def test_one_number_finds_the_setting():
    """An accuracy gives the cheapest setting that reaches it, a time the best that keeps it; out of reach is None."""
    points = tuple(make_point(error, price) for error, price in ((0.3, 1.0), (0.1, 2.0), (0.1, 3.0), (0.01, 9.0)))
    result = replace(measure_tradeoff(SERIES, repeats=1), points=points)
    assert cheapest_within(result, 0.1) is points[1]
    assert best_within(result, 8.9).error == 0.1
    assert cheapest_within(result, 0.001) is None
    assert best_within(result, 0.5) is None


def test_registry_finds_all_knobs_of_a_stage(monkeypatch):
    """A stage gives its knobs in their order; the same knob again replaces; an unknown stage names those there are."""
    monkeypatch.setattr(tradeoff_module, "_REGISTRY", {})
    first, other = register(SERIES), register(replace(SERIES, knob="order"))
    register(replace(SERIES, stage="plan"))
    assert find_tradeoffs("series") == (first, other)
    again = register(replace(SERIES, unit="term"))
    assert find_tradeoffs("series") == (again, other)
    assert list(registered()) == [("series", "terms"), ("series", "order"), ("plan", "terms")]
    with pytest.raises(SettingsError, match="no trade-off for stage 'serie'; there are: plan, series"):
        find_tradeoffs("serie")


def test_no_repeats_are_refused():
    """At least one timed round is needed."""
    with pytest.raises(SettingsError, match="at least 1, got 0"):
        measure_tradeoff(SERIES, repeats=0)


def test_result_is_json_and_names_the_machine():
    """The result survives JSON with load, threads and versions."""
    found = json.loads(json.dumps(measure_tradeoff(SERIES, repeats=1).to_dict()))
    assert {"processor", "cores", "threads", "versions", "load_before"} <= set(found["machine"])
    assert found["points"][0]["ns_per_unit"] > 0


def test_waves_are_what_they_claim():
    """The analytic scene holds periods of 4 to 40 px only and is the same for the same seed."""
    waves = draw_waves(3)
    period = 1 / np.hypot(*waves.frequency.T)
    assert period.min() >= 4
    assert period.max() <= 40
    np.testing.assert_array_equal(waves.at(np.ones((1, 2))), draw_waves(3).at(np.ones((1, 2))))


def printed(result: Result) -> str:
    """The table as a terminal shows it."""
    console = Console(file=io.StringIO(), width=140)
    print_tradeoff(result, console)
    return console.file.getvalue()


def test_floors_are_those_that_an_entry_declares(tmp_path):
    """Levels of error and the time of copying the bytes are in the result, the table and the plot; or in none."""
    levels = (Level("a thousandth", 1e-3), Level("nothing", 1e-9))
    floored = replace(SERIES, settings=(10.0, 4000.0), levels=lambda truth: levels, moved_bytes=6.0)
    result = measure_tradeoff(floored, repeats=1)
    assert result.levels == levels
    assert result.memory_floor_ns > 0
    words = printed(result)
    assert "within a thousandth (0.001): 4000.0, " in words
    assert "within nothing (1e-09): no setting" in words
    assert "copying the bytes of a sum alone" in words
    draw_tradeoffs(tmp_path / "plot.png", [result])
    bare = measure_tradeoff(SERIES, repeats=1)
    assert (bare.levels, bare.memory_floor_ns) == ((), None)
    assert "within" not in printed(bare)


@pytest.mark.parametrize("errors", [(0.0, 0.1, 3.0), (0.0, 0.0), (math.inf, 0.5), (math.nan, math.nan)])
def test_plots_take_errors_of_zero_and_none_at_all(tmp_path, errors):
    """Exact settings and failed ones neither stop the plot nor warn."""
    points = mark_pareto([make_point(error, 1.0 + number) for number, error in enumerate(errors)])
    result = replace(measure_tradeoff(SERIES, repeats=1), points=points, levels=(Level("half", 0.5),))
    draw_tradeoffs(tmp_path / "plot.png", [result] * 4)
    assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")


def test_noise_levels_follow_the_camera():
    """Half the converter's range at a contrast of 0.2: a tenth of shot and read noise, and half a step."""
    camera = LineCamera()
    electrons = camera.full_well_e / 2
    noise, step = (level.error * 0.2 * electrons for level in noise_levels(camera))
    assert 10 * noise == pytest.approx(math.sqrt(electrons + 20**2))
    assert step == pytest.approx(2.5)


def test_resampling_kernels_rank_by_error():
    """More taps are more exact on 4-40 px content; nearest errs by 24 % of the scene's deviation (erratum E10)."""
    result = measure_tradeoff(RESAMPLE, repeats=1)
    nearest, bilinear, cubic = (point.error for point in result.points)
    assert (nearest, bilinear, cubic) == pytest.approx((0.24, 0.093, 0.029), rel=0.03)
    assert all(name in printed(result) for name in RESAMPLE.settings)


def test_line_models_get_better_to_the_exact():
    """Over the field of 10240 x 10240 px no rotation errs by 307 px, the slope by 185, exact rays by nothing."""
    errors = [point.error for point in measure_tradeoff(LINE_MODEL, repeats=1).points]
    assert errors[:4] == pytest.approx([307, 185, 183, 12.2], rel=0.01)
    assert errors[4] == 0


def test_ties_sixteen_apart_keep_the_goal():
    """The error grows with the square of the distance, stays below 2e-3 px at 16, and is rounding without ties."""
    errors = {point.setting: point.error for point in measure_tradeoff(TIE_SPACING, repeats=1).points}
    assert errors[1] < 1e-9
    assert errors[16] < 2e-3
    assert errors[64] / errors[16] == pytest.approx(16, rel=0.1)


def test_wider_overlaps_find_shifts_better():
    """Every overlap finds the known shifts to 0.1 px, and the widest at least three times better than the narrowest."""
    errors = [point.error for point in measure_tradeoff(OVERLAP, repeats=1).points]
    assert max(errors) < 0.1
    assert errors[-1] < errors[0] / 3


def test_fewer_lines_take_less_time_and_show_less():
    """Beyond the slit's width the error grows with the scan's step, while the modelled seconds shrink."""
    result = measure_tradeoff(SCAN_STEP, repeats=1)
    seconds, errors = [point.price_s for point in result.points], [point.error for point in result.points]
    assert seconds == sorted(seconds, reverse=True)
    assert errors[1:] == sorted(errors[1:])
    assert errors[0] == pytest.approx(result.levels[0].error, rel=0.1)
