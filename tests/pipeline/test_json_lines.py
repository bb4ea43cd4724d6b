"""Lines that vouch for themselves: every bit counts, and a line that is lost takes no other with it."""

from __future__ import annotations

import json
import zlib
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.json_lines import read_checked, with_check

values = st.one_of(
    st.text(max_size=12), st.floats(allow_nan=False), st.booleans(), st.integers(), st.lists(st.integers(), max_size=3)
)
objects = st.dictionaries(st.text(max_size=6).filter(lambda name: name != "check"), values, min_size=1, max_size=4)


def line(content: dict[str, Any]) -> bytes:
    """An object as a line with its checksum."""
    return with_check(json.dumps(content, ensure_ascii=False).encode())


@settings(max_examples=30)
@given(st.lists(objects, max_size=6))
def test_lines_come_back(contents: list[dict[str, Any]]) -> None:
    """In order and numbered, as plain JSON too."""
    text = b"".join(line(one) for one in contents)
    assert [(one.number, one.content, one.state) for one in read_checked(text)] == [
        (number, content, "whole") for number, content in enumerate(contents, 1)
    ]
    assert [{**json.loads(one), "check": 0} for one in text.splitlines()] == [{**one, "check": 0} for one in contents]


@settings(max_examples=30)
@given(st.lists(objects, min_size=1, max_size=5), st.data())
def test_no_flipped_bit_is_silent(contents: list[dict[str, Any]], data: st.DataObject) -> None:
    """It costs one line at most, changes none, and is told, but for the end of the last line."""
    text = bytearray(b"".join(line(one) for one in contents))
    bit = data.draw(st.integers(0, 8 * len(text) - 1))
    text[bit // 8] ^= 1 << bit % 8
    found = list(read_checked(bytes(text)))
    kept = [one.content for one in found if one.content is not None]
    assert kept in [contents, *(contents[:index] + contents[index + 1 :] for index in range(len(contents)))]
    assert any(one.state == "changed" for one in found) or (bit // 8 == len(text) - 1 and kept == contents)


@settings(max_examples=30)
@given(st.lists(objects, min_size=1, max_size=4), st.binary(max_size=60), st.data())
def test_what_a_power_cut_leaves_costs_no_whole_line(
    contents: list[dict[str, Any]], rest: bytes, data: st.DataObject
) -> None:
    """A part of a line and other bytes behind it, then whole lines again below."""
    torn = line(contents[0])[: data.draw(st.integers(0, len(line(contents[0])) - 2))]
    text = b"".join(map(line, contents)) + torn + rest + b"\n" + b"".join(map(line, contents))
    kept = [one.content for one in read_checked(text) if one.state == "whole"]
    assert kept == contents * 2


@pytest.mark.parametrize(
    ("text", "state"),
    [
        (b'{"a": 1}', "changed"),
        (b'{"a": 1', "torn"),
        (b"\x00" * 30, "torn"),
        (b"[1]", "torn"),
        (b'{"a": }', "changed"),
        (b'{"a": 1, "check": "00000000"}', "changed"),
        (b'{"a": 1, "chdck": "7aa88204"}', "changed"),
        (b'{"a": 1, "check": "7AA88204"}', "changed"),
    ],
)
def test_other_lines_are_called_what_they_are(text: bytes, state: str) -> None:
    """What a power cut left is told from lines that are damaged."""
    assert line({"a": 1}) == b'{"a": 1, "check": "7aa88204"}\n'
    assert [one.state for one in read_checked(text)] == [state]


def test_depth_without_end_is_no_line() -> None:
    """Nesting that no parser follows counts as nothing, checksum or not."""
    text = b'{"a": ' + b"[" * 100_000
    checksummed = text + b', "check": "%08x"}' % zlib.crc32(text)
    assert [one.content for one in read_checked(checksummed)] == [None]
