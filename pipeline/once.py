"""Compute a value when it is first used."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock
from typing import Generic, TypeVar

Value = TypeVar("Value")


class Once(Generic[Value]):
    """Call ``make`` once, in the thread that needs it first, while others wait; after an error it is called again.

    Compares equal only to itself.
    """

    def __init__(self, make: Callable[[], Value]) -> None:
        self._make: Callable[[], Value] | None = make
        self._made: list[Value] = []
        self._lock = Lock()

    @staticmethod
    def of(value: Value) -> Once[Value]:
        """Hold a value that is already known."""
        once = Once(lambda: value)
        once()
        return once

    def is_made(self) -> bool:
        """Return whether the value is known."""
        return bool(self._made)

    def __call__(self) -> Value:
        """Return the value; the first call computes it."""
        with self._lock:
            if self._make is not None:
                self._made.append(self._make())
                self._make = None  # frees its inputs
            return self._made[0]
