"""What looks after a schedule on Prefect: it skips and reaps by the ledgers, and plans one flow run a due time.

A server that is away is told of; what could not be done is done at the next look. Prefect's own scheduler is not used:
it makes runs of a new deployment late, and knows nothing of what the ledger has already.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from flows.schedule.due_runs import ScheduleNews, Tell, send_notice, together
from flows.schedule.field_schedule import FieldSchedule, moment_words, read_moment
from flows.schedule.rig_lock import RigLock
from flows.schedule.served import ServedField, ServeRequest
from pipeline.lazy import deferred
from storage.archive.staging import take_lock

if TYPE_CHECKING:
    import prefect.client.orchestration as prefect_client
    import prefect.client.schemas.filters as prefect_filters
    import prefect.client.schemas.objects as prefect_objects
    import prefect.exceptions as prefect_exceptions
    import prefect.states as prefect_states
else:
    prefect_client = deferred("prefect.client.orchestration")
    prefect_filters = deferred("prefect.client.schemas.filters")
    prefect_objects = deferred("prefect.client.schemas.objects")
    prefect_exceptions = deferred("prefect.exceptions")
    prefect_states = deferred("prefect.states")

LIMIT = "rig"  # a Prefect concurrency limit that shows who waits; the kernel's lock decides
REPROCESS_LOCK = "reprocess-flow.lock"
SKIPPED = "Skipped"  # the name of the state of what was taken back here, not by a person
MOST_RUNS = 200  # that wait, looked at in one go; the server gives no more
MOST_TRIES = 3  # flow runs of one due time that ended without a beginning in the ledger

AHEAD, LEAST_AHEAD, MOST_AHEAD = timedelta(minutes=1), 2, 12  # due times to come that stand in Prefect
UNHEARD = timedelta(minutes=2)
A_LOOK = "a look at the schedule"
CANCELLED = "it was cancelled in Prefect"


@dataclass
class FlowRuns:
    """The flow runs of one field, by the due times that they were made for."""

    name: str
    tries: dict[datetime, int] = field(default_factory=dict)
    known: bool = False  # to Prefect: the runner that was just started tells it of the field in some seconds

    def settle(
        self, client: Any, wanted: Mapping[datetime, int], now: datetime, spared: Collection[datetime] = ()
    ) -> list[datetime]:
        """Have a flow run for each due time that is wanted, by how often it was begun, and none for any other.

        Those of ``spared`` are neither made nor taken back. Gives the due times whose run somebody cancelled.
        """
        waiting = self._waiting(client)
        for due in waiting.keys() - wanted.keys() - set(spared):
            self._take_back(client, due, waiting[due], now, "it is accounted for already, or not served any more")
        self.tries = {due: number for due, number in self.tries.items() if due in wanted}
        missing = [due for due in wanted if due not in waiting and due not in spared]
        try:
            deployment = client.read_deployment_by_name(f"survey/{self.name}").id
        except prefect_exceptions.ObjectNotFound:
            self.known = False
            return []
        self.known = True
        return [due for due in missing if not self._plan(client, deployment, due, wanted[due])]

    def stop(self, client: Any, now: datetime) -> None:
        """Take back all that has not begun."""
        for due, runs in self._waiting(client).items():
            self._take_back(client, due, runs, now, "the schedule was stopped")

    def give_up(self, client: Any, due: datetime) -> None:
        """A due time's run whose process is gone before it began: another is made at the next look."""
        for run in self._waiting(client).get(due, []):
            if run.state is not None and run.state.is_pending():
                client.set_flow_run_state(run.id, prefect_states.Crashed(message="it never began"), force=True)

    def _plan(self, client: Any, deployment: Any, due: datetime, begun: int) -> bool:
        """Make a due time's flow run: asked again Prefect gives the same one. False where somebody cancelled it."""
        while (number := self.tries.setdefault(due, 0)) < MOST_TRIES:
            run = client.create_flow_run_from_deployment(
                deployment,
                parameters={"due": moment_words(due)},
                state=prefect_states.Scheduled(scheduled_time=due),
                name=f"survey-{self.name}",
                idempotency_key=f"{self.name} {moment_words(due)} {begun} {number}",
            )
            if run.state is None or not run.state.is_final():
                return True
            if run.state.is_cancelled() and run.state.name != SKIPPED:
                return False
            self.tries[due] = number + 1
        return True

    def _take_back(self, client: Any, due: datetime, runs: Iterable[Any], now: datetime, why: str) -> None:
        """No process is started for these any more. Of those to come nothing is left: they may be planned again."""
        for run in runs:
            if run.state is None or not run.state.is_scheduled():
                continue  # a process was started for it, and finds out by itself
            if due > now:
                client.delete_flow_run(run.id)
            else:
                client.set_flow_run_state(run.id, prefect_states.Cancelled(name=SKIPPED, message=why))

    def _waiting(self, client: Any) -> dict[datetime, list[Any]]:
        named = prefect_filters.DeploymentFilter(name=prefect_filters.DeploymentFilterName(any_=[self.name]))
        runs: dict[datetime, list[Any]] = {}
        for run in _read_runs(client, "survey", "SCHEDULED", "PENDING", deployment_filter=named):
            due = read_moment(run.parameters.get("due"))
            if due is None and run.auto_scheduled:  # an earlier version left it to Prefect
                due = run.expected_start_time
            if due is not None:
                runs.setdefault(due, []).append(run)
        return runs


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
        with self._errors("Prefect"), self.client_of() as client:
            client.upsert_global_concurrency_limit_by_name(LIMIT, 1)
        for one in self.request.fields:
            with self._errors(one.name):
                self._alone(one, lambda one=one: self._reap_prefect(one))  # type: ignore[misc]

    def tell_news(self) -> None:
        """Tell how runs ended since the last time, a line each; one notice for all that ended alike in a field."""
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
        looking = reprocessing = 0
        for lock in rigs.values():
            with self._errors("the rig"):
                looking += not lock.take(A_LOOK)
                lock.release()
        for archive in archives:
            with self._errors("reprocess"):
                release = take_lock(archive / ".locks" / REPROCESS_LOCK, wait=False)
                reprocessing += release is None
                if release is not None:
                    release()
        return looking == len(rigs) or looking + reprocessing >= self.request.limit

    def look(self) -> bool:
        """Account for what is too late or dead, plan due times in Prefect; False where it does not know a field yet."""
        for one in self.request.fields:
            with self._errors(one.name):
                self._look_at(one, self.schedules[one.name])
        return all(runs.known for runs in self.runs.values())

    def _look_at(self, one: ServedField, schedule: FieldSchedule) -> None:
        resumed: list[datetime] = []
        free = self._alone(one, lambda: resumed.extend(schedule.reap(self._why)))
        waiting = schedule.pending(None if free else f"the rig was in use by {one.lock().holder()}")
        state, now = schedule.state(), schedule.clock.now()
        coming = enumerate(islice(schedule.timetable.due_after(now), MOST_AHEAD))
        ahead = (due for number, due in coming if number < LEAST_AHEAD or due - now <= AHEAD)
        wanted = dict.fromkeys((*waiting, *ahead), 0)
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
        if not lock.take(A_LOOK):
            return False
        try:
            with self._errors(one.name):
                work()
        finally:
            lock.release()
        return True

    def _why(self, line: Mapping[str, Any]) -> str | None:
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
        release = take_lock(one.archive / ".locks" / REPROCESS_LOCK, wait=False)
        if release is not None:
            try:
                with self.client_of() as client:
                    reap_flow_runs(client, None, str(one.settings.out))
            finally:
                release()

    @contextmanager
    def _errors(self, what: str) -> Iterator[None]:
        """Tell of an error and go on: what is missed now is done at the next look."""
        try:
            yield
        except Exception as error:
            self.tell(f"{what}: {error}")


def reap_flow_runs(client: Any, field: str | None, archive: str | None) -> list[str]:
    """Crash runs that Prefect believes alive, of a field or an archive whose lock is held here; gives their names."""
    flow, parameter, value = ("reprocess", "archive", archive) if field is None else ("survey", "field", field)
    reaped: list[str] = []
    for run in _read_runs(client, flow, "RUNNING", "PENDING"):
        if run.parameters.get(parameter) == value:
            client.set_flow_run_state(
                run.id, prefect_states.Crashed(message="its process was gone: its lock is free"), force=True
            )
            reaped.append(run.name)
    return reaped


def _read_runs(client: Any, flow: str, *states: str, **filters: Any) -> list[Any]:
    named = prefect_filters.FlowFilter(name=prefect_filters.FlowFilterName(any_=[flow]))
    of_type = prefect_filters.FlowRunFilterState(
        type=prefect_filters.FlowRunFilterStateType(any_=[prefect_objects.StateType[state] for state in states])
    )
    runs: list[Any] = client.read_flow_runs(
        flow_filter=named, flow_run_filter=prefect_filters.FlowRunFilter(state=of_type), limit=MOST_RUNS, **filters
    )
    return runs


def _client() -> Any:
    return prefect_client.get_client(sync_client=True)
