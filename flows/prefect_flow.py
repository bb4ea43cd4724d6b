"""The survey as a Prefect flow.

    from spectralzoom.flows.prefect_flow import survey
    from spectralzoom.flows.settings.settings import Settings

    if __name__ == "__main__":  # Prefect imports the program of a served flow again for every run
        survey(Settings(scene="farm", seconds=25))                          # once, now
        survey.serve("north", cron="0 6 * * *", parameters={"settings": {...}})   # every day at six

`flows.survey` has the stages. `flows.survey_field` runs them without Prefect, whose import takes a second.

No ``from __future__ import annotations`` here: Prefect reads the signatures.
"""

from typing import cast

from prefect import flow
from prefect.states import Completed

from spectralzoom.flows.observer import current_observer, say_state
from spectralzoom.flows.opening.visit import name_of_flow_run
from spectralzoom.flows.publish.publishing import RunRef, outcome
from spectralzoom.flows.settings.settings import Settings
from spectralzoom.flows.stage import inside_flow
from spectralzoom.flows.survey_field import survey_field


@flow(
    name="survey",
    flow_run_name=name_of_flow_run,
    validate_parameters=True,
    persist_result=False,
    on_running=[say_state],
    on_completion=[say_state],
    on_failure=[say_state],
    on_crashed=[say_state],
)
def survey(settings: Settings) -> RunRef:
    """Survey a field: capture, rectify, score, capture again, segment, evaluate and publish.

    Parameters
    ----------
    settings
        Settings of the survey; all have defaults. A run of a deployment is a visit named by its due time, with the
        newest prior map of the field.

    Returns
    -------
    The address of the published run, or of the last store if ``until`` of the settings stops the survey.

    Raises
    ------
    PipelineError : what is wrong, what is allowed, and what to do.
    """
    run = cast(RunRef, current_observer().carry(lambda: survey_field(settings)))
    if not inside_flow():
        return run
    return cast(RunRef, Completed(message=outcome(run), data=run))  # Prefect returns its data to the caller
