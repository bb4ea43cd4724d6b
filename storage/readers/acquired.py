"""Find in a file's own words when its light was captured: tags of TIFF and EXIF, ENVI fields, attributes of arrays."""

from __future__ import annotations

import re
from collections.abc import Mapping
from datetime import UTC, date, datetime, time, timedelta
from typing import NamedTuple

import numpy as np

# whole keys without case and signs, in order of trust; the first with a day counts, and any of them may add the time
NAMES = (
    *("acquisitiondatetime", "acquisitionstarttime", "acquisitiontime", "acquisitiondate", "dateacquired", "acquired"),
    *("emitacquisitionstarttime", "datetimeoriginal", "exifdatetimeoriginal", "datetimedigitized"),
    *("exifdatetimedigitized", "timecoveragestart", "ncglobaltimecoveragestart", "startdatetime"),
    *("datatakesensingstart", "datatake1datatakesensingstart"),
    *("sensingstart", "sensingtime", "sensingdate", "capturetime", "capturedate", "observationtime", "observationdate"),
    *("flightdate", "productstarttime", "starttime", "scenecentertime", "time", "datetime"),
    *("timestamp", "imagedate", "date"),
)
CHANGED = ("tifftagdatetime", "exifdatetime")  # of the image, or of its last change
_LABEL = re.compile(r"([A-Za-z ]+)(\([a-z/. -]+\))?:\s*(?=\d)")  # DATE(yyyy-mm-dd): or UTC TIME:
_FIRST_YEAR = 1971  # a clock that was never set says 1970 or 0


class Acquired(NamedTuple):
    """When the light of a file was captured: a day or a moment in UTC, ISO 8601; None where the file does not say."""

    text: str | None
    notes: tuple[str, ...]


def acquired_of(fields: Mapping[str, object], now: datetime | None = None) -> Acquired:
    """Return the day or moment of acquisition that ``fields`` state. The creation of a file or product is none.

    A value is text, bytes, a number or an array with one element, as ISO 8601 or Exif write it. Others, and days before
    1971 or after ``now`` (None: the clock), are left out with a note. A time without a zone is taken as UTC.
    """
    latest = (now or datetime.now(UTC)).date() + timedelta(days=1)
    known = {re.sub(r"[\W_]", "", key.lower()): key for key in fields}
    day, clock, where, notes = None, None, "", list[str]()
    for name in (name for name in (*NAMES, *CHANGED) if name in known):
        key = known[name]
        text = _text_of(fields[key])
        if text.lower() in ("", "unknown", "none", "null", "nan", "nat", "n/a", "-"):
            continue
        zone = fields.get(key.replace("DateTime", "OffsetTime"), "") if "DateTimeO" in key else ""
        try:
            found, at = _read(text, f"{zone}".strip(" \0"), latest)
        except ValueError as error:
            notes.append(f"{key} = {text[:40]!r} is not used as the day of acquisition: {error}; state it with --visit")
            continue
        if day is None and found is not None:
            day, clock, where = found, at or clock, key
        elif found is None:
            clock = clock or at
        elif day is not None and name not in CHANGED and abs(found - day) > timedelta(days=1):
            notes.append(f"{key} states another day, {found}, than {where}, which counts")
    if day is None:
        return Acquired(None, tuple(notes))
    moment = None if clock is None else datetime.combine(day, clock, clock.tzinfo or UTC).astimezone(UTC)
    said = f"{day}" if moment is None else f"{moment:%Y-%m-%dT%H:%M:%SZ}"
    assumed = "" if clock is None or clock.tzinfo is not None else ", read as UTC, since no time zone is stated"
    return Acquired(said, (*notes, f"acquired {said} by {where}{assumed}; --visit states another day"))


def _text_of(value: object) -> str:
    """Return a value as text; empty for several, and for a number that is no day such as 20220701."""
    one = np.asarray(value).reshape(-1)
    if one.size != 1 or (one.dtype.kind in "iufb" and not re.fullmatch(r"(19|20)\d{6}", f"{one[0]}")):
        return ""
    text = one[0].decode("utf-8", "replace") if isinstance(one[0], bytes) else f"{one[0]}"
    text = re.sub(r"^(\d{4})[:/](\d\d)[:/](\d\d)", r"\1-\2-\3", text.strip(" \0\"'{}"))
    return f"{text}Z" if one.dtype.kind == "M" and text != "NaT" else text  # CF counts in UTC


def _read(text: str, zone: str, latest: date) -> tuple[date | None, time | None]:
    """Return day and time of day in a text, None for the one that it lacks. Raises ValueError: it cannot be read."""
    label = _LABEL.match(text)
    words, form = ("", "") if label is None else (label[1], label[2] or "")
    body = re.sub(r"\s*(UTC|GMT)$", "Z", text if label is None else text[label.end() :])
    if form.startswith("(dd-mm"):
        body = re.sub(r"^(\d\d)-(\d\d)-(\d{4})", r"\3-\2-\1", body)
    if re.match(r"\d\d:", body):
        return None, time.fromisoformat(f"{body}{'Z' * words.startswith('UTC')}{zone}")
    if not re.match(r"\d{4}-\d\d-\d\d|\d{8}", body):
        raise ValueError("it is no whole day such as 2022-07-01")
    has_clock = ":" in body or "T" in body
    moment = datetime.fromisoformat(f"{body}{zone if has_clock else ''}")
    day = moment.date()
    if not (day.year >= _FIRST_YEAR and day <= latest):
        raise ValueError("it lies in the future" if day > latest else f"it lies before {_FIRST_YEAR}")
    return day, moment.timetz() if has_clock else None
