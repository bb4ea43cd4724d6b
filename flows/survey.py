"""Define the survey as a Prefect flow: from raw sweeps to a class map and its receipt.

    from flows.settings.parameters import SurveySettings
    from flows.survey import survey

    if __name__ == "__main__":  # Prefect imports the program of a served flow again for every run
        survey(SurveySettings(scene="farm", seconds=25))                          # once, now
        survey.serve("north", cron="0 6 * * *", parameters={"settings": {...}})   # every day at six

Every step is a task that takes and returns addresses of stores, not arrays. Existing stores are not computed again, so
that a stopped survey resumes. `survey.fn` runs the same steps without a server.

No ``from __future__ import annotations`` here: Prefect reads the signatures.
"""

from prefect import flow

from flows.publish.publishing import add_accuracy, clear_raw, publish
from flows.settings.parameters import SurveySettings
from flows.tasks.captures import capture_pass, captured_signal, first_mosaic, plan_capture
from flows.tasks.open_survey import OpenSurvey, RunRef
from flows.tasks.prefect_tasks import as_task
from flows.tasks.stages.accuracy import evaluate
from flows.tasks.stages.attention import score
from flows.tasks.stages.condense import condense_raster
from flows.tasks.stages.effects import choose_effects
from flows.tasks.stages.maps import ground, segment
from flows.tasks.stages.placement import locate, rectify_fine, register_coarse, register_fine
from pipeline.errors import SettingsError
from storage.archive.keys import StageRef


@flow(name="survey", flow_run_name="survey-{settings.name_of_run}", validate_parameters=True, persist_result=False)
def survey(settings: SurveySettings, capture_deployment: str | None = None) -> RunRef:
    """Survey a field: capture, rectify, score, capture again, segment and publish.

    Parameters
    ----------
    settings
        Settings of the survey; all have defaults. A run of a deployment is a visit named by its due time, with the
        newest prior map of the field.
    capture_deployment
        Deployment of the flow `capture` on the rig's machine, such as ``capture/rig``, which captures into the archive
        of the settings. By default, this machine captures.

    Returns
    -------
    The address of the published run; of an earlier one where nothing had to be captured.

    Raises
    ------
    PipelineError : what is wrong, what is allowed, and what to do.
    """
    opened = plan_capture(settings)
    if isinstance(opened, RunRef):  # nothing has to be captured
        return opened
    opened.capture_deployment = capture_deployment
    with opened.at_work():
        draw_class_map(opened)
        return clear_raw(opened, judge(opened, publish(opened)))


def draw_class_map(opened: OpenSurvey) -> None:
    """Run the stages from the first pass to the class map, and store their products in it."""
    if opened.is_map:  # no capture
        mosaic = condense_raster(opened)
        class_map = segment(opened, mosaic, score(opened, mosaic))
    else:
        mosaic, class_map = _draw_captured(opened)
    if opened.on_the_ground:
        ground(opened, class_map, mosaic)


def _draw_captured(opened: OpenSurvey) -> tuple[StageRef, StageRef]:
    """Capture the field in one or two passes, and segment it; return mosaic and class map."""
    effects = choose_effects(opened)
    signal = captured_signal(opened, "coarse", effects)
    seams = register_coarse(opened, signal) if opened.registers else None
    mosaic = first_mosaic(opened, signal, locate(opened, signal, seams), seams)
    request = score(opened, mosaic)
    if opened.goes_back(request):  # second pass
        signal = captured_signal(opened, "fine", request, effects)
        seams = register_fine(opened, signal, mosaic) if opened.registers else None
        mosaic = rectify_fine(opened, signal, seams)
    return mosaic, segment(opened, mosaic, request)


def judge(opened: OpenSurvey, run: RunRef) -> RunRef:
    """Evaluate a published class map if there are labels; this is not part of the survey's cost."""
    if not run.pending:
        return run
    return as_task(add_accuracy, "add_accuracy")(opened, run, evaluate(opened, *opened.products.judged))


@flow(name="capture", flow_run_name="capture-{settings.name_of_run}", validate_parameters=True, persist_result=False)
def capture(
    settings: SurveySettings, sweeps: str = "coarse", inputs: list[str] | None = None, rig_file: str | None = None
) -> str:
    """Capture the sweeps of one pass into the archive of the settings, on the rig's machine.

    Parameters
    ----------
    settings
        Settings of the survey.
    sweeps
        ``coarse`` (the first pass or a uniform scan) or ``fine`` (the second pass).
    inputs
        Addresses of the input stores of the pass; those of a first pass are computed here.
    rig_file
        Settings file on the rig's machine whose table [rig] has the addresses of its devices. It is a parameter of the
        deployment, so that the survey needs neither ports nor passwords.

    Returns
    -------
    The address of the stored sweeps.
    """
    opened = plan_capture(settings if rig_file is None else settings.with_rig_of(rig_file))
    if isinstance(opened, RunRef):
        return opened.uri
    with opened.at_work():
        parts = [address.split("/") for address in inputs or []]
        if any(len(part) != 3 for part in parts) or (sweeps == "fine" and len(parts) != 2):
            raise SettingsError(
                f"inputs = {inputs}: expected addresses stages/STAGE/KEY of stores; a fine pass needs those of its "
                "scores and of its effects"
            )
        known = [opened.run.archive.ref(*part[1:]) for part in parts]
        return capture_pass(opened, sweeps, *(known or [choose_effects(opened)])).uri
