"""What a file says it holds, judged before anything of that size is asked for: against its bytes, and the machine."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from pipeline.errors import SceneError

DEFLATE_RATIO = 1100  # bytes that one byte of zlib's can stand for, rounded up: it is 1032
MOST_RATIO = 10_000  # by which any packed numbers may exceed their bytes
SPARE_BYTES = 1 << 20  # that a file may claim whatever its size: numbers that are all alike take none
_GROUP_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))


def machine_bytes() -> int:
    """Memory of this machine, or of the part of it that this process may use [bytes]."""
    there = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    for limit in _GROUP_LIMITS:
        with suppress(OSError, ValueError):  # no such file, or "max"
            there = min(there, int(limit.read_text()))
    return there


def check_claim(where: object, claimed: int, stored: int, ratio: int = MOST_RATIO) -> None:
    """Refuse more bytes of numbers than ``stored`` bytes can mean (SceneError)."""
    if claimed > max(stored * ratio, SPARE_BYTES):
        raise SceneError(
            f"{where} claims {claimed} bytes of numbers, and {stored} bytes lie on the disk: it is damaged or made to "
            "fill the memory; copy it again"
        )


def check_memory(where: object, needed: int) -> None:
    """Refuse what takes more memory than there is (SceneError)."""
    there = machine_bytes()
    if needed > there:
        raise SceneError(
            f"{where}: reading it takes about {needed / 1e9:.1f} GB of memory, this machine has {there / 1e9:.1f}; cut "
            "a part out of it, or store it as ENVI, GeoTIFF in tiles or Zarr, which are read a few lines at a time"
        )
