"""Run the stages of an opened survey, and record each."""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from spectralzoom.flows.tasks.prefect_tasks import Observer, current_observer, inside_flow
from spectralzoom.flows.tasks.run import SurveyRun, now
from spectralzoom.flows.tasks.stage import Stage
from spectralzoom.flows.tasks.stages.accuracy import evaluate
from spectralzoom.flows.tasks.stages.attention import load_plan, score
from spectralzoom.flows.tasks.stages.capture import capture_coarse, capture_fine
from spectralzoom.flows.tasks.stages.condense import condense_coarse, condense_fine, condense_raster
from spectralzoom.flows.tasks.stages.effects import choose_effects
from spectralzoom.flows.tasks.stages.maps import ground, segment
from spectralzoom.flows.tasks.stages.placement import locate, rectify, rectify_fine, register_coarse, register_fine
from spectralzoom.pipeline.errors import SurveyStopped
from spectralzoom.storage.runs import StageRecord
from spectralzoom.storage.store import Ref, manifest_sha256
from spectralzoom.storage.whole_files import bytes_in

RIG_LIMIT = "rig"  # Prefect's global concurrency limit, where the server has one of that name
LEASE_S = 60  # until a lost process frees that limit
TRY_S = 10  # between two tries to get it
OF_THE_SURVEY = (
    *(choose_effects, capture_coarse, condense_coarse, register_coarse, locate, rectify, condense_raster, score),
    *(capture_fine, condense_fine, register_fine, rectify_fine, segment, ground, evaluate),
)
STAGES: dict[str, Stage] = {one.name: one for one in OF_THE_SURVEY}
TITLES = {"plan": "scene, weights and plan", **{name: one.title for name, one in STAGES.items()}}


def versions() -> dict[str, int]:
    """Return the version of every product."""
    return {one.product.name: one.product.version for one in STAGES.values()}


@dataclass(frozen=True)
class RunRef:
    """Address of a published run."""

    uri: str  # relative to the archive
    folder: Path
    stopped: SurveyStopped | None = None  # at the store of this address, before a run was published

    @property
    def name(self) -> str:
        """Return the name of the run's folder."""
        return self.folder.name


class Products(dict[str, Ref]):
    """Stores of a survey by stage."""

    @property
    def mosaic(self) -> Ref:
        """Return the mosaic of all passes, or of the raster."""
        return self.there("rectify_fine", "rectify", "condense_raster")[0]

    @property
    def signals(self) -> list[Ref]:
        """Return the store of all condensed lines; empty for a raster."""
        return self.there("condense_fine", "condense_coarse")[:1]

    @property
    def judged(self) -> list[Ref]:
        """Return the inputs of the evaluation."""
        return [self.mosaic, *self.there("score", "segment", "choose_effects", "register_coarse")]

    def there(self, *stages: str) -> list[Ref]:
        """Return the stores of those stages that ran."""
        return [self[name] for name in stages if name in self]


