"""Find the files that a simulated line passes from the command to the class map, during a small survey.

A file is passed if it is on the stack when a function of the source takes or returns pixels. Pixels are an array of two
axes or more with at least as many numbers as one line of the camera. They are passed as a value, in a sequence, or as a
field of a value. Results from lines (tables, passes, class probabilities, the map) are pixels too.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

from tests.house.source_tree import ROOMS, ROOT

LINE = 640  # numbers: the samples of a line in one band
FIRST = 4  # items of a sequence that are checked
MAP_DRAWN = ("flows/tasks/stages/maps.py", "build")  # its return is the end of the way


@cache
def file_of(code: CodeType) -> str | None:
    """Return the source file that holds the code, relative to the root; None for code from elsewhere."""
    path = Path(code.co_filename)
    if not path.is_relative_to(ROOT):
        return None
    inner = path.relative_to(ROOT)
    return inner.as_posix() if inner.parts[0] in ROOMS else None


def has_pixels(value: Any, deep: bool = True) -> bool:
    """Return whether a value is, contains or has as a field an array with as many numbers as a line."""
    shape = getattr(value, "shape", None)
    if isinstance(shape, tuple) and hasattr(value, "dtype"):
        sizes = [size for size in shape if isinstance(size, int)]
        count = 1
        for size in sizes:
            count *= size
        return len(sizes) > 1 and count >= LINE
    if isinstance(value, tuple | list):
        return any(has_pixels(one, deep) for one in value[:FIRST])
    return deep and any(has_pixels(one, False) for one in vars(value).values()) if hasattr(value, "__dict__") else False


@contextmanager
def passed_files() -> Iterator[set[str]]:
    """Collect the files that pixels pass during the block until the map is drawn, in this thread and in new ones."""
    passed: set[str] = set()
    drawn = threading.Event()

    def watch(frame: FrameType, event: str, given: Any) -> None:
        if drawn.is_set() or event not in ("call", "return") or file_of(frame.f_code) is None:
            return
        values = [given] if event == "return" else frame.f_locals.values()
        if any(map(has_pixels, values)):
            place: FrameType | None = frame
            while place is not None:
                if (file := file_of(place.f_code)) is not None:
                    passed.add(file)
                place = place.f_back
        if event == "return" and (file_of(frame.f_code), frame.f_code.co_name) == MAP_DRAWN:
            drawn.set()

    threading.setprofile(watch)
    sys.setprofile(watch)
    try:
        yield passed
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
