"""Trade-offs: four measures of each setting, and their display."""

from __future__ import annotations

import io
import json
import math
from typing import Any

import pytest
import torch
from rich.console import Console

from spectralzoom.flows import tradeoff as tradeoff_module
from spectralzoom.flows.tradeoff import TRADEOFFS, Figures, Tradeoff, measure_tradeoff, print_tradeoff, tradeoff
from spectralzoom.pipeline.errors import ArchiveError, SettingsError
from spectralzoom.storage.whole_files import to_json


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


LIMIT = math.pi**2 / 6


def sum_of(terms):
    """Return the truncated series."""
    return math.fsum(1 / n**2 for n in range(1, int(terms) + 1))


def distance(terms, out):
    """Judge the truncated series."""
    return Figures(abs(out - LIMIT), int(terms))


def make_series(run=sum_of, judge=distance, settings=(4000.0, 16000.0, 64000.0), prepare=lambda: None):
    """Return a trade-off of a truncated series, or of other functions."""

    def prepared(seed, scene, weights):
        prepare()
        return run, judge

    return Tradeoff("series", "terms", "absolute error", "terms", settings, prepared)


SERIES = make_series()


def spend(clock, seconds):
    """Let time pass and return an error of 0."""
    clock.cpu_s += seconds
    return Figures(0.0, 1)


def test_every_setting_is_judged_and_runs_in_turn():
    """A truncated series has the error of its remainder; each round starts at another setting."""
    for point in measure_tradeoff(SERIES, repeats=1)["points"]:
        assert point["error"] == pytest.approx(1 / float(point["setting"]), rel=1e-3)
        assert point["bytes"] == point["setting"]
    seen: list[float] = []
    watched = make_series(lambda terms: seen.append(float(terms)) or 0.0, settings=(1.0, 2.0, 3.0))
    measure_tradeoff(watched, repeats=2)
    assert seen == [1, 2, 3, 2, 3, 1]


def test_the_shortest_run_counts(clock):
    """A machine that pauses for a while raises neither time."""
    turns = iter((1.0, 4.0, 2.0, 2.0, 3.0, 9.0))  # the second round begins with the second setting
    halting = make_series(lambda terms: spend(clock, next(turns)), lambda *_: Figures(0.0, 1), (1.0, 2.0))
    second = measure_tradeoff(halting, repeats=3)["points"][1]
    assert (second["time_s"], second["processor_s"]) == (4, 2)


def test_settings_run_on_one_thread():
    """Torch has one thread while settings run, and its old number afterwards."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        counted = make_series(lambda terms: torch.get_num_threads(), lambda terms, out: Figures(out, 1))
        assert {point["error"] for point in measure_tradeoff(counted, repeats=1)["points"]} == {1}
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_only_the_run_is_timed(clock):
    """Preparation and judging do not count; the camera's seconds replace the wall time."""
    given = {"settings": (1.0, 4.0), "prepare": lambda: spend(clock, 100)}
    timed = make_series(lambda terms: spend(clock, terms), lambda terms, out: spend(clock, 100), **given)
    assert [one["processor_s"] for one in measure_tradeoff(timed, repeats=2)["points"]] == [1, 4]
    scanned = make_series(lambda terms: spend(clock, terms), lambda terms, out: Figures(0.0, 1, 60 * terms), **given)
    point = measure_tradeoff(scanned, repeats=1)["points"][1]
    assert (point["time_s"], point["processor_s"]) == (240, 4)


def test_result_is_json_and_names_the_machine():
    """It has load and versions; NaN and infinity become null."""
    points = [{"error": error} for error in (math.nan, math.inf, 0.5)]
    found = json.loads(to_json({**measure_tradeoff(SERIES, repeats=1), "points": points}))
    assert {"processor", "cores", "load", "versions"} == set(found["machine"])
    assert [point["error"] for point in found["points"]] == [None, None, 0.5]


def printed(result: dict[str, Any], width: int = 140) -> str:
    """Return the table as a terminal shows it."""
    console = Console(file=io.StringIO(), width=width)
    print_tradeoff(result, console)
    return console.file.getvalue()


def test_the_table_has_four_measures_and_begins_with_the_smallest_error():
    """80 columns cut neither the name of a setting nor a measure; the default is marked."""
    measures = {"time_s": 2.5, "processor_s": 1.25, "bytes": 3_000_000}
    points = [{"setting": f"a-setting-of-20-lett{one}", "error": one, **measures} for one in (2, 1)]
    result = {**measure_tradeoff(SERIES, repeats=1), "points": points}
    words = printed({**result, "default": points[0]["setting"]}, width=80)
    assert words.index("20-lett1") < words.index("20-lett2 (default)")
    assert all(one in words for one in ("2.5 s", "1.25 s", "3 MB", "1 repeat in turn"))
    assert words.count("(default)") == 1
    assert "(default)" not in printed(result)


def test_a_wrong_stage_or_folder_is_refused_before_measuring(tmp_path, monkeypatch):
    """The message lists the stages, or names the file in place of the folder."""
    monkeypatch.setitem(TRADEOFFS, "series", make_series(prepare=lambda: pytest.fail("measured")))
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
