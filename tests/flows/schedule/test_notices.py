"""Notices: of trouble only, one for what ended alike, to an address that can be asked, and never needed."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from flows.schedule.due_runs import NAMED_BY, Outcome, ScheduleNews, Several, notice_address, send_notice, together
from flows.schedule.rig_lock import RigLock
from flows.schedule.serve_command import serve_plain
from pipeline.errors import PipelineError, SettingsError
from tests.flows.schedule.schedule_days import NOON, HandClock, field_schedule, opened

LATER = NOON + timedelta(hours=33)


@contextmanager
def listening(code: int = 204, elsewhere: str = "") -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """An address on this machine that answers with a code, and what was posted to it or asked."""
    posted: list[dict[str, Any]] = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            posted.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.do_GET()

        def do_GET(self) -> None:  # as what follows a redirect of a POST asks
            if self.command == "GET":
                posted.append({"asked": self.path})
            self.send_response(code)
            self.send_header("Location", elsewhere)
            self.end_headers()

        def log_message(self, *words: object) -> None:
            pass

    server = HTTPServer(("127.0.0.1", 0), Handler)
    thread = Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}/", posted
    server.shutdown()
    server.server_close()
    thread.join()


@pytest.fixture
def listener() -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """An address that takes notices."""
    with listening() as one:
        yield one


def test_notices_are_of_trouble_only_and_never_needed(listener: tuple[str, list[dict[str, Any]]]) -> None:
    """Failed and skipped runs are posted where an address was given; one that does not answer is nothing."""
    address, posted = listener
    failed, done = Outcome("north", NOON, "failed", "no reply"), Outcome("north", NOON, "done")
    assert send_notice(address, failed, "archive")
    assert not send_notice(address, done, "archive")
    assert not send_notice(None, failed, "archive")
    assert not send_notice("http://127.0.0.1:9/", failed, "archive")
    assert [(one["field"], one["ending"], one["reason"]) for one in posted] == [("north", "failed", "no reply")]


@pytest.fixture
def stranger() -> Iterator[str]:
    """An address where something answers that speaks another protocol."""
    listener = socket.create_server(("127.0.0.1", 0))

    def answer() -> None:
        while True:
            try:
                line, _ = listener.accept()
            except OSError:
                return
            with line:
                line.recv(4096)
                line.sendall(b"SSH-2.0-OpenSSH_9.6\r\n")

    thread = Thread(target=answer)
    thread.start()
    yield f"http://127.0.0.1:{listener.getsockname()[1]}/"
    listener.shutdown(socket.SHUT_RDWR)
    listener.close()
    thread.join()


def test_who_speaks_another_protocol_does_not_answer(stranger: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A notice to it is lost without a word; a Prefect server that is none is refused in one message."""
    assert not send_notice(stranger, Outcome("north", NOON, "failed", "no reply"), "archive")
    from flows.schedule.server import server_for

    for url in (stranger, "http://127.0.0.1:port/api"):
        monkeypatch.setenv("PREFECT_API_URL", url)
        with pytest.raises(SettingsError, match="no Prefect server answers at"), server_for(Path("none"), 0):
            pass


@pytest.mark.parametrize(
    "address",
    [
        "http://127.0.0.1:port/x",
        "http://127.0.0.1/hook 1",
        "http://127.0.0.1/hook\t1",
        "http://127.0.0.1/hook\x7f",
        "http://127.0.0.1:0/",
        "http://127.0.0.1:99999/",
        "http://[::1/",
        "https://user:word@127.0.0.1/",
        "https://",
        "ftp://127.0.0.1/",
        "",
        "\nhttp://127.0.0.1/",
    ],
)
def test_an_address_that_cannot_be_asked_is_refused(address: str) -> None:
    """A port that is none, blanks, control characters, a password: notices to it would be lost without a word."""
    with pytest.raises(SettingsError, match="is no address; expected https://HOST/PATH"):
        notice_address(address)


@pytest.mark.parametrize("address", [None, "http://127.0.0.1:8080/hook?key=1", "https://[::1]/", "https://a.example"])
def test_an_address_that_can_be_asked(address: str | None) -> None:
    """None is an address, too: nobody's."""
    assert notice_address(address) == address


