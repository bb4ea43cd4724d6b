"""Trade-offs: four measures of each setting, Pareto points and their display."""

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

from flows import tradeoff as tradeoff_module
from flows.publish.panels import png
from flows.tradeoff import (
    TRADEOFFS,
    Figures,
    Point,
    Result,
    Tradeoff,
    mark_pareto,
    measure_tradeoff,
    print_tradeoff,
    tradeoff,
    tradeoff_figure,
)
from pipeline.errors import ArchiveError, SettingsError
from storage.archive.whole_files import to_json


def make_point(error: float, cost: float, size: int = 1) -> Point:
    """Return a point of a setting."""
    return Point("s", error, cost, cost, size)


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
    bytes="terms",
    settings=(4000.0, 16000.0, 64000.0),
    prepare=lambda seed, scene, weights: math.pi**2 / 6,
    run=lambda truth, terms: math.fsum(1 / n**2 for n in range(1, int(terms) + 1)),
    judge=lambda truth, terms, out: Figures(abs(out - truth), int(terms)),
)


def spend(clock, seconds):
    """Let time pass and return an error of 0."""
    clock.cpu_s += seconds
    return Figures(0.0, 1)


def test_every_setting_is_judged_and_runs_in_turn():
    """A truncated series has the error of its remainder; each round starts at another setting."""
    for point in measure_tradeoff(SERIES, repeats=1).points:
        assert point.error == pytest.approx(1 / float(point.setting), rel=1e-3)
        assert point.bytes == point.setting
    seen: list[float] = []
    watched = replace(SERIES, settings=(1.0, 2.0, 3.0), run=lambda truth, terms: seen.append(float(terms)) or 0.0)
    measure_tradeoff(watched, repeats=2)
    assert seen == [1, 2, 3, 2, 3, 1]


def test_the_shortest_run_counts(clock):
    """A machine that pauses for a while raises neither time."""
    turns = iter((1.0, 4.0, 2.0, 2.0, 3.0, 9.0))  # the second round begins with the second setting
    halting = replace(
        SERIES,
        settings=(1.0, 2.0),
        run=lambda truth, terms: spend(clock, next(turns)),
        judge=lambda *_: Figures(0.0, 1),
    )
    second = measure_tradeoff(halting, repeats=3).points[1]
    assert (second.time_s, second.processor_s) == (4, 2)


def test_settings_run_on_one_thread():
    """Torch has one thread while settings run, and its old number afterwards."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        counted = replace(
            SERIES, run=lambda truth, terms: torch.get_num_threads(), judge=lambda truth, terms, out: Figures(out, 1)
        )
        assert {point.error for point in measure_tradeoff(counted, repeats=1).points} == {1}
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_only_the_run_is_timed(clock):
    """Preparation and judging do not count; the camera's seconds replace the wall time."""
    timed = replace(
        SERIES,
        settings=(1.0, 4.0),
        prepare=lambda seed, scene, weights: spend(clock, 100),
        run=lambda truth, terms: spend(clock, terms),
        judge=lambda truth, terms, out: spend(clock, 100),
    )
    assert [one.processor_s for one in measure_tradeoff(timed, repeats=2).points] == [1, 4]
    scanned = replace(timed, judge=lambda truth, terms, out: Figures(0.0, 1, camera_s=60 * terms))
    point = measure_tradeoff(scanned, repeats=1).points[1]
    assert (point.time_s, point.processor_s) == (240, 4)


@given(st.lists(st.tuples(*[st.integers(0, 4)] * 3), min_size=1, max_size=12))
def test_pareto_points_are_not_dominated(rows):
    """No marked point is dominated, and a marked point dominates every other point."""
    points = mark_pareto([make_point(*row) for row in rows])
    measures = [(point.error, point.time_s, point.bytes) for point in points]
    front = {row for row, point in zip(measures, points, strict=True) if point.pareto}
    assert front
    for row, point in zip(measures, points, strict=True):
        better = [one for one in front if one != row and all(a <= b for a, b in zip(one, row, strict=True))]
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


def test_the_table_has_four_measures_and_begins_with_the_smallest_error():
    """80 columns cut neither the name of a setting nor a measure; the default is marked, notes are below."""
    points = tuple(Point(f"a-setting-of-20-lett{one}", one, 2.5, 1.25, 3_000_000) for one in (2, 1))
    result = replace(measure_tradeoff(SERIES, repeats=1), points=points, notes=("labels [lack] wheat",))
    words = printed(replace(result, default=points[0].setting), width=80)
    assert words.index("20-lett1") < words.index("20-lett2 (default)")
    assert all(one in words for one in ("2.5 s", "1.25 s", "3 MB", "1 repeat in turn", "labels [lack] wheat"))
    assert words.count("(default)") == 1
    assert "(default)" not in printed(result)


def test_the_figure_shows_error_against_time_and_bytes():
    """Points of the Pareto front are filled, the others hollow."""
    points = mark_pareto([make_point(0.0, 2.0), make_point(1e-3, 1.0), make_point(0.5, 3.0, 7)])
    figure = tradeoff_figure([replace(measure_tradeoff(SERIES, repeats=1), points=points)])
    figure.draw_without_rendering()
    time, size = figure.axes
    assert {line.get_xdata()[0]: line.get_fillstyle() for line in time.lines} == {1: "full", 2: "full", 3: "none"}
    assert [line.get_xdata()[0] for line in size.lines] == [1, 1, 7]


def test_a_wrong_stage_or_folder_is_refused_before_measuring(tmp_path, monkeypatch):
    """The message lists the stages, or names the file in place of the folder."""
    monkeypatch.setitem(TRADEOFFS, "series", replace(SERIES, prepare=lambda *_: pytest.fail("measured")))
    (tmp_path / "taken").write_text("")
    with pytest.raises(ArchiveError, match=r"cannot write to .*taken: .*; choose another --out"):
        tradeoff("series", out=tmp_path / "taken")
    with pytest.raises(
        SettingsError, match="no trade-off for stage 'serie'; there are: condense, rectify, segment, simulate"
    ):
        tradeoff("serie", out=tmp_path)


def test_scenes_that_do_not_fit_are_refused(tmp_path):
    """Other stages take no scene, and scene and weights need each other."""
    weights = tmp_path / "w.safetensors"
    for stage, scene, read_by in (
        ("rectify", "cube.npy", weights),
        ("survey", "cube.npy", None),
        (None, "cube.npy", None),
        ("segment", None, weights),
    ):
        with pytest.raises(SettingsError, match="--scene FILE and --weights FILE go together, with the stages segment"):
            tradeoff(stage, scene=scene, weights=read_by, out=tmp_path)


@pytest.mark.parametrize("errors", [(0.0, 0.1, 3.0), (0.0, 0.0), (math.inf, 0.5), (math.nan, math.nan)])
def test_plots_accept_zero_and_non_finite_errors(tmp_path, errors):
    """Exact and failed settings neither stop the plot nor warn."""
    points = mark_pareto([make_point(error, 1.0 + number) for number, error in enumerate(errors)])
    result = replace(measure_tradeoff(SERIES, repeats=1), points=points)
    assert png(tradeoff_figure([result] * 4)).startswith(b"\x89PNG")
