"""The pages of this project and their parts: fenced blocks with marks, links, headings and named paths."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from spectralzoom.flows.settings.documents import settings_table

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = (ROOT / "README.md", *sorted(path for path in DOCS.rglob("*.md") if "_build" not in path.parts))
LINKED = (*PAGES, ROOT / "CHANGELOG.md")

_FENCE = re.compile(r"^(?P<marks>`{3,})(?P<language>[^`\n]*)$")
_MARK = re.compile(r"<!-- test: (?P<words>.+?) -->")
_LINK = re.compile(r"!?\[[^\]]*\]\((?P<target>[^)\s]+)\)")
_CODE = re.compile(r"`[^`\n]+`")
_HEADING = re.compile(r"^#{1,6} (?P<words>.+)$", re.MULTILINE)


@dataclass(frozen=True)
class Block:
    """One fenced block: its place, language, text, and the mark in the comment before it."""

    page: Path
    line: int  # of its first line of text
    language: str
    text: str
    mark: str

    @property
    def place(self) -> str:
        """Return page and line, for messages."""
        return f"{self.page.relative_to(ROOT)}:{self.line}"

    @property
    def file(self) -> str | None:
        """Return the file name in the block's first line, such as ``# scene.toml``."""
        found = re.match(r"# (\S+\.(?:py|toml))$", self.text.partition("\n")[0])
        return None if found is None else found[1]


@cache
def blocks_of(page: Path) -> tuple[Block, ...]:
    """Return every fenced block of a page, in order."""
    lines = page.read_text(encoding="utf-8").splitlines()
    found = []
    number = 0
    while number < len(lines):
        fence = _FENCE.match(lines[number])
        if fence is None:
            number += 1
            continue
        end = lines.index(fence["marks"], number + 1)
        marked = _MARK.fullmatch(lines[number - 1]) if number else None
        text = "\n".join(lines[number + 1 : end]) + "\n"
        found.append(Block(page, number + 2, fence["language"].strip(), text, marked["words"] if marked else ""))
        number = end + 1
    return tuple(found)


@cache
def prose_of(page: Path) -> str:
    """Return a page without its fenced blocks and comments."""
    text = re.sub(r"<!--.*?-->", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    return re.sub(r"^(`{3,})[^\n]*\n.*?^\1$", "", text, flags=re.DOTALL | re.MULTILINE)


def links_of(page: Path) -> list[str]:
    """Return the targets of a page's links and pictures."""
    return [found["target"] for found in _LINK.finditer(_CODE.sub("", prose_of(page)))]


def named_code(page: Path) -> list[str]:
    """Return the words in backticks in a page's prose."""
    return [found[0].strip("`") for found in _CODE.finditer(prose_of(page))]


@cache
def anchors_of(page: Path) -> frozenset[str]:
    """Return the anchors of a page's headings, as GitHub and MyST make them."""
    text = prose_of(page) + (settings_table() if page.name == "settings.md" else "")
    words = (found["words"] for found in _HEADING.finditer(text))
    return frozenset(re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in words)
