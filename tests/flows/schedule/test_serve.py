"""Serving: what is refused before anything runs, schedules without a server, and artifacts."""

from __future__ import annotations

import base64
import io
import json
import os
import signal
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from flows.publish.survey_command import MOST_BYTES, artifact_key, savings_rows, small_jpeg, survey_markdown
from flows.schedule import serve_command
from flows.schedule import server as serve_prefect
from flows.schedule.due_runs import Outcome
from flows.schedule.rig_lock import RigLock
from flows.schedule.serve_command import alone_on, load_fields, serve_plain
from flows.schedule.served import ServedField, ServeRequest
from flows.schedule.times import parse_timetable
from flows.settings.survey_settings import Settings
from pipeline.errors import ArchiveError
from storage.archive.archive import Archive
from storage.archive.ledger import Ledger
from storage.remote.opening import verify_archive
from tests.flows.schedule.schedule_days import NOON, HandClock, field_schedule

pytestmark = pytest.mark.usefixtures("no_effects")

EVERY = parse_timetable(None, "20m", "UTC")


BAD = {
    "no fields": ((), "--every 30m", 2, "no fields: give the settings file of one or more"),
    "cron nonsense": (("north",), "--cron hourly", 2, "--cron 'hourly': expected five fields"),
    "no such file": (("nowhere",), "--every 30m", 2, "no settings file .*nowhere.toml"),
    "unknown key": (("typo",), "--every 30m", 2, "unknown setting 'sceene' in .*typo.toml; did you mean 'scene'"),
    "neither scene nor rig": (("blind",), "--every 30m", 2, "blind.toml says neither scene nor source = 'rig'"),
    "scene missing": (("gone",), "--every 30m", 1, "gone.toml: there is no file .*gone.png"),
    "twice": (("north", "north"), "--every 30m", 2, "are both called north"),
    "late": (("north",), "--every 30m --late 1.5", 2, "--late 1.5: expected a share of the interval"),
    "limit": (("north",), "--every 30m --limit 0", 2, "--limit 0: expected 1 or more"),
    "address": (("north",), "--every 30m --notify ftp://x", 2, "expected https://HOST/PATH"),
    "name": (("named",), "--every 30m", 2, "'name' in .*named.toml must be a name of letters, digits"),
}


@pytest.mark.parametrize("case", BAD)
def test_refused_before_anything_is_served(
    case: str, field_file: Callable[..., Path], tmp_path: Path, command_line: Any
) -> None:
    """One clear message and the right exit code; no archive and no server is left."""
    names, words, code, message = BAD[case]
    field_file("north")
    field_file("typo", lines='sceene = "x"')
    field_file("blind", scene=None)
    field_file("gone", scene="gone.png")
    field_file("named", name="../north")
    given = [word.strip("'").replace("_", " ") for word in words.split()]
    command_line("serve", *(tmp_path / f"{name}.toml" for name in names), *given).refused(code, message)
    assert not (tmp_path / "archive" / "schedule").exists()


def test_two_serves_on_one_archive(field_file: Callable[..., Path], command_line: Any) -> None:
    """The second is refused while the first serves, and not after it."""
    file = field_file()
    with alone_on(load_fields([file])):
        ended = command_line("serve", file, "--every", "30m", "--engine", "plain")
    ended.refused(1, "another serve works on the archive")
    fields = load_fields([field_file()])
    with alone_on(fields), pytest.raises(ArchiveError, match="another serve"), alone_on(fields):
        pass
    with alone_on(fields):
        pass


def test_two_serves_of_one_rig(field_file: Callable[..., Path], tmp_path: Path, command_line: Any) -> None:
    """Also with archives of their own the second is refused: a rig is served once."""
    port = f"/dev/ttyNONE{os.getpid()}"  # these tests may run twice on one machine
    rig = f'[rig]\nport = "{port}"\nhost = "192.0.2.1"\n'
    files = [field_file(name, out=str(tmp_path / name), source="rig") for name in ("north", "south")]
    for file in files:
        file.write_text(file.read_text() + rig)
    with alone_on(load_fields(files[:1])):
        ended = command_line("serve", files[1], "--every", "30m", "--engine", "plain")
    ended.refused(1, f"another serve uses the rig at {port}: give all its fields to that one")


