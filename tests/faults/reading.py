"""One reading of a file that may be anything: within a limit of time, with its memory traced."""

from __future__ import annotations

import signal
import time
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from pipeline.errors import PipelineError
from storage.readers.scan_files import open_cube_source

LONGEST_S = 30  # then it counts as hanging


class TookTooLongError(Exception):
    """A file kept its reader busy."""


@contextmanager
def at_most(seconds: int) -> Iterator[None]:
    """Raise TookTooLongError inside the block when it has run so long; for the main thread."""

    def ring(signum: int, frame: FrameType | None) -> None:
        raise TookTooLongError(f"more than {seconds} s")

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@dataclass(frozen=True)
class Reading:
    """How the opening and reading of one source ended."""

    refused: str | None  # the error's class, where it was one with words
    wrong: str | None  # what no reading may do
    seconds: float
    peak_bytes: int


def try_reading(address: Path) -> Reading:
    """Open a source and read the first and the last lines that it holds."""
    tracemalloc.start()
    begun, refused, wrong = time.monotonic(), None, None
    try:
        with at_most(LONGEST_S):
            source = open_cube_source(address)
            held = source.shape[0] - source.lost_lines
            source.read(0, min(held, 64))
            source.read(max(held - 64, 0), held)
    except PipelineError as error:
        refused = type(error).__name__
        wrong = "an error without words" if not str(error) or "Traceback" in str(error) else None
    except BaseException as error:
        wrong = f"{type(error).__name__}: {str(error)[:200]}"
    seconds, peak = time.monotonic() - begun, tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return Reading(refused, wrong, seconds, peak)
