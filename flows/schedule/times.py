"""When surveys are due: by cron or every so often, in a time zone; until when a late one may still begin; the clock."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from cronsim import CronSim, CronSimError

from pipeline.errors import SettingsError

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
LEAST, MOST = timedelta(seconds=10), timedelta(days=366)
UNITS_S = {"s": 1, "min": 60, "m": 60, "h": 3600, "d": 86400}


@dataclass(frozen=True)
class Timetable:
    """Due times, one of ``cron`` and ``every`` given. Made by `parse_timetable`, which checks it.

    ``every`` counts from the first second of 1970 (UTC): due times do not depend on when a schedule began. Where
    clocks are set forward or back, ``cron`` does as Debian's: what falls into the lost hour runs right after it, and
    what falls into the doubled hour runs once, but for hours and minutes that are ``*``.
    """

    cron: str | None = None
    every: timedelta | None = None
    timezone: str = "UTC"

    @cached_property
    def zone(self) -> ZoneInfo:
        return ZoneInfo(self.timezone)

    def due_after(self, moment: datetime) -> Iterator[datetime]:
        """Due times later than a moment, in UTC, rising; ends where there are none."""
        if self.every is not None:
            number = (moment - EPOCH) // self.every
            while True:
                number += 1
                yield EPOCH + number * self.every
        last = moment
        try:
            for found in CronSim(str(self.cron), moment.astimezone(self.zone)):
                due = found.astimezone(UTC)
                if due > last:
                    last = due
                    yield due
        except (CronSimError, OverflowError):
            return

    def due_between(self, after: datetime, until: datetime) -> Iterator[datetime]:
        for due in self.due_after(after):
            if due > until:
                return
            yield due

    def next_after(self, moment: datetime) -> datetime | None:
        return next(self.due_after(moment), None)

    def interval(self, due: datetime) -> timedelta:
        """From a due time to the next; a day after the last."""
        following = self.next_after(due)
        return timedelta(days=1) if following is None else following - due

    def latest_start(self, due: datetime, late: float) -> datetime:
        """Until when the run of a due time may begin; ``late`` is a share of the interval."""
        return due + late * self.interval(due)

    def words(self) -> str:
        return f'cron "{self.cron}" ({self.timezone})' if self.every is None else f"every {every_words(self.every)}"

    def to_dict(self) -> dict[str, Any]:
        """Plain values for the ledger; `read_timetable` reads them back."""
        every = None if self.every is None else self.every.total_seconds()
        return {"cron": self.cron, "every_s": every, "timezone": self.timezone}


def parse_timetable(cron: str | None, every: str | None, timezone: str | None = None) -> Timetable:
    """Check what was given of a schedule; SettingsError: not exactly one of both, or it, or the time zone, is none."""
    if (cron is None) == (every is None):
        got = "neither" if cron is None else "both"
        raise SettingsError(f"a schedule needs --cron or --every, got {got}; such as --every 30m or --cron '0 6 * * *'")
    zone = _zone(timezone)
    if every is not None:
        return Timetable(every=parse_every(every), timezone=zone)
    found = Timetable(cron=_cron(str(cron)), timezone=zone)
    if found.next_after(datetime.now(UTC)) is None:
        raise SettingsError(f"--cron {cron!r} is never due; expected five fields: minute hour day month weekday")
    return found


def read_timetable(content: Mapping[str, Any]) -> Timetable | None:
    """A timetable from the ledger; None where it is none that can be read."""
    try:
        every, zone = content.get("every_s"), str(content.get("timezone", "UTC"))
        if every is not None:
            return parse_timetable(None, exact_words(timedelta(seconds=float(every))), zone)
        return parse_timetable(content.get("cron"), None, zone)
    except (SettingsError, TypeError, ValueError, OverflowError):
        return None


def parse_every(text: str) -> timedelta:
    """A time such as 90s, 30m, 2h or 1d (SettingsError)."""
    found = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*(s|min|m|h|d)\s*", text)
    if found is None:
        raise SettingsError(f"--every {text!r}: expected a number and s, m, h or d, such as 30m")
    span = timedelta(seconds=min(float(found[1]) * UNITS_S[found[2]], 1e9))
    if not LEAST <= span <= MOST:
        raise SettingsError(f"--every {text!r}: expected {every_words(LEAST)} to {every_words(MOST)}")
    return span


def every_words(span: timedelta) -> str:
    """A span in the largest unit that it is a whole number of."""
    for unit in ("d", "h", "m"):
        number, rest = divmod(span, timedelta(seconds=UNITS_S[unit]))
        if not rest:
            return f"{number}{unit}"
    return exact_words(span)


def exact_words(span: timedelta) -> str:
    """A span in seconds, for `parse_every`: nothing of it is rounded."""
    return f"{span.total_seconds():.6f}".rstrip("0").rstrip(".") + "s"


def _cron(text: str) -> str:
    if len(text.split()) != 5:
        raise SettingsError(
            f"--cron {text!r}: expected five fields, minute hour day month weekday, got {len(text.split())}; such as "
            "'0 6 * * *', at six every day"
        )
    try:
        CronSim(text, datetime.now(UTC))
    except CronSimError as error:
        raise SettingsError(f"--cron {text!r}: {error}; expected such as '*/30 6-20 * * *'") from None
    return " ".join(text.split())


def _zone(name: str | None) -> str:
    """A time zone's name: the one given, or this machine's, or UTC."""
    given = name or os.environ.get("TZ", "").lstrip(":")
    if not name and (not given or given.startswith("/")):
        place = Path("/etc/localtime")
        parts = place.resolve().parts if place.is_symlink() else ()
        given = "/".join(parts[parts.index("zoneinfo") + 1 :]) if "zoneinfo" in parts else "UTC"
    try:
        ZoneInfo(given)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        raise SettingsError(f"--timezone {given!r} is no time zone; expected such as Europe/Berlin, or UTC") from None
    return given


class WallClock(Protocol):
    """The time of day, which may jump."""

    def now(self) -> datetime:
        """The moment, with its zone."""

    def sleep(self, seconds: float) -> None:
        """Let time pass. [s]"""


@dataclass(frozen=True)
class SystemWallClock:
    """The machine's clock."""

    def now(self) -> datetime:
        return datetime.now(UTC)

    def sleep(self, seconds: float) -> None:
        """Wait; nothing for a time that is not above 0. [s]"""
        if seconds > 0:
            time.sleep(seconds)
