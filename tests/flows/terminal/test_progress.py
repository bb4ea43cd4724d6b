"""Progress: bars on a terminal, lines in a log."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from flows.terminal.progress import StageProgress


def test_a_log_gets_one_line_when_a_stage_ends() -> None:
    """Where there is no terminal nothing is drawn over, and each stage says once that it ended."""
    out = io.StringIO()
    with StageProgress(Console(file=out), {"rectify": "mosaic"}) as progress:
        for done in (0.1, 0.5, 0.9):
            progress.show("rectify", done)
        progress.show("rectify", 1.0, "ran", ended=True)
    assert out.getvalue().splitlines() == ["mosaic: 100% ran"]


def test_words_of_a_scene_are_not_markup() -> None:
    """A name in square brackets is shown, not read as a style."""
    out = io.StringIO()
    with StageProgress(Console(file=out)) as progress:
        progress.show("looking", 1.0, "[red]field[/]", ended=True)
    assert "[red]field[/]" in out.getvalue()


def test_words_on_a_bar_are_not_markup() -> None:
    """On a terminal too a name in square brackets is shown as it is."""
    out = io.StringIO()
    with StageProgress(Console(file=out, force_terminal=True, width=160, color_system=None)) as progress:
        progress.show("looking", 0.5, "[red]field[/]")
    assert "[red]field[/]" in out.getvalue()


def test_words_go_beside_the_stage_that_runs() -> None:
    """What is said while nothing counts stands beside the stage that runs, and nowhere once that has ended."""
    out = io.StringIO()
    with StageProgress(Console(file=out, force_terminal=True, width=160, color_system=None)) as progress:
        progress.say("before any stage")
        progress.show("looking", 0.25)
        progress.say("fetching 3 of 55 MB")
        progress.show("looking", 1.0, "ran", ended=True)
        progress.say("afterwards")
    assert "before any stage" not in out.getvalue()
    assert "afterwards" not in out.getvalue()
    assert "looking" in out.getvalue()
    assert "ran" in out.getvalue()


def test_a_log_says_what_a_long_stage_is_at(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where there is no terminal the words come with the line that is due."""
    out = io.StringIO()
    monkeypatch.setattr("flows.terminal.progress.LINE_EVERY_S", -1.0)
    with StageProgress(Console(file=out), {"capture": "coarse sweep"}) as progress:
        progress.show("capture", 0.0)
        progress.say("fetching 3 of 55 MB")
    assert out.getvalue().splitlines()[-1] == "coarse sweep: 0% fetching 3 of 55 MB"


def test_a_narrow_terminal_keeps_bars_and_times() -> None:
    """In 80 columns words stand where the time left would, cut off at the end of the line; nothing else gives way."""
    out = io.StringIO()
    with StageProgress(Console(file=out, force_terminal=True, width=80, color_system=None)) as progress:
        progress.show("what lines turned by 90 degrees would show", 0.5)
        progress.say("fetching a file of a long name: 12.3 of 129.0 MB")
    lines = out.getvalue().splitlines()
    assert any("━" in line and "0:00:00 fetching a file" in line and "…" in line for line in lines)
    assert any("0:00:00 left" in line for line in lines)
