"""Schedules on Prefect: a deployment for each field, a watcher that mends what Prefect does not see, and reaping.

Prefect starts the runs and shows them; what is due, and what became of it, the ledgers say.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any

from flows.field_schedule import FieldSchedule
from flows.schedule_lock import RigLock
from flows.schedule_runs import Tell
from flows.schedule_state import moment_words
from flows.schedule_times import EPOCH, Timetable
from flows.serve_fields import ServedField
from flows.serve_runner import RunnerProcess
from flows.serve_server import LocalServer, server_for
from pipeline.errors import PipelineError
from storage.staging import take_lock

WATCH_S = 15.0
GRACE = timedelta(seconds=45)  # after a due time Prefect's own scheduler is given so long
ASK_AGAIN = timedelta(minutes=3)
UNHEARD = timedelta(minutes=1)


@dataclass(frozen=True, kw_only=True)
class ServeRequest:
    """What is to be served, and how."""

    fields: Sequence[ServedField]
    timetable: Timetable
    late: float
    limit: int = 1
    port: int = 4200
    out: str | None = None
    notify: str | None = None

    def parameters(self, one: ServedField) -> dict[str, Any]:
        """Parameters of a field's deployment."""
        content = self.timetable.to_dict()
        every = None if content["every_s"] is None else f"{content['every_s']:g}s"
        return {
            "field": one.name, "settings": str(one.file), "out": one.settings.out if self.out else None,
            "cron": content["cron"], "every": every, "timezone": self.timetable.timezone, "late": self.late,
            "notify": self.notify,
        }  # fmt: skip

    def words(self) -> dict[str, Any]:
        """All of it as plain values, for another process."""
        given = self.parameters(self.fields[0])
        return {
            "files": [str(one.file) for one in self.fields], "out": self.out, "limit": self.limit,
            **{name: given[name] for name in ("cron", "every", "timezone", "late", "notify")},
        }  # fmt: skip

    def schedules(self) -> dict[str, FieldSchedule]:
        """The schedule of every field, by its name."""
        return {one.name: one.schedule(self.timetable, self.late) for one in self.fields}


def serve_prefect(request: ServeRequest, tell: Tell) -> None:
    """Serve until interrupted.

    Raises
    ------
    PipelineError : no server, or a ledger cannot be written at the start.
    """
    schedules, home = request.schedules(), request.fields[0].archive / ".prefect"
    log = home / "surveys.log"
    with server_for(home, request.port) as server:
        for schedule in schedules.values():
            schedule.open()
        watcher, runner = Watcher(request, schedules, tell), RunnerProcess(request.words(), log)
        try:
            tell(f"what surveys say: {log}")
            watcher.prepare()
            runner.keep_up()
            while True:
                time.sleep(WATCH_S)
                _keep_up(server, runner, tell)
                watcher.look()
                watcher.tell_news()
                if watcher.unheard():
                    tell("runs that were asked for do not begin: Prefect's runner is started again")
                    runner.restart()
        finally:
            runner.stop()
            watcher.tell_news()
            for schedule in schedules.values():
                with suppress(PipelineError):
                    schedule.close()


def _keep_up(server: LocalServer | None, runner: RunnerProcess, tell: Tell) -> None:
    """Start again what has ended; a runner whose server was away does not find it again by itself."""
    if server is not None and server.keep_up():
        tell("the Prefect server had ended and is started again")
        server.wait()
        runner.restart()
    elif runner.keep_up():
        tell("Prefect's runner had ended and is started again")


