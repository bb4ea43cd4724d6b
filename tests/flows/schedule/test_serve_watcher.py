"""The watcher of a schedule on Prefect, without a server: what it asks for, resumes, tells, and leaves alone."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack, nullcontext
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from prefect.exceptions import ObjectNotFound
from prefect.states import Cancelled, Completed, Pending, Running, State

from flows.schedule import watcher as serve_watcher
from flows.schedule.due_runs import Outcome
from flows.schedule.field_schedule import FieldSchedule, moment_words
from flows.schedule.serve_command import load_fields
from flows.schedule.served import ServedField, ServeRequest
from flows.schedule.times import parse_timetable
from flows.schedule.watcher import Watcher
from pipeline.errors import ArchiveError
from storage.archive.archive import Archive
from storage.archive.ledger import Ledger
from storage.archive.staging import take_lock
from tests.flows.schedule.schedule_days import NOON, HandClock

BUSY = {(1, 1, 0), (1, 0, 1), (2, 1, 1), (2, 2, 0), (3, 2, 0), (2, 0, 2)}  # limit, surveys, reprocessings
EVERY = parse_timetable(None, "20m", "UTC")


class AClient:
    """Stands for a Prefect client and its server: keeps flow runs, one for each idempotency key."""

    def __init__(self, state: str = "CRASHED") -> None:
        self.runs: dict[str, SimpleNamespace] = {}
        self.asked: list[str] = []  # due times for which a run was made, in turn
        self.known = True
        self._state = state

    def read_deployment_by_name(self, name: str) -> SimpleNamespace:
        """A deployment, once the runner has told of it."""
        if not self.known:
            raise ObjectNotFound(RuntimeError(name))
        return SimpleNamespace(id=name)

    def create_flow_run_from_deployment(
        self, deployment: str, *, parameters: dict[str, Any], state: State, name: str, idempotency_key: str
    ) -> SimpleNamespace:
        """A new run, or the one that was made by that key."""
        if idempotency_key not in self.runs:
            known = {"id": idempotency_key, "deployment": deployment, "parameters": parameters, "state": state}
            self.runs[idempotency_key] = SimpleNamespace(**known, auto_scheduled=False)
            self.asked.append(parameters["due"])
        return self.runs[idempotency_key]

    def read_flow_runs(self, deployment_filter: Any, **filters: Any) -> list[SimpleNamespace]:
        """Runs of a field that wait or are pending."""
        (name,) = deployment_filter.name.any_
        waiting = [run for run in self.runs.values() if run.deployment == f"survey/{name}"]
        return [run for run in waiting if run.state.is_scheduled() or run.state.is_pending()]

    def set_flow_run_state(self, run: str, state: State, force: bool = False) -> None:
        """Set it."""
        self.runs[run].state = state

    def delete_flow_run(self, run: str) -> None:
        """Forget it."""
        del self.runs[run]

    def read_flow_run(self, known: str) -> SimpleNamespace:
        """A run in the state given."""
        return SimpleNamespace(state=SimpleNamespace(type=SimpleNamespace(value=self._state)))

    def waits(self, name: str = "north") -> list[str]:
        """Due times of the runs of a field that no process was started for, in order."""
        found = [run for run in self.runs.values() if run.deployment == f"survey/{name}" and run.state.is_scheduled()]
        return sorted(run.parameters["due"] for run in found)

    def run_of(self, due: str) -> SimpleNamespace:
        """The newest run of a due time."""
        return [run for run in self.runs.values() if run.parameters["due"] == due][-1]


def watcher(file: Path, state: str = "CRASHED") -> tuple[HandClock, AClient, Watcher, FieldSchedule, ServedField]:
    """A watcher of one field, with its schedule open since noon, and its clock and client."""
    clock, client = HandClock(), AClient(state)
    (one,) = load_fields([file])
    schedule = one.schedule(EVERY, 0.5, clock)
    schedule.open()
    request = ServeRequest(fields=[one], timetable=EVERY, late=0.5)
    watch = Watcher(request, {one.name: schedule}, lambda words: None, lambda: nullcontext(client))
    return clock, client, watch, schedule, one


def two_rigs(
    field_file: Callable[..., Path], tmp_path: Path, clock: HandClock, client: AClient, limit: int = 1
) -> tuple[Watcher, dict[str, FieldSchedule]]:
    """A watcher of two fields with an archive and a rig each."""
    fields = load_fields([field_file("north"), field_file("south", out=str(tmp_path / "other"))])
    schedules = {one.name: one.schedule(EVERY, 0.9, clock) for one in fields}
    for schedule in schedules.values():
        schedule.open()
    request = ServeRequest(fields=fields, timetable=EVERY, late=0.9, limit=limit)
    return Watcher(request, schedules, lambda words: None, lambda: nullcontext(client)), schedules


def test_each_due_time_has_one_run_ahead_of_it(field_file: Callable[..., Path]) -> None:
    """However often it is looked, and whoever looks: no due time is asked for twice, none is left out."""
    clock, client, watch, schedule, _ = watcher(field_file())
    for _ in range(3 * 60 * 4):
        clock.sleep(15)
        watch.look()
        due = clock.now().replace(second=0)
        if due.minute % 20 == 0 and due > NOON:
            schedule.begin(due)
            schedule.end(due, "done")
            client.run_of(moment_words(due)).state = Completed()
        other = Watcher(watch.request, watch.schedules, watch.tell, watch.client_of)
        other.look()
    expected = [moment_words(NOON + timedelta(minutes=20 * number)) for number in range(1, 12)]
    assert client.asked == expected
    assert client.waits() == expected[-2:]


def test_what_is_accounted_for_is_taken_back(field_file: Callable[..., Path]) -> None:
    """A run that was skipped by rule has no process started for it any more, and says why; others stay."""
    clock, client, watch, _, _ = watcher(field_file())
    watch.look()
    clock.sleep(31 * 60)
    watch.look()
    skipped = client.run_of("2026-06-01T12:20:00Z")
    assert (skipped.state.type.value, skipped.state.name) == ("CANCELLED", "Skipped")
    assert client.waits() == ["2026-06-01T12:40:00Z", "2026-06-01T13:00:00Z"]
    assert len(client.asked) == len(set(client.asked)) == 3


def test_a_run_under_way_is_left_alone(field_file: Callable[..., Path]) -> None:
    """While its rig is held, neither its own run nor one that waits for the rig is taken back or made again."""
    clock, client, watch, schedule, one = watcher(field_file())
    watch.look()
    clock.sleep(20 * 60)
    lock = one.lock()
    assert lock.take("a survey")
    client.run_of("2026-06-01T12:20:00Z").state = Pending()
    schedule.begin(clock.now(), flow_run="abc")
    clock.sleep(60)
    watch.look()
    assert client.run_of("2026-06-01T12:20:00Z").state.is_pending()
    assert len(client.asked) == 3
    lock.release()


def test_a_run_that_somebody_cancelled_is_skipped(field_file: Callable[..., Path]) -> None:
    """On Prefect's pages, before it began: the ledger says so when it is due, and it is not made again."""
    clock, client, watch, schedule, _ = watcher(field_file())
    watch.look()
    client.run_of("2026-06-01T12:20:00Z").state = Cancelled()
    clock.sleep(10 * 60)
    watch.look()
    assert [line["event"] for line in schedule.ledger.lines()] == ["opened"]
    clock.sleep(10 * 60)
    watch.look()
    line = schedule.ledger.lines()[-1]
    assert (line["event"], line["due"], line["reason"]) == (
        "skipped",
        "2026-06-01T12:20:00Z",
        "it was cancelled in Prefect",
    )


