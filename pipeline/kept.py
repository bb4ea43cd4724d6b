"""Keep what blocks of one piece of work share in a process, and free it before the next piece."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import TypeVar

Key = TypeVar("Key")
Opened = TypeVar("Opened")

_caches: list[Callable[[], None]] = []


def kept(make: Callable[[Key], Opened]) -> Callable[[Key], Opened]:
    """Keep the last result of a function in each process, until `free_kept`."""
    cached = lru_cache(maxsize=1)(make)
    _caches.append(cached.cache_clear)
    return cached


def free_kept() -> None:
    """Free what this process keeps."""
    for clear in _caches:
        clear()
