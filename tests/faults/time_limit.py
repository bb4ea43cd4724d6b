"""A limit on how long a reader may be kept busy."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


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
