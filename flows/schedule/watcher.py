"""What looks after a schedule on Prefect: it skips and reaps by the ledgers, and plans one flow run a due time.

A server that is away is told of; what could not be done is done at the next look.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

from flows.schedule.due_runs import Tell
from flows.schedule.field_schedule import FieldSchedule
from flows.schedule.fields import ServedField
from flows.schedule.news import ScheduleNews, together
from flows.schedule.notices import send_notice
from flows.schedule.queue import FlowRuns
from flows.schedule.rig_lock import RigLock
from flows.schedule.served import ServeRequest
from flows.schedule.times import Timetable
from storage.archive.staging import take_lock

AHEAD, LEAST_AHEAD, MOST_AHEAD = timedelta(minutes=1), 2, 12  # due times to come that stand in Prefect
UNHEARD = timedelta(minutes=2)
CANCELLED = "it was cancelled in Prefect"


class Asked(NamedTuple):
    """From when on a planned run could have begun, and how often it had by then."""

    at: datetime
    attempts: int


@dataclass
class Watcher:
    """Looks at the ledgers every now and then, with and without Prefect: skips, reaps, and asks for what was missed."""

    request: ServeRequest
    schedules: Mapping[str, FieldSchedule]
    tell: Tell
    client_of: Callable[[], Any] = field(default=lambda: _client())
    asked: dict[tuple[str, datetime], Asked] = field(default_factory=dict)  # and not begun since, as far as is known
    news: ScheduleNews = field(init=False)
    runs: dict[str, FlowRuns] = field(init=False)

    def __post_init__(self) -> None:
        self.runs = {name: FlowRuns(name) for name in self.schedules}
        self.news = ScheduleNews(self.schedules, lambda name, error: self.tell(f"{name}: {error}"))

    def prepare(self) -> None:
        """At the start: the limit that shows the queue, and runs that are told as alive and are not."""
        from flows.schedule.prefect_flows import LIMIT

        with self._errors("Prefect"), self.client_of() as client:
            client.upsert_global_concurrency_limit_by_name(LIMIT, 1)
        for one in self.request.fields:
            with self._errors(one.name):
                self._alone(one, lambda one=one: self._reap_prefect(one))  # type: ignore[misc]

    def tell_news(self) -> None:
        """Tell how runs ended since the last time, a line each, and give notice where an address was given.

        Of all that ended alike in a field there is one notice.
        """
        archives, fresh = {one.name: one.settings.out for one in self.request.fields}, self.news.fresh()
        for outcome in fresh:
            self.tell(outcome.words())
        for outcome in together(fresh):
            send_notice(self.request.notify, outcome, archives[outcome.field])

    def unheard(self) -> bool:
        """Whether a run that was asked for has not begun in time though nothing else runs: told once for each."""
        if self.busy():  # they wait for their turn, and the runner has a survey under way
            return False
        late: list[tuple[str, datetime]] = []
        for name in {name for name, _ in self.asked}:
            with self._errors(name):
                late += self._late_ones(name)
        for name, due in late:
            del self.asked[name, due]
            with self._errors("Prefect"), self.client_of() as client:
                self.runs[name].give_up(client, due)
        return bool(late)

    def _late_ones(self, name: str) -> list[tuple[str, datetime]]:
        """What of a field was asked for a while ago and has not begun; what has is forgotten."""
        state, now = self.schedules[name].state(), self.schedules[name].clock.now()
        late: list[tuple[str, datetime]] = []
        for (field_name, due), asked in list(self.asked.items()):
            if field_name != name:
                continue
            if due in state.ended or len(state.begun.get(due, ())) > asked.attempts:
                del self.asked[name, due]
            elif now - asked.at > UNHEARD:
                late.append((name, due))
        return late

    def busy(self) -> bool:
        """Whether another survey would have to wait: all rigs are in use, or as much runs as may run at a time."""
        rigs: dict[Path | str, RigLock] = {}
        archives: set[Path] = set()
        for one in self.request.fields:
            with self._errors(one.name):
                lock = one.lock()
                rigs[lock.place] = lock
                archives.add(one.archive)
        looking = sum(self._is_in_use(lock) for lock in rigs.values())
        reprocessing = sum(self._is_reprocessed(archive) for archive in archives)
        return looking == len(rigs) or looking + reprocessing >= self.request.limit

    def _is_in_use(self, lock: RigLock) -> bool:
        with self._errors("the rig"):
            if not lock.take("a look at the schedule"):
                return True
            lock.release()
        return False

    def _is_reprocessed(self, archive: Path) -> bool:
        from flows.schedule.prefect_flows import REPROCESS_LOCK

        with self._errors("reprocess"):
            release = take_lock(archive / ".locks" / REPROCESS_LOCK, wait=False)
            if release is None:
                return True
            release()
        return False

    def look(self) -> bool:
        """Once over all fields: what is too late or dead is accounted for, and Prefect has a run of each due time.

        False where Prefect does not know of a field yet.
        """
        for one in self.request.fields:
            with self._errors(one.name):
                self._look_at(one, self.schedules[one.name])
        return all(runs.known for runs in self.runs.values())

    def _look_at(self, one: ServedField, schedule: FieldSchedule) -> None:
        resumed: list[datetime] = []
        free = self._alone(one, lambda: resumed.extend(schedule.reap(self._why)))
        waiting = schedule.pending(None if free else f"the rig was in use by {one.lock().holder()}")
        state, now = schedule.state(), schedule.clock.now()
        wanted = dict.fromkeys((*waiting, *_ahead(schedule.timetable, now)), 0)
        wanted |= {due: len(state.begun.get(due, ())) for due in resumed}
        self._note(one.name, wanted, now)
        cancelled: list[datetime] = []
        with self._errors("Prefect"), self.client_of() as client:
            cancelled = self.runs[one.name].settle(client, wanted, now, state.open.keys() - set(resumed))
        for due in sorted(set(cancelled) & {*waiting, *resumed}):
            schedule.end(due, "failed" if due in resumed else "skipped", CANCELLED)

    def _note(self, name: str, wanted: Mapping[datetime, int], now: datetime) -> None:
        """Which runs could begin from when on; one that was told of before is begun again."""
        for due, attempts in wanted.items():
            known = self.asked.get((name, due))
            if known is None or known.attempts < attempts:
                self.asked[name, due] = Asked(max(now, due), attempts)
                if attempts:
                    self.tell(f"{name}: the run due {due:%H:%M:%S} UTC is asked for again")
        for field_name, due in list(self.asked):
            if field_name == name and due not in wanted:
                del self.asked[name, due]

    def stop(self) -> None:
        """Take back what Prefect was to begin: nothing is due any more."""
        for name, runs in self.runs.items():
            with suppress(Exception), self.client_of() as client:
                runs.stop(client, self.schedules[name].clock.now())

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
                return CANCELLED
        return None

    def _reap_prefect(self, one: ServedField) -> None:
        with self.client_of() as client:
            for name in reap_flow_runs(client, one.name, None):
                self.tell(f"{one.name}: the flow run {name} was told as running and is gone: crashed")
        self._reap_reprocess(one)

    def _reap_reprocess(self, one: ServedField) -> None:
        from flows.schedule.prefect_flows import REPROCESS_LOCK

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


def _ahead(timetable: Timetable, now: datetime) -> list[datetime]:
    """The next due times: those of the next minute, and a few more for people to see."""
    coming = islice(timetable.due_after(now), MOST_AHEAD)
    return [due for number, due in enumerate(coming) if number < LEAST_AHEAD or due - now <= AHEAD]


def reap_flow_runs(client: Any, field: str | None, archive: str | None) -> list[str]:
    """Set flow runs that Prefect believes alive to Crashed; only for whoever holds their lock. Gives their names.

    Of the survey of ``field``, or of the reprocessing of ``archive``.
    """
    from prefect.client.schemas.filters import FlowFilter, FlowFilterName, FlowRunFilter, FlowRunFilterState
    from prefect.client.schemas.filters import FlowRunFilterStateType as StateFilter
    from prefect.client.schemas.objects import StateType
    from prefect.states import Crashed

    flow = FlowFilter(name=FlowFilterName(any_=["reprocess" if field is None else "survey"]))
    alive = FlowRunFilter(state=FlowRunFilterState(type=StateFilter(any_=[StateType.RUNNING, StateType.PENDING])))
    reaped: list[str] = []
    for run in client.read_flow_runs(flow_filter=flow, flow_run_filter=alive):
        if run.parameters.get("field" if field is not None else "archive") == (field if field is not None else archive):
            client.set_flow_run_state(run.id, Crashed(message="its process was gone: its lock is free"), force=True)
            reaped.append(run.name)
    return reaped


def _client() -> Any:
    from prefect.client.orchestration import get_client

    return get_client(sync_client=True)
