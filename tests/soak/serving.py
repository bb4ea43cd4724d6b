"""Three fields that one emulated rig looks at, served by a clock turned by hand: in this process, or in one to kill.

``python -m tests.soak.serving FOLDER MOMENT`` runs what is due at the moment, as a process of its own.
"""

from __future__ import annotations

import logging
import sys
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from rich.console import Console

from flows.schedule.due_runs import Outcome, run_all
from flows.schedule.field_schedule import FieldSchedule
from flows.schedule.serve_command import load_fields, survey_field
from flows.schedule.served import ServedField
from flows.schedule.times import parse_timetable
from storage.archive.ledger import ledgers
from tests.flows.schedule.schedule_days import HandClock
from tests.soak.pulled_rig import RigControl

FIELDS = {"north": 1, "south": 2, "west": 3}  # with the seeds of their scenes
EVERY, LATE = "1h", 0.5
SURVEY_S = 400.0  # of the hand clock
BANDS = ",".join(map(str, range(8, 264, 16)))  # 16 of the farm's 270
SCENE: dict[str, Any] = {
    "scene": "farm",
    "size": "128x128",
    "bands": BANDS,
    "day": 172,
    "camera": {"exposure_ms": 9.0, "readout_ms": 1.0},
}
TIMETABLE = parse_timetable(None, EVERY, "UTC")
QUIET = Console(quiet=True)

Trouble = Callable[[str, datetime], None]


def scene_settings() -> dict[str, dict[str, Any]]:
    """What stands before the rig, for each field."""
    return {name: {**SCENE, "seed": seed} for name, seed in FIELDS.items()}


def write_fields(folder: Path, archive: Path, rig: Mapping[str, Any]) -> None:
    """Write the settings of each field, NAME.toml."""
    for name, scene in scene_settings().items():
        told = {
            "name": name,
            **scene,
            "source": "rig",
            "out": str(archive),
            "engine": "plain",
            "controls": False,
            "budget": 0.8,
            "rig": dict(rig),
        }
        tables = {key: value for key, value in told.items() if isinstance(value, dict)}
        lines = [f"{key} = {_toml(value)}" for key, value in told.items() if key not in tables]
        for table, values in tables.items():
            lines += [f"[{table}]", *(f"{key} = {_toml(value)}" for key, value in values.items())]
        text = "\n".join([*lines, ""])
        tomllib.loads(text)
        (folder / f"{name}.toml").write_text(text)


def _toml(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else f'"{value}"' if isinstance(value, str) else str(value)


@dataclass
class Serving:
    """What serves the fields whose settings lie in a folder."""

    folder: Path
    fields: Mapping[str, ServedField]
    schedules: Mapping[str, FieldSchedule]
    clock: HandClock
    rig: RigControl
    before: Trouble = field(default=lambda name, due: None)  # called as a survey begins
    after: Callable[[], None] = field(default=lambda: None)  # and as it has ended, well or not

    @classmethod
    def of(cls, folder: Path, clock: HandClock) -> Serving:
        """Serve the settings of a folder."""
        fields = {one.name: one for one in load_fields([folder / f"{name}.toml" for name in FIELDS])}
        schedules = {name: one.schedule(TIMETABLE, LATE, clock) for name, one in fields.items()}
        return cls(folder, fields, schedules, clock, RigControl(folder))

    @property
    def archive(self) -> Path:
        """Folder of the archive."""
        return next(iter(self.fields.values())).archive

    def run(self, tell: Callable[[str], None]) -> list[Outcome]:
        """Run what is due now."""
        return run_all(self.schedules, lambda name: self.fields[name].lock(), self.survey, tell)

    def survey(self, name: str, due: datetime) -> Path:
        """Survey a field for a due time, through the rig."""
        try:
            self.before(name, due)
            self.rig.ask("look", name)
            self.clock.sleep(SURVEY_S)
            return survey_field(self.fields[name], due, TIMETABLE, QUIET)
        finally:
            self.after()

    def begun(self) -> int:
        """How many runs have begun so far, each attempt counted."""
        return sum(line["event"] == "begun" for one in ledgers(self.archive) for line in one.lines())

    def is_waiting(self) -> bool:
        """Whether anything is to be run now."""
        return any(one.pending() or one.state().open for one in self.schedules.values())


if __name__ == "__main__":
    logging.disable(logging.ERROR)
    Serving.of(Path(sys.argv[1]), HandClock(datetime.fromisoformat(sys.argv[2]))).run(lambda words: None)
