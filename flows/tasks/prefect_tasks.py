"""Run functions as Prefect tasks inside a flow, and report what a survey does to the terminal and to Prefect.

Parts of Prefect are imported at their first use: together they take a second. No ``from __future__ import annotations``
here: Prefect reads signatures.
"""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, TypeVar

RETRY_DELAY_S = 2.0
Function = TypeVar("Function", bound=Callable[..., Any])


def inside_flow() -> bool:
    """Return whether a Prefect flow is running."""
    if "prefect.context" not in sys.modules:
        return False
    from prefect.context import FlowRunContext

    return FlowRunContext.get() is not None


def as_task(function: Function, name: str, *, retries: int = 0) -> Function:
    """Return the function as a Prefect task inside a flow, else unchanged.

    An OSError is retried ``retries`` times, 2 s apart; other errors are not. The task run is named by the task and by
    the ``name_of_run`` of its first argument: ``rectify-north``.
    """
    return _task(function, name, retries) if inside_flow() else function


@cache
def _task(function: Any, name: str, retries: int) -> Any:
    import prefect
    from prefect.cache_policies import NO_CACHE
    from prefect.runtime import task_run

    def run_name() -> str:
        subject = next(iter(task_run.parameters.values()), None)
        return f"{name}-{getattr(subject, 'name_of_run', 'survey')}"

    return prefect.task(
        function,
        name=name,
        task_run_name=run_name,
        cache_policy=NO_CACHE,  # the archive finds stores by their content
        persist_result=False,
        retries=retries,
        retry_delay_seconds=RETRY_DELAY_S,
        retry_condition_fn=lambda task, run, state: isinstance(state.result(raise_on_failure=False), OSError),
    )


@dataclass(frozen=True)
class Observer:
    """Callbacks that report what a survey does."""

    watch: Callable[[str, str, float], None] = lambda stage, state, done: None  # progress of a stage, 0..1
    note: Callable[[str], None] = lambda text: None  # assumptions and warnings
    say: Callable[[str], None] = lambda text: None  # state of a device before its first line
    log: Callable[[str], None] = lambda text: None  # one line for each finished stage


_terminal: ContextVar[Observer | None] = ContextVar("observer", default=None)


@contextmanager
def observed_by(observer: Observer) -> Iterator[None]:
    """Report the surveys of the block to ``observer`` as well as to Prefect."""
    before = _terminal.set(observer)
    try:
        yield
    finally:
        _terminal.reset(before)


def current_observer() -> Observer:
    """Return the observer of a survey that is opened now."""
    terminal = _terminal.get() or Observer()
    if not inside_flow():
        return terminal

    def note(text: str) -> None:
        terminal.note(text)
        log_to_run(text)

    return replace(terminal, note=note, log=log_to_run)


def log_to_run(text: str) -> None:
    """Write a line into the log of the Prefect run; errors of the server are ignored."""
    with suppress(Exception):
        from prefect import get_run_logger

        get_run_logger().info(text)
