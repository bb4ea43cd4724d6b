"""The visit of a survey: when a run of a deployment was due."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from spectralzoom.flows.settings.parameters import SurveySettings
from spectralzoom.flows.settings.survey_settings import BUILT_IN_SCENES, Settings
from spectralzoom.flows.stage import inside_flow
from spectralzoom.flows.tasks.scene import scene_of_visit
from spectralzoom.storage.readers.open_cubes import open_cube_source


def settings_of_visit(parameters: SurveySettings) -> Settings:
    """Return the settings of a run; a run of a deployment is a visit of its due time.

    Raises SettingsError, SceneError: the settings or the raster cannot be used.
    """
    due = due_time()
    settings = parameters.settings()
    return settings if due is None else at_due_time(scene_of_visit(settings, due.astimezone()), due)


def due_time() -> datetime | None:
    """Return the due time of a run of a deployment; None for other runs."""
    if not inside_flow():
        return None
    from prefect.context import FlowRunContext

    context = FlowRunContext.get()
    flow_run = None if context is None else context.flow_run
    if flow_run is None or flow_run.deployment_id is None or flow_run.expected_start_time is None:
        return None
    return datetime.fromisoformat(flow_run.expected_start_time.isoformat()).replace(microsecond=0)


def name_of_flow_run() -> str:
    """Return the name of the present flow run: ``survey``, the field, and the visit if it has a name or a due time."""
    from prefect.runtime import flow_run

    settings = flow_run.parameters["settings"].settings()
    due = due_time()
    visit = settings.visit or (None if due is None else _named(due))
    return "-".join(["survey", settings.name or Path(settings.scene).stem, *([] if visit is None else [visit])])


def _named(due: datetime) -> str:
    return due.astimezone(UTC).isoformat().replace("+00:00", "Z")


def at_due_time(settings: Settings, due: datetime) -> Settings:
    """Return the settings of a scheduled visit: it has the due time as its name and starts from the newest prior map.

    The visit of a raster has the time of acquisition in its file, if any (SceneError: it cannot be read).
    The farm has the day of the due time in this machine's time zone. Stated values of visit, day and prior are kept.
    """
    acquired = open_cube_source(settings.scene).acquired if settings.is_map and settings.visit is None else None
    requested = replace(
        settings,
        visit=settings.visit or acquired or _named(due),
        prior="latest" if settings.prior == "auto" else settings.prior,
    )
    if requested.source == "sim" and requested.scene in BUILT_IN_SCENES and requested.day is None:
        return replace(requested, day=due.astimezone().timetuple().tm_yday)
    return requested
