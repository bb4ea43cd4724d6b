"""The fields of a schedule: their settings, checked before anything is served, and one survey of one of them."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from rich.console import Console

from flows.schedule.field_schedule import FieldSchedule
from flows.schedule.field_schedule import moment_words
from flows.schedule.rig_lock import RigLock, hold_place, rig_lock
from flows.schedule.times import SystemWallClock, Timetable, WallClock
from flows.settings.load import load_settings
from flows.settings.survey_settings import Settings
from pipeline.errors import ArchiveError, PipelineError, RigError, SettingsError
from pipeline.simulator.scenes.farm.farm_scene import FARM_NAMES
from storage.archive.ledger import Ledger
from storage.archive.staging import read_toml, take_lock
from storage.remote.opening import open_archive


@dataclass(frozen=True)
class ServedField:
    """One field: its name, its file of settings and what stands in it."""

    name: str
    file: Path
    settings: Settings

    @property
    def archive(self) -> Path:
        """Folder of the archive, or of its working copy."""
        return open_archive(self.settings.out).root

    def schedule(self, timetable: Timetable, late: float, clock: WallClock | None = None) -> FieldSchedule:
        """The field's schedule and ledger."""
        return FieldSchedule(Ledger(self.archive, self.name), timetable, late, clock or SystemWallClock())

    def lock(self) -> RigLock:
        """The lock of the rig that looks at it."""
        return rig_lock(self.settings, self.archive)

    def settings_of(self, due: datetime, timetable: Timetable) -> Settings:
        """What the survey of a due time is asked for: a visit of its own; a simulated farm is as on that day.

        What stands before a rig, an emulated one too, is as it is.
        """
        asked = replace(self.settings, name=self.name, visit=moment_words(due))
        if asked.source == "sim" and asked.scene in FARM_NAMES and asked.day is None:
            asked = replace(asked, day=due.astimezone(timetable.zone).timetuple().tm_yday)
        return asked


def load_field(file: Path, out: str | None = None) -> ServedField:
    """Read one field's settings; ``out`` wins over the file's archive.

    Raises
    ------
    SettingsError : the file cannot be used, or says neither what to look at nor that a rig looks.
    """
    settings = load_settings(file, {"out": out})
    said = read_toml(file)
    if "scene" not in said and settings.source != "rig":
        raise SettingsError(
            f"{file} says neither scene nor source = 'rig': nothing to look at; give the field's scene, or its rig"
        )
    name = settings.name or re.sub(r"[^A-Za-z0-9_.-]+", "-", file.stem).strip("-.") or "field"
    return ServedField(name, file.absolute(), settings)


def load_fields(files: Sequence[Path], out: str | None = None) -> list[ServedField]:
    """Read the settings of every field, in turn, and see whether they can be surveyed; nothing is captured.

    Raises
    ------
    PipelineError : there are none, two are called the same, or the first that cannot be surveyed, named.
    """
    if not files:
        raise SettingsError("no fields: give the settings file of one or more, such as serve north.toml --every 30m")
    fields = [load_field(file, out) for file in files]
    for number, one in enumerate(fields):
        same = [other for other in fields[:number] if other.name == one.name]
        if same:
            raise SettingsError(
                f'{same[0].file} and {one.file} are both called {one.name}: give one of them another name = "..."'
            )
        _check(one)
    return fields


def _check(one: ServedField) -> None:
    from flows.survey.run import open_run

    try:
        open_run(replace(one.settings, name=one.name), planning=True)  # no device is asked before its first survey
    except PipelineError as error:
        raise type(error)(f"{one.file}: {error}") from error


def survey_field(one: ServedField, due: datetime, timetable: Timetable, console: Console) -> Path:
    """Survey a field for a due time; gives the folder of the published run."""
    from flows.publish.survey_command import run_survey

    return run_survey(one.settings_of(due, timetable), console).folder


@contextmanager
def alone_on(fields: Sequence[ServedField]) -> Iterator[None]:
    """Keep another serve off the archives and the rigs of these fields while the block runs.

    Raises
    ------
    ArchiveError : another serves one of the archives.
    RigError : another serves one of the rigs.
    """
    roots: Mapping[Path, str] = {one.archive: str(one.settings.out) for one in fields}
    rigs = {one.lock().of_servers(): one.settings.rig.port for one in fields if one.settings.source == "rig"}
    with ExitStack() as held:
        for root, name in roots.items():
            release = take_lock(root / ".locks" / "serve.lock", wait=False)
            if release is None:
                raise ArchiveError(
                    f"another serve works on the archive {name}: give all its fields to that one, or end it first"
                )
            held.callback(release)
        for place, port in rigs.items():
            held.callback(_alone_on_rig(place, port))
        yield


def _alone_on_rig(place: Path | str, port: str) -> Callable[[], None]:
    release = hold_place(place, f"a serve (process {os.getpid()})")
    if release is None:
        raise RigError(f"another serve uses the rig at {port}: give all its fields to that one, or end it first")
    return release