def test_an_address_may_stand_in_a_file_or_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No process list shows it then, nor does the message that refuses it; the flag wins over the environment."""
    file = tmp_path / "notify"
    file.write_text("https://a.example/token\n")
    assert notice_address(str(file)) == "https://a.example/token"
    monkeypatch.setenv(NAMED_BY, "https://b.example/token")
    assert (notice_address(None), notice_address(str(file))) == ("https://b.example/token", "https://a.example/token")
    file.write_text("token, no address")
    with pytest.raises(SettingsError, match=r"what stands in .*notify is no address") as refused:
        notice_address(str(file))
    assert "token" not in str(refused.value)
    with pytest.raises(SettingsError, match="no file that holds one"):
        notice_address(str(tmp_path / "none"))


@pytest.mark.parametrize("code", [301, 302, 303, 307, 308])
def test_a_notice_follows_no_redirect(listener: tuple[str, list[dict[str, Any]]], code: int) -> None:
    """An answer that names another address, such as a port of this machine, has nothing posted or asked there."""
    with listening(code, listener[0]) as (address, asked):
        sent = send_notice(f"{address}hook", Outcome("north", NOON, "failed", "no reply"), "archive")
    assert (sent, len(asked), listener[1]) == (False, 1, [])


def test_what_ended_alike_is_one_notice_that_counts(listener: tuple[str, list[dict[str, Any]]]) -> None:
    """For each field and ending; what ended alone is as it was, counts as one, and keeps its reason."""
    address, posted = listener
    outcomes = [Outcome("north", NOON + timedelta(hours=number), "skipped", "too late") for number in range(2)]
    for outcome in (outcomes[0], *together(outcomes)):
        assert send_notice(address, outcome, "archive")
    lone, several = posted
    assert (lone["count"], "since" in lone) == (1, False)
    assert lone.keys() < several.keys()
    assert (several["count"], several["since"], several["due"]) == (2, "2026-06-01T12:00:00Z", "2026-06-01T13:00:00Z")
    skipped = [Outcome("north", NOON + timedelta(hours=number), "skipped", f"late by {number}") for number in range(3)]
    failed, other = Outcome("north", NOON, "failed", "no reply"), Outcome("south", NOON, "skipped", "too late")
    many, one, two = together([*skipped[:2], failed, skipped[2], other])
    assert (one, two) == (failed, other)
    assert isinstance(many, Several)
    assert (many.count, many.since, many.due, many.ending) == (3, NOON, NOON + timedelta(hours=2), "skipped")
    assert many.words() == (
        "north, 3 due between 2026-06-01 12:00:00 and 2026-06-01 14:00:00 UTC, skipped: the last one: late by 2"
    )


def test_an_outage_is_one_notice_and_the_next_run_does_not_wait(tmp_path: Path) -> None:
    """After 33 hours without power every due time is accounted for, and one notice says how many were skipped."""
    clock, noted = HandClock(), list[Outcome]()
    schedule = field_schedule(tmp_path, clock)
    schedule.open()
    clock.sleep(33 * 3600)
    serve_plain(
        {"north": schedule},
        {"north": RigLock(tmp_path / "lock")},
        lambda name, due: tmp_path / "run",
        lambda words: None,
        clock=clock,
        note=noted.append,
        until=LATER + timedelta(minutes=1),
    )
    notices = [one for one in noted if one.ending != "done"]
    assert [(type(one), one.ending) for one in notices] == [(Several, "skipped")]
    assert "north, 98 due between 2026-06-01 12:20:00 and 2026-06-02 20:40:00 UTC, skipped" in notices[0].words()


@pytest.mark.parametrize(("hours", "count"), [(100, 300), (10**6, None)])
def test_very_many_due_times_are_news(tmp_path: Path, hours: int, count: int | None) -> None:
    """What has one line in the ledger for very many due times is told as that, once."""
    clock, refused = HandClock(), list[PipelineError]()
    schedule = field_schedule(tmp_path, clock)
    schedule.open()
    news = ScheduleNews({"north": schedule}, lambda name, error: refused.append(error))
    clock.sleep(hours * 3600 + 15 * 60)
    schedule.pending()
    (outcome,) = news.fresh()
    assert isinstance(outcome, Several)
    assert (outcome.count, outcome.since, outcome.ending) == (count, NOON, "skipped")
    told = "very many" if count is None else str(count)
    assert f"north, {told} due between 2026-06-01 12:00:00 and " in outcome.words()
    assert (
        together([outcome, Outcome("north", NOON, "skipped", "too late")])[0]
        .words()
        .startswith(f"north, {told if count is None else count + 1} due between")
    )
    assert news.fresh() == []
    assert ScheduleNews({"north": schedule}, lambda name, error: refused.append(error)).fresh() == []
    assert refused == []


def test_a_line_for_no_due_time_is_no_news(tmp_path: Path) -> None:
    """Nothing is told where all that passed had been accounted for, or of a line that cannot be understood."""
    _, schedule = opened(tmp_path)
    news = ScheduleNews({"north": schedule}, lambda name, error: None)
    passed = {"event": "passed", "at": "2026-06-01T12:00:00Z", "after": "2026-06-01T12:00:00Z", "count": 0}
    schedule.ledger.append({**passed, "until": "2026-06-01T13:00:00Z"})
    schedule.ledger.append({**passed, "count": 3})
    assert news.fresh() == []
