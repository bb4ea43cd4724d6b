"""Trade-offs: timing, scores, Pareto points and their display."""

from __future__ import annotations

import io
import json
import math
from dataclasses import asdict, replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from flows.publish.panels import png
from flows.tradeoff import command
from flows.tradeoff import entries as tradeoff_module
from flows.tradeoff.command import print_tradeoff, tradeoff, tradeoff_figure
from flows.tradeoff.entries import Figures, Point, Result, Tradeoff, mark_pareto, measure_tradeoff
from pipeline.errors import ArchiveError, SettingsError
from storage.archive.whole_files import to_json


def make_point(error: float, cost: float, setting: str = "s") -> Point:
    """Return a point of a setting."""
    return Point(setting, error, cost, cost, 1.0)


class Clock:
    """Stand-in for the time module: time passes only when a test asks for it, and twice as fast on the wall."""

    def __init__(self) -> None:
        self.cpu_s = 0.0

    def process_time(self) -> float:
        """Return processor seconds."""
        return self.cpu_s

    def perf_counter(self) -> float:
        """Return wall seconds."""
        return 2 * self.cpu_s


@pytest.fixture(autouse=True)
def uncollected(monkeypatch):
    """Skip the garbage collection before each run, which would take most of the time here."""
    monkeypatch.setattr(tradeoff_module.gc, "collect", lambda: 0)


@pytest.fixture
def clock(monkeypatch):
    """Return the clock that times trade-offs."""
    stands_in = Clock()
    monkeypatch.setattr(tradeoff_module, "time", stands_in)
    return stands_in


SERIES = Tradeoff(
    stage="series",
    knob="terms",
    error="absolute error",
    reference="pi^2 / 6",
    settings=(4000.0, 16000.0, 64000.0),
    prepare=lambda seed: math.pi**2 / 6,
    run=lambda truth, terms: math.fsum(1 / n**2 for n in range(1, int(terms) + 1)),
    judge=lambda truth, terms, out: Figures(abs(out - truth)),
)


def spend(clock, seconds):
    """Let time pass and return an error of 0."""
    clock.cpu_s += seconds
    return Figures(0.0)


def test_every_setting_is_judged_and_runs_in_turn():
    """A truncated series has the error of its remainder; each round starts at another setting."""
    for point in measure_tradeoff(SERIES, repeats=1).points:
        assert point.error == pytest.approx(1 / float(point.setting), rel=1e-3)
    seen: list[float] = []
    watched = replace(SERIES, settings=(1.0, 2.0, 3.0), run=lambda truth, terms: seen.append(float(terms)) or 0.0)
    measure_tradeoff(watched, repeats=2)
    assert seen == [1, 2, 3, 1, 2, 3, 2, 3, 1]


def test_a_first_setting_of_no_cost_gives_no_ratio():
    """A cube of one value takes no bytes."""
    free = replace(SERIES, settings=(1.0, 2.0), judge=lambda truth, terms, out: Figures(0.0, cost=terms - 1))
    assert [math.isnan(one.ratio) for one in measure_tradeoff(free, repeats=1).points] == [True, True]


def test_the_cost_is_the_shortest_time(clock):
    """A machine that pauses for a while does not raise the cost."""
    turns = iter((1.0, 1.0, 2.0, 4.0, 2.0, 2.0, 3.0, 9.0))  # the second round begins with the second setting
    halting = replace(
        SERIES, settings=(1.0, 2.0), run=lambda truth, terms: spend(clock, next(turns)), judge=lambda *_: Figures(0.0)
    )
    second = measure_tradeoff(halting, repeats=3).points[1]
    assert (second.cost, second.time_s, second.ratio) == (2, 2, 2)


