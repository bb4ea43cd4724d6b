"""Read words that name things: fields, stores and runs, and moments at the begin of a text."""

from __future__ import annotations

import re
from contextlib import suppress
from datetime import UTC, datetime

from spectralzoom.pipeline.errors import is_visible

YEARS = range(1900, 2201)
MOST_NAME = 255  # characters of a field's name, as of a file's
PART, CLEARED = UNFINISHED = (".part", ".cleared")  # ends of names of folders that are not complete
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}")
_DAY = re.compile(r"^\d{4}-\d\d-\d\d(?!\d)")
_SCHEDULER = re.compile(r"threads|processes|(tcp|tls)://([^\s/:]+|\[[0-9a-fA-F:]+\]):\d+")


def is_name(name: str) -> bool:
    """Return whether this can be the name of a stage, a store or a run."""
    return _NAME.fullmatch(name) is not None and not name.endswith(UNFINISHED)


def is_field_name(name: str) -> bool:
    """Return whether this can be the name of a field: letters of any script, spaces and marks, on one line."""
    shown = all(is_visible(one) and one not in "/\n\t" for one in name)
    return shown and len(name) <= MOST_NAME and any(map(str.isalnum, name))


def is_scheduler(text: str) -> bool:
    """Return whether a text is ``threads``, ``processes``, or the address of a dask scheduler."""
    return _SCHEDULER.fullmatch(text) is not None


def moment_of(text: object) -> datetime | None:
    """Return the moment or day in ISO 8601 at the begin of a text, in UTC if it names no zone; else None."""
    if not isinstance(text, str) or not (words := text.split()):
        return None
    for some in (" ".join(words), " ".join(words[:2]), words[0], *_DAY.findall(words[0])):
        with suppress(ValueError):
            found = datetime.fromisoformat(some)
            return found.replace(tzinfo=found.tzinfo or UTC) if found.year in YEARS else None
    return None
