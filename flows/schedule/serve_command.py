"""What `spectralzoom serve` does: check everything, then survey fields on a schedule until it is stopped."""

from __future__ import annotations

import math
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from flows.schedule.due_runs import Outcome, Tell
from flows.schedule.fields import alone_on, load_fields, survey_field
from flows.schedule.notices import notice_address, send_notice
from flows.schedule.plain_schedule import serve_plain
from flows.schedule.prefect_schedule import serve_prefect
from flows.schedule.served import ServeRequest
from flows.schedule.times import parse_timetable
from pipeline.errors import SettingsError
from storage.remote.object_stores import is_remote


@dataclass(frozen=True, kw_only=True)
class ServeChoice:
    """What was given on the command line."""

    files: Sequence[Path]
    cron: str | None = None
    every: str | None = None
    timezone: str | None = None
    out: str | None = None
    limit: int = 1
    late: float = 0.5
    engine: str = "prefect"
    port: int = 4200
    notify: str | None = None


def run_serve(choice: ServeChoice, console: Console) -> int:
    """Serve until interrupted; what happens is told on ``console``, a line a run.

    Raises
    ------
    PipelineError : something given cannot be used; nothing is served.
    """
    timetable = parse_timetable(choice.cron, choice.every, choice.timezone)
    if not (math.isfinite(choice.late) and 0 < choice.late <= 1):
        raise SettingsError(f"--late {choice.late}: expected a share of the interval, above 0 and at most 1")
    if choice.limit < 1:
        raise SettingsError(f"--limit {choice.limit}: expected 1 or more surveys at a time")
    notify = notice_address(choice.notify)
    out = choice.out if choice.out is None or is_remote(choice.out) else str(Path(choice.out).absolute())
    fields = load_fields(choice.files, out)

    def tell(words: str) -> None:
        console.print(escape(words), highlight=False, soft_wrap=True)

    request = ServeRequest(
        fields=fields,
        timetable=timetable,
        late=choice.late,
        limit=choice.limit,
        port=choice.port,
        out=out,
        notify=notify,
    )
    with alone_on(fields), _stopped_cleanly(tell):
        if choice.engine == "prefect":
            serve_prefect(request, tell)
        else:
            tell(request.headline)
            _serve_plain(request, console, tell)
    return 0


@contextmanager
def _stopped_cleanly(tell: Tell) -> Iterator[None]:
    """Let Ctrl-C, and a service manager's SIGTERM, be the way to stop: the schedule is closed, and that is no error."""

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    except KeyboardInterrupt:
        tell("stopped: nothing is due any more; the same command serves again, and resumes what was interrupted")
    finally:
        signal.signal(signal.SIGTERM, before)


def _serve_plain(request: ServeRequest, console: Console, tell: Tell) -> None:
    by_name = {one.name: replace(one, settings=replace(one.settings, engine="plain")) for one in request.fields}

    def note(outcome: Outcome) -> None:
        send_notice(request.notify, outcome, by_name[outcome.field].settings.out)

    serve_plain(
        request.schedules(),
        {one.name: one.lock() for one in request.fields},
        lambda name, due: survey_field(by_name[name], due, request.timetable, console),
        tell,
        note=note,
    )
