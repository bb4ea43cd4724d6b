"""What has become known of due runs since the last look, whoever wrote it into the ledgers: told, and sent on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from flows.field_schedule import FieldSchedule
from flows.schedule_runs import Outcome
from pipeline.errors import PipelineError


@dataclass
class ScheduleNews:
    """Endings that a ledger did not have before. What it has when this is made, or was first readable, is no news."""

    schedules: Mapping[str, FieldSchedule]
    refused: Callable[[str, PipelineError], None]  # told of a field whose ledger cannot be read
    _known: dict[str, set[datetime]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.fresh()

    def fresh(self) -> list[Outcome]:
        """How due runs ended since the last time, field after field."""
        return [outcome for name, schedule in self.schedules.items() for outcome in self._of(name, schedule)]

    def _of(self, name: str, schedule: FieldSchedule) -> list[Outcome]:
        try:
            ended = schedule.state().ended
        except PipelineError as error:
            self.refused(name, error)
            return []
        known = self._known.get(name)
        self._known[name] = set(ended)
        return [] if known is None else [_outcome(name, due, ended[due]) for due in sorted(set(ended) - known)]


def _outcome(name: str, due: datetime, line: Mapping[str, Any]) -> Outcome:
    reason, run = line.get("reason"), line.get("run")
    return Outcome(name, due, line["event"], None if reason is None else str(reason), None if run is None else str(run))
