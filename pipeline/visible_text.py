"""Text from files, devices and archives as people may be shown it: it moves no cursor and turns no words round."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable

_LAYOUT = "\n\t"  # control characters that text for people has
_DIRECTION = ("LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI")
_UNSEEN = "\u00ad\u061c\u200b\u200e\u200f\u2060\ufeff"  # marks of direction, and what takes no room
_SUSPECT = re.compile(r"[^\n\t\x20-\x7e\u00a1-\u00ac\u00ae-\u02ff\u0370-\u058f\u2010-\u2027\u2030-\u205e\u4e00-\u9fff]")


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")


def visible(text: str, escaped: Callable[[str], str] = _escaped) -> str:
    r"""Text in which control characters, marks of direction and unseen ones stand as escapes: ``\x1b``, ``\u202e``.

    Lines, tabs and the letters of all scripts stay; so do the joiners that some scripts are written with.
    """
    return _SUSPECT.sub(lambda found: found[0] if is_visible(found[0]) else escaped(found[0]), text)


def is_visible(character: str) -> bool:
    """Whether a character is one that `visible` leaves as it is."""
    if character in _LAYOUT:
        return True
    if character in _UNSEEN or unicodedata.bidirectional(character) in _DIRECTION:
        return False
    tag = "\U000e0000" <= character <= "\U000e007f"
    return not tag and unicodedata.category(character) not in ("Cc", "Cs", "Zl", "Zp")
