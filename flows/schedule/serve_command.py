"""What `spectralzoom serve` does: check everything, then survey fields on a schedule until it is stopped."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from rich.console import Console
from rich.markup import escape

from flows.cli.app import stderr
from flows.schedule.due_runs import Outcome, ScheduleNews, Survey, Tell, notice_address, run_all, send_notice, together
from flows.schedule.field_schedule import FieldSchedule
from flows.schedule.rig_lock import RigLock, hold_place
from flows.schedule.served import ServedField, ServeRequest, load_field
from flows.schedule.server import serve_prefect
from flows.schedule.times import SystemWallClock, Timetable, WallClock, parse_timetable
from flows.tasks.run import open_run
from flows.terminal.processes import DONE, terminable
from pipeline.errors import ArchiveError, PipelineError, RigError, SettingsError
from pipeline.lazy import deferred
from storage.archive.staging import take_lock
from storage.remote.object_stores import is_remote

if TYPE_CHECKING:
    import flows.publish.survey_command as survey_command
else:
    survey_command = deferred("flows.publish.survey_command")

LOOK_AGAIN = timedelta(seconds=30)  # a clock that jumps, or a run that died, is seen after this at the latest


def serve(
    *fields: Path,
    cron: str | None = None,
    every: str | None = None,
    timezone: str | None = None,
    out: str | None = None,
    limit: int = 1,
    late: float = 0.5,
    engine: Literal["prefect", "plain"] = "prefect",
    port: int = 4200,
    notify: str | None = None,
) -> int:
    """Survey fields on a schedule, one after another, until stopped; every due run is done, skipped by rule, or failed.

    Parameters
    ----------
    fields
        A settings file for each field, in turn.
    cron
        When all of them are due: minute hour day month weekday, such as '0 6-20 * * *'.
    every
        Or how often: 30m, 2h, 1d; counted from midnight UTC of 1970, not from now.
    timezone
        Of --cron, such as Europe/Berlin; this machine's by default.
    out
        Archive for all fields, a folder or s3://bucket/prefix; by default that of each field's settings.
    limit
        Surveys at a time, by Prefect; of one rig it is always one.
    late
        Share of the time to the next due one after which a run may not begin any more: it is skipped.
    engine
        `prefect`, with pages to look at, or `plain`, in this process alone.
    port
        Of Prefect's pages on this machine; a server that PREFECT_API_URL names is used instead.
    notify
        Address that is told of failed and skipped runs, a POST of JSON, or a file that holds it: what stands on the
        command line is in the process list. SPECTRALZOOM_NOTIFY in the environment does as well. By default nobody.
    """
    timetable = parse_timetable(cron, every, timezone)
    if not (math.isfinite(late) and 0 < late <= 1):
        raise SettingsError(f"--late {late}: expected a share of the interval, above 0 and at most 1")
    if limit < 1:
        raise SettingsError(f"--limit {limit}: expected 1 or more surveys at a time")
    address = notice_address(notify)
    archive = out if out is None or is_remote(out) else str(Path(out).absolute())
    served = load_fields(fields, archive)
    request = ServeRequest(
        fields=served, timetable=timetable, late=late, limit=limit, port=port, out=archive, notify=address
    )
    with alone_on(served), _stopped_cleanly(_tell):
        if engine == "prefect":
            serve_prefect(request, _tell)
        else:
            _tell(request.headline)
            by_name = {one.name: replace(one, settings=replace(one.settings, engine="plain")) for one in served}
            serve_plain(
                request.schedules(),
                {one.name: one.lock() for one in served},
                lambda name, due: survey_field(by_name[name], due, timetable, stderr),
                _tell,
                note=lambda outcome: send_notice(address, outcome, by_name[outcome.field].settings.out),
            )
    return DONE


def survey_field(one: ServedField, due: datetime, timetable: Timetable, console: Console) -> Path:
    """Survey a field for a due time; gives the folder of the published run."""
    return survey_command.run_survey(one.settings_of(due, timetable), console).folder


def _tell(words: str) -> None:
    stderr.print(escape(words), soft_wrap=True)


def load_fields(files: Sequence[Path], out: str | None = None) -> list[ServedField]:
    """Settings of every field, in turn, each seen to be surveyable; nothing is captured (PipelineError names it)."""
    if not files:
        raise SettingsError("no fields: give the settings file of one or more, such as serve north.toml --every 30m")
    fields = [load_field(file, out) for file in files]
    for number, one in enumerate(fields):
        same = [other for other in fields[:number] if other.name == one.name]
        if same:
            raise SettingsError(
                f'{same[0].file} and {one.file} are both called {one.name}: give one of them another name = "..."'
            )
        try:
            open_run(replace(one.settings, name=one.name), planning=True)  # no device is asked before its first survey
        except PipelineError as error:
            raise type(error)(f"{one.file}: {error}") from error
    return fields


@contextmanager
def alone_on(fields: Sequence[ServedField]) -> Iterator[None]:
    """Keep another serve off these fields' archives (ArchiveError) and rigs (RigError) while the block runs."""
    roots: Mapping[Path, str] = {one.archive: str(one.settings.out) for one in fields}
    rigs = {one.lock().of_servers(): one.settings.rig.port for one in fields if one.settings.source == "rig"}
    with ExitStack() as held:
        for root, name in roots.items():
            release = take_lock(root / ".locks" / "serve.lock", wait=False)
            if release is None:
                raise ArchiveError(
                    f"another serve works on the archive {name}: give all its fields to that one, or end it first"
                )
            held.callback(release)
        for place, port in rigs.items():
            release = hold_place(place, f"a serve (process {os.getpid()})")
            if release is None:
                raise RigError(
                    f"another serve uses the rig at {port}: give all its fields to that one, or end it first"
                )
            held.callback(release)
        yield


