"""Run Zarr in the calling thread, which saves a third of a small survey's processor time.

Zarr hands each call to an event loop in another thread, and each file and chunk to one more thread. For files of a
few bytes that costs more than the work. Here the caller's thread runs an event loop for the call, and does all
awaited work at once, in order. Bytes and errors are the same. Processes that tests start use Zarr unchanged.
"""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import Awaitable, Callable, Coroutine, Iterable
from queue import Empty, SimpleQueue
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from zarr.core import common
from zarr.core import sync as zarr_sync

IDLE: SimpleQueue[asyncio.AbstractEventLoop] = SimpleQueue()  # a loop for each thread that is within a call
HANDED_OVER = zarr_sync.sync


async def _in_thread(work: Callable[..., Any], *given: Any, **named: Any) -> Any:
    return work(*given, **named)


async def _in_order(
    items: Iterable[tuple[Any, ...]], work: Callable[..., Awaitable[Any]], limit: int | None = None
) -> list[Any]:
    return [await work(*item) for item in items]


def _at_once(
    call: Coroutine[Any, Any, Any], loop: asyncio.AbstractEventLoop | None = None, timeout: float | None = None
) -> Any:
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        pass
    else:
        return HANDED_OVER(call, loop, timeout)  # a thread runs one loop at a time
    try:
        own = IDLE.get_nowait()
    except Empty:
        own = asyncio.new_event_loop()
    try:
        return own.run_until_complete(call)
    finally:
        IDLE.put(own)


def work_at_once(patch: pytest.MonkeyPatch) -> None:
    """Patch Zarr in this process to run in the calling thread, until the patch is undone."""
    own_asyncio: Any = SimpleNamespace(**{**vars(asyncio), "to_thread": _in_thread})
    instead = {"sync": (HANDED_OVER, _at_once), "concurrent_map": (common.concurrent_map, _in_order)}
    instead["asyncio"] = (asyncio, own_asyncio)
    for module in [found for name, found in sys.modules.items() if name.startswith("zarr.")]:
        for name, (real, own) in instead.items():
            if isinstance(module, ModuleType) and vars(module).get(name) is real:
                patch.setattr(module, name, own)


def close_loops() -> None:
    """Close the unused event loops."""
    while not IDLE.empty():
        IDLE.get().close()


def _forget_loops() -> None:
    while not IDLE.empty():  # a child's loop would wake its parent's
        IDLE.get()


os.register_at_fork(after_in_child=_forget_loops)
