"""Code and pages use the terms of docs/reference/glossary.md, and none of its banned words."""

from __future__ import annotations

import io
import re
import tokenize
from functools import cache
from pathlib import Path

import pytest

from tests.docs.pages import DOCS, PAGES, ROOT

GLOSSARY = DOCS / "reference" / "glossary.md"
ROOMS = ("pipeline", "models", "storage", "flows", "spectralzoom")
SOURCES = sorted(path for room in ROOMS for path in (ROOT / room).rglob("*.py"))
OTHERS = {  # other meanings of these words in these files
    "track": ("pipeline/simulator/scenes/farm", "pipeline/simulator/optics"),  # a class of the farm
    "strips": ("models/reading", "flows/publish", "storage/readers", "flows/tasks"),  # of rows of an image
    "panel": ("flows/publish",),  # of a figure
    "dead": ("pipeline/signal", "pipeline/simulator"),  # elements of a detector
}
KEPT = {"LookupError", "ProcessLookupError", "shares_memory"}  # names of Python and numpy
PARTS = re.compile(r"[A-Z]+(?![a-z])|[A-Z][a-z0-9]*|[a-z0-9]+")  # the words of a name in snake or camel case


def banned(column: int) -> set[str]:
    """Return the words of a column of the glossary's table."""
    rows = [line.split("|")[1:-1] for line in GLOSSARY.read_text().splitlines() if line.startswith("| ")][1:]
    return {word.strip() for row in rows for word in row[column].split(",") if word.strip()}


@cache
def names_in(path: Path) -> set[str]:
    """Return all names of a module, its own name and those of its folders."""
    tokens = tokenize.generate_tokens(io.StringIO(path.read_text()).readline)
    return {one.string for one in tokens if one.type == tokenize.NAME} | {path.stem, *path.relative_to(ROOT).parts[:-1]}


@pytest.mark.parametrize("word", sorted(banned(3)))
def test_no_name_has_a_banned_word(word: str) -> None:
    """The names are those of variables, functions, classes, modules and folders."""
    others = OTHERS.get(word, ())
    wrong = [
        f"{path.relative_to(ROOT)}: {name}"
        for path in SOURCES
        if not str(path.relative_to(ROOT)).startswith(others or ("-",))
        for name in names_in(path)
        if word in map(str.lower, PARTS.findall(name)) and name not in KEPT
    ]
    assert wrong == []


@pytest.mark.parametrize("word", sorted(banned(4)))
def test_no_page_has_a_banned_word(word: str) -> None:
    """The glossary and the changelog may have them."""
    pages = [page for page in PAGES if page.name not in (GLOSSARY.name, "CHANGELOG.md")]
    found = re.compile(rf"\b{word}s?\b", re.IGNORECASE)
    assert [page.name for page in pages if found.search(page.read_text())] == []


def test_names_of_the_glossary_exist_in_the_code() -> None:
    """Each name in the column "in code" is a name in the source."""
    known = {name for path in SOURCES for name in names_in(path)}
    rows = [line.split("|")[1:-1] for line in GLOSSARY.read_text().splitlines() if line.startswith("| ")][1:]
    assert [name for row in rows for name in re.findall(r"`(\w+)`", row[2]) if name not in known] == []
