"""The flows that Prefect runs on schedule or request, a field's survey and an archive's reprocessing, and their runner.

Their parameters can only name what is served; all else stands in the file of `flows.schedule.served`. What a survey
needs is imported when it has begun: on a busy machine that takes longer than a run may be late.

No ``from __future__ import annotations`` here: Prefect reads the signatures. What is done is in plain functions.
"""

import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from prefect import State, flow, serve
from prefect.concurrency.sync import concurrency
from prefect.context import FlowRunContext
from prefect.states import Cancelled, Completed, Failed
from prefect.types.entrypoint import EntrypointType

from flows.schedule.due_runs import Outcome, ScheduleNews, run_due, send_notice, together
from flows.schedule.field_schedule import FieldSchedule, read_moment
from flows.schedule.served import ServedField, ServeRequest, read_served, served_archive, served_field, served_weights
from flows.schedule.times import WallClock
from flows.schedule.watcher import LIMIT, REPROCESS_LOCK, SKIPPED
from flows.terminal.processes import FAILED, PARTLY
from flows.terminal.progress import on_stderr
from pipeline.errors import NothingToMend, PipelineError, RigError
from pipeline.lazy import deferred
from storage.archive.staging import take_lock
from storage.remote.opening import open_archive

if TYPE_CHECKING:
    import flows.archive.reprocess_command as reprocess_command
    import flows.publish.survey_command as survey_command
else:
    reprocess_command = deferred("flows.archive.reprocess_command")
    survey_command = deferred("flows.publish.survey_command")  # torch, once the run is noted as begun

A_LOOK_S = 1.0
AHEAD = timedelta(minutes=2)  # a run that is begun earlier than this was begun by hand


@flow(name="survey", flow_run_name="survey-{field}", persist_result=False)
def survey_scheduled(field: str, due: str | None = None) -> State:
    """Survey one served field: for the due time that this run was made for, or at once where it was asked by hand."""
    try:
        request = read_served()
        one = served_field(request, field)
        schedule = one.schedule(request.timetable, request.late)
        moment = read_moment(due) or _scheduled()
        if moment is None or not _wait_for(moment, schedule.clock):
            return _by_hand(one, request)
        news = ScheduleNews({field: schedule}, lambda name, error: None)
        if not schedule.join(moment):
            return _skipped("it is of a schedule that is not served any more")
        outcome = _run(one, schedule, moment, request)
    except PipelineError as error:
        return Failed(message=str(error))
    for known in together(news.fresh()):
        send_notice(request.notify, known, one.settings.out)
    if outcome.ending == "failed":
        return Failed(message=outcome.reason)
    if outcome.ending == "done":
        return Completed(message=outcome.run)
    return _skipped(outcome.reason or "it is accounted for already")


def _run(one: ServedField, schedule: FieldSchedule, moment: datetime, request: ServeRequest) -> Outcome:
    waiting = [*schedule.state().open, *schedule.pending()]
    known = next((found for found in waiting if abs((found - moment).total_seconds()) < 1), None)
    if known is None:
        line = schedule.state().ended.get(moment, {})
        return Outcome(one.name, moment, None, str(line.get("reason") or "it is accounted for in the ledger already"))
    context = FlowRunContext.get()
    facts = {} if context is None or context.flow_run is None else {"flow_run": str(context.flow_run.id)}
    with _shown_in_queue():
        return run_due(schedule, known, one.lock(), lambda field, due: _survey(one, due, request), facts=facts)


def _survey(one: ServedField, due: datetime, request: ServeRequest) -> Path:
    published = survey_command.run_survey(one.settings_of(due, request.timetable), on_stderr())
    with suppress(Exception):  # a server that is gone: the archive has it all
        survey_command.publish_artifacts(published, one.name, one.settings.out)
    return published.folder


def _by_hand(one: ServedField, request: ServeRequest) -> State:
    """A survey that somebody asked for on Prefect's pages: it has no due time, and waits for nobody."""
    lock = one.lock()
    if not lock.take_soon(f"{one.name}, by hand"):
        raise RigError(f"the rig is in use by {lock.holder()}; run again when that survey has ended")
    try:
        folder = _survey(one, datetime.now(UTC).replace(microsecond=0), request)
    except NothingToMend as said:
        return Completed(message=str(said))
    finally:
        lock.release()
    return Completed(message=f"runs/{folder.name}")


