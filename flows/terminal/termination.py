"""SIGTERM, as service managers, job queues and `kill` send it: what runs is broken off as by Ctrl-C, not cut off."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

EXIT_CODE = 128 + signal.SIGTERM  # as a shell tells of a command that SIGTERM ended


class Terminated(KeyboardInterrupt):
    """The process was told to end. All that clears up after Ctrl-C clears up after it."""


@contextmanager
def terminable(*, last: bool = False) -> Iterator[None]:
    """Raise `Terminated` in the main thread where SIGTERM comes while the block runs; other threads are left alone.

    Where the block is the ``last`` that the process does, its exit code stands then: SIGTERM has no effect any more.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, _terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_IGN if last else before)


def _terminate(number: int, frame: FrameType | None) -> None:
    raise Terminated
