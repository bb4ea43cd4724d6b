"""One due run of a field (wait for the rig, survey, note how it ended), and what is told of runs here and elsewhere."""

from __future__ import annotations

import json
import os
import urllib.request
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from http.client import HTTPException
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from flows.schedule.field_schedule import Ending, FieldSchedule, moment_words, read_moment, read_state
from flows.schedule.rig_lock import RigLock
from pipeline.errors import NothingToMend, PipelineError, SettingsError

Survey = Callable[[str, datetime], Path]  # field and due time in, the folder of the published run out
Tell = Callable[[str], None]  # one line for the operator


@dataclass(frozen=True)
class Outcome:
    """What became of a due run; ``ending`` is None where it has none of its own in the ledger."""

    field: str
    due: datetime
    ending: Ending | None
    reason: str | None = None
    run: str | None = None
    error: BaseException | None = None

    def words(self) -> str:
        told = self.ending or "was not begun here"
        more = f": {self.reason}" if self.reason else f": {self.run}" if self.run else ""
        return f"{self.field}, due {self.due:%Y-%m-%d %H:%M:%S} UTC, {told}{more}"


def outcome_of(field: str, due: datetime, line: Mapping[str, Any]) -> Outcome:
    """What a line of the ledger says became of a due run."""
    return Outcome(field, due, line.get("event"), line.get("reason"), line.get("run"))


def run_due(
    schedule: FieldSchedule, due: datetime, lock: RigLock, survey: Survey, *, facts: Mapping[str, object] | None = None
) -> Outcome:
    """Run one due survey, or skip it where the rig is not free in time, and note how it ended.

    A process that dies in it, and an operator's interruption, leave a beginning without an end: the next process that
    looks resumes the run or notes that it failed. Raises ArchiveError: the ledger cannot be written;
    `FieldSchedule.reap` accounts for the run later.
    """
    latest = schedule.timetable.latest_start(due, schedule.late)
    resumed = due in schedule.state().open
    if resumed:  # its time to begin is over: until the next is due
        latest = due + schedule.timetable.interval(due)
    words = f"{schedule.field}, due {due:%H:%M:%S} UTC"
    if not lock.wait(latest, schedule.clock, words):
        if resumed:
            return _as_noted(schedule, due)
        reason = f"the rig was in use by {lock.holder()} until it was too late to begin"
        return _end(schedule, due, "skipped", reason)
    try:
        if schedule.begin(due, **(facts or {})) is None:
            return _as_noted(schedule, due)
        return _survey(schedule, due, survey)
    finally:
        lock.release()


def _survey(schedule: FieldSchedule, due: datetime, survey: Survey) -> Outcome:
    started = schedule.clock.now()
    try:
        folder = survey(schedule.field, due)
    except NothingToMend as said:
        return _end(schedule, due, "done", str(said), run=f"runs/{said.run}", seconds=0.0)
    except PipelineError as error:
        return _end(schedule, due, "failed", str(error), error=error)
    except OSError as error:
        return _end(schedule, due, "failed", f"{error}; check the machine and its disks", error=error)
    except Exception as error:
        reason = f"{type(error).__name__}: {error}; this is a defect of SpectralZoom, please report it"
        return _end(schedule, due, "failed", reason, error=error)
    seconds = round((schedule.clock.now() - started).total_seconds(), 3)
    return _end(schedule, due, "done", run=f"runs/{folder.name}", seconds=seconds)


def _end(
    schedule: FieldSchedule,
    due: datetime,
    ending: Ending,
    reason: str | None = None,
    *,
    run: str | None = None,
    seconds: float | None = None,
    error: BaseException | None = None,
) -> Outcome:
    if not schedule.end(due, ending, reason, run=run, seconds=seconds):
        return _as_noted(schedule, due)
    return Outcome(schedule.field, due, ending, reason, run, error)


def _as_noted(schedule: FieldSchedule, due: datetime) -> Outcome:
    """What the ledger says of a run that ended otherwise than here."""
    return outcome_of(schedule.field, due, schedule.state().ended.get(due, {}))


def run_all(
    schedules: Mapping[str, FieldSchedule], lock_of: Callable[[str], RigLock], survey: Survey, tell: Tell
) -> list[Outcome]:
    """Resume what died, skip what is too late, run what is due, field by field; one without a ledger waits, told of."""
    outcomes: list[Outcome] = []
    waiting = [(due, name) for name in schedules for due in _to_run(schedules[name], lock_of(name), tell)]
    for due, name in sorted(waiting, key=lambda one: one[0]):  # of one due time, fields in the order given
        try:
            outcome = run_due(schedules[name], due, lock_of(name), survey)
        except PipelineError as error:
            tell(f"{name}: {error}")
            continue
        outcomes.append(outcome)
        tell(outcome.words())
    return outcomes


def _to_run(schedule: FieldSchedule, lock: RigLock, tell: Tell) -> list[datetime]:
    """Runs to resume, where the rig is free and tells that they died, and runs that are due."""
    try:
        if not lock.take(schedule.field):
            return schedule.pending(f"the rig was in use by {lock.holder()}")
        try:
            return [*schedule.reap(), *schedule.pending()]
        finally:
            lock.release()
    except PipelineError as error:
        tell(f"{schedule.field}: {error}")
        return []


