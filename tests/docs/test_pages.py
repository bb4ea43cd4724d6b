"""The pages hold what they promise: every block runs, every link and path leads somewhere, README stays short."""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from tests.docs.pages import DOCS, LINKED, PAGES, ROOT, anchors_of, blocks_of, links_of, named_code
from tests.docs.running import Reader
from tests.prior_work import with_effects, without_effects

WITH_BLOCKS = [page for page in PAGES if blocks_of(page)]
OF_EFFECTS = {DOCS / "background" / "simulator.md"}  # pages that show which effects are chosen; others need no choice
README_LINES = 130
PATH = re.compile(
    r"(?:pipeline|models|storage|flows|tests|docs|\.ci)(?:/[\w.-]+)*/?|[\w-]+\.(?:md|toml|yaml|txt)|Makefile"
)
OF_USERS = {"scene.toml", "emulated.toml", "field.toml", "survey.toml", "north.toml"}  # pages have people write them


def named(page: Path) -> str:
    """A page's name in messages."""
    return page.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("page", WITH_BLOCKS, ids=named)
def test_every_block_runs(page: Path, place: Path, request: pytest.FixtureRequest) -> None:
    """From top to bottom, in a folder with a small survey in it."""
    blocks = blocks_of(page)
    bucket = request.getfixturevalue("bucket") if any(one.mark == "bucket" for one in blocks) else None
    reader = Reader(place, bucket)
    with reader.left, with_effects() if page in OF_EFFECTS else without_effects():
        for block in blocks:
            reader.follow(block)


@pytest.mark.parametrize("page", LINKED, ids=named)
def test_links_lead_somewhere(page: Path) -> None:
    """Files and anchors are there; addresses of the web are well formed, and not asked."""
    wrong = []
    for target in links_of(page):
        parts = urlsplit(target)
        if parts.scheme:
            wrong += [] if parts.scheme == "https" and "." in parts.netloc else [target]
            continue
        to = (page.parent / parts.path).resolve() if parts.path else page
        known = to.exists() and (not parts.fragment or parts.fragment in anchors_of(to))
        wrong += [] if known else [target]
    assert wrong == []


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_named_paths_are_there(page: Path) -> None:
    """A path of the repository in backticks is one: what was renamed shows here."""
    named_paths = {word.split("::")[0] for word in named_code(page) if PATH.fullmatch(word)} - OF_USERS
    assert [path for path in sorted(named_paths) if not (ROOT / path).exists()] == []


def test_readme_is_short() -> None:
    """What takes longer stands in docs."""
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= README_LINES


def test_rooms_of_the_table_are_those_of_the_tree() -> None:
    """Every folder named in the first table of architecture is there, and no room is left out."""
    page = (DOCS / "reference" / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| (.*) \|$", page, re.M)
    assert [top for top, _ in rows] == ["pipeline", "models", "storage", "flows"]
    for top, words in rows:
        there = {path.name for path in (ROOT / top).rglob("*/") if not path.name.startswith("__")}
        named = set(re.findall(r"`(\w+)`", words))
        first = {path.name for path in (ROOT / top).iterdir() if (path / "__init__.py").is_file()}
        assert named <= there
        assert first <= named | {"shipped"}
