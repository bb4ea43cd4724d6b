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

from flows import serve_watcher
from flows.field_schedule import FieldSchedule
from flows.schedule_runs import Outcome
from flows.schedule_times import parse_timetable
from flows.serve_fields import ServedField, load_fields
from flows.serve_request import ServeRequest
from flows.serve_watcher import Watcher
from pipeline.errors import ArchiveError
from storage.archive import Archive
from storage.ledger import Ledger
from storage.staging import take_lock
from tests.flows.schedule_days import NOON, HandClock

EVERY = parse_timetable(None, "20m", "UTC")


class AClient:
    """Stands for a Prefect client: keeps what it was asked for."""

    def __init__(self, state: str = "CRASHED") -> None:
        self.asked: list[dict[str, Any]] = []
        self._state = state

    def read_deployment_by_name(self, name: str) -> SimpleNamespace:
        """A deployment."""
        return SimpleNamespace(id=name)

    def create_flow_run_from_deployment(self, deployment: str, parameters: dict[str, Any]) -> None:
        """Note it."""
        self.asked.append({"deployment": deployment, **parameters})

    def read_flow_run(self, known: str) -> SimpleNamespace:
        """A run in the state given."""
        return SimpleNamespace(state=SimpleNamespace(type=SimpleNamespace(value=self._state)))


def watcher(file: Path, clock: HandClock, client: AClient) -> tuple[Watcher, FieldSchedule, ServedField]:
    """A watcher of one field, with its schedule open."""
    (one,) = load_fields([file])
    schedule = one.schedule(EVERY, 0.5, clock)
    schedule.open()
    request = ServeRequest(fields=[one], timetable=EVERY, late=0.5)
    return (
        Watcher(request, {one.name: schedule}, lambda words: None, lambda: nullcontext(client)), schedule, one
    )  # fmt: skip


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


def test_what_prefect_did_not_start_is_asked_for_once(field_file: Callable[..., Path]) -> None:
    """After a grace a due run that nobody began is asked for by name and due time, and not again at every look."""
    clock, client = HandClock(), AClient()
    watch, _, _ = watcher(field_file(), clock, client)
    clock.sleep(20 * 60 + 10)
    assert watch.look() == []
    clock.sleep(60)
    assert watch.look() == [("north", NOON + timedelta(minutes=20))]
    clock.sleep(30)
    assert watch.look() == []
    assert [(one["deployment"], one["due"]) for one in client.asked] == [("survey/north", "2026-06-01T12:20:00Z")]


@pytest.mark.parametrize(("state", "resumed"), [("CRASHED", True), ("CANCELLED", False)])
def test_a_crashed_run_is_resumed_a_cancelled_one_is_not(
    field_file: Callable[..., Path], state: str, resumed: bool
) -> None:
    """While its lock is held it lives; when that is free it is asked for again, unless somebody cancelled it."""
    clock, client = HandClock(), AClient(state)
    watch, schedule, one = watcher(field_file(), clock, client)
    clock.sleep(20 * 60)
    lock = one.lock()
    assert lock.take("a survey")
    schedule.begin(clock.now(), flow_run="abc")
    clock.sleep(60)
    assert watch.look() == []
    lock.release()
    assert bool(watch.look()) is resumed
    assert bool(schedule.state().open) is resumed
    if not resumed:
        assert schedule.ledger.lines()[-1]["reason"] == "it was cancelled in Prefect"


def test_nothing_is_asked_for_while_the_only_place_is_taken(field_file: Callable[..., Path], tmp_path: Path) -> None:
    """With one survey at a time, another rig's survey or a reprocessing is waited for, and its runner is left alone."""
    from flows.serve_flow import REPROCESS_LOCK

    clock, client = HandClock(), AClient()
    watch, _ = two_rigs(field_file, tmp_path, clock, client)
    fields, request = watch.request.fields, watch.request
    clock.sleep(22 * 60)
    south = fields[1].lock()
    assert south.take("a survey")
    assert watch.look() == []
    south.release()
    reprocessing = take_lock(fields[1].archive / ".locks" / REPROCESS_LOCK, wait=False)
    assert reprocessing is not None
    assert watch.look() == []
    reprocessing()
    assert sorted(name for name, _ in watch.look()) == ["north", "south"]
    clock.sleep(120)
    assert south.take("a survey")
    assert not watch.unheard()
    assert not replace(watch, request=replace(request, limit=2)).busy()
    south.release()
    assert watch.unheard()


