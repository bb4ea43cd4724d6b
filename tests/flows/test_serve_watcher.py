"""The watcher of a schedule on Prefect, without a server: what it asks for, resumes, tells, and leaves alone."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
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
    fields = load_fields([field_file("north"), field_file("south", out=str(tmp_path / "other"))])
    schedules = {one.name: one.schedule(EVERY, 0.9, clock) for one in fields}
    for schedule in schedules.values():
        schedule.open()
    request = ServeRequest(fields=fields, timetable=EVERY, late=0.9)
    watch = Watcher(request, schedules, lambda words: None, lambda: nullcontext(client))
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