@dataclass(frozen=True, kw_only=True)
class Several(Outcome):
    """Due runs of a field that ended alike, from ``since`` to ``due``; ``count`` is None where too many to count."""

    since: datetime
    count: int | None

    def words(self) -> str:
        """In one line."""
        number = "very many" if self.count is None else self.count
        span = f"{self.since:%Y-%m-%d %H:%M:%S} and {self.due:%Y-%m-%d %H:%M:%S} UTC"
        return f"{self.field}, {number} due between {span}, {self.ending}: {self.reason}"


@dataclass
class ScheduleNews:
    """Endings that a ledger did not have before. What it has when this is made, or was first readable, is no news."""

    schedules: Mapping[str, FieldSchedule]
    refused: Callable[[str, PipelineError], None]  # told of a field whose ledger cannot be read
    _known: dict[str, set[datetime]] = field(default_factory=dict)
    _passed: dict[str, int] = field(default_factory=dict)  # lines for very many due times

    def __post_init__(self) -> None:
        self.fresh()

    def fresh(self) -> list[Outcome]:
        return [outcome for name, schedule in self.schedules.items() for outcome in self._of(name, schedule)]

    def _of(self, name: str, schedule: FieldSchedule) -> list[Outcome]:
        try:
            lines = schedule.ledger.lines()
        except PipelineError as error:
            self.refused(name, error)
            return []
        ended, passed = read_state(lines).ended, [line for line in lines if line.get("event") == "passed"]
        known, told = self._known.get(name), self._passed.get(name, 0)
        self._known[name], self._passed[name] = set(ended), len(passed)
        if known is None:
            return []
        many = [found for line in passed[told:] if (found := _several(name, line)) is not None]
        return [*many, *(outcome_of(name, due, ended[due]) for due in sorted(set(ended) - known))]


def together(outcomes: Iterable[Outcome]) -> list[Outcome]:
    """The same with one for all runs of a field that ended alike: after an outage there are very many."""
    alike: dict[tuple[str, str | None], list[Outcome]] = {}
    for outcome in outcomes:
        alike.setdefault((outcome.field, outcome.ending), []).append(outcome)
    return [_as_one(same) for same in alike.values()]


def _as_one(outcomes: Sequence[Outcome]) -> Outcome:
    if len(outcomes) == 1:
        return outcomes[0]
    last = max(outcomes, key=lambda one: one.due)
    counts = [one.count if isinstance(one, Several) else 1 for one in outcomes]
    return Several(
        last.field,
        last.due,
        last.ending,
        f"the last one: {last.reason}",
        since=min(one.since if isinstance(one, Several) else one.due for one in outcomes),
        count=None if None in counts else sum(filter(None, counts)),
    )


def _several(name: str, line: Mapping[str, Any]) -> Several | None:
    """What a line for very many due times says; None where none was left to be accounted for."""
    after, until, count = read_moment(line.get("after")), read_moment(line.get("until")), line.get("count")
    if after is None or until is None or count == 0:
        return None
    number = count if isinstance(count, int) else None
    return Several(name, until, "skipped", str(line.get("reason")), since=after, count=number)


PATIENCE_S = 5.0
TOLD = ("failed", "skipped")
NAMED_BY = "SPECTRALZOOM_NOTIFY"  # the environment variable that may hold the address


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    """A notice goes where it was sent, and nowhere else: not to a port of this machine that the answer names."""

    def redirect_request(self, *answer: object) -> None:
        """Follow none: the answer is an error."""


def notice_address(given: str | None) -> str | None:
    """Where notices go: an address, or one in the file that was given, or in SPECTRALZOOM_NOTIFY; None without any.

    What stands on a command line can be read in the process list: an address that holds a token belongs in a file.
    Raises SettingsError: it is no address that can be posted to, or there is no such file.
    """
    named = os.environ.get(NAMED_BY) or None
    if given is None:
        return None if named is None else _checked(named, f"{NAMED_BY} is no address")
    if "://" in given or not given:
        return _checked(given, f"--notify {given!r} is no address")
    try:
        text = Path(given).read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise SettingsError(
            f"--notify {given!r} is no address and no file that holds one ({error}); expected https://HOST/PATH"
        ) from error
    return _checked(text.strip(), f"--notify: what stands in {given} is no address")


def _checked(address: str, otherwise: str) -> str:
    try:
        parts = urlsplit(address)
        known = parts.scheme in ("http", "https") and parts.hostname and parts.port != 0 and "@" not in parts.netloc
    except ValueError:
        known = False
    if not known or not address.isprintable() or any(character.isspace() for character in address):
        raise SettingsError(f"{otherwise}; expected https://HOST/PATH")
    return address


def send_notice(address: str | None, outcome: Outcome, archive: str) -> bool:
    """Post one JSON object for a run, or several, that failed or were skipped.

    False where nothing was sent, for whatever reason. ``count`` is how many there are, null where too many to count;
    ``due`` and ``reason`` are of the last, and with several ``since`` is when they began to be due.
    """
    if address is None or outcome.ending not in TOLD:
        return False
    several = {"count": outcome.count, "since": moment_words(outcome.since)} if isinstance(outcome, Several) else {}
    content = {
        "text": outcome.words(),
        "field": outcome.field,
        "due": moment_words(outcome.due),
        "ending": outcome.ending,
        "reason": outcome.reason,
        "archive": archive,
        "count": 1,
        **several,
    }
    request = urllib.request.Request(
        address, json.dumps(content).encode(), {"Content-Type": "application/json"}, method="POST"
    )
    opener = urllib.request.build_opener(_NoRedirects)
    with suppress(OSError, ValueError, HTTPException), opener.open(request, timeout=PATIENCE_S):
        return True
    return False
