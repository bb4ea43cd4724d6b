"""Open, plan and survey a field."""

from __future__ import annotations

from datetime import UTC, datetime

from spectralzoom.flows.opening.open_field import open_field
from spectralzoom.flows.opening.visit import settings_of_visit
from spectralzoom.flows.planning.plan_survey import plan_survey
from spectralzoom.flows.publish.publishing import RunRef
from spectralzoom.flows.settings.settings import Settings
from spectralzoom.flows.settings.values import RIG
from spectralzoom.flows.survey import carry_out


def survey_field(settings: Settings) -> RunRef:
    """Open, plan and survey a field; returns and raises as `carry_out`."""
    started = datetime.now(UTC)
    checked = settings_of_visit(settings)
    if checked.source == RIG:
        from spectralzoom.pipeline.rig.drivers import check_devices  # imports pyserial

        check_devices(checked.rig)
    return carry_out(plan_survey(open_field(checked)), started)