def deployments(request: ServeRequest) -> list[Any]:
    """A deployment of the survey for each field, and of reprocessing for each archive, on request."""
    from prefect.schedules import Cron, Interval
    from prefect.types.entrypoint import EntrypointType

    from flows.serve_flow import reprocess_archive, survey_scheduled

    timetable = request.timetable
    when: Any = (
        Interval(timetable.every, anchor_date=EPOCH, timezone="UTC")
        if timetable.every is not None
        else Cron(str(timetable.cron), timezone=timetable.timezone)
    )
    made = [
        survey_scheduled.to_deployment(
            one.name, schedules=[when], parameters=request.parameters(one), tags=[one.settings.source, one.name],
            description=f"Surveys of {one.name} by {one.file}, {timetable.words()}.", version="1",
            entrypoint_type=EntrypointType.MODULE_PATH,
        )
        for one in request.fields
    ]  # fmt: skip
    for number, out in enumerate(dict.fromkeys(one.settings.out for one in request.fields), 1):
        made.append(
            reprocess_archive.to_deployment(
                "archive" if number == 1 else f"archive-{number}", parameters={"archive": str(out)},
                description=f"Surveys of {out} again, with newer weights or stages; on request.", version="1",
                entrypoint_type=EntrypointType.MODULE_PATH,
            )
        )  # fmt: skip
    return made


@dataclass
class Watcher:
    """Looks at the ledgers every now and then, with and without Prefect: skips, reaps, and asks for what was missed."""

    request: ServeRequest
    schedules: Mapping[str, FieldSchedule]
    tell: Tell
    client_of: Callable[[], Any] = field(default=lambda: _client())
    asked: dict[tuple[str, datetime], datetime] = field(default_factory=dict)
    attempts: dict[tuple[str, datetime], int] = field(default_factory=dict)
    told: dict[str, set[datetime]] = field(default_factory=dict)

    def prepare(self) -> None:
        """At the start: the limit that shows the queue, and runs that are told as alive and are not."""
        from flows.serve_flow import LIMIT

        self.tell_news()  # what ended before is known
        with self._errors("Prefect"), self.client_of() as client:
            client.upsert_global_concurrency_limit_by_name(LIMIT, 1)
        for one in self.request.fields:
            self._alone(one, lambda one=one: self._reap_prefect(one))  # type: ignore[misc]

    def tell_news(self) -> None:
        """Tell how runs ended since the last time, a line each."""
        for name, schedule in self.schedules.items():
            with self._errors(name):
                ended = schedule.state().ended
                known = self.told.get(name)
                self.told[name] = set(ended)
                for due in sorted(set(ended) - known) if known is not None else ():
                    line = ended[due]
                    more = line.get("reason") or line.get("run")
                    self.tell(f"{name}, due {due:%Y-%m-%d %H:%M:%S} UTC, {line['event']}: {more}")

    def unheard(self) -> bool:
        """Whether a run that was asked for has not begun in time though the rig is free: told once for each."""
        late: list[tuple[str, datetime]] = []
        for (name, due), asked in self.asked.items():
            state, now = self.schedules[name].state(), self.schedules[name].clock.now()
            began = due in state.ended or len(state.begun.get(due, ())) > self.attempts.get((name, due), 0)
            if not began and now - asked > UNHEARD:
                late.append((name, due))
        for one in late:
            del self.asked[one]
        return bool(late)

    def look(self) -> list[tuple[str, datetime]]:
        """Once over all fields; gives the runs that were asked for."""
        missed: list[tuple[str, datetime]] = []
        for one in self.request.fields:
            schedule = self.schedules[one.name]
            with self._errors(one.name):
                resumed: list[datetime] = []
                free = self._alone(one, lambda r=resumed, s=schedule: r.extend(s.reap(self._why)))  # type: ignore[misc]
                why = None if free else f"the rig was in use by {one.lock().holder()}"
                now = schedule.clock.now()
                waiting = [due for due in schedule.pending(why) if now - due >= GRACE]
                missed += [(one.name, due) for due in (*resumed, *(waiting if free else ()))]
        asked = [(name, due) for name, due in missed if self._is_to_be_asked(name, due)]
        for name, due in asked:
            with self._errors("Prefect"):
                self._ask(name, due)
        return asked

    def _is_to_be_asked(self, name: str, due: datetime) -> bool:
        now = self.schedules[name].clock.now()
        if now - self.asked.get((name, due), EPOCH) < ASK_AGAIN:
            return False
        self.asked[name, due] = now
        self.attempts[name, due] = len(self.schedules[name].state().begun.get(due, ()))
        return True

    def _ask(self, name: str, due: datetime) -> None:
        """Have a run that crashed, or that Prefect did not start, run now."""
        one = next(one for one in self.request.fields if one.name == name)
        with self.client_of() as client:
            deployment = client.read_deployment_by_name(f"survey/{name}")
            parameters = {**self.request.parameters(one), "due": moment_words(due)}
            client.create_flow_run_from_deployment(deployment.id, parameters=parameters)
        self.tell(f"{name}: the run due {due:%H:%M:%S} UTC is asked for again")

    def _alone(self, one: ServedField, work: Callable[[], object]) -> bool:
        """Do it while no survey holds the field's rig; False where one does."""
        lock: RigLock = one.lock()
        if not lock.take("a look at the schedule"):
            return False
        try:
            with self._errors(one.name):
                work()
        finally:
            lock.release()
        return True

    def _why(self, line: Mapping[str, Any]) -> str | None:
        """Why a run is not to be resumed: somebody cancelled it."""
        known = line.get("flow_run")
        with suppress(Exception), self.client_of() as client:
            state = client.read_flow_run(known).state if known else None
            if state is not None and state.type.value in ("CANCELLED", "CANCELLING"):
                return "it was cancelled in Prefect"
        return None

    def _reap_prefect(self, one: ServedField) -> None:
        with self.client_of() as client:
            for name in reap_flow_runs(client, one.name, str(one.file)):
                self.tell(f"{one.name}: the flow run {name} was told as running and is gone: crashed")
        self._reap_reprocess(one)

    def _reap_reprocess(self, one: ServedField) -> None:
        from flows.serve_flow import REPROCESS_LOCK

        release = take_lock(one.archive / ".locks" / REPROCESS_LOCK, wait=False)
        if release is not None:
            try:
                with self.client_of() as client:
                    reap_flow_runs(client, None, str(one.settings.out))
            finally:
                release()

    def _errors(self, what: str) -> _Told:
        return _Told(self.tell, what)


