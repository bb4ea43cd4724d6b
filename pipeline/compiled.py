"""Compile loops over arrays with numba when their module is first imported, and cache them for the next process."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
from numba import types

Loop = TypeVar("Loop", bound=Callable[..., Any])
FLOATS, DOUBLES, OFFSETS = types.float32, types.float64, types.int64
# Without reassociation a sum is the same in every lane of a vector; a * b + c is rounded once.
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}}


def rows_of(kind: types.Type, axes: int, *, read_only: bool = False) -> types.Array:
    """Return the type of C-contiguous arrays; with ``read_only`` the type takes writable ones too."""
    return types.Array(kind, axes, "C", readonly=read_only)


def record_of(record: type, *fields: types.Type) -> types.Type:
    """Return the type of a named tuple with fields of these types."""
    make: Any = types.NamedTuple
    found: types.Type = make(fields, record)
    return found


def compiled(*signature: types.Type) -> Callable[[Loop], Loop]:
    """Compile a function for arguments of these types alone; threads may call it at the same time.

    All functions that it calls stand in the same file, since numba checks only that file for changes to its cache.
    Values of other files are arguments, not globals. Without a usable cache the function is compiled again.
    """

    def compile_loop(loop: Loop) -> Loop:
        made: Any
        try:
            made = numba.njit(signature, cache=True, **_OPTIONS)(loop)
        except Exception:  # of the cache's folder or file; an error of the loop itself is raised again below
            made = numba.njit(signature, **_OPTIONS)(loop)
        return cast(Loop, made)

    return compile_loop