@pytest.mark.parametrize(
    ("url", "words", "message"),
    [
        ("http://127.0.0.1:9/api", (), "no Prefect server answers at http://127.0.0.1:9/api, which PREFECT_"),
        ("", ("--port", 70000), "--port 70000 cannot be used"),
    ],
)
def test_a_server_that_cannot_be_had(
    url: str,
    words: Sequence[object],
    message: str,
    field_file: Callable[..., Path],
    command_line: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One message, before anything is said to be served; the field's ledger has no line."""
    monkeypatch.setenv("PREFECT_API_URL", url)
    file = field_file()
    ended = command_line("serve", file, "--every", "30m", *words)
    ended.refused(2, message.replace(" ", r"\s+"))
    assert "serving" not in ended.err
    assert load_fields([file])[0].schedule(EVERY, 0.5).ledger.lines() == []


def test_a_ledger_that_cannot_be_written_at_the_start(
    field_file: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is served on Prefect, and no field is left as if it were."""
    request = ServeRequest(fields=load_fields([field_file("north"), field_file("south")]), timetable=EVERY, late=0.5)
    append = Ledger.append

    def refuse(self: Ledger, line: Mapping[str, Any]) -> None:
        if self.field == "south":
            raise ArchiveError("the disk is full")
        append(self, line)

    monkeypatch.setattr(Ledger, "append", refuse)
    monkeypatch.setattr(serve_prefect, "server_for", lambda home, port: nullcontext())
    with pytest.raises(ArchiveError, match="the disk is full"):
        serve_prefect.serve_prefect(request, lambda words: None)
    assert [line["event"] for line in request.schedules()["north"].ledger.lines()] == ["opened", "closed"]


def test_sigterm_stops_a_schedule(
    field_file: Callable[..., Path], command_line: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That is the way to stop it, and no error: it says how to go on, and ends with 0."""

    def terminated(*given: Any, **named: Any) -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        pytest.fail("SIGTERM was not heard")

    monkeypatch.setattr(serve_command, "serve_plain", terminated)
    ended = command_line("serve", field_file(), "--every", "30m", "--engine", "plain")
    assert (ended.code, ended.errors) == (0, [])
    assert ended.err.splitlines()[-1].startswith("stopped: nothing is due any more; the same command serves again")


def test_fields_are_asked_for_by_archive_and_day(field_file: Callable[..., Path], tmp_path: Path) -> None:
    """One archive given for all wins; each due time is a visit, and the farm is as on that day."""
    files = [field_file("north"), field_file("south", out=str(tmp_path / "other"))]
    assert [Path(one.settings.out).name for one in load_fields(files)] == ["archive", "other"]
    given = str(tmp_path / "all")
    assert {one.settings.out for one in load_fields(files, given)} == {given}
    due = datetime(2026, 2, 1, 23, 30, tzinfo=UTC)
    one = ServedField("farm", Path("farm.toml"), Settings(scene="farm@2"))
    berlin = parse_timetable("30 0 * * *", None, "Europe/Berlin")
    asked = one.settings_of(due, berlin)
    assert (asked.name, asked.visit, asked.day) == ("farm", "2026-02-01T23:30:00Z", 33)
    assert asked.prior == "latest"  # a field that is served is remembered, unless its file says otherwise
    alone = ServedField("farm", Path("farm.toml"), Settings(scene="farm@2", prior="none"))
    assert alone.settings_of(due, berlin).prior == "none"
    fixed = ServedField("farm", Path("farm.toml"), Settings(scene="farm@2", day=172))
    assert fixed.settings_of(due, berlin).day == 172
    rig = ServedField("farm", Path("farm.toml"), Settings(scene="farm@2", source="rig"))
    assert rig.settings_of(due, berlin).day is None  # what stands before a rig is as it is


def test_plain_serving_needs_no_server(
    field_file: Callable[..., Path], command_line: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Its surveys run without one too, whatever the fields' files say or leave out."""
    engines: list[str] = []

    def served(schedules: Any, locks: Any, survey: Callable[..., Path], *_: Any, **named: Any) -> None:
        survey("north", NOON)

    def surveyed(one: ServedField, *_: Any) -> Path:
        engines.append(one.settings.engine)
        return tmp_path

    monkeypatch.setattr(serve_command, "serve_plain", served)
    monkeypatch.setattr(serve_command, "survey_field", surveyed)
    ended = command_line("serve", field_file("north", engine="prefect"), "--every", "30m", "--engine", "plain")
    assert (ended.code, engines) == (0, ["plain"])


def test_plain_serving_surveys_fields_in_turn_and_each_visit_anew(
    field_file: Callable[..., Path], tmp_path: Path, survey_png: Any
) -> None:
    """Two fields, two due times: four published runs, each with light of its own, and ledgers that name them."""
    fields = {one.name: one for one in load_fields([field_file("north"), field_file("south")])}
    clock = HandClock()
    schedules = {name: one.schedule(EVERY, 0.5, clock) for name, one in fields.items()}

    def survey(name: str, due: datetime) -> Path:
        asked = fields[name].settings_of(due, EVERY)
        return Path(survey_png(tmp_path / "archive", name=name, visit=asked.visit).folder)

    serve_plain(
        schedules,
        {name: one.lock() for name, one in fields.items()},
        survey,
        lambda words: None,
        clock=clock,
        until=NOON + timedelta(minutes=41),
    )
    archive = Archive.open(tmp_path / "archive")
    assert [path.name.split("-")[1] for path in archive.runs()] == ["north", "south", "north", "south"]
    for name, schedule in schedules.items():
        lines = schedule.ledger.lines()
        assert [line["event"] for line in lines] == ["opened", "begun", "done", "begun", "done", "closed"], name
        assert all((archive.root / line["run"]).is_dir() for line in lines if line["event"] == "done")
    receipts = [json.loads((path / "receipt.json").read_text()) for path in archive.runs()]
    assert (
        len({receipt["products"]["raw_coarse"] for receipt in receipts}) == 2
    )  # one for each visit: here both fields are one scene
    assert [finding for finding in verify_archive(archive) if finding.problem] == []


def test_the_picture_of_an_artifact_is_small(survey_png: Any, tmp_path: Path) -> None:
    """At most 100 KiB in the text, whatever the picture; the text has the receipt's figures and where the report is."""
    noise = np.random.default_rng(0).integers(0, 256, (1500, 2000, 3), dtype=np.uint8)
    file = io.BytesIO()
    Image.fromarray(noise).save(file, "PNG")
    assert len(base64.b64encode(small_jpeg(file.getvalue()))) <= MOST_BYTES
    published = survey_png(tmp_path)
    text = survey_markdown(published, "archive/runs/x")
    assert "data:image/jpeg;base64," in text
    assert "archive/runs/x/report.html" in text
    assert all(row["cost"] in text for row in savings_rows(published.receipt))
    assert artifact_key("North_field 7") == "north-field-7"


def refuse(monkeypatch: pytest.MonkeyPatch, field: str, event: str) -> None:
    """Let the disk refuse one kind of line of one field."""
    real = Ledger.append

    def append(self: Ledger, line: dict[str, object]) -> None:
        if (self.field, line["event"]) == (field, event):
            raise ArchiveError("the disk is full")
        real(self, line)

    monkeypatch.setattr(Ledger, "append", append)


def test_what_waited_too_long_for_another_field_is_told_with_its_reason(tmp_path: Path) -> None:
    """One line a run, with how it ended: also where it was too late as its turn came."""
    clock, told, noted = HandClock(), list[str](), list[Outcome]()
    schedules = {name: field_schedule(tmp_path, clock, name) for name in ("north", "south")}
    lock = RigLock(tmp_path / "rig.lock")

    def survey(field: str, due: datetime) -> Path:
        clock.sleep(11 * 60)
        return tmp_path / "run"

    serve_plain(
        schedules,
        dict.fromkeys(schedules, lock),
        survey,
        told.append,
        clock=clock,
        note=noted.append,
        until=NOON + timedelta(minutes=35),
    )
    assert told == [
        "north, due 2026-06-01 12:20:00 UTC, done: runs/run",
        "south, due 2026-06-01 12:20:00 UTC, skipped: it could not begin in time (noted 11.0 min after it was due)",
    ]
    assert [(one.field, one.ending) for one in noted] == [("north", "done"), ("south", "skipped")]


def test_an_ending_from_elsewhere_is_told(tmp_path: Path) -> None:
    """A run that could not be resumed here, and that another process ended in the same look, is told as that."""
    clock, told, due = HandClock(), list[str](), NOON + timedelta(minutes=20)
    schedules = {name: field_schedule(tmp_path, clock, name, late=1.0) for name in ("south", "north", "west")}
    locks, other = {name: RigLock(tmp_path / name) for name in schedules}, RigLock(tmp_path / "north")

    def survey(field: str, due: datetime) -> Path:
        if field == "south":
            assert other.take("another process")
        elif field == "west":
            schedules["north"].end(due, "failed", "no reply")
        return tmp_path / "run"

    schedules["north"].open()
    clock.moment = due
    schedules["north"].begin(due)
    for name in ("south", "west"):
        schedules[name].open(due)
    serve_plain(schedules, locks, survey, told.append, clock=clock, until=due + timedelta(minutes=20))
    other.release()
    assert told == [
        "south, due 2026-06-01 12:20:00 UTC, done: runs/run",
        "north, due 2026-06-01 12:20:00 UTC, was not begun here",
        "west, due 2026-06-01 12:20:00 UTC, done: runs/run",
        "north, due 2026-06-01 12:20:00 UTC, failed: no reply",
    ]


def test_a_schedule_that_cannot_be_closed_is_told_of_and_the_others_are_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Serving ends as it was asked to; the field whose ledger refuses is named."""
    clock, told = HandClock(), list[str]()
    schedules = {name: field_schedule(tmp_path, clock, name) for name in ("north", "south")}
    locks = dict.fromkeys(schedules, RigLock(tmp_path / "rig.lock"))
    refuse(monkeypatch, "north", "closed")
    serve_plain(schedules, locks, lambda *given: tmp_path, told.append, clock=clock, until=NOON + timedelta(minutes=1))
    assert {name: schedule.state().serving for name, schedule in schedules.items()} == {"north": True, "south": False}
    assert told == ["north: the disk is full"]


def test_a_schedule_that_cannot_be_opened_leaves_none_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is served then: those that were opened before it are closed, and the message is the disk's."""
    clock = HandClock()
    schedules = {name: field_schedule(tmp_path, clock, name) for name in ("north", "south", "west")}
    locks = dict.fromkeys(schedules, RigLock(tmp_path / "rig.lock"))
    refuse(monkeypatch, "south", "opened")
    with pytest.raises(ArchiveError, match="the disk is full"):
        serve_plain(schedules, locks, lambda *given: tmp_path, lambda words: None, clock=clock)
    assert [line["event"] for line in schedules["north"].ledger.lines()] == ["opened", "closed"]
    assert not any(schedules[name].ledger.lines() for name in ("south", "west"))