@dataclass
class _Told:
    """Tells of an error and goes on: what is missed now is done at the next look."""

    tell: Tell
    what: str

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> bool:
        if not isinstance(error, Exception):
            return False
        self.tell(f"{self.what}: {error}")
        return True


def reap_flow_runs(client: Any, field: str | None, what: str) -> list[str]:
    """Set flow runs that Prefect believes alive to Crashed; only for whoever holds their lock. Gives their names.

    Of the survey of ``field`` by the settings file ``what``, or of the reprocessing of the archive ``what``.
    """
    from prefect.client.schemas.filters import FlowFilter, FlowFilterName, FlowRunFilter, FlowRunFilterState
    from prefect.client.schemas.filters import FlowRunFilterStateType as StateFilter
    from prefect.client.schemas.objects import StateType
    from prefect.states import Crashed

    flow = FlowFilter(name=FlowFilterName(any_=["reprocess" if field is None else "survey"]))
    alive = FlowRunFilter(state=FlowRunFilterState(type=StateFilter(any_=[StateType.RUNNING, StateType.PENDING])))
    key = "archive" if field is None else "settings"
    reaped: list[str] = []
    for run in client.read_flow_runs(flow_filter=flow, flow_run_filter=alive):
        if run.parameters.get(key) == what and run.parameters.get("field") in (field, None):
            client.set_flow_run_state(run.id, Crashed(message="its process was gone: its lock is free"), force=True)
            reaped.append(run.name)
    return reaped


def _client() -> Any:
    from prefect.client.orchestration import get_client

    return get_client(sync_client=True)
