"""Text made safe for display: characters that control a terminal or the direction of text become escapes."""

from __future__ import annotations

import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.pipeline.errors import (
    ArchiveError,
    IncompleteStoreError,
    PipelineError,
    RigError,
    SceneError,
    is_visible,
    visible,
)


@given(st.text(st.characters()))  # surrogates included
def test_visible_text_has_no_control_characters(text: str) -> None:
    """Line ends and tabs stay; direction marks and surrogates are escaped. A second pass changes nothing."""
    shown = visible(text)
    assert all(letter in "\n\t" or unicodedata.category(letter) not in ("Cc", "Cs") for letter in shown)
    assert not any(unicodedata.bidirectional(letter) in ("RLO", "LRO", "RLE", "LRE", "RLI", "LRI") for letter in shown)
    assert visible(shown) == shown
    shown.encode("utf-8")


def test_every_character_follows_one_rule() -> None:
    """The fast path for common text accepts exactly the characters that the rule accepts."""
    codes = [*range(0x3100), *range(0x3100, 0x110000, 13), *range(0xD800, 0xE000, 3), *range(0xE0000, 0xE0080)]
    assert [code for code in codes if (visible(chr(code)) == chr(code)) is not is_visible(chr(code))] == []


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
def test_visible_text_has_the_escapes_of_python(text: str, shown: str) -> None:
    """Letters of all scripts, their joiners and emoji stay."""
    assert visible(text) == shown


@pytest.mark.parametrize("kind", [PipelineError, SceneError, RigError, ArchiveError, IncompleteStoreError])
def test_error_messages_are_visible(kind: type[PipelineError]) -> None:
    """Control characters that an error quotes from a file or device are escaped."""
    assert str(kind("greeted with '\x1b]0;x\x07'")) == "greeted with '\\x1b]0;x\\x07'"
