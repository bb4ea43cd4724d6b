"""What reaches terminal, log and pages: progress, and names and devices' words as escapes, whatever prints them."""

from __future__ import annotations

import ast
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress
from rich.table import Table

from flows.archive.history import FieldHistory, render_history
from flows.publish.report import render_markdown
from flows.terminal.figures import three_digits
from flows.terminal.progress import StageProgress, Terminal
from pipeline.errors import is_visible
from storage.archive.whole_files import to_json

HOSTILE = "field\x1b]0;owned\x07\x1b[2J\u202egnp.map\x9b31m\u2028\udcff"
SHOWN = "field\\x1b]0;owned\\x07\\x1b[2J\\u202egnp.map\\x9b31m\\u2028\\udcff"


def test_nothing_that_is_printed_steers_the_terminal() -> None:
    """Styles and borders are the console's own; in the words no control character is left."""
    rows = Table("name")
    rows.add_row(escape(HOSTILE))
    for thing in (escape(HOSTILE), rows, [HOSTILE]):
        file = io.StringIO()
        Terminal(file=file, width=200, color_system=None).print(thing)
        assert all(is_visible(letter) for letter in file.getvalue())
        assert "\\u202e" in file.getvalue()


def test_bars_and_json_show_names_as_escapes() -> None:
    """A bar moves the cursor itself, nothing else does; JSON reads back as it was."""
    file = io.StringIO()
    with Progress(console=Terminal(file=file, width=200, force_terminal=True, color_system=None)) as bars:
        bars.add_task(escape(HOSTILE), total=1)
    assert "\x1b]0" not in file.getvalue()
    assert "\u202e" not in file.getvalue()
    content = {HOSTILE: [HOSTILE, "Süd 🌾"]}
    text = to_json(content)
    assert all(is_visible(letter) for letter in text)
    assert "Süd 🌾" in text
    assert json.loads(text) == content


def _history(words: str) -> FieldHistory:
    row = {
        **{"run": words, "created": "2026-06-01T10:00:00Z", "visited": "2026-06-01T10:00:00Z", "visit": words},
        **{"miou": 0.5, "overall_accuracy": None, "training_scene": None, "capture_s": 9.0},
        **{"areas": {words: 1.0}, "unit": "fraction", "replaced": False},
    }
    return FieldHistory(words, words, [row])


def test_pages_show_names_as_escapes() -> None:
    """Words beside a name are not turned round by it, and nothing in them is markup."""
    text = render_history(_history(HOSTILE), "runs")
    assert all(is_visible(letter) for letter in text)
    assert text.count(SHOWN) >= 3
    assert '<b title="' not in render_history(_history('<b title="x">'), "runs")


def test_prefects_pages_show_names_as_escapes() -> None:
    """The text of a survey has them, with its markup off."""
    words = HOSTILE + "<b>[x](y)`|"
    text = render_markdown(
        "survey.md", survey=words, headline=words, picture="", findings=[words], where="archive/runs/x_1"
    )
    assert all(is_visible(letter) for letter in text)
    assert text.count(r"\<b\>\[x\](y)\`\|") == 3
    assert "`archive/runs/x_1/report.html`" in text


def test_a_command_names_a_hostile_file_in_escapes(command_line: Any, tmp_path: Path) -> None:
    """The message of a verb quotes what it was given."""
    ended = command_line("survey", tmp_path / "north\x1b[31m\u202e.toml")
    assert (ended.code, len(ended.errors)) == (2, 1)
    assert "north\\x1b[31m\\u202e.toml" in ended.err
    assert "\u202e" not in ended.err


def test_every_console_is_a_terminal() -> None:
    """No verb prints past it: consoles are made in one module, and pages escape by one function."""
    root = Path(__file__).parents[3] / "flows"
    made: list[str] = []
    for path in root.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Console":
                made.append(path.name)
            if isinstance(node, ast.ImportFrom) and node.module in ("html", "jinja2") and path.name != "report.py":
                made.append(path.name)
    assert made == []


TERMINAL = {"force_terminal": True, "color_system": None, "width": 160}


