"""Loops over arrays, compiled by numba when their module is first imported and kept for the next process."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
from numba import types

Loop = TypeVar("Loop", bound=Callable[..., Any])
FLOATS, DOUBLES, OFFSETS = types.float32, types.float64, types.int64
# Sums that are not reassociated are the same anywhere in a vector: a * b + c is rounded once, in all lanes alike.
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}}


def rows_of(kind: types.Type, axes: int, *, read_only: bool = False) -> types.Array:
    """Give the type of C-contiguous arrays; those that are ``read_only`` may be any."""
    return types.Array(kind, axes, "C", readonly=read_only)


def record_of(record: type, *fields: types.Type) -> types.Type:
    """Give the type of a named tuple whose fields are of these types."""
    make: Any = types.NamedTuple
    found: types.Type = make(fields, record)
    return found


def compiled(*signature: types.Type) -> Callable[[Loop], Loop]:
    """Compile a function for arguments of these types alone; threads may call it at the same time.

    What it calls stands in the same file: numba asks that one alone whether what it kept is still right. Values of
    other files are arguments, not globals. Nothing is refused where nothing can be kept, or what was kept is spoilt: it
    is compiled anew.
    """

    def compile_loop(loop: Loop) -> Loop:
        made: Any
        try:
            made = numba.njit(signature, cache=True, **_OPTIONS)(loop)
        except Exception:  # of folders, disks and files; an error of the loop itself comes again
            made = numba.njit(signature, **_OPTIONS)(loop)
        return cast(Loop, made)

    return compile_loop
