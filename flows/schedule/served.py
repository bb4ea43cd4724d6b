"""What is served, kept in a file that flow runs read: whoever asks for a run can name a field or an archive, no more.

Parameters of a flow run come from Prefect's server, and from whoever may ask it for runs; files, archives, schedulers
and addresses come from here.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flows.schedule.field_schedule import FieldSchedule
from flows.schedule.fields import ServedField, load_field
from flows.schedule.times import Timetable, exact_words, parse_timetable
from pipeline.errors import SettingsError
from storage.archive.whole_files import write_whole

NAMED_BY = "SPECTRALZOOM_SERVED"  # the environment variable that names the file
KEYS = ("files", "out", "cron", "every", "timezone", "late", "limit", "notify")


@dataclass(frozen=True, kw_only=True)
class ServeRequest:
    """What is to be served, and how."""

    fields: Sequence[ServedField]
    timetable: Timetable
    late: float
    limit: int = 1
    port: int = 4200
    out: str | None = None
    notify: str | None = None

    @property
    def headline(self) -> str:
        """What is served, and how that is ended."""
        names = ", ".join(one.name for one in self.fields)
        return f"serving {names}, {self.timetable.words()}; stop with Ctrl-C, the same command goes on"

    def schedules(self) -> dict[str, FieldSchedule]:
        """The schedule of every field, by its name."""
        return {one.name: one.schedule(self.timetable, self.late) for one in self.fields}


def write_served(request: ServeRequest, path: Path) -> None:
    """Keep what is served, for this user's eyes; notices are left to whoever serves, who sees all ledgers."""
    table = request.timetable
    content = {
        "files": [str(one.file) for one in request.fields],
        "out": request.out,
        "cron": table.cron,
        "every": None if table.every is None else exact_words(table.every),
        "timezone": table.timezone,
        "late": request.late,
        "limit": request.limit,
        "notify": None,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, json.dumps(content, indent=2))


def read_served() -> ServeRequest:
    """What is served here, by the file that the environment names; fields are read, not yet checked.

    Raises
    ------
    SettingsError : no file is named, or it, or a field's settings in it, cannot be used.
    """
    path = os.environ.get(NAMED_BY)
    if not path:
        raise SettingsError(
            f"nothing says what may be surveyed here: expected a file in {NAMED_BY}, as `serve` writes it and "
            f"prefect.yaml describes it"
        )
    words = _read(Path(path))
    fields = [load_field(Path(str(file)), words["out"]) for file in words["files"]]
    if not fields:
        raise SettingsError(f"{path} names no field: expected files = [...], settings files")
    return ServeRequest(
        fields=fields,
        timetable=parse_timetable(words["cron"], words["every"], words["timezone"]),
        late=float(words["late"]),
        limit=int(words["limit"]),
        out=words["out"],
        notify=words["notify"],
    )


def served_field(request: ServeRequest, name: str) -> ServedField:
    """The field of that name (SettingsError where it is not served)."""
    for one in request.fields:
        if one.name == name:
            return one
    raise SettingsError(f"the field {name!r} is not served here: {', '.join(one.name for one in request.fields)} are")


def served_archive(request: ServeRequest, name: str) -> str:
    """The archive of that name (SettingsError where none of the fields has it)."""
    names = list(dict.fromkeys(str(one.settings.out) for one in request.fields))
    if name not in names:
        raise SettingsError(f"the archive {name!r} is not served here: {', '.join(names)}")
    return name


def served_weights(request: ServeRequest, name: str | None) -> Path | None:
    """Weights of that name, None for None (SettingsError where no served field's settings name them)."""
    if name is None:
        return None
    names = list(dict.fromkeys(str(one.settings.weights) for one in request.fields if one.settings.weights is not None))
    if name not in names:
        known = ", ".join(names) or "none"
        raise SettingsError(
            f"the weights {name!r} are of no field that is served here (theirs: {known}): write them into a field's "
            f"settings, or use spectralzoom reprocess --weights"
        )
    return Path(name)


def _read(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise SettingsError(f"{NAMED_BY} names {path}, which cannot be read as JSON: {error}") from error
    if not isinstance(content, Mapping) or set(content) - set(KEYS) or not isinstance(content.get("files"), list):
        raise SettingsError(f"{path}: expected an object with {', '.join(KEYS)}")
    words = {"out": None, "cron": None, "every": None, "timezone": None, "late": 0.5, "limit": 1, "notify": None}
    return {**words, "files": [], **content}
