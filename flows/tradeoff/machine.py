"""The machine that trade-offs are measured on: its name and load, one thread of it, and what its memory can do."""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata

import numpy as np
from numpy.typing import NDArray

COPIED_BYTES = 1 << 26  # beyond any cache


class Copying:
    """A copy of memory that is timed like a setting: every round once, the least counts."""

    def __init__(self) -> None:
        self._source: NDArray[np.uint8] = np.ones(COPIED_BYTES, np.uint8)
        self._target = np.zeros_like(self._source)
        self._seconds: list[float] = []

    def run(self) -> None:
        """Copy once."""
        start = time.process_time()
        np.copyto(self._target, self._source)
        self._seconds.append(time.process_time() - start)

    @property
    def ns_per_byte(self) -> float:
        """Least time of one byte read or written; NaN before the first copy. [ns]"""
        return 1e9 * min(self._seconds, default=float("nan")) / (2 * COPIED_BYTES)


@contextmanager
def one_thread() -> Iterator[int]:
    """Hold torch, where a stage has loaded it, to one thread; gives the number of threads in use."""
    # Stages own torch; flows must neither import it nor pay for it where no stage needs it.
    torch = sys.modules.get("torch")
    if torch is None:
        yield 1
        return
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield torch.get_num_threads()
    finally:
        torch.set_num_threads(before)


def describe_machine(threads: int) -> dict[str, object]:
    """Processor, cores, system, threads in use and versions of what computes."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "threads": threads,
        "versions": {name: metadata.version(name) for name in ("numpy", "scipy", "torch")},
    }


def mean_load() -> float | None:
    """Mean number of running processes over the last minute; None where the system does not say."""
    return round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None


def _processor() -> str:
    """The processor's name as the system knows it."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:  # noqa: PTH123
            return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "unknown")
    except OSError:
        return platform.processor() or "unknown"
