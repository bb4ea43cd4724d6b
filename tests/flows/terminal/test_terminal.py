"""Output on terminal, in log and pages: progress, and control characters in names or device messages as escapes."""

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

from spectralzoom.flows.publish.report import render_markdown
from spectralzoom.flows.terminal.figures import three_digits
from spectralzoom.flows.terminal.progress import StageProgress, Terminal
from spectralzoom.pipeline.errors import is_visible
from spectralzoom.storage.whole_files import to_json
from tests.flows.publish.test_receipt import make_receipt, page_of

HOSTILE = "field\x1b]0;owned\x07\x1b[2J\u202egnp.map\x9b31m\u2028\udcff"
SHOWN = "field\\x1b]0;owned\\x07\\x1b[2J\\u202egnp.map\\x9b31m\\u2028\\udcff"


def test_printed_text_has_no_control_characters() -> None:
    """Styles and borders come from the console itself."""
    rows = Table("name")
    rows.add_row(escape(HOSTILE))
    for thing in (escape(HOSTILE), rows, [HOSTILE]):
        file = io.StringIO()
        Terminal(file=file, width=200, color_system=None).print(thing)
        assert all(is_visible(letter) for letter in file.getvalue())
        assert "\\u202e" in file.getvalue()


def test_bars_and_json_show_names_as_escapes() -> None:
    """A bar writes cursor movements of its own only; JSON with escapes reads back unchanged."""
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


def test_pages_show_names_as_escapes() -> None:
    """A name cannot reverse the text beside it; HTML in it is no markup, nor is Markdown on Prefect's page."""
    receipt = make_receipt()
    receipt["survey"] = HOSTILE + '<b title="x">'
    page = page_of(receipt)
    assert page.count(SHOWN) >= 2
    assert '<b title="' not in page
    words = HOSTILE + "<b>[x](y)`|"
    shown = {"survey": words, "headline": [words], "findings": [words]}
    text = render_markdown("survey.md", **shown, picture="", where="archive/runs/x_1")
    assert text.count(r"\<b\>\[x\](y)\`\|") == 3
    assert "`archive/runs/x_1/report.html`" in text
    assert all(map(is_visible, page + text))


def test_a_command_names_a_hostile_file_in_escapes(command_line: Any, tmp_path: Path) -> None:
    """The error message quotes the file's name without control characters."""
    ended = command_line("survey", tmp_path / "north\x1b[31m\u202e.toml")
    assert (ended.code, len(ended.errors)) == (2, 1)
    assert "north\\x1b[31m\\u202e.toml" in ended.err
    assert "\u202e" not in ended.err


def test_every_console_is_a_terminal() -> None:
    """One module makes every console and one function escapes every page, so no command bypasses them."""
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
    """Return the text that a progress display writes during the steps; console options can make it a terminal."""
    out = io.StringIO()
    with StageProgress(Console(file=out, **console), {"rectify": "mosaic"}) as progress:
        steps(progress)
    return out.getvalue()


def test_a_log_gets_one_line_when_a_stage_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """A log has no redrawn lines; during a long stage its message comes with the next due line."""

    def steps(progress: StageProgress) -> None:
        for done in (0.1, 0.5, 0.9):
            progress.show("rectify", done)
        progress.show("rectify", 1.0, "ran", ended=True)

    def long(progress: StageProgress) -> None:
        progress.show("rectify", 0.0)
        progress.say("fetching 3 of 55 MB")

    assert progress_of(steps).splitlines() == ["mosaic: 100% ran"]
    monkeypatch.setattr("spectralzoom.flows.terminal.progress.LINE_EVERY_S", -1.0)
    assert progress_of(long).splitlines()[-1] == "mosaic: 0% fetching 3 of 55 MB"


@pytest.mark.parametrize("console", [{}, TERMINAL], ids=["log", "terminal"])
def test_scene_names_are_not_markup(console: dict[str, Any]) -> None:
    """A name in square brackets is shown as it is and not read as a style."""
    assert "[red]field[/]" in progress_of(lambda one: one.show("looking", 1.0, "[red]field[/]", ended=True), **console)
    assert "[red]field[/]" in progress_of(lambda one: one.show("looking", 0.5, "[red]field[/]"), **TERMINAL)


def test_messages_stand_beside_the_running_stage() -> None:
    """Messages before the first stage or after the last one are not shown."""

    def steps(progress: StageProgress) -> None:
        progress.say("before any stage")
        progress.show("looking", 0.25)
        progress.say("fetching 3 of 55 MB")
        progress.show("looking", 1.0, "ran", ended=True)
        progress.say("afterwards")

    told = progress_of(steps, **TERMINAL)
    found = [words in told for words in ("before any stage", "afterwards", "looking", "ran")]
    assert found == [False, False, True, True]


def test_a_log_has_the_time_left_of_a_running_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    """An ended stage has none."""
    monkeypatch.setattr("rich.progress.Task.time_remaining", 75.0)
    monkeypatch.setattr("spectralzoom.flows.terminal.progress.LINE_EVERY_S", -1.0)
    assert progress_of(lambda one: one.show("rectify", 0.5, "step 28")).splitlines() == [
        "mosaic: 50% step 28, 75 s left"
    ]
    assert "left" not in progress_of(lambda one: one.show("rectify", 0.5, "failed", ended=True))


def test_a_narrow_terminal_keeps_bars_and_times() -> None:
    """In 80 columns the message is cut at the end of the line; bar and times stay."""

    def steps(progress: StageProgress) -> None:
        progress.show("what lines turned by 90 degrees would show", 0.5)
        progress.say("fetching a file of a long name: 12.3 of 129.0 MB")

    lines = progress_of(steps, **{**TERMINAL, "width": 80}).splitlines()
    assert any("━" in line and "0:00:00 left" in line and "fetching" in line and "…" in line for line in lines)


@pytest.mark.parametrize(
    ("value", "words"),
    [(0, "0"), (0.0823, "0.0823"), (12.83, "12.8"), (280.4, "280"), (999.6, "1 000"), (43712, "43 700")],
)
def test_figures_of_any_size_have_three_digits(value: float, words: str) -> None:
    """Large figures, such as hectares an hour, have no exponent."""
    assert three_digits(value).replace("\u202f", " ") == words
