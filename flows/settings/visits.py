"""The time of a run's visit, by its settings and its receipt."""

from __future__ import annotations

from contextlib import suppress
from datetime import UTC, datetime, timedelta

from flows.settings.survey_settings import BUILT_IN_SCENES
from pipeline.simulator.scenes.farm.farm_scene import USUAL_DAY, USUAL_HOUR
from storage.archive.records import Run


def time_of_visit(run: Run) -> str | None:
    """Return the moment that names a run's visit, else day and hour of a built-in scene, else when the run began.

    A day of a built-in scene counts in the year of the run. The moment is in ISO 8601 in UTC; None: nothing is known.
    """
    named, began = _moment(run.settings.get("visit")), _moment(run.receipt.get("started")) or _moment(run.created)
    if named is not None or began is None or run.settings.get("scene") not in BUILT_IN_SCENES:
        return named or began
    day, hour = (run.settings.get(name) for name in ("day", "hour"))
    with suppress(TypeError, ValueError, OverflowError):
        grown = timedelta(days=(USUAL_DAY if day is None else day) - 1, hours=USUAL_HOUR if hour is None else hour)
        return (datetime(int(began[:4]), 1, 1, tzinfo=UTC) + grown).isoformat()
    return began


def _moment(value: object) -> str | None:
    """Return a moment in ISO 8601 in UTC; None for anything else."""
    with suppress(ValueError, OverflowError):
        found = datetime.fromisoformat(value) if isinstance(value, str) else None
        return None if found is None else found.replace(tzinfo=found.tzinfo or UTC).astimezone(UTC).isoformat()
    return None
