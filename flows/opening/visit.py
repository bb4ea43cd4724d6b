"""The visit of a survey: when a run of a deployment was due, and when a published run was captured."""

from __future__ import annotations

from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path

from spectralzoom.flows.opening.scene import scene_of_visit
from spectralzoom.flows.settings.settings import Settings
from spectralzoom.flows.settings.values import BUILT_IN_SCENES
from spectralzoom.flows.stage import inside_flow
from spectralzoom.pipeline.simulator.scenes.laws import USUAL_DAY, USUAL_HOUR
from spectralzoom.pipeline.words import moment_of
from spectralzoom.storage.readers.open_cubes import open_cube_source
from spectralzoom.storage.runs import Run


def settings_of_visit(settings: Settings) -> Settings:
    """Return the settings of a run; a run of a deployment is a visit of its due time.

    Raises SettingsError, SceneError: the settings or the raster cannot be used.
    """
    due = due_time()
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

    settings = flow_run.parameters["settings"]
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
    requested = settings.but(
        visit=settings.visit or acquired or _named(due), prior="latest" if settings.prior == "auto" else settings.prior
    )
    if requested.source == "sim" and requested.scene in BUILT_IN_SCENES and requested.day is None:
        return requested.but(day=due.astimezone().timetuple().tm_yday)
    return requested


def time_of_visit(run: Run) -> str | None:
    """Return the moment of a run's visit or file, else day and hour of a built-in scene, else when the run began.

    A day of a built-in scene counts in the year of the run. The moment is in ISO 8601 in UTC; None: nothing is known.
    """
    named = moment_of(run.acquired)
    began = moment_of(run.receipt.get("started")) or moment_of(run.created)
    found = named or began
    with suppress(TypeError, ValueError, OverflowError):
        if named is None and began is not None and run.settings.get("scene") in BUILT_IN_SCENES:
            day, hour = (run.settings.get(name) for name in ("day", "hour"))
            grown = timedelta(days=(USUAL_DAY if day is None else day) - 1, hours=USUAL_HOUR if hour is None else hour)
            found = datetime(began.astimezone(UTC).year, 1, 1, tzinfo=UTC) + grown
    with suppress(OverflowError):
        return None if found is None else found.astimezone(UTC).isoformat()
    return None
