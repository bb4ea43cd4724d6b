"""Functions as Prefect tasks: inside a flow they are run by Prefect, elsewhere they are called.

No ``from __future__ import annotations`` here: Prefect reads signatures.
"""

import sys
from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING, Any, TypeVar

from pipeline.lazy import deferred

if TYPE_CHECKING:
    import prefect
    import prefect.cache_policies as prefect_cache_policies
    import prefect.context as prefect_context
    import prefect.runtime.task_run as prefect_task_run
else:
    prefect = deferred("prefect")
    prefect_cache_policies = deferred("prefect.cache_policies")
    prefect_context = deferred("prefect.context")
    prefect_task_run = deferred("prefect.runtime.task_run")

RETRY_DELAY_S = 2.0
Function = TypeVar("Function", bound=Callable[..., Any])


def inside_flow() -> bool:
    """Return whether a Prefect flow is being run, here and now."""
    return "prefect.context" in sys.modules and prefect_context.FlowRunContext.get() is not None


def as_task(function: Function, name: str, *, retries: int = 0) -> Function:
    """Return the function as a Prefect task where a flow runs, else as it is.

    An OSError is tried again ``retries`` times, 2 s apart: a device or a disk may answer then. Other errors stand.
    A task run is called by task and field, ``rectify-north``: by the ``name_of_run`` of its first argument.
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
        cache_policy=prefect_cache_policies.NO_CACHE,  # the archive knows what is there, by content
        persist_result=False,
        retries=retries,
        retry_delay_seconds=RETRY_DELAY_S,
        retry_condition_fn=lambda task, run, state: isinstance(state.result(raise_on_failure=False), OSError),
    )
