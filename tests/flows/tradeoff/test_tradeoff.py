"""Trade-offs: what is timed and judged, which points win, which floors apply, and how they are shown."""

from __future__ import annotations

import io
import json
import math
from dataclasses import replace
from itertools import combinations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from flows.tradeoff import entries as tradeoff_module
from flows.tradeoff.command import draw_tradeoffs, print_tradeoff, run_tradeoff, tradeoff_figure
from flows.tradeoff.entries import (
    Level,
    Point,
    Result,
    Tradeoff,
    cheapest_within,
    find_tradeoffs,
    mark_pareto,
    measure_tradeoff,
    register,
    registered,
)
from pipeline.errors import ArchiveError, SettingsError


def make_point(error: float, price: float) -> Point:
    """A point whose price is processor time."""
    return Point("s", error, 1.0, price, price, price, price, 1.0, None)


class Clock:
    """Stands for the time module: time passes only where a test lets it, on the wall twice as fast."""

    def __init__(self) -> None:
        self.cpu_s = 0.0

    def process_time(self) -> float:
        """Processor seconds."""
        return self.cpu_s

    def perf_counter(self) -> float:
        """Wall seconds."""
        return 2 * self.cpu_s


@pytest.fixture
def clock(monkeypatch):
    """The clock that trade-offs are timed by."""
    stands_in = Clock()
    monkeypatch.setattr(tradeoff_module, "time", stands_in)
    return stands_in


def sum_series(terms: int) -> float:
    """The first terms of 1/n^2."""
    return math.fsum(1 / n**2 for n in range(1, terms + 1))


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


def spend(clock, seconds):
    """Let time pass, and give an error of 0."""
    clock.cpu_s += seconds
    return 0.0


def test_every_setting_is_judged_and_runs_in_turn():
    """A series that stops errs by its remainder; rounds start at another setting each; at least one is needed."""
    for point in measure_tradeoff(SERIES, repeats=1).points:
        assert point.error == pytest.approx(1 / float(point.setting), rel=1e-3)
    with pytest.raises(SettingsError, match="at least 1, got 0"):
        measure_tradeoff(SERIES, repeats=0)
    seen: list[float] = []
    watched = replace(SERIES, settings=(1.0, 2.0, 3.0), run=lambda truth, terms: seen.append(float(terms)) or 0.0)
    measure_tradeoff(watched, repeats=2)
    assert seen == [1, 2, 3, 1, 2, 3, 2, 3, 1]


def test_least_times_are_the_price_and_the_floor(clock, monkeypatch):
    """A machine that halts for a while raises neither price nor the floor of copying the bytes."""
    turns = iter((1.0, 1.0, 2.0, 4.0, 2.0, 2.0, 3.0, 9.0))  # the second round begins with the second setting
    halting = replace(SERIES, settings=(1.0, 2.0), run=lambda truth, terms: spend(clock, next(turns)))
    second = measure_tradeoff(halting, repeats=3).points[1]
    assert (second.cpu_min_s, second.cpu_median_s, second.wall_median_s) == (2, 4, 8)
    assert second.ratio == 2
    turns = iter((3.0, 1.0, 2.0))
    monkeypatch.setattr(tradeoff_module.np, "copyto", lambda *_: spend(clock, next(turns) * 2**27 * 1e-9))
    result = measure_tradeoff(replace(SERIES, moved_bytes=6.0), repeats=3)
    assert result.memory_floor_ns == pytest.approx(6.0)


