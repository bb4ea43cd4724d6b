"""The survey: from a coarse look to a class map, top to bottom, on whichever engine runs its stages."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

from flows.survey.run import SurveyRun
from flows.survey.stage import all_stages
from storage.archive.keys import StageRef
from storage.archive.records import StageRecord, State

STAGES = all_stages()
TITLES = {name: stage.title for name, stage in STAGES.items()}


class Step(Protocol):
    """Runs one stage on stores given by reference; an engine decides where and how often it is tried."""

    def __call__(self, stage: str, /, *inputs: StageRef) -> StageRef | None:
        """Give the stage's store, None where the stage has nothing to do."""


class Products(dict[str, StageRef | None]):
    """The stores that a survey leaves, by stage; None where a stage had nothing to do."""

    def of(self, stage: str) -> StageRef:
        ref = self[stage]
        assert ref is not None, stage
        return ref

    def there(self, stages: Iterable[str]) -> list[StageRef]:
        """The stores of some stages, without those that had nothing to do."""
        return [ref for ref in (self[name] for name in stages) if ref is not None]


def survey(step: Step) -> Products:
    """Sweep coarsely, decide where detail changes the map, look there again, draw the map; `judge` says how good."""
    return _run_all(step, Products(), judging=False)


def judge(step: Step, products: Products) -> Products:
    """Judge the map of a survey by the labels, where there are any; none of it is part of the survey's own cost."""
    return _run_all(step, Products(products), judging=True)


def _run_all(step: Step, made: Products, *, judging: bool) -> Products:
    for stage in STAGES.values():
        if stage.judges == judging:
            made[stage.name] = step(stage.name, *made.there(stage.of))
    return made


Watch = Callable[[str, str, float], None]  # stage, state (running, ran, cached, skipped, failed), how far


@dataclass
class StageRunner:
    """Runs stages in this process and keeps a record of each: the plain engine, and what Prefect's tasks call."""

    run: SurveyRun
    watch: Watch = field(default=lambda stage, state, done: None)
    records: dict[str, StageRecord] = field(default_factory=dict)

    def __call__(self, stage: str, /, *inputs: StageRef) -> StageRef | None:
        self.watch(stage, "running", 0.0)
        meter, reached = _Meter(), 0.0

        def report(done: float) -> None:
            nonlocal reached
            reached = done
            self.watch(stage, "running", done)

        try:
            wanted = STAGES[stage](replace(self.run, report=report), *inputs)
            ref, built = (None, False) if wanted is None else STAGES[stage].produce(self.run.archive, wanted)
        except BaseException:
            self.watch(stage, "failed", reached)
            raise
        state: State = "skipped" if ref is None else "ran" if built else "cached"
        wall, cpu, peak = meter.read() if state == "ran" else (None, None, None)
        size = self.run.archive.stored_bytes
        bytes_in = sum(size(given) for given in inputs)
        key, bytes_out = ("", 0) if ref is None else (ref.key, size(ref))
        known = None if ref is None else self.run.archive.manifest_hash(ref)
        self.records[stage] = StageRecord(stage, key, state, wall, cpu, peak, bytes_in, bytes_out, known)
        self.watch(stage, state, 1.0)
        return ref


class _Meter:
    """Wall and CPU seconds and the highest memory since it was made."""

    def __init__(self) -> None:
        with suppress(OSError):  # Linux: start the peak anew
            Path("/proc/self/clear_refs").write_text("5")
        self._wall, self._cpu = time.perf_counter(), time.process_time()

    def read(self) -> tuple[float, float, int]:
        return time.perf_counter() - self._wall, time.process_time() - self._cpu, peak_bytes()


def peak_bytes() -> int:
    """Highest resident memory of this process [bytes]."""
    with suppress(OSError, ValueError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
