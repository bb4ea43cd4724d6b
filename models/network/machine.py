"""Use of the machine by networks: processor or accelerator, torch's threads, and freed memory."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Literal, get_args

from pipeline.errors import SettingsError
from pipeline.lazy import deferred

if TYPE_CHECKING:
    import torch
else:
    torch = deferred("torch")  # a scan is simulated without

Device = Literal["auto", "cpu", "cuda", "mps"]
Present = Literal["cpu", "cuda", "mps"]
PROCESSOR: Present = "cpu"
KEPT = ((-3, 2**30), (-1, 2**31 - 1), (-2, 2**26))  # mallopt: mmap threshold, trim threshold, top pad [bytes]


def choose_device(asked: str) -> Present:
    """Name the device that is asked for; of ``auto`` the first accelerator that torch can use here, else ``cpu``.

    Raises SettingsError: torch can use no such device on this machine; says which there are.
    """
    if asked == PROCESSOR:  # known without torch
        return PROCESSOR
    there: list[Present] = [PROCESSOR]
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


def give_back_freed_memory() -> None:
    """Return the memory that the C library kept, when a stage is done: the next one takes pieces of other sizes."""
    try:
        ctypes.CDLL("libc.so.6").malloc_trim(0)
    except (OSError, AttributeError):
        return  # another C library