def test_settings_run_on_one_thread():
    """Torch has one thread while settings run, and those it had before afterwards."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        counted = replace(SERIES, run=lambda truth, terms: torch.get_num_threads(), judge=lambda truth, terms, out: out)
        assert {point.error for point in measure_tradeoff(counted, repeats=1).points} == {1}
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_only_run_is_timed_or_its_modelled_seconds(clock):
    """Preparing, warming up and judging cost nothing; a stage whose time is not spent here is priced by its model."""
    modelled = replace(
        SERIES,
        settings=(1.0, 3.0),
        modelled_s=lambda truth, terms, out: 60 * terms,
        run=lambda truth, terms: spend(clock, 0.5),
    )
    point = measure_tradeoff(modelled, repeats=1).points[1]
    assert (point.price_s, point.ratio, point.wall_min_s) == (180, 3, 1)
    timed = replace(
        SERIES,
        settings=(1.0, 4.0),
        prepare=lambda seed: spend(clock, 100),
        work=lambda truth, terms: 5.0,
        run=lambda truth, terms: spend(clock, terms),
        judge=lambda truth, terms, out: spend(clock, 100),
    )
    first, second = measure_tradeoff(timed, repeats=2).points
    assert (first.cpu_min_s, first.wall_min_s, second.cpu_min_s, second.wall_min_s) == (1, 2, 4, 8)
    assert (second.price_s, second.ratio, second.ns_per_unit) == (4, 4, 0.8e9)


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


def test_one_number_finds_the_cheapest_setting():
    """An accuracy gives the cheapest setting that reaches it, or None; one that failed never wins."""
    points = mark_pareto([make_point(math.nan, 0.1), make_point(0.5, 1.0)])
    assert [point.pareto for point in points] == [False, True]
    result = replace(measure_tradeoff(SERIES, repeats=1), points=points)
    assert cheapest_within(result, 10) is points[1]
    points = tuple(make_point(error, price) for error, price in ((0.3, 1.0), (0.1, 2.0), (0.1, 3.0), (0.01, 9.0)))
    result = replace(measure_tradeoff(SERIES, repeats=1), points=points)
    assert cheapest_within(result, 0.1) is points[1]
    assert cheapest_within(result, 0.001) is None


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


def test_result_is_json_and_names_the_machine():
    """With load, threads and versions; neither NaN nor infinity is in it."""
    found = json.loads(json.dumps(measure_tradeoff(SERIES, repeats=1).to_dict()))
    assert {"processor", "cores", "threads", "versions", "load_before"} <= set(found["machine"])
    assert found["points"][0]["ns_per_unit"] > 0
    points = (make_point(math.nan, 1.0), make_point(math.inf, 1.0), make_point(0.5, 1.0))
    result = replace(measure_tradeoff(SERIES, repeats=1), points=points)
    found = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    assert [point["error"] for point in found["points"]] == [None, None, 0.5]


NAMED = replace(make_point(0.1234, 3.59e-3), setting="a-setting-of-20-lett")


def printed(result: Result, width: int = 140) -> str:
    """The table as a terminal shows it."""
    console = Console(file=io.StringIO(), width=width)
    print_tradeoff(result, console)
    return console.file.getvalue()


def test_table_goes_from_the_most_exact_setting_down():
    """What errs least comes first; 80 columns cut no setting's name; a single repeat is one."""
    words = printed(measure_tradeoff(SERIES, repeats=1))
    assert words.index("64000.0") < words.index("16000.0") < words.index(" 4000.0")
    words = printed(replace(measure_tradeoff(SERIES, repeats=1), points=(NAMED,)), width=80)
    assert NAMED.setting in words
    assert "1 repeat in turn" in words


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


def test_figure_tells_winners_from_beaten_and_exact_from_small():
    """Winners are filled, the beaten hollow; an error of 0 stands below the least, named so on the axis."""
    points = mark_pareto([make_point(0.0, 2.0), make_point(1e-3, 1.0), make_point(0.5, 3.0)])
    figure = tradeoff_figure([replace(measure_tradeoff(SERIES, repeats=1), points=points)])
    figure.draw_without_rendering()
    (axes,) = figure.axes
    front, beaten = axes.lines
    assert [line.get_fillstyle() for line in (front, beaten)] == ["full", "none"]
    assert [list(line.get_xdata()) for line in (front, beaten)] == [[1000, 2000], [3000]]
    exact = min(front.get_ydata())
    assert 0 < exact < 1e-3
    names = {label.get_text(): tick for tick, label in zip(axes.get_yticks(), axes.get_yticklabels(), strict=True)}
    assert names["0, exact"] == exact


def test_figure_draws_every_floor_and_no_name_over_another():
    """Three levels and the memory's floor are lines at their places, and their names keep clear of each other."""
    levels = tuple(Level(f"goal of {error:g} px", error) for error in (0.3, 0.02, 1e-3))
    points = mark_pareto([make_point(error, price) for error, price in ((1.0, 4e-9), (0.3, 2e-8), (1e-4, 1e-8))])
    result = replace(measure_tradeoff(SERIES, repeats=1), points=points, levels=levels, memory_floor_ns=0.4)
    figure = tradeoff_figure([result])
    figure.draw_without_rendering()
    (axes,) = figure.axes
    across = [line.get_ydata()[0] for line in axes.lines if len(set(line.get_ydata())) == 1 < len(line.get_ydata())]
    assert across == [0.3, 0.02, 1e-3]
    assert [0.4, 0.4] in [list(line.get_xdata()) for line in axes.lines]
    boxes = [text.get_window_extent() for text in axes.texts if text.get_size() == 9]
    assert len(boxes) == 4
    assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))


def test_folder_that_cannot_be_is_refused_before_anything_is_measured(tmp_path, monkeypatch):
    """A file in the folder's place is named in the error, and no setting ran."""
    monkeypatch.setattr(tradeoff_module, "_REGISTRY", {})
    register(replace(SERIES, run=lambda truth, terms: pytest.fail("measured")))
    (tmp_path / "taken").write_text("")
    with pytest.raises(ArchiveError, match=r"cannot write to .*taken: .*; choose another --out"):
        run_tradeoff("series", tmp_path / "taken", 1, 0, Console(quiet=True))


@pytest.mark.parametrize("errors", [(0.0, 0.1, 3.0), (0.0, 0.0), (math.inf, 0.5), (math.nan, math.nan)])
def test_plots_take_errors_of_zero_and_none_at_all(tmp_path, errors):
    """Exact settings and failed ones neither stop the plot nor warn."""
    points = mark_pareto([make_point(error, 1.0 + number) for number, error in enumerate(errors)])
    result = replace(measure_tradeoff(SERIES, repeats=1), points=points, levels=(Level("half", 0.5),))
    draw_tradeoffs(tmp_path / "plot.png", [result] * 4)
    assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")
