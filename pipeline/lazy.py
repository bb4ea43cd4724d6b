"""Lazy values and modules: a value is made, and a module imported, once it is asked for."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from threading import Lock
from types import ModuleType
from typing import Any, Generic, TypeVar

Value = TypeVar("Value")


class Once(Generic[Value]):
    """Calls ``make`` once, by whichever thread asks first, while the others wait; a ``make`` that fails is asked again.

    Equal to nothing but itself: what it will hold is not known before.
    """

    def __init__(self, make: Callable[[], Value]) -> None:
        self._make: Callable[[], Value] | None = make
        self._made: list[Value] = []
        self._lock = Lock()

    @staticmethod
    def of(value: Value) -> Once[Value]:
        """Hold a value that is there already."""
        once = Once(lambda: value)
        once()
        return once

    def is_made(self) -> bool:
        """Return whether the value is there."""
        return bool(self._made)

    def __call__(self) -> Value:
        """Give the value, making it the first time."""
        with self._lock:
            if self._make is not None:
                self._made.append(self._make())
                self._make = None  # what it was made from may go
            return self._made[0]


class DeferredModule(ModuleType):
    """Stands for a module at the head of a file; the module is imported when a name of it is first used."""

    def __getattr__(self, name: str) -> Any:
        return getattr(import_module(self.__name__), name)


def deferred(name: str) -> Any:
    """A package that takes long to load, or is an extra, for a file that most commands load and few make use of.

    Written beside the import for type checkers::

        if TYPE_CHECKING:
            import torch
        else:
            torch = deferred("torch")
    """
    return DeferredModule(name)