def test_settings_run_on_one_thread():
    """Torch has one thread while settings run, and its old number afterwards."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        counted = replace(
            SERIES, run=lambda truth, terms: torch.get_num_threads(), judge=lambda truth, terms, out: Figures(out)
        )
        assert {point.error for point in measure_tradeoff(counted, repeats=1).points} == {1}
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_only_the_run_is_timed(clock):
    """Preparation and judging do not count; a cost from judging replaces the time."""
    timed = replace(
        SERIES,
        settings=(1.0, 4.0),
        prepare=lambda seed: spend(clock, 100),
        run=lambda truth, terms: spend(clock, terms),
        judge=lambda truth, terms, out: spend(clock, 100),
    )
    first, second = measure_tradeoff(timed, repeats=2).points
    assert (first.cost, second.cost, second.time_s, second.ratio) == (1, 4, 4, 4)
    priced = replace(timed, judge=lambda truth, terms, out: Figures(0.0, 60 * terms))
    point = measure_tradeoff(priced, repeats=1).points[1]
    assert (point.cost, point.ratio, point.time_s) == (240, 4, 4)


@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=1, max_size=12))
def test_pareto_points_are_not_dominated(pairs):
    """No marked point dominates another, and a marked point dominates every other point."""
    points = mark_pareto([make_point(error, price) for error, price in pairs])
    front = {(point.error, point.cost) for point in points if point.pareto}
    assert front
    for point in points:
        better = [f for f in front if f[0] <= point.error and f[1] <= point.cost and f != (point.error, point.cost)]
        assert bool(better) != point.pareto


def test_result_is_json_and_names_the_machine():
    """It has load, threads and versions; NaN and infinity become null."""
    points = (make_point(math.nan, 1.0), make_point(math.inf, 1.0), make_point(0.5, 1.0))
    found = json.loads(to_json(asdict(replace(measure_tradeoff(SERIES, repeats=1), points=points))))
    assert {"processor", "cores", "threads", "versions", "load_before"} <= set(found["machine"])
    assert [point["error"] for point in found["points"]] == [None, None, 0.5]


def printed(result: Result, width: int = 140) -> str:
    """Return the table as a terminal shows it."""
    console = Console(file=io.StringIO(), width=width)
    print_tradeoff(result, console)
    return console.file.getvalue()


def test_the_table_begins_with_the_smallest_error():
    """80 columns cut neither the name of a setting nor another figure."""
    figured = replace(
        SERIES, judge=lambda truth, terms, out: Figures(1 / terms, 2.5, {"squared": 0.0625}), cost="pages of paper"
    )
    result = measure_tradeoff(figured, repeats=1)
    words = printed(result)
    assert words.index("64000.0") < words.index("16000.0") < words.index(" 4000.0")
    named = replace(result.points[0], setting="a-setting-of-20-lett")
    words = printed(replace(result, points=(named,)), width=80)
    assert all(one in words for one in (named.setting, "squared", "0.062", "paper", "2.5", "1 repeat in turn"))


def test_the_default_is_marked() -> None:
    """Table, figure and JSON mark it; without a default nothing is marked."""
    result = measure_tradeoff(replace(SERIES, default=16000.0), repeats=1)
    assert "16000.0 (default)" in printed(result)
    assert printed(result).count("(default)") == 1
    (axes,) = tradeoff_figure([result]).axes
    assert [text.get_text() for text in axes.texts if "default" in text.get_text()] == ["16000.0 (default)"]
    assert asdict(result)["default"] == 16000.0
    assert "(default)" not in printed(measure_tradeoff(SERIES, repeats=1))


def test_the_figure_distinguishes_pareto_points():
    """They are filled, the others hollow; a family is one line with its members named at their points."""
    told = (("scan, 1 ms", 0.0, 2.0), ("scan, 2 ms", 1e-3, 1.0), ("two passes, half", 0.5, 3.0))
    points = mark_pareto([make_point(error, cost, name) for name, error, cost in told])
    figure = tradeoff_figure([replace(measure_tradeoff(SERIES, repeats=1), points=points, level=("half", 0.5))])
    figure.draw_without_rendering()
    (axes,) = figure.axes
    marks = {tuple(line.get_xdata()): line.get_fillstyle() for line in axes.lines if line.get_marker() == "o"}
    assert marks == {(1.0,): "full", (2.0,): "full", (3.0,): "none"}
    assert {text.get_text() for text in axes.texts} == {"1 ms", "2 ms", "half"}
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["scan", "two passes"]


def test_a_wrong_stage_or_folder_is_refused_before_measuring(tmp_path, monkeypatch):
    """The message lists the stages, or names the file in place of the folder."""
    monkeypatch.setitem(command.TRADEOFFS, "series", replace(SERIES, prepare=lambda seed: pytest.fail("measured")))
    (tmp_path / "taken").write_text("")
    with pytest.raises(ArchiveError, match=r"cannot write to .*taken: .*; choose another --out"):
        tradeoff("series", out=tmp_path / "taken")
    with pytest.raises(SettingsError, match="no trade-off for stage 'serie'; there are: rectify, segment, simulate"):
        tradeoff("serie", out=tmp_path)


@pytest.mark.parametrize("errors", [(0.0, 0.1, 3.0), (0.0, 0.0), (math.inf, 0.5), (math.nan, math.nan)])
def test_plots_accept_zero_and_non_finite_errors(tmp_path, errors):
    """Exact and failed settings neither stop the plot nor warn."""
    points = mark_pareto([make_point(error, 1.0 + number) for number, error in enumerate(errors)])
    result = replace(measure_tradeoff(SERIES, repeats=1), points=points, level=("half", 0.5))
    assert png(tradeoff_figure([result] * 4)).startswith(b"\x89PNG")