def progress_of(steps: Callable[[StageProgress], None], **console: Any) -> str:
    """What is written while stages go on; in a log, unless the console is a terminal."""
    out = io.StringIO()
    with StageProgress(Console(file=out, **console), {"rectify": "mosaic"}) as progress:
        steps(progress)
    return out.getvalue()


def test_a_log_gets_one_line_when_a_stage_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where there is no terminal nothing is drawn over; of a long stage the words come with the line that is due."""

    def steps(progress: StageProgress) -> None:
        for done in (0.1, 0.5, 0.9):
            progress.show("rectify", done)
        progress.show("rectify", 1.0, "ran", ended=True)

    def long(progress: StageProgress) -> None:
        progress.show("rectify", 0.0)
        progress.say("fetching 3 of 55 MB")

    assert progress_of(steps).splitlines() == ["mosaic: 100% ran"]
    monkeypatch.setattr("flows.terminal.progress.LINE_EVERY_S", -1.0)
    assert progress_of(long).splitlines()[-1] == "mosaic: 0% fetching 3 of 55 MB"


@pytest.mark.parametrize("console", [{}, TERMINAL], ids=["log", "terminal"])
def test_words_of_a_scene_are_not_markup(console: dict[str, Any]) -> None:
    """A name in square brackets is shown, not read as a style."""
    assert "[red]field[/]" in progress_of(lambda one: one.show("looking", 1.0, "[red]field[/]", ended=True), **console)
    bar = progress_of(lambda one: one.show("looking", 0.5, "[red]field[/]"), **TERMINAL)
    assert "[red]field[/]" in bar


def test_words_go_beside_the_stage_that_runs() -> None:
    """What is said while nothing counts stands beside the stage that runs, and nowhere once that has ended."""

    def steps(progress: StageProgress) -> None:
        progress.say("before any stage")
        progress.show("looking", 0.25)
        progress.say("fetching 3 of 55 MB")
        progress.show("looking", 1.0, "ran", ended=True)
        progress.say("afterwards")

    told = progress_of(steps, **TERMINAL)
    found = [words in told for words in ("before any stage", "afterwards", "looking", "ran")]
    assert found == [False, False, True, True]


def test_time_left_stands_behind_the_words(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a stage that runs, as a training does for long, and no longer of one that has ended; in a log as well."""
    monkeypatch.setattr("rich.progress.Task.time_remaining", 75.0)
    monkeypatch.setattr("flows.terminal.progress.LINE_EVERY_S", -1.0)
    log = progress_of(lambda one: one.show("rectify", 0.5, "step 28"))
    assert log.splitlines() == ["mosaic: 50% step 28, 75 s left"]
    told = progress_of(lambda one: one.show("training", 0.5, "step 28"), **{**TERMINAL, "width": 120})
    assert "step 28  left 0:01:15" in told
    told = progress_of(lambda one: one.show("training", 0.5, "failed", ended=True), **{**TERMINAL, "width": 120})
    assert "failed" in told
    assert "failed  left" not in told


def test_a_narrow_terminal_keeps_bars_and_times() -> None:
    """In 80 columns words stand where the time left would, cut off at the end of the line; nothing else gives way."""

    def steps(progress: StageProgress) -> None:
        progress.show("what lines turned by 90 degrees would show", 0.5)
        progress.say("fetching a file of a long name: 12.3 of 129.0 MB")

    lines = progress_of(steps, **{**TERMINAL, "width": 80}).splitlines()
    assert any("━" in line and "0:00:00 fetching a file" in line and "…" in line for line in lines)
    assert any("0:00:00 left" in line for line in lines)


@pytest.mark.parametrize(
    ("value", "words"),
    [(0, "0"), (0.0823, "0.0823"), (12.83, "12.8"), (280.4, "280"), (999.6, "1 000"), (43712, "43 700")],
)
def test_figures_of_any_size_have_three_digits(value: float, words: str) -> None:
    """No exponent however many hectares an hour there are."""
    assert three_digits(value).replace("\u202f", " ") == words
