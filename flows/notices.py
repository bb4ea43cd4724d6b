"""Telling somebody elsewhere that a run failed or was skipped: off unless an address was given, and never needed."""

from __future__ import annotations

import json
import urllib.request
from contextlib import suppress
from urllib.parse import urlsplit

from flows.schedule_runs import Outcome
from flows.schedule_state import moment_words
from pipeline.errors import SettingsError

PATIENCE_S = 5.0
TOLD = ("failed", "skipped")


def check_address(address: str | None) -> str | None:
    """The address itself, if a notice can be posted to it (SettingsError)."""
    parts = urlsplit(address or "http://none")
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise SettingsError(f"--notify {address!r} is no address; expected https://HOST/PATH")
    return address


def send_notice(address: str | None, outcome: Outcome, archive: str) -> bool:
    """Post one JSON object for a run that failed or was skipped; False where nothing was sent, for whatever reason."""
    if address is None or outcome.ending not in TOLD:
        return False
    content = {
        "text": outcome.words(), "field": outcome.field, "due": moment_words(outcome.due), "ending": outcome.ending,
        "reason": outcome.reason, "archive": archive,
    }  # fmt: skip
    request = urllib.request.Request(
        address, json.dumps(content).encode(), {"Content-Type": "application/json"}, method="POST"
    )
    with suppress(OSError, ValueError), urllib.request.urlopen(request, timeout=PATIENCE_S):
        return True
    return False
