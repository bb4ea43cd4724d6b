"""Define the first tasks of a survey: open and plan it, and capture a pass.

No ``from __future__ import annotations`` here: Prefect reads signatures.
"""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import replace
from datetime import datetime

from spectralzoom.flows.settings.parameters import SurveySettings, at_due_time
from spectralzoom.flows.settings.survey_settings import RIG, Settings
from spectralzoom.flows.settings.values import KEEP_RAW
from spectralzoom.flows.tasks.open_survey import OpenSurvey
from spectralzoom.flows.tasks.prefect_tasks import as_task, current_observer, inside_flow
from spectralzoom.flows.tasks.run import SurveyRun, open_run
from spectralzoom.flows.tasks.scene import scene_of_visit
from spectralzoom.flows.tasks.stages.attention import score
from spectralzoom.flows.tasks.stages.capture import capture_coarse, capture_fine
from spectralzoom.flows.tasks.stages.condense import condense_coarse, condense_fine
from spectralzoom.flows.tasks.stages.placement import rectify
from spectralzoom.pipeline.errors import IncompleteStoreError
from spectralzoom.storage.store import Ref

OPENING = "plan"
_opened: ContextVar[list[tuple[Settings, SurveyRun]] | None] = ContextVar("opened", default=None)
PASSES = {"coarse": capture_coarse, "fine": capture_fine}
CONDENSED = {"coarse": condense_coarse, "fine": condense_fine}


def plan_capture(settings: SurveySettings) -> OpenSurvey:
    """Open scene, weights and archive, and plan the first pass; a task inside a flow.

    Raises PipelineError: the first error, before anything is captured.
    """
    return as_task(_plan_capture, "plan_capture")(settings)


@contextmanager
def opened_first(settings: Settings) -> Iterator[None]:
    """Open a survey before its flow begins, so that errors precede the start of a server. Raises as `open_run`."""
    watch = current_observer().watch
    watch(OPENING, "running", 0.0)
    try:
        run = open_run(settings)
    except BaseException:
        watch(OPENING, "failed", 1.0)
        raise
    watch(OPENING, "opened", 1.0)
    opened = [(settings, run)]
    before = _opened.set(opened)
    try:
        yield
    finally:
        _opened.reset(before)
        opened.clear()  # event loops of Zarr and Prefect keep the context in which they began


def _plan_capture(settings: SurveySettings) -> OpenSurvey:
    observer = current_observer()
    requested = settings.settings()
    due = _due_time()
    first, run = next(iter(_opened.get() or ()), (None, None))
    if run is None or first is not requested:
        if due is not None:
            requested = scene_of_visit(at_due_time(requested, due), due.astimezone())
        run = open_run(requested)
    run.archive.reclaim()  # remove incomplete stores of killed runs
    for note in run.notes:
        observer.note(note)
    return OpenSurvey(replace(run, source=run.source.saying(observer.say)), observer)


def _due_time() -> datetime | None:
    """Return the due time of a run of a deployment; None for other runs."""
    if not inside_flow():
        return None
    from prefect.context import FlowRunContext

    context = FlowRunContext.get()
    flow_run = None if context is None else context.flow_run
    if flow_run is None or flow_run.deployment_id is None or flow_run.expected_start_time is None:
        return None
    return datetime.fromisoformat(flow_run.expected_start_time.isoformat()).replace(microsecond=0)


def capture_pass(survey: OpenSurvey, sweeps: str, *inputs: Ref) -> Ref:
    """Return the stored sweeps of a pass, ``coarse`` or ``fine``; capture them if the archive lacks them.

    Raises RigError: another survey uses the rig.
    """
    survey.hold_rig(PASSES[sweeps], *inputs)
    return PASSES[sweeps](survey, *inputs)


def captured_signal(survey: OpenSurvey, sweeps: str, *inputs: Ref) -> Ref:
    """Return the condensed sweeps of a pass; capture only what the archive lacks. Raises as `capture_pass`."""
    condense, stage = CONDENSED[sweeps], PASSES[sweeps]
    before = survey.products.there("capture_coarse") if sweeps == "fine" else []
    found = None
    with suppress(IncompleteStoreError):  # an incomplete input is an error of the capture
        raw = survey.run.archive.ref(stage.product.name, stage.key(stage.wants(survey.run, *inputs)))
        found = condense.find(survey.run.archive, condense.wants(survey.run, raw, *before))
    if found is None:
        if before and not survey.run.archive.is_there(before[0].uri):  # raw lines were deleted
            capture_pass(survey, "coarse", inputs[-1])
        return condense(survey, capture_pass(survey, sweeps, *inputs), *before)
    settings = survey.run.settings
    if settings.keep == KEEP_RAW and settings.source != RIG and survey.run.archive.find(raw.stage, raw.key) is None:
        capture_pass(survey, sweeps, *inputs)  # an earlier run deleted the raw lines that this one keeps
    elif survey.run.archive.is_known(raw):
        survey.take_as_found(stage.name, raw, *inputs)
    return condense(survey, raw, *before)


def first_mosaic(survey: OpenSurvey, *inputs: Ref | None) -> Ref:
    """Return the mosaic of the first pass; one that was cleared after the second pass is not made again."""
    given = [ref for ref in inputs if ref is not None]
    with suppress(IncompleteStoreError):  # an incomplete input is an error of the stage
        mosaic = survey.run.archive.ref(rectify.product.name, rectify.key(rectify.wants(survey.run, *given)))
        cleared = survey.run.archive.is_known(mosaic) and survey.run.archive.find(mosaic.stage, mosaic.key) is None
        request = score.find(survey.run.archive, score.wants(survey.run, mosaic)) if cleared else None
        if request is not None and survey.goes_back(request):
            survey.take_as_found(rectify.name, mosaic, *given)
            return mosaic
    return rectify(survey, *given)
