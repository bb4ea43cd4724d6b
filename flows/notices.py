"""Telling somebody elsewhere that runs failed or were skipped: off unless an address was given, and never needed."""

from __future__ import annotations

import json
import urllib.request
from contextlib import suppress
from http.client import HTTPException
from urllib.parse import urlsplit

from flows.schedule_news import Several
from flows.schedule_runs import Outcome
from flows.schedule_state import moment_words
from pipeline.errors import SettingsError

PATIENCE_S = 5.0
TOLD = ("failed", "skipped")


def check_address(address: str | None) -> str | None:
    """The address itself, if a notice can be posted to it (SettingsError)."""
    if address is not None and not _can_be_asked(address):
        raise SettingsError(f"--notify {address!r} is no address; expected https://HOST/PATH")
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
        "text": outcome.words(), "field": outcome.field, "due": moment_words(outcome.due), "ending": outcome.ending,
        "reason": outcome.reason, "archive": archive, "count": 1, **several,
    }  # fmt: skip
    request = urllib.request.Request(
        address, json.dumps(content).encode(), {"Content-Type": "application/json"}, method="POST"
    )
    with suppress(OSError, ValueError, HTTPException), urllib.request.urlopen(request, timeout=PATIENCE_S):
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