def test_notice_is_given_of_whatever_the_ledger_says(
    field_file: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also of a due time that nobody began and of a run that died: once each, in the words of the terminal."""
    clock, noted = HandClock(), []
    told: list[str] = []
    watch, schedule, _ = watcher(field_file(), clock, AClient())
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
        ("http://127.0.0.1:9/", "failed"), ("http://127.0.0.1:9/", "skipped"),
    ]  # fmt: skip
    assert told == [words for _, _, words in noted]
    assert "its process was gone before it ended" in told[0]
    assert "it could not begin in time" in told[1]


def test_prefect_is_given_a_grace_and_asked_again_after_a_while(field_file: Callable[..., Path]) -> None:
    """45 s for its own scheduler; what it was asked for and did not begin it is asked for again after 3 min."""
    clock, client = HandClock(), AClient()
    watch, _, _ = watcher(field_file(), clock, client)
    asked: list[float] = []
    for after in (0, 44, 45, 46, 60, 200, 224, 225, 226, 404, 405, 420):  # seconds after it was due
        clock.moment = NOON + timedelta(minutes=20, seconds=after)
        asked += [after] * len(watch.look())
    assert asked == [45, 225, 405]
    assert len(client.asked) == 3


def test_of_short_intervals_less_grace_is_given(field_file: Callable[..., Path]) -> None:
    """Every minute a run may wait for 30 s: after 10 s it is asked for, and can still begin."""
    clock, client = HandClock(), AClient()
    (one,) = load_fields([field_file()])
    minutely = parse_timetable(None, "1m", "UTC")
    schedule = one.schedule(minutely, 0.5, clock)
    schedule.open()
    request = ServeRequest(fields=[one], timetable=minutely, late=0.5)
    watch = Watcher(request, {one.name: schedule}, lambda words: None, lambda: nullcontext(client))
    asked: list[float] = []
    for after in (0, 5, 9, 10, 20):
        clock.moment = NOON + timedelta(minutes=1, seconds=after)
        asked += [after] * len(watch.look())
    assert asked == [10]


def test_a_server_that_is_away_was_not_asked(field_file: Callable[..., Path]) -> None:
    """It is told of, asked at the next look, and the runner is not started again for what nobody was asked for."""
    clock, client = HandClock(), AClient()
    told: list[str] = []
    watch, _, _ = watcher(field_file(), clock, client)
    watch.tell, here = told.append, watch.client_of

    def away() -> Any:
        raise OSError("connection refused")

    watch.client_of = away
    clock.sleep(20 * 60 + 60)
    assert watch.look() == []
    assert told == ["Prefect: connection refused"]
    clock.sleep(90)
    assert not watch.unheard()
    watch.client_of = here
    assert watch.look() == [("north", NOON + timedelta(minutes=20))]
    assert len(client.asked) == 1


@pytest.mark.parametrize("begins", [True, False])
def test_what_has_begun_is_not_unheard(field_file: Callable[..., Path], begins: bool) -> None:
    """A minute after it was asked for, what has not begun is told of once; what has is forgotten."""
    clock = HandClock()
    watch, schedule, _ = watcher(field_file(), clock, AClient())
    clock.sleep(20 * 60 + 60)
    ((_, due),) = watch.look()
    if begins:
        schedule.begin(due)
    clock.sleep(60)
    assert not watch.unheard()
    clock.sleep(1)
    assert watch.unheard() is not begins
    assert watch.asked == {}
    assert not watch.unheard()


def test_a_resumed_run_is_heard_when_it_begins_again(field_file: Callable[..., Path]) -> None:
    """That it had begun once, before it was asked for, is no sign of life; that it was skipped or failed is the end."""
    clock = HandClock()
    watch, schedule, _ = watcher(field_file(), clock, AClient())
    clock.sleep(20 * 60)
    due = clock.now()
    schedule.begin(due)
    clock.sleep(60)
    assert watch.look() == [("north", due)]
    clock.sleep(61)
    assert watch.unheard()
    assert watch.look() == [("north", due)]
    schedule.begin(due)
    clock.sleep(61)
    assert not watch.unheard()
    assert watch.look() == [("north", due)]
    schedule.end(due, "failed", "no reply")
    clock.sleep(61)
    assert not watch.unheard()
    assert watch.asked == {}


def test_a_field_that_cannot_be_read_is_told_of_and_the_others_go_on(
    field_file: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A ledger that cannot be read, or an archive that is away, ends neither a look nor what is asked of the others."""
    clock, client, told = HandClock(), AClient(), list[str]()
    watch, schedules = two_rigs(field_file, tmp_path, clock, client)
    watch.tell = told.append
    clock.sleep(21 * 60)
    assert [name for name, _ in watch.look()] == ["north", "south"]
    clock.sleep(61)
    north = schedules["north"].ledger.path
    lines = Ledger.lines

    def refuse(self: Ledger) -> list[dict[str, Any]]:
        if self.path == north:
            raise ArchiveError("cannot read the ledger")
        return lines(self)

    monkeypatch.setattr(Ledger, "lines", refuse)
    assert watch.unheard()
    assert [name for name, _ in watch.look()] == ["south"]
    watch.tell_news()
    assert set(told[2:]) == {
        "north: cannot read the ledger", "south: the run due 12:20:00 UTC is asked for again",
    }  # fmt: skip
    monkeypatch.undo()
    clock.sleep(181)
    opened = Archive.open

    def away(location: str, **options: Any) -> Archive:
        if location == watch.request.fields[0].settings.out:
            raise ArchiveError("the archive is away")
        return opened(location, **options)

    monkeypatch.setattr(Archive, "open", away)
    del told[:]
    assert not watch.busy()
    assert [name for name, _ in watch.look()] == ["south"]
    watch.prepare()
    assert "north: the archive is away" in told


@pytest.mark.parametrize(
    ("limit", "looking", "reprocessing", "busy"),
    [
        (1, 0, 0, False), (1, 1, 0, True), (1, 0, 1, True), (2, 1, 0, False), (2, 0, 1, False), (2, 1, 1, True),
        (2, 2, 0, True), (3, 1, 1, False), (3, 2, 0, True), (3, 0, 2, False), (2, 0, 2, True),
    ],
)  # fmt: skip
def test_who_would_have_to_wait(
    field_file: Callable[..., Path], tmp_path: Path, limit: int, looking: int, reprocessing: int, busy: bool
) -> None:
    """A survey waits where all rigs are in use, or as much runs, reprocessing included, as may run at a time."""
    from flows.serve_flow import REPROCESS_LOCK

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
        assert watch.busy() is busy


def test_a_field_whose_rig_is_in_use_is_not_asked_for(field_file: Callable[..., Path], tmp_path: Path) -> None:
    """It waits for its rig, though another field's may be surveyed beside it."""
    clock = HandClock()
    watch, _ = two_rigs(field_file, tmp_path, clock, AClient(), limit=2)
    clock.sleep(21 * 60)
    lock = watch.request.fields[0].lock()
    assert lock.take("a survey by hand")
    assert [name for name, _ in watch.look()] == ["south"]
    lock.release()
    assert [name for name, _ in watch.look()] == ["north"]


def test_after_an_outage_there_is_one_notice(field_file: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """Every due time that was missed is told, and one notice counts them."""
    clock, told, noted = HandClock(), list[str](), list[str]()
    watch, _, _ = watcher(field_file(), clock, AClient())
    watch.tell = told.append
    monkeypatch.setattr(serve_watcher, "send_notice", lambda address, outcome, archive: noted.append(outcome.words()))
    clock.sleep(33 * 3600 + 15 * 60)
    watch.look()
    watch.tell_news()
    assert len(told) == 99
    assert [words.split(",")[1] for words in noted] == [
        " 99 due between 2026-06-01 12:20:00 and 2026-06-02 21:00:00 UTC"
    ]
