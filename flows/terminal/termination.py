"""What ends a command from outside: SIGTERM, which breaks it off as Ctrl-C does, and what a machine refuses."""

from __future__ import annotations

import resource
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from storage.archive.staging import disk_advice

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


# Of exceptions that are no MemoryError: of torch and of threads; and, where memory is limited, of the loader.
_OF_MEMORY = ("can't allocate memory", "not enough memory", "can't start new thread", "cannot allocate memory")
_OF_LIMITED_MEMORY = ("failed to map segment", "could not find/load shared object")


def refusal_words(error: BaseException) -> str | None:
    """What was refused and what to do; None where the error is something else."""
    text, limit = str(error), resource.getrlimit(resource.RLIMIT_AS)[0]
    limited = limit != resource.RLIM_INFINITY
    known = (*_OF_MEMORY, *(_OF_LIMITED_MEMORY if limited else ()))
    if isinstance(error, MemoryError) or any(words in text.lower() for words in known):
        allowed = f"; this process may take {limit / 1e9:.1f} GB (ulimit -v)" if limited else ""
        told = text.partition(". ")[0].rstrip(".") or "the machine has no more"
        return (
            f"memory ran out: {told}{allowed}. Make room or raise the limit, or ask for less: a smaller scene, fewer "
            f"--bands, less --memory, fewer --workers"
        )
    if isinstance(error, OSError) and (advice := disk_advice(error)) is not None:
        where = f" {error.filename}" if error.filename else ""
        return f"the system refused to read or write{where}: {advice}"
    return None
