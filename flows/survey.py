"""Define the survey as a Prefect flow: from raw sweeps to a class map and its receipt.

    from spectralzoom.flows.settings.parameters import SurveySettings
    from spectralzoom.flows.survey import survey

    if __name__ == "__main__":  # Prefect imports the program of a served flow again for every run
        survey(SurveySettings(scene="farm", seconds=25))                          # once, now
        survey.serve("north", cron="0 6 * * *", parameters={"settings": {...}})   # every day at six

Every step is a task that takes and returns addresses of stores, not arrays. Existing stores are not computed again, so
that a stopped survey resumes. `survey.fn` runs the same steps without a server.

No ``from __future__ import annotations`` here: Prefect reads the signatures.
"""

from prefect import flow

from spectralzoom.flows.publish.publishing import clear_raw, publish
from spectralzoom.flows.settings.parameters import SurveySettings
from spectralzoom.flows.tasks.captures import captured_signal, first_mosaic, plan_capture
from spectralzoom.flows.tasks.open_survey import OpenSurvey, RunRef
from spectralzoom.flows.tasks.stages.accuracy import evaluate
from spectralzoom.flows.tasks.stages.attention import score
from spectralzoom.flows.tasks.stages.condense import condense_raster
from spectralzoom.flows.tasks.stages.effects import choose_effects
from spectralzoom.flows.tasks.stages.maps import ground, segment
from spectralzoom.flows.tasks.stages.placement import locate, rectify_fine, register_coarse, register_fine
from spectralzoom.pipeline.errors import SurveyStopped
from spectralzoom.storage.store import Ref


@flow(name="survey", flow_run_name="survey-{settings.name_of_run}", validate_parameters=True, persist_result=False)
def survey(settings: SurveySettings) -> RunRef:
    """Survey a field: capture, rectify, score, capture again, segment, evaluate and publish.

    Parameters
    ----------
    settings
        Settings of the survey; all have defaults. A run of a deployment is a visit named by its due time, with the
        newest prior map of the field.

    Returns
    -------
    The address of the published run. Of the last store, where ``until`` of the settings stops the survey.

    Raises
    ------
    PipelineError : what is wrong, what is allowed, and what to do.
    """
    opened = plan_capture(settings)
    with opened.at_work():
        try:
            draw_class_map(opened)
            if opened.is_judged:
                evaluate(opened, *opened.products.judged)
        except SurveyStopped as stopped:
            return RunRef(stopped.uri, opened.run.archive.root / stopped.uri, stopped=stopped)
        return clear_raw(opened, publish(opened))


def draw_class_map(opened: OpenSurvey) -> None:
    """Run the stages from the first pass to the class map, and store their products in it."""
    if opened.is_map:  # no capture
        mosaic = condense_raster(opened)
        opened.stop_after(mosaic, "capture", "mosaic")
        class_map = segment(opened, mosaic, score(opened, mosaic))
    else:
        mosaic, class_map = _draw_captured(opened)
    if opened.on_the_ground:
        ground(opened, class_map, mosaic)


def _draw_captured(opened: OpenSurvey) -> tuple[Ref, Ref]:
    """Capture the field in one or two passes, and segment it; return mosaic and class map."""
    effects = choose_effects(opened)
    signal = captured_signal(opened, "coarse", effects)
    if opened.run.plan.plain:
        opened.stop_after(signal, "capture")
    seams = register_coarse(opened, signal) if opened.registers else None
    mosaic = first_mosaic(opened, signal, locate(opened, signal, seams), seams)
    if opened.run.plan.plain:  # no network has to choose a second pass
        opened.stop_after(mosaic, "mosaic")
    request = score(opened, mosaic)
    if opened.goes_back(request):  # second pass
        signal = captured_signal(opened, "fine", request, effects)
        opened.stop_after(signal, "capture")
        seams = register_fine(opened, signal, mosaic) if opened.registers else None
        mosaic = rectify_fine(opened, signal, seams)
    opened.stop_after(mosaic, "capture", "mosaic")
    return mosaic, segment(opened, mosaic, request)
