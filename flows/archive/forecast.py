"""What a survey would run: its own stage functions, asked which store they want, with nothing built or written."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from flows.archive.stage_costs import PastCosts
from flows.settings.survey_settings import Settings
from flows.survey.run import SurveyRun, open_run
from flows.survey.stage import Stage, Wanted
from flows.survey.survey import STAGES, judge, survey
from pipeline.errors import IncompleteStoreError, PipelineError
from storage.archive.archive import Archive
from storage.archive.keys import StageRef
from storage.archive.keys import plain, store_at
from storage.archive.lineage import Catalogue, Change, changes_between
from storage.archive.records import Store
from storage.remote.opening import is_archive, open_archive

State = Literal["cached", "to run", "blocked", "skipped"]


@dataclass(frozen=True)
class StageForecast:
    """What would become of one stage. ``seconds`` and ``size`` are None where the archive has nothing to go by."""

    stage: str
    state: State
    key: str | None  # None while an input of it is not known
    why: str
    seconds: float | None = 0.0
    size: int | None = 0  # [bytes]
    basis: str = ""  # what the estimate comes from, or why there is none
    changes: tuple[Change, ...] = ()  # against the newest store of the same stage and scene


class _WaitsError(IncompleteStoreError):
    """A stage asks for the content, or for the key, of what is still to be made."""


@dataclass(frozen=True)
class _Awaited(StageRef):
    """Where a store would be: whoever asks for its path, or for a key that is not known, waits for ``made_by``."""

    made_by: str

    def __getattribute__(self, name: str) -> Any:
        value = object.__getattribute__(self, name)
        if name == "path" or (name == "key" and not value):
            raise _WaitsError(object.__getattribute__(self, "made_by"))
        return value


@dataclass(frozen=True)
class Forecast:
    """What a survey would do, stage by stage in order, and why this machine would refuse to (None: it would not)."""

    stages: list[StageForecast]
    refused: str | None = None


def forecast(settings: Settings) -> Forecast:
    """Tell of every stage what a survey of these settings would do. Writes nothing.

    Raises
    ------
    PipelineError : what the survey itself would refuse at its start, but for a scene that this machine cannot hold.
    """
    with _opened(settings) as run:
        planner = Planner(run, Catalogue.read(run.archive.root))
        judge(planner, survey(planner))
    return Forecast(planner.rows, run.refused)


@contextmanager
def _opened(settings: Settings) -> Iterator[SurveyRun]:
    """The survey's context on its archive as it is; where there is none yet, on an empty one that goes away again."""
    with tempfile.TemporaryDirectory(prefix="spectralzoom-plan-") as empty:
        archive = Archive(Path(empty), writes=False)
        if is_archive(settings.out):
            archive = open_archive(settings.out, create=False, write=False)
        run = open_run(replace(settings, out=empty), planning=True)
        yield replace(run, settings=settings, archive=archive)


@dataclass
class Planner:
    """An engine for `flows.survey.survey.survey` that asks every stage for its key, and runs none."""

    run: SurveyRun
    catalogue: Catalogue
    rows: list[StageForecast] = field(default_factory=list)
    _planned: dict[str, Store] = field(default_factory=dict)  # by address

    def __post_init__(self) -> None:
        self._costs = PastCosts(self.catalogue, self.run)

    def __call__(self, stage: str, /, *inputs: StageRef) -> StageRef | None:
        """Forecast one of ``STAGES`` by its name."""
        row, ref = self._ask(stage, inputs)
        self.rows.append(row)
        return ref

    def _ask(self, stage: str, inputs: Sequence[StageRef]) -> tuple[StageForecast, StageRef | None]:
        try:
            wanted = STAGES[stage](self.run, *inputs)
            if wanted is None:
                return StageForecast(stage, "skipped", None, "nothing to do with these settings"), None
            return self._look(STAGES[stage], wanted)
        except _WaitsError as wait:
            return self._blocked(stage, f"waits for {wait}")
        except (PipelineError, OSError) as error:  # what is there cannot be used: the survey would stop here
            return self._blocked(stage, str(error))

    def _blocked(self, stage: str, why: str) -> tuple[StageForecast, StageRef]:
        seconds, size, basis = self._costs.estimate(stage)
        row = StageForecast(stage, "blocked", None, why, seconds, size, basis)
        return row, _Awaited(STAGES[stage].product.name, "", Path(), stage)

    def _look(self, stage: Stage, wanted: Wanted) -> tuple[StageForecast, StageRef]:
        """Find the store that a stage wants, or say why there is none."""
        key = stage.key(wanted)
        if stage.name == "capture_fine":
            self._costs.plan_fine(sum(sweep["lines"] for sweep in wanted.params["sweeps"]))
        found = stage.find(self.run.archive, wanted)
        if found is not None:
            return StageForecast(stage.name, "cached", key, "stored"), found
        ref = store_at(self.run.archive.root, stage.product.name, key)
        inputs = [one.key for one in wanted.inputs]
        facts = {"version": stage.product.version, "params": plain(wanted.params), "inputs": inputs}
        self._planned[ref.uri] = Store(ref, facts)
        why, changes = self._reason(stage.name, self._planned[ref.uri])
        row = StageForecast(stage.name, "to run", key, why, *self._costs.estimate(stage.name), changes)
        return row, _Awaited(ref.stage, key, ref.path, stage.name)

    def _reason(self, stage: str, store: Store) -> tuple[str, tuple[Change, ...]]:
        """What differs from the newest store of the same stage of the same scene, in words and in full."""
        stored = self._costs.stored(stage)
        before = next((one for one in stored if self._costs.of_scene(one)), None)
        if before is None:
            return ("nothing stored yet of this scene" if stored else "nothing stored yet"), ()
        known = replace(self.catalogue, stores=self.catalogue.stores | self._planned)
        found = tuple(change for change in changes_between(known, before, store) if change.kind != "library")
        return _in_words(found, store.ref.stage), found


def _in_words(changes: Sequence[Change], stage: str) -> str:
    """The first thing that differs where it began, and how many more."""
    causes = [change for change in changes if change.kind != "input"] or list(changes)
    if not causes:
        return "nothing differs but its key"
    first = causes[0]
    where = "" if first.where == stage else f" of {first.where}"
    more = f", and {len(causes) - 1} more" if len(causes) > 1 else ""
    if first.kind == "input":
        return f"other {first.name} than in the newest store{more}"
    if first.name == "weights":
        return f"other weights than in the newest store{where}{more}"
    name = "version" if first.kind == "version" else first.name
    return f"{name}{where}: {_shown(first.old)} before, {_shown(first.new)} now{more}"


def _shown(value: object) -> str:
    """A value as a person writes it: lists with commas, nothing as none."""
    parts = value if isinstance(value, list) else [value]
    return ", ".join("none" if part is None else str(part) for part in parts) or "none"
