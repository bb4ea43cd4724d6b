"""The index of a line spool: what its lines belong to, then one entry a line, each with a checksum of its own text.

The entries' checksums go on from that of the header, so an entry belongs to one sweep alone and can be told from
another's even where the header is damaged. Entries say their number: one that is lost takes no other with it.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pipeline.json_lines import CheckedLine, read_checked, with_check
from pipeline.source import Line
from storage.archive.keys import plain

FORMAT = "spectralzoom line spool 2"
_KINDS = {
    "line": int,
    "mirror_x": float,
    "mirror_y": float,
    "time_s": float,
    "exposure_ms": float,
    "valid": bool,
    "crc32": int,
}


@dataclass(frozen=True)
class SpoolEntry:
    """What the index says of a line, and as which text."""

    facts: Mapping[str, Any]
    text: bytes

    @property
    def number(self) -> int:
        """The line's number in the sweep."""
        return int(self.facts["line"])

    def fits(self, content: bytes) -> bool:
        """Whether these are the numbers that were written with it."""
        return bool(zlib.crc32(content) == self.facts["crc32"])


@dataclass(frozen=True)
class Head:
    """The first line of an index. ``facts`` have format, samples, bands and what the lines belong to."""

    facts: Mapping[str, Any]
    text: bytes

    @classmethod
    def of(cls, samples: int, bands: int, header: Mapping[str, Any]) -> Head:
        """Make the first line for lines of this size that belong to ``header``."""
        facts = {"format": FORMAT, "samples": samples, "bands": bands, "header": plain(dict(header))}
        text = json.dumps(facts).encode()
        return cls(json.loads(text), with_check(text))

    def entry(self, line: Line, content: bytes | memoryview) -> SpoolEntry:
        """Give the entry of a line whose numbers are written as ``content``."""
        facts = {
            "line": int(line.number),
            "mirror_x": float(line.mirror_x),
            "mirror_y": float(line.mirror_y),
            "time_s": float(line.time_s),
            "exposure_ms": float(line.exposure_ms),
            "valid": bool(line.valid),
            "crc32": zlib.crc32(content),
        }
        return SpoolEntry(facts, with_check(json.dumps(facts).encode(), zlib.crc32(self.text)))

    def entries(self, index: bytes) -> dict[int, SpoolEntry]:
        """Entries of an index that are whole and belong to this head, by number; whatever else it holds is passed over.

        Of two of one number the later counts.
        """
        rest = index[len(self.text) - 1 :] if self.is_head_of(index) else index
        found = (_entry(line) for line in read_checked(rest, zlib.crc32(self.text)))
        return {entry.number: entry for entry in found if entry is not None}

    def is_head_of(self, index: bytes) -> bool:
        """Whether an index begins so; of the end of this line nothing is asked, which is told from what follows."""
        return index.startswith(self.text[:-1])


def read_head(index: bytes) -> CheckedLine | None:
    """Read the first line of an index, whosever it is; None of an empty file."""
    return next(read_checked(index.split(b"\n", 1)[0]), None)


def known_head(index: bytes) -> Head | None:
    """The head of an index; None where it cannot be believed, or is of another format."""
    found = read_head(index)
    if found is None or found.content is None or found.state != "whole" or found.content.get("format") != FORMAT:
        return None
    sizes = [found.content.get(name) for name in ("samples", "bands")]
    if not all(type(size) is int and size > 0 for size in sizes) or not isinstance(found.content.get("header"), dict):
        return None
    return Head(found.content, found.text + b"\n")


def difference(found: Mapping[str, Any], wanted: Mapping[str, Any]) -> str:
    """First thing in which two heads differ, in words."""
    have, want = ({**head, **_table(head.get("header"))} for head in (found, wanted))
    for name in sorted((set(have) | set(want)) - {"header"}):
        if have.get(name) != want.get(name):
            return f"{name} is {have.get(name)!r}, expected {want.get(name)!r}"
    return "its header differs"


def _entry(line: CheckedLine) -> SpoolEntry | None:
    facts = line.content
    if facts is None or line.state != "whole" or facts.keys() != _KINDS.keys():
        return None
    if any(type(facts[name]) is not kind for name, kind in _KINDS.items()) or facts["line"] < 0:
        return None
    return SpoolEntry(facts, line.text + b"\n")


def _table(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}
