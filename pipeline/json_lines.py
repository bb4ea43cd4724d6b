"""Read and write lines of JSON with a checksum, for files that are only appended to.

The last member of each object, ``check``, is the CRC-32 of the text before it.
"""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

_CHECK = re.compile(rb', "check": "([0-9a-f]{8})"\}')
_OPENS, _CLOSES = b', "check": "', b'"}'
_LENGTH = len(_OPENS) + 8 + len(_CLOSES)

State = Literal["whole", "torn", "changed"]


@dataclass(frozen=True)
class CheckedLine:
    """One line of a file; ``content`` is None where the line is damaged.

    ``torn``: the incomplete end of a write that a power cut interrupted, or bytes of another kind. ``changed``: a
    complete line in which bytes have changed.
    """

    number: int  # from 1
    text: bytes
    content: dict[str, Any] | None
    state: State


def with_check(text: bytes) -> bytes:
    """Return the line of an object, given as JSON on one line and not empty."""
    body = text[: -len(b"}")]
    return body + b"%s%08x%s\n" % (_OPENS, zlib.crc32(body), _CLOSES)


def read_checked(content: bytes) -> Iterator[CheckedLine]:
    """Yield every line of a file. Two lines that lost the line end between them are both whole.

    They are followed by one line that is ``changed``. A single flipped bit never makes a line ``torn``, and never
    changes the content of a ``whole`` one.
    """
    for number, text in enumerate(content.split(b"\n"), 1):
        if text:
            yield from _line(number, text)


def _line(number: int, text: bytes) -> Iterator[CheckedLine]:
    found = _whole(text)
    if found is not None:
        yield CheckedLine(number, text, found, "whole")
        return
    ends = [match.end() for match in _CHECK.finditer(text)]
    for start, end in zip([0, *ends], ends, strict=False):
        for part in (text[start:end], text[start + 1 : end]):  # the second: behind a line end that has changed
            found = _whole(part)
            if found is not None:
                yield CheckedLine(number, part, found, "whole")
                break
    changed = ends or _had_check(text) or text.endswith(b"}")
    yield CheckedLine(number, text, None, "changed" if changed else "torn")


def _whole(text: bytes) -> dict[str, Any] | None:
    """Return the object of a line if the checksum is that of its text."""
    body, check = text[:-_LENGTH], _CHECK.fullmatch(text[-_LENGTH:])
    if check is None or int(check[1], 16) != zlib.crc32(body):
        return None
    try:
        found = json.loads(body + b"}")
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def _had_check(text: bytes) -> bool:
    """Return whether a line ends in a checksum, up to one wrong byte."""
    tail = text[-_LENGTH:]
    fixed = tail[: len(_OPENS)] + tail[-len(_CLOSES) :]
    return len(tail) == _LENGTH and sum(a != b for a, b in zip(fixed, _OPENS + _CLOSES, strict=True)) <= 1
