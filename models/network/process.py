"""How this process uses the machine: threads of torch, and freed memory."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from pipeline.lazy import deferred

if TYPE_CHECKING:
    import torch
else:
    torch = deferred("torch")  # a scan is simulated without

KEPT = ((-3, 2**30), (-1, 2**31 - 1), (-2, 2**26))  # mallopt: mmap threshold, trim threshold, top pad [bytes]


def use_one_thread() -> None:
    """Hold torch to one thread: on a shared machine two spend their time waiting for each other."""
    torch.set_num_threads(1)


@contextmanager
def one_thread() -> Iterator[None]:
    """Hold torch to one thread for a while, for a measurement; to as many as before afterwards."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def keep_freed_memory() -> None:
    """Ask the C library to keep freed memory: large arrays otherwise cost more page faults than arithmetic."""
    try:
        libc = ctypes.CDLL("libc.so.6")
        for option, value in KEPT:
            libc.mallopt(option, value)
    except (OSError, AttributeError):
        return  # another C library: slower, nothing else
