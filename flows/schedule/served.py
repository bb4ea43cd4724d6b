"""What is served: fields and their settings, kept in a file that flow runs read, and one survey of one of them.

Whoever asks Prefect for a run can name a field or an archive, no more: files, archives, schedulers and addresses come
from that file.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from flows.schedule.field_schedule import FieldSchedule, moment_words
from flows.schedule.rig_lock import RigLock, rig_lock
from flows.schedule.times import SystemWallClock, Timetable, WallClock, exact_words, parse_timetable
from flows.settings.load import load_settings
from flows.settings.survey_settings import Settings
from pipeline.errors import SettingsError
from pipeline.simulator.scenes.farm.farm_scene import FARM_NAMES
from storage.archive.ledger import Ledger
from storage.archive.staging import read_toml
from storage.archive.whole_files import write_whole
from storage.remote.opening import open_archive

NAMED_BY = "SPECTRALZOOM_SERVED"  # the environment variable that names the file
KEYS = ("files", "out", "cron", "every", "timezone", "late", "limit", "notify")


@dataclass(frozen=True)
class ServedField:
    """One field: its name, its file of settings and what stands in it."""

    name: str
    file: Path
    settings: Settings

    @property
    def archive(self) -> Path:
        return open_archive(self.settings.out).root

    def schedule(self, timetable: Timetable, late: float, clock: WallClock | None = None) -> FieldSchedule:
        return FieldSchedule(Ledger(self.archive, self.name), timetable, late, clock or SystemWallClock())

    def lock(self) -> RigLock:
        return rig_lock(self.settings, self.archive)

    def settings_of(self, due: datetime, timetable: Timetable) -> Settings:
        """What the survey of a due time is asked for: a visit of its own, a simulated farm as on that day."""
        prior = "latest" if self.settings.prior == "auto" else self.settings.prior
        asked = replace(self.settings, name=self.name, visit=moment_words(due), prior=prior)
        if asked.source == "sim" and asked.scene in FARM_NAMES and asked.day is None:
            asked = replace(asked, day=due.astimezone(timetable.zone).timetuple().tm_yday)
        return asked


def load_field(file: Path, out: str | None = None) -> ServedField:
    """One field's settings, ``out`` before the file's own; SettingsError: unusable, or nothing to look at."""
    settings = load_settings(file, {"out": out})
    said = read_toml(file)
    if "scene" not in said and settings.source != "rig":
        raise SettingsError(
            f"{file} says neither scene nor source = 'rig': nothing to look at; give the field's scene, or its rig"
        )
    name = settings.name or re.sub(r"[^A-Za-z0-9_.-]+", "-", file.stem).strip("-.") or "field"
    return ServedField(name, file.absolute(), settings)


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
        names = ", ".join(one.name for one in self.fields)
        return f"serving {names}, {self.timetable.words()}; stop with Ctrl-C, the same command goes on"

    def schedules(self) -> dict[str, FieldSchedule]:
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
    """What is served, by the file that the environment names; fields not yet checked (SettingsError: unusable)."""
    path = os.environ.get(NAMED_BY)
    if not path:
        raise SettingsError(
            f"nothing says what may be surveyed here: expected a file in {NAMED_BY}, as `serve` writes it and "
            f"prefect.yaml describes it"
        )
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise SettingsError(f"{NAMED_BY} names {path}, which cannot be read as JSON: {error}") from error
    if not isinstance(content, Mapping) or set(content) - set(KEYS) or not isinstance(content.get("files"), list):
        raise SettingsError(f"{path}: expected an object with {', '.join(KEYS)}")
    words = {**dict.fromkeys(KEYS), "late": 0.5, "limit": 1, **content}
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
    found = {one.name: one for one in request.fields}
    if name not in found:
        raise SettingsError(f"the field {name!r} is not served here: {', '.join(found)} are")
    return found[name]


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
