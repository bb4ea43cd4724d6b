"""Telling somebody elsewhere that runs failed or were skipped: off unless an address was given, and never needed."""

from __future__ import annotations

import json
import os
import urllib.request
from contextlib import suppress
from http.client import HTTPException
from pathlib import Path
from urllib.parse import urlsplit

from flows.schedule.due_runs import Outcome
from flows.schedule.ledger_state import moment_words
from flows.schedule.news import Several
from pipeline.errors import SettingsError

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
    if not _can_be_asked(address):
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


def _can_be_asked(address: str) -> bool:
    if not address.isprintable() or any(character.isspace() for character in address):
        return False
    try:
        parts = urlsplit(address)
        port = parts.port
    except ValueError:
        return False
    return parts.scheme in ("http", "https") and bool(parts.hostname) and port != 0 and "@" not in parts.netloc
