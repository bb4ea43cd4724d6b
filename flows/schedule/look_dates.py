"""When a field was looked at: what the axes of its history go by, whenever a run of it was published."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from typing import Any

from flows.schedule.field_schedule import read_moment
from flows.settings.survey_settings import BUILT_IN_SCENES
from pipeline.simulator.scenes.farm.farm_scene import USUAL_HOUR
from storage.archive.records import Run


def look_of(run: Run, due: object) -> datetime | None:
    """The moment that a run's visit is called by, else when it was ``due``, else the day that its farm was drawn on.

    Of others when they began, or were published. The day is of the year in which the run was published. None where
    nothing of that can be read.
    """
    named = next((at for at in map(read_moment, (run.settings.get("visit"), due)) if at is not None), None)
    if named is not None:
        return named
    began = next((at for at in map(read_moment, (run.receipt.get("started"), run.created)) if at is not None), None)
    return _day_of_farm(run.settings, began) or began


def _day_of_farm(settings: Mapping[str, Any], published: datetime | None) -> datetime | None:
    day, hour = settings.get("day"), settings.get("hour")
    if settings.get("scene") not in BUILT_IN_SCENES or not isinstance(day, int) or published is None:
        return None
    of_day = float(hour) if isinstance(hour, int | float) else USUAL_HOUR
    if not (1 <= day <= 366 and 0 <= of_day <= 24):
        return None
    return datetime(published.year, 1, 1, tzinfo=UTC) + timedelta(days=day - 1, hours=of_day)
