"""The survey: from a coarse look to a class map, top to bottom, on whichever engine runs its stages."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

from flows.survey import placement, stages
from flows.survey.accuracy import evaluate
from flows.survey.effect_choice import choose_effects
from flows.survey.ground import ground
from flows.survey.orientation import compare_turned
from flows.survey.pointing import register_coarse, register_fine
from flows.survey.run import SurveyRun
from flows.survey.scores import JUDGING
from storage.archive.archive import StageRef
from storage.archive.records import StageRecord, State

STAGES: dict[str, Callable[..., StageRef | None]] = {
    "choose_effects": choose_effects,
    "capture_coarse": stages.capture_coarse,
    "register_coarse": register_coarse,
    "locate": placement.locate,
    "rectify": placement.rectify,
    "attend": stages.attend,
    "capture_fine": stages.capture_fine,
    "register_fine": register_fine,
    "cut_patches": placement.cut_patches,
    "draw_map": stages.draw_map,
    "compare_turned": compare_turned,
    "ground": ground,
    JUDGING: evaluate,
}
TITLES = {
    "choose_effects": "effects that matter",
    "capture_coarse": "coarse sweep",
    "register_coarse": "seams of the coarse sweeps",
    "locate": "lookup",
    "rectify": "mosaic",
    "attend": "attention and plan",
    "capture_fine": "fine sweeps",
    "register_fine": "fine sweeps on the mosaic",
    "cut_patches": "fine patches",
    "draw_map": "class map",
    "compare_turned": "what lines turned by 90° would show",
    "ground": "map on the ground",
    JUDGING: "accuracy (not part of the survey)",
    "publish": "pictures and report",
}


class Step(Protocol):
    """Runs one stage on stores given by reference; an engine decides where and how often it is tried."""

    def __call__(self, stage: str, /, *inputs: StageRef) -> StageRef | None:
        """Give the stage's store, None where the stage has nothing to do."""


@dataclass(frozen=True)
class Products:
    """The stores that a survey leaves; None where a stage had nothing to do."""

    effects: StageRef
    raw_coarse: StageRef
    coarse_pointing: StageRef | None
    lookup: StageRef
    mosaic: StageRef
    attention: StageRef
    raw_fine: StageRef
    fine_pointing: StageRef | None
    patches: StageRef
    class_map: StageRef
    turned: StageRef
    ground_map: StageRef | None
    accuracy: StageRef | None = None  # once the map is judged


def survey(step: Step) -> Products:
    """Sweep the field coarsely, decide where detail changes the map, look there again, and draw the map.

    How good the map is `judge` tells.
    """
    effects = _needed(step("choose_effects"))
    raw = _needed(step("capture_coarse", effects))
    coarse_pointing = step("register_coarse", raw)
    lookup = _needed(step("locate", raw, *_there(coarse_pointing)))
    mosaic = _needed(step("rectify", raw, lookup, *_there(coarse_pointing)))
    attention = _needed(step("attend", mosaic))
    fine = _needed(step("capture_fine", attention, effects))
    fine_pointing = step("register_fine", fine, mosaic)
    patches = _needed(step("cut_patches", attention, fine, *_there(fine_pointing)))
    class_map = _needed(step("draw_map", mosaic, patches))
    turned = _needed(step("compare_turned", mosaic, attention))
    ground_map = step("ground", class_map, mosaic)
    return Products(
        effects, raw, coarse_pointing, lookup, mosaic, attention, fine, fine_pointing, patches, class_map, turned,
        ground_map,
    )  # fmt: skip


def judge(step: Step, products: Products) -> Products:
    """Judge the map of a survey by the labels, where there are any; none of it is part of the survey's own cost."""
    given = (products.mosaic, products.patches, products.class_map, products.effects, *_there(products.coarse_pointing))
    return replace(products, accuracy=step(JUDGING, *given))


def _there(ref: StageRef | None) -> tuple[StageRef, ...]:
    """A reference that may be missing, as inputs."""
    return () if ref is None else (ref,)


def _needed(ref: StageRef | None) -> StageRef:
    assert ref is not None
    return ref


Watch = Callable[[str, str, float], None]  # stage, state (running, ran, cached, skipped, failed), how far


@dataclass
class StageRunner:
    """Runs stages in this process and keeps a record of each: the plain engine, and what Prefect's tasks call."""

    run: SurveyRun
    watch: Watch = field(default=lambda stage, state, done: None)
    records: dict[str, StageRecord] = field(default_factory=dict)

    def __call__(self, stage: str, /, *inputs: StageRef) -> StageRef | None:
        """Run one of ``STAGES`` by its name."""
        self.watch(stage, "running", 0.0)
        meter = _Meter()
        made: list[bool] = []

        def produce(
            name: str, build: Callable[[Path], None], params: Mapping[str, Any], refs: Sequence[StageRef]
        ) -> StageRef:
            ref, ran = self.run.archive.produce(
                name, build, version=stages.VERSIONS[name], params=params, inputs=[ref.key for ref in refs]
            )
            made.append(ran)
            return ref

        reached = 0.0

        def report(done: float) -> None:
            nonlocal reached
            reached = done
            self.watch(stage, "running", done)

        try:
            ref = STAGES[stage](replace(self.run, report=report), produce, *inputs)
        except BaseException:
            self.watch(stage, "failed", reached)
            raise
        state: State = "skipped" if ref is None else "ran" if made[-1] else "cached"
        self.records[stage] = self._record(stage, ref, state, meter, inputs)
        self.watch(stage, state, 1.0)
        return ref

    def _record(
        self, stage: str, ref: StageRef | None, state: State, meter: _Meter, inputs: Sequence[StageRef]
    ) -> StageRecord:
        size = self.run.archive.stored_bytes
        wall, cpu, peak = meter.read() if state == "ran" else (None, None, None)
        bytes_in = sum(size(given) for given in inputs)
        key, bytes_out = ("", 0) if ref is None else (ref.key, size(ref))
        known = None if ref is None else self.run.archive.manifest_hash(ref)
        return StageRecord(stage, key, state, wall, cpu, peak, bytes_in, bytes_out, known)


class _Meter:
    """Wall and CPU seconds and the highest memory since it was made."""

    def __init__(self) -> None:
        with suppress(OSError):  # Linux: start the peak anew
            Path("/proc/self/clear_refs").write_text("5")
        self._wall, self._cpu = time.perf_counter(), time.process_time()

    def read(self) -> tuple[float, float, int]:
        """Wall seconds, CPU seconds, bytes."""
        return time.perf_counter() - self._wall, time.process_time() - self._cpu, peak_bytes()


def peak_bytes() -> int:
    """Highest resident memory of this process [bytes]."""
    with suppress(OSError, ValueError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