@contextmanager
def _stopped_cleanly(tell: Tell) -> Iterator[None]:
    """Let Ctrl-C, and a service manager's SIGTERM, be the way to stop: the schedule is closed, and that is no error."""
    try:
        with terminable():
            yield
    except KeyboardInterrupt:
        tell("stopped: nothing is due any more; the same command serves again, and resumes what was interrupted")


def serve_plain(
    schedules: Mapping[str, FieldSchedule],
    locks: Mapping[str, RigLock],
    survey: Survey,
    tell: Tell,
    *,
    clock: WallClock | None = None,
    note: Callable[[Outcome], object] = lambda outcome: None,
    until: datetime | None = None,
) -> None:
    """Serve until ``until`` or interrupted, then close. PipelineError: a ledger cannot be written at the start."""
    watch, news = clock or SystemWallClock(), ScheduleNews(schedules, lambda name, error: tell(f"{name}: {error}"))
    with ExitStack() as opened:
        for name, schedule in schedules.items():
            opened.callback(_close, name, schedule, tell)
            schedule.open()
        while until is None or watch.now() < until:
            outcomes = run_all(schedules, lambda name: locks[name], survey, tell)
            ran = {(outcome.field, outcome.due) for outcome in outcomes if outcome.ending}
            fresh = news.fresh()
            for outcome in fresh:  # also what was skipped, or found dead
                if (outcome.field, outcome.due) not in ran:
                    tell(outcome.words())
            for outcome in together(fresh):
                note(outcome)
            if not any(outcome.ending for outcome in outcomes):  # else others may have become due meanwhile
                now = watch.now()
                due = [schedule.timetable.next_after(now) for schedule in schedules.values()]
                watch.sleep(min([LOOK_AGAIN, *(one - now for one in due if one is not None)]).total_seconds())


def _close(name: str, schedule: FieldSchedule, tell: Tell) -> None:
    """Close a schedule; one that cannot be closed keeps the others from nothing."""
    try:
        schedule.close()
    except PipelineError as error:
        tell(f"{name}: {error}")
