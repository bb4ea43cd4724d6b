"""Pages are correct: every block runs, every link and path exists, and the README is short."""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from tests.docs.pages import DOCS, LINKED, PAGES, ROOT, anchors_of, blocks_of, links_of, named_code
from tests.docs.running import Reader
from tests.prior_work import with_effects, without_effects

WITH_BLOCKS = [page for page in PAGES if blocks_of(page)]
OF_EFFECTS = {DOCS / "background" / "simulator.md"}  # pages that show the automatic choice of effects; others skip it
README_LINES = 130
PATH = re.compile(
    r"(?:pipeline|models|storage|flows|tests|docs|\.ci)(?:/[\w.-]+)*/?|[\w-]+\.(?:md|toml|yaml|txt)|Makefile"
)
OF_USERS = {"scene.toml", "fake.toml", "field.toml", "survey.toml", "north.toml"}  # written by users of the pages


def named(page: Path) -> str:
    """Return a page's name for messages."""
    return page.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("page", WITH_BLOCKS, ids=named)
def test_every_block_runs(page: Path, place: Path, request: pytest.FixtureRequest) -> None:
    """Blocks run from top to bottom, in a folder with a small survey."""
    blocks = blocks_of(page)
    bucket = request.getfixturevalue("bucket") if any(one.mark == "bucket" for one in blocks) else None
    reader = Reader(place, bucket)
    with with_effects() if page in OF_EFFECTS else without_effects():
        for block in blocks:
            reader.follow(block)


@pytest.mark.parametrize("page", LINKED, ids=named)
def test_links_have_existing_targets(page: Path) -> None:
    """Files and anchors exist; web addresses are well-formed https and are not requested."""
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
def test_named_paths_exist(page: Path) -> None:
    """Each path of the repository in backticks exists, so a renamed file is found here."""
    named_paths = {word.split("::")[0] for word in named_code(page) if PATH.fullmatch(word)} - OF_USERS
    assert [path for path in sorted(named_paths) if not (ROOT / path).exists()] == []


def test_readme_is_short() -> None:
    """The limit is README_LINES; longer texts belong into docs."""
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= README_LINES


def test_the_table_of_folders_matches_the_source_tree() -> None:
    """Every folder in the first table of architecture.md exists, and no package is missing."""
    page = (DOCS / "reference" / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| (.*) \|$", page.partition("\n## ")[0], re.M)
    assert [top for top, _ in rows] == ["pipeline", "models", "storage", "flows"]
    for top, words in rows:
        there = {path.name for path in (ROOT / top).rglob("*/") if not path.name.startswith("__")}
        named = set(re.findall(r"`(\w+)`", words))
        first = {path.name for path in (ROOT / top).iterdir() if (path / "__init__.py").is_file()}
        assert named <= there
        assert first <= named | {"shipped"}


def test_names_of_the_glossary_exist_in_the_code() -> None:
    """Each name in its column "in code" is a word of the source."""
    rows = re.findall(r"^\|.*\|(.*)\|$", (DOCS / "reference" / "glossary.md").read_text(encoding="utf-8"), re.M)
    folders = (ROOT / name for name in ("pipeline", "models", "storage", "flows"))
    known = {word for top in folders for path in top.rglob("*.py") for word in re.findall(r"\w+", path.read_text())}
    assert [name for row in rows[2:] for name in re.findall(r"`(\w+)`", row) if name not in known] == []
