"""Pages, docstrings and messages follow the rules of plain English, and the check finds each broken rule."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tests.house import language


def rules_of(text: str, kind: str = "page") -> list[str]:
    """Return the numbers of the rules that a sentence breaks."""
    return [rule[0] for rule in language.broken_rules(language.Sentence(Path("one.md"), 1, kind, text))]


@pytest.mark.parametrize(
    ("text", "rules"),
    [
        ("The planner selects a scan.", []),
        ("Of all scans it takes the cheapest.", ["1"]),
        ("Which scans exist?", []),
        (f"The planner {'very ' * 24}slowly ends.", ["2"]),
        ("It took 3 s, 4 s and 5 s.", ["4"]),
        ("A field of 1280 x 1024 px takes 3 to 100 ms.", []),
        ("Codes such as `1 2 3 4` are no numbers.", []),
        ("Nobody reads it.", ["6"]),
        ("The survey goes on.", ["6"]),
        ("The weights before had 94.2.", ["7"]),
        ("It is no longer there, as on 2026-01-02.", ["7"]),
    ],
)
def test_a_broken_rule_is_found(text: str, rules: list[str]) -> None:
    """Each rule has a sentence that breaks it, and some have one that only seems to."""
    assert rules_of(text) == rules


def test_a_lower_case_message_may_be_a_fragment() -> None:
    """A message that begins in lower case may begin with "of"; one that begins in upper case may not."""
    assert rules_of("of {} rows", "message") == []
    assert rules_of("Of {} rows", "message") == ["1"]


def test_a_page_is_split_into_sentences(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Code, tables, headings and comments are skipped; list items are separate; links become their text."""
    prose = "# Of it\n<!-- Of it -->\nOne [two](three.md) four. Five\nsix.\n\n- Seven.\n- Eight,\n  nine.\n"
    (tmp_path / "page.md").write_text(f"{prose}\n| Of it |\n```sh\nOf it\n```\n")
    monkeypatch.setattr(language, "ROOT", tmp_path)
    found = [(one.line, one.text) for one in language.sentences_of_page(Path("page.md"))]
    assert found == [(3, "One two four."), (3, "Five six."), (6, "Seven."), (7, "Eight, nine.")]


def test_code_is_split_into_sentences() -> None:
    """Docstrings, strings of four words or more, and f-strings with gaps are found."""
    code = 'def f(n):\n    """Return it.\n\n    None.\n    """\n    raise E(f"got {n} lines of sweeps", "one")\n'
    found = [(one.kind, one.text) for one in language.sentences_of_code(Path("one.py"), ast.parse(code))]
    assert found == [("docstring", "Return it."), ("docstring", "None."), ("message", "got {} lines of sweeps")]


def test_numbers_without_units_are_found() -> None:
    """A plain number of a known quantity needs a unit in its name; arrays and other names do not."""
    tree = ast.parse("def f(exposure: float, exposure_ms: float, wavelength: NDArray, timeout: float | None): ...")
    assert [name for _, name in language.names_without_unit(Path("one.py"), tree)] == ["exposure", "timeout"]


def test_all_texts_follow_the_rules() -> None:
    """`python tests/house --language` prints nothing."""
    assert [f"{one.path}:{one.line}: rule {rule}: {one.text}" for one, rule in language.violations()] == []
