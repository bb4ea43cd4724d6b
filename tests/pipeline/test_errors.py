"""Text as people may be shown it: what steers a terminal or turns words round stands as escapes."""

from __future__ import annotations

import sys
import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import ArchiveError, IncompleteStoreError, PipelineError, RigError, SceneError, is_visible, visible

anything = st.text(st.characters())  # surrogates included


@given(anything)
def test_nothing_is_left_that_steers(text: str) -> None:
    """No control character but lines and tabs, no mark of direction, no half of a pair; and once is enough."""
    shown = visible(text)
    assert all(letter in "\n\t" or unicodedata.category(letter) not in ("Cc", "Cs") for letter in shown)
    assert not any(unicodedata.bidirectional(letter) in ("RLO", "LRO", "RLE", "LRE", "RLI", "LRI") for letter in shown)
    assert visible(shown) == shown
    shown.encode("utf-8")


def test_every_character_is_judged_by_one_rule() -> None:
    """The quick way over what most text is made of leaves just what the rule leaves."""
    codes = [
        *range(0x3100),
        *range(0x3100, sys.maxunicode + 1, 13),
        *range(0xD800, 0xE000, 3),
        *range(0xE0000, 0xE0080),
    ]
    wrong = [code for code in codes if (visible(chr(code)) == chr(code)) is not is_visible(chr(code))]
    assert wrong == []


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("field\x1b[31mred", "field\\x1b[31mred"),
        ("\x9b2J", "\\x9b2J"),
        ("one\rtwo\b\x07", "one\\rtwo\\x08\\x07"),
        ("map\u202egnp.exe", "map\\u202egnp.exe"),
        ("a\u2066b\u2069\u200f", "a\\u2066b\\u2069\\u200f"),
        ("name\udcff", "name\\udcff"),
        ("a\u2028b\ufeff\U000e0041", "a\\u2028b\\ufeff\\U000e0041"),
        ("Acker Süd, 麦田, حقل, می‌خواهم, 🌾\n\tweed", "Acker Süd, 麦田, حقل, می‌خواهم, 🌾\n\tweed"),
    ],
)
def test_by_hand(text: str, shown: str) -> None:
    """Escapes as Python writes them; letters of all scripts and their joiners stay."""
    assert visible(text) == shown


@pytest.mark.parametrize("kind", [PipelineError, SceneError, RigError, ArchiveError, IncompleteStoreError])
def test_errors_are_visible(kind: type[PipelineError]) -> None:
    """Whatever file or device an error quotes, its words can be printed."""
    assert str(kind("greeted with '\x1b]0;x\x07'")) == "greeted with '\\x1b]0;x\\x07'"
