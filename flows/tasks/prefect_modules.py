"""The parts of Prefect that flows use, each imported at its first use: together they take a second."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.lazy import deferred

if TYPE_CHECKING:
    import prefect
    import prefect.artifacts as prefect_artifacts
    import prefect.cache_policies as prefect_cache_policies
    import prefect.client.orchestration as prefect_client
    import prefect.client.schemas.filters as prefect_filters
    import prefect.concurrency.sync as prefect_concurrency
    import prefect.context as prefect_context
    import prefect.deployments as prefect_deployments
    import prefect.exceptions as prefect_exceptions
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
    prefect_deployments = deferred("prefect.deployments")
    prefect_exceptions = deferred("prefect.exceptions")
    prefect_filters = deferred("prefect.client.schemas.filters")
    prefect_handlers = deferred("prefect.logging.handlers")
    prefect_server = deferred("prefect.server.api.server")
    prefect_settings = deferred("prefect.settings")
    prefect_task_run = deferred("prefect.runtime.task_run")
    uvicorn = deferred("uvicorn")
__all__ = [
    "prefect",
    "prefect_artifacts",
    "prefect_cache_policies",
    "prefect_client",
    "prefect_concurrency",
    "prefect_context",
    "prefect_deployments",
    "prefect_exceptions",
    "prefect_filters",
    "prefect_handlers",
    "prefect_server",
    "prefect_settings",
    "prefect_task_run",
    "uvicorn",
]
