"""Choose device, threads and memory policy of the networks."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Literal, get_args

from spectralzoom.pipeline.errors import SettingsError

Device = Literal["auto", "cpu", "cuda", "mps"]
Present = Literal["cpu", "cuda", "mps"]
PROCESSOR: Present = "cpu"
# mallopt: mmap threshold, trim threshold, top pad [bytes]; one arena, since threads' own keep what they freed
KEPT = ((-3, 2**30), (-1, 2**31 - 1), (-2, 2**26), (-8, 1))


def choose_device(asked: str) -> Present:
    """Return the device to use; for ``auto`` the first accelerator that torch can use, else ``cpu``.

    Raises SettingsError: torch cannot use this device here; the message lists the available ones.
    """
    if asked == PROCESSOR:
        return PROCESSOR
    import torch

    there = [PROCESSOR]
    if torch.backends.mps.is_available():
        there.insert(0, "mps")
    if torch.cuda.is_available():
        there.insert(0, "cuda")
    found = next((name for name in there if asked in ("auto", name)), None)
    if found is None:
        known = ", ".join(get_args(Device))
        why = "torch can use none on this machine" if asked in get_args(Device) else f"it is one of {known}"
        raise SettingsError(f"--device {asked}: {why}; there is {', '.join(there)}: give that, or auto")
    return found


def use_one_thread() -> None:
    """Limit torch to one thread: on a shared machine more threads wait for each other."""
    import torch

    torch.set_num_threads(1)


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit torch to one thread within the context."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def keep_freed_memory() -> None:
    """Let the C library keep freed memory: page faults of large arrays would take longer than the arithmetic."""
    with suppress(OSError, AttributeError):  # another C library is slower
        libc = ctypes.CDLL("libc.so.6")
        for option, value in KEPT:
            libc.mallopt(option, value)


def give_back_freed_memory() -> None:
    """Return kept memory to the system at the end of a stage: the next one needs blocks of other sizes."""
    with suppress(OSError, AttributeError):  # another C library
        ctypes.CDLL("libc.so.6").malloc_trim(0)