@pytest.mark.parametrize("stopped", [1, 5])
def test_a_schedule_that_is_stopped_leaves_nothing_to_begin(field_file: Callable[..., Path], stopped: int) -> None:
    """However often it is stopped and served again, what is due next has a run."""
    _, client, watch, _, _ = watcher(field_file())
    for _ in range(stopped):
        watch.look()
        watch.stop()
        assert client.waits() == []
    watch.look()
    assert client.waits() == ["2026-06-01T12:20:00Z", "2026-06-01T12:40:00Z"]


def test_a_field_that_prefect_does_not_know_yet(field_file: Callable[..., Path]) -> None:
    """The runner tells of it some seconds after its start: nothing is told, and the next look comes soon."""
    (_, client, watch, _, _), told = watcher(field_file()), list[str]()
    watch.tell, client.known = told.append, False
    assert not watch.look()
    client.known = True
    assert watch.look()
    assert (told, len(client.asked)) == ([], 2)


@pytest.mark.parametrize(("state", "resumed"), [("CRASHED", True), ("CANCELLED", False)])
def test_a_crashed_run_is_resumed_a_cancelled_one_is_not(
    field_file: Callable[..., Path], state: str, resumed: bool
) -> None:
    """While its lock is held it lives; when that is free it is asked for again, unless somebody cancelled it."""
    clock, client, watch, schedule, one = watcher(field_file(), state)
    clock.sleep(20 * 60)
    lock = one.lock()
    assert lock.take("a survey")
    schedule.begin(clock.now(), flow_run="abc")
    clock.sleep(60)
    watch.look()
    assert client.asked.count("2026-06-01T12:20:00Z") == 0
    lock.release()
    watch.look()
    assert bool(client.asked.count("2026-06-01T12:20:00Z")) is resumed
    assert bool(schedule.state().open) is resumed
    if not resumed:
        assert schedule.ledger.lines()[-1]["reason"] == "it was cancelled in Prefect"


