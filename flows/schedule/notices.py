"""What has become known of due runs since the last look: told here, and sent elsewhere where an address was given."""

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

from flows.schedule.due_runs import Outcome, outcome_of
from flows.schedule.field_schedule import FieldSchedule, moment_words, read_moment, read_state
from pipeline.errors import PipelineError, SettingsError


@dataclass(frozen=True, kw_only=True)
class Several(Outcome):
    """Due runs of a field that ended alike. ``due`` is the last one's, ``since`` the first one's or shortly before it.

    ``count`` is None where there are too many to count.
    """

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
        """How due runs ended since the last time, field after field."""
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

    Raises
    ------
    SettingsError : it is no address that can be posted to, or there is no such file.
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
