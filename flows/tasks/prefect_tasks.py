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
from typing import TYPE_CHECKING, Any, TypeVar

from pipeline.lazy import deferred

if TYPE_CHECKING:
    import prefect
    import prefect.artifacts as prefect_artifacts
    import prefect.cache_policies as prefect_cache_policies
    import prefect.client.orchestration as prefect_client
    import prefect.client.schemas.filters as prefect_filters
    import prefect.concurrency.sync as prefect_concurrency
    import prefect.context as prefect_context
    import prefect.logging.handlers as prefect_handlers
    import prefect.runtime.task_run as prefect_task_run
    import prefect.server.api.server as prefect_server
    import prefect.settings as prefect_settings
    import uvicorn
else:
    prefect = deferred("prefect")
    prefect_artifacts = deferred("prefect.artifacts")
    prefect_cache_policies = deferred("prefect.cache_policies")
    prefect_client = deferred("prefect.client.orchestration")
    prefect_concurrency = deferred("prefect.concurrency.sync")
    prefect_context = deferred("prefect.context")
    prefect_filters = deferred("prefect.client.schemas.filters")
    prefect_handlers = deferred("prefect.logging.handlers")
    prefect_server = deferred("prefect.server.api.server")
    prefect_settings = deferred("prefect.settings")
    prefect_task_run = deferred("prefect.runtime.task_run")
    uvicorn = deferred("uvicorn")


RETRY_DELAY_S = 2.0
Function = TypeVar("Function", bound=Callable[..., Any])


def inside_flow() -> bool:
    """Return whether a Prefect flow is running."""
    return "prefect.context" in sys.modules and prefect_context.FlowRunContext.get() is not None


def as_task(function: Function, name: str, *, retries: int = 0) -> Function:
    """Return the function as a Prefect task inside a flow, else unchanged.

    An OSError is retried ``retries`` times, 2 s apart; other errors are not. The task run is named by the task and by
    the ``name_of_run`` of its first argument: ``rectify-north``.
    """
    return _task(function, name, retries) if inside_flow() else function


@cache
def _task(function: Any, name: str, retries: int) -> Any:
    def run_name() -> str:
        subject = next(iter(prefect_task_run.parameters.values()), None)
        return f"{name}-{getattr(subject, 'name_of_run', 'survey')}"

    return prefect.task(
        function,
        name=name,
        task_run_name=run_name,
        cache_policy=prefect_cache_policies.NO_CACHE,  # the archive finds stores by their content
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
        prefect.get_run_logger().info(text)