@contextmanager
def _shown_in_queue() -> Iterator[None]:
    """Take a place in Prefect's queue of the rig, where it has one; without one, or with a stale one, go on."""
    held = ExitStack()
    with suppress(Exception):
        held.enter_context(concurrency(LIMIT, occupy=1, timeout_seconds=5, lease_duration=60))
    try:
        yield
    finally:
        with suppress(Exception):  # a server that has gone meanwhile: the place is free when its lease is over
            held.close()


def _wait_for(moment: datetime, clock: WallClock) -> bool:
    """Wait until a due time has come: Prefect begins runs up to seconds before it. False where it is far away."""
    if moment - clock.now() > AHEAD:
        return False
    while (left := (moment - clock.now()).total_seconds()) > 0:
        clock.sleep(min(left, 1.0))
    return True


def _scheduled() -> datetime | None:
    """The time that Prefect's scheduler meant; None of a run that it did not make."""
    context = FlowRunContext.get()
    if context is None or context.flow_run is None or not context.flow_run.auto_scheduled:
        return None
    expected = context.flow_run.expected_start_time
    return None if expected is None else datetime.fromtimestamp(expected.timestamp(), UTC)


def _skipped(why: str) -> State:
    """The end of a run that did nothing: not the green of one that surveyed."""
    return Cancelled(name=SKIPPED, message=why)


@flow(name="reprocess", flow_run_name="reprocess-{archive}", persist_result=False)
def reprocess_archive(
    archive: str,
    since: str | None = None,
    stage: str | None = None,
    field: str | None = None,
    failed: bool = False,
    weights: str | None = None,
    dry_run: bool = False,
) -> State:
    """Survey every field of a served archive again; ``weights`` may be those that a served field's settings name."""
    try:
        served = read_served()
        archive = served_archive(served, archive)
        request = reprocess_command.ReprocessRequest(
            archive, since, stage, field, failed, served_weights(served, weights), dry_run
        )
        lock = open_archive(archive, create=False, write=False).root / ".locks" / REPROCESS_LOCK
        release = take_lock(lock, wait=False)
        if release is None:  # it may be but the watcher's look
            time.sleep(A_LOOK_S)
            release = take_lock(lock, wait=False)
        if release is None:
            return _skipped("this archive is being reprocessed already")
        try:
            code = reprocess_command.run_reprocess(request, on_stderr())
        finally:
            release()
    except PipelineError as error:
        return Failed(message=str(error))
    if code == FAILED:
        return Failed(message="no field could be reprocessed; reprocess-TIME.json beside the archive says why")
    return Completed(message="some fields failed: see reprocess-TIME.json" if code == PARTLY else "done")


@contextmanager
def own_temporary_folder() -> Iterator[None]:
    """Let this process have its temporary files in a folder that is this user's alone.

    Prefect's runner keeps what it starts in /tmp/runner_storage, which belongs to the first user who ever ran one: that
    one could exchange it, and no other can run one.
    """
    usual = tempfile.tempdir
    with tempfile.TemporaryDirectory(prefix="spectralzoom-runner-", ignore_cleanup_errors=True) as own:
        tempfile.tempdir = own
        try:
            yield
        finally:
            tempfile.tempdir = usual


def deployments(request: ServeRequest) -> list[Any]:
    """A deployment for each field and each archive; without schedules: `flows.schedule.watcher` plans each time."""
    alike: dict[str, Any] = {"version": "1", "entrypoint_type": EntrypointType.MODULE_PATH}
    surveys = [
        survey_scheduled.to_deployment(
            one.name,
            schedules=[],
            parameters={"field": one.name},
            tags=[one.settings.source, one.name],
            description=f"Surveys of {one.name} by {one.file}, {request.timetable.words()}.",
            **alike,
        )
        for one in request.fields
    ]
    archives = [
        reprocess_archive.to_deployment(
            "archive" if number == 1 else f"archive-{number}",
            parameters={"archive": str(out)},
            description=f"Surveys of {out} again, with newer weights or stages; on request.",
            **alike,
        )
        for number, out in enumerate(dict.fromkeys(one.settings.out for one in request.fields), 1)
    ]
    return [*surveys, *archives]


def serve_runs() -> None:
    """Run what is served until told to stop; `serve` starts it anew, for Prefect's runner can lose its server."""
    request = read_served()
    with suppress(KeyboardInterrupt), own_temporary_folder():
        serve(*deployments(request), limit=request.limit, print_starting_message=False)