class OpenSurvey:
    """Opened survey: runs its stages in this process, and records them. No dataclass, which Prefect would copy."""

    def __init__(self, run: SurveyRun, observer: Observer | None = None) -> None:
        self.run = run
        self.started = now()
        self.observer = current_observer() if observer is None else observer
        self.products = Products()
        self.records: dict[str, StageRecord] = {}
        self._written = 0
        self._held: ExitStack | None = None  # while at work
        self._holds_rig = False

    @property
    def name_of_run(self) -> str:
        """Return the name of the field, for names of Prefect runs."""
        return self.run.name

    def goes_back(self, request: Ref) -> bool:
        """Return whether the plan requests a second pass."""
        return not self.run.plan.plain and bool(load_plan(request).sweeps)

    @property
    def is_map(self) -> bool:
        """Return whether the scene is a raster, so that nothing is captured."""
        return self.run.raster is not None

    @property
    def registers(self) -> bool:
        """Return whether sweeps are registered to correct pointing errors."""
        return self.run.settings.pointing_px > 0

    @property
    def on_the_ground(self) -> bool:
        """Return whether there is also a map on the ground."""
        return self.run.settings.pose is not None

    @property
    def is_judged(self) -> bool:
        """Return whether the class map is evaluated: there are labels, and the settings ask for the accuracy."""
        return self.run.scene.labelled and self.run.settings.accuracy

    @contextmanager
    def at_work(self) -> Iterator[None]:
        """Lock archive and worker pool; the rig is locked by `hold_rig`."""
        with ExitStack() as self._held:
            self._held.callback(vars(self).pop, "run", None)  # Prefect keeps the survey, which is the result of a task
            self._held.enter_context(self.run.archive.in_use())
            self._held.enter_context(self.run.settings.pool.open())
            yield

    def hold_rig(self, capture: Stage, *inputs: Ref) -> None:
        """Lock the rig of this machine until the survey ends, if the archive lacks the sweeps of a capture.

        Inside a flow, the survey first waits for the global concurrency limit ``rig`` of the Prefect server, if there
        is one. Raises RigError: another survey uses the rig.
        """
        if self._held is None or self._holds_rig or not self.run.settings.on_hardware:
            return
        if capture.find(self.run.archive, capture.wants(self.run, *inputs)) is not None:
            return
        from spectralzoom.flows.tasks.rig_field import rig_to_oneself

        while inside_flow():  # signals are handled between tries
            from prefect.concurrency.sync import concurrency

            try:
                limit = concurrency(RIG_LIMIT, occupy=1, lease_duration=LEASE_S, timeout_seconds=TRY_S)
                self._held.enter_context(limit)
                break
            except TimeoutError:
                self.observer.note(f"waits for the rig: another survey has it, or was killed less than {LEASE_S} s ago")
        self._held.enter_context(rig_to_oneself(self.run.settings.rig.port))
        self._holds_rig = True

    def stop_after(self, ref: Ref, *stages: str) -> None:
        """Raise SurveyStopped if one of ``stages``, whose last store is ``ref``, is ``until`` of the settings."""
        if self.run.settings.until in stages:
            raise SurveyStopped(str(self.run.settings.until), ref.uri, self.run.archive.name)

    def __call__(self, stage: str, /, *inputs: Ref) -> Ref:
        """Return the store of a stage, from the archive or built."""
        shown = True

        def watch(stage: str, state: str, done: float) -> None:
            if shown or state == "failed":
                self.observer.watch(stage, state, done)

        with suppress(OSError):  # Linux: reset the peak
            Path("/proc/self/clear_refs").write_text("5")
        wall_s, cpu_s = time.perf_counter(), time.process_time()
        reached = 0.0

        def report(done: float) -> None:
            nonlocal reached
            reached = done
            watch(stage, "running", done)

        try:
            wanted = STAGES[stage].wants(replace(self.run, report=report), *inputs)
            shown = wanted.shown
            watch(stage, "running", 0.0)
            ref, built = STAGES[stage].produce(self.run.archive, wanted)
        except BaseException:
            watch(stage, "failed", reached)
            raise
        state: Literal["ran", "cached"] = "ran" if built else "cached"
        spent = (time.perf_counter() - wall_s, time.process_time() - cpu_s, peak_bytes()) if built else ()
        self._record(stage, ref, inputs, state, *spent)
        if built:
            self._written += bytes_in(self.run.archive.root / ref.uri)
        watch(stage, state, 1.0)
        record = self.records[stage]
        took = "found" if record.wall_s is None else f"{record.wall_s:.1f} s"
        self.observer.log(f"{TITLES[stage]}: {took}, {(record.bytes_out or 0) / 1e6:.1f} MB, {ref.uri}")
        return ref

    def take_as_found(self, stage: str, ref: Ref, *inputs: Ref) -> None:
        """Record an existing store of ``inputs``, whose files may have been deleted."""
        self._record(stage, ref, inputs, "cached")
        self.observer.watch(stage, "cached", 1.0)

    def _record(
        self,
        stage: str,
        ref: Ref,
        inputs: Sequence[Ref],
        state: Literal["ran", "cached"],
        wall: float | None = None,
        cpu: float | None = None,
        peak: int | None = None,
    ) -> None:
        size = self.run.archive.stored_bytes
        known = manifest_sha256(self.run.archive.root / ref.uri)
        bytes_in = sum(size(one) for one in inputs)
        self.records[stage] = StageRecord(stage, ref.key, state, wall, cpu, peak, bytes_in, size(ref), known)
        self.products[stage] = ref

    @property
    def bytes_written(self) -> int:
        """Return the bytes of stores and spools that were written."""
        return self._written + self.run.archive.spooled_bytes


def peak_bytes() -> int:
    """Return the peak resident memory of this process [bytes]."""
    with suppress(OSError, ValueError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