def test_a_runner_that_has_something_to_do_is_left_alone(field_file: Callable[..., Path], tmp_path: Path) -> None:
    """With one survey at a time, what waits for another rig's survey is not unheard."""
    clock, client = HandClock(), AClient()
    watch, _ = two_rigs(field_file, tmp_path, clock, client)
    fields, request = watch.request.fields, watch.request
    watch.look()
    clock.sleep(23 * 60)
    watch.look()
    south = fields[1].lock()
    assert south.take("a survey")
    assert not watch.unheard()
    assert not replace(watch, request=replace(request, limit=2)).busy()
    south.release()
    assert watch.unheard()


def test_notice_is_given_of_whatever_the_ledger_says(
    field_file: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also of a due time that nobody began and of a run that died: once each, in the words of the terminal."""
    (clock, _, watch, schedule, _), told, noted = watcher(field_file()), list[str](), []
    watch.tell, watch.request = told.append, replace(watch.request, notify="http://127.0.0.1:9/")

    def note(address: str | None, outcome: Outcome, archive: str) -> bool:
        noted.append((address, outcome.ending, outcome.words()))
        return True

    monkeypatch.setattr(serve_watcher, "send_notice", note)
    clock.sleep(20 * 60)
    schedule.begin(clock.now())
    clock.sleep(35 * 60)
    watch.look()
    watch.tell_news()
    watch.tell_news()
    assert [(address, ending) for address, ending, _ in noted] == [
        ("http://127.0.0.1:9/", "failed"),
        ("http://127.0.0.1:9/", "skipped"),
    ]
    assert told == [words for _, _, words in noted]
    assert "its process was gone before it ended" in told[0]
    assert "it could not begin in time" in told[1]


def test_a_server_that_is_away_is_told_of(field_file: Callable[..., Path]) -> None:
    """What it could not be asked for it is asked for at the next look."""
    (clock, client, watch, _, _), told = watcher(field_file()), list[str]()
    watch.tell, here = told.append, watch.client_of

    def away() -> Any:
        raise OSError("connection refused")

    watch.client_of = away
    clock.sleep(20 * 60 + 60)
    watch.look()
    assert told == ["Prefect: connection refused"]
    watch.client_of = here
    watch.look()
    assert client.waits()[0] == "2026-06-01T12:20:00Z"


@pytest.mark.parametrize("begins", [True, False])
def test_what_has_begun_is_not_unheard(field_file: Callable[..., Path], begins: bool) -> None:
    """Two minutes after it was due, what has not begun is told of once; a process that is gone is given up."""
    clock, client, watch, schedule, _ = watcher(field_file())
    watch.look()
    clock.sleep(20 * 60)
    due = clock.now()
    client.run_of(moment_words(due)).state = Pending()
    if begins:
        schedule.begin(due)
    clock.sleep(120)
    assert not watch.unheard()
    clock.sleep(1)
    assert watch.unheard() is not begins
    assert not watch.unheard()
    if not begins:
        assert client.run_of(moment_words(due)).state.is_crashed()
        watch.look()
        assert client.asked.count(moment_words(due)) == 2
        assert client.waits()[0] == moment_words(due)


def test_a_resumed_run_is_heard_when_it_begins_again(field_file: Callable[..., Path]) -> None:
    """That it had begun once, before it was asked for, is no sign of life; that it was skipped or failed is the end."""
    (clock, client, watch, schedule, _), told = watcher(field_file()), list[str]()
    watch.tell = told.append
    clock.sleep(20 * 60)
    due = clock.now()
    for _ in range(2):
        schedule.begin(due)
        watch.look()
        client.run_of(moment_words(due)).state = Running()
    assert told == ["north: the run due 12:20:00 UTC is asked for again"] * 2
    assert client.asked.count(moment_words(due)) == 2
    clock.sleep(121)
    assert watch.unheard()
    watch.look()
    schedule.begin(due)
    clock.sleep(121)
    assert not watch.unheard()
    schedule.end(due, "failed", "no reply")
    watch.look()
    assert due not in [known for _, known in watch.asked]


def test_a_field_that_cannot_be_read_is_told_of_and_the_others_go_on(
    field_file: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A ledger that cannot be read, or an archive that is away, ends neither a look nor what is asked of the others."""
    clock, client, told = HandClock(), AClient(), list[str]()
    watch, schedules = two_rigs(field_file, tmp_path, clock, client)
    watch.tell = told.append
    clock.sleep(21 * 60)
    watch.look()
    clock.sleep(121)
    north = schedules["north"].ledger.path
    lines = Ledger.lines

    def refuse(self: Ledger) -> list[dict[str, Any]]:
        if self.path == north:
            raise ArchiveError("cannot read the ledger")
        return lines(self)

    monkeypatch.setattr(Ledger, "lines", refuse)
    assert watch.unheard()
    clock.sleep(20 * 60)
    watch.look()
    watch.tell_news()
    assert {words for words in told if words.startswith("north")} == {"north: cannot read the ledger"}
    assert (client.waits("north")[-1], client.waits("south")[-1]) == ("2026-06-01T13:00:00Z", "2026-06-01T13:20:00Z")
    monkeypatch.undo()
    opened = Archive.open

    def away(location: str, **options: Any) -> Archive:
        if location == watch.request.fields[0].settings.out:
            raise ArchiveError("the archive is away")
        return opened(location, **options)

    monkeypatch.setattr(Archive, "open", away)
    del told[:]
    assert not watch.busy()
    clock.sleep(20 * 60)
    watch.look()
    assert (client.waits("north")[-1], client.waits("south")[-1]) == ("2026-06-01T13:00:00Z", "2026-06-01T13:40:00Z")
    watch.prepare()
    assert "north: the archive is away" in told


@pytest.mark.parametrize(
    ("limit", "looking", "reprocessing"),
    [
        (1, 0, 0),
        (1, 1, 0),
        (1, 0, 1),
        (2, 1, 0),
        (2, 0, 1),
        (2, 1, 1),
        (2, 2, 0),
        (3, 1, 1),
        (3, 2, 0),
        (3, 0, 2),
        (2, 0, 2),
    ],
)
def test_who_would_have_to_wait(
    field_file: Callable[..., Path], tmp_path: Path, limit: int, looking: int, reprocessing: int
) -> None:
    """A survey waits where all rigs are in use, or as much runs, reprocessing included, as may run at a time."""
    from flows.schedule.watcher import REPROCESS_LOCK

    watch, _ = two_rigs(field_file, tmp_path, HandClock(), AClient(), limit)
    with ExitStack() as held:
        for one in watch.request.fields[:looking]:
            lock = one.lock()
            assert lock.take("a survey")
            held.callback(lock.release)
        for one in watch.request.fields[:reprocessing]:
            release = take_lock(one.archive / ".locks" / REPROCESS_LOCK, wait=False)
            assert release is not None
            held.callback(release)
        assert watch.busy() is ((limit, looking, reprocessing) in BUSY)


def test_after_an_outage_there_is_one_notice(field_file: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """Every due time that was missed is told, and one notice counts them."""
    (clock, _, watch, _, _), told, noted = watcher(field_file()), list[str](), list[str]()
    watch.tell = told.append
    monkeypatch.setattr(serve_watcher, "send_notice", lambda address, outcome, archive: noted.append(outcome.words()))
    clock.sleep(33 * 3600 + 15 * 60)
    watch.look()
    watch.tell_news()
    assert len(told) == 99
    assert [words.split(",")[1] for words in noted] == [
        " 99 due between 2026-06-01 12:20:00 and 2026-06-02 21:00:00 UTC"
    ]
