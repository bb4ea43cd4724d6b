"""Capture sweeps: lines go to a spool, and to one raw cube per sweep."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass
from itertools import islice
from typing import cast

import numpy as np

from spectralzoom.flows.frame import FieldView
from spectralzoom.flows.stage import Output, Unkeyed, stage
from spectralzoom.flows.stages.effects import chosen_effects, load_manifest
from spectralzoom.pipeline.errors import PipelineError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import CostModel, Sweep, exposing
from spectralzoom.pipeline.signal.condense import LineStatistics
from spectralzoom.pipeline.signal.line_faults import LineJudge
from spectralzoom.pipeline.signal.subspace import SignalStatistics
from spectralzoom.pipeline.simulator.simulated import BLOCK_LINES, SimulatedSource, sweep_starts
from spectralzoom.pipeline.source import RECORD, Line, SimulatedLight, Source
from spectralzoom.storage.arrays.cubes import STATISTICS, RawCubeWriter, SweepHeader
from spectralzoom.storage.arrays.spool import Spool
from spectralzoom.storage.parallel.pool import WorkerPool
from spectralzoom.storage.store import Ref
from spectralzoom.storage.whole_files import make_folder, read_own, write_new

RAW, RAW_VERSION = "capture", 15
SAVED_S = "saved_s"  # fact of a simulated capture, for its receipt
KEPT = "source"  # folder of a source's own files within a capture's spool
MADE_BY = ("pipeline/simulator", "pipeline/rig", "pipeline/capture", "storage/arrays/cubes.py")


@dataclass(frozen=True)
class SweepRequest:
    """Sweeps to capture, one after the other."""

    sweeps: Sequence[Sweep]
    starts_s: Mapping[str, float]  # of each sweep by name, in seconds from the first one of the survey

    @staticmethod
    def of(sweeps: Sequence[Sweep], camera: LineCamera, cost: CostModel, *, after_s: float = 0.0) -> SweepRequest:
        """Request sweeps, from ``after_s`` on."""
        return SweepRequest(sweeps, sweep_starts(sweeps, camera, cost, after_s=after_s))


@stage("capture", version=RAW_VERSION, product=RAW, retries=2, made_by=MADE_BY)
def capture_coarse(
    out: Output,
    effects: Ref | None,
    *,
    request: SweepRequest,
    view: FieldView,
    source: Unkeyed[Source],
    pool: Unkeyed[WorkerPool],
) -> None:
    """Capture the first pass, or the uniform scan; ``view`` identifies what the source shows."""
    SweepRecorder(out, effects, view, pool).take(source, request)


@stage("capture of requested lines", version=RAW_VERSION, product=RAW, retries=2, made_by=MADE_BY)
def capture_fine(
    out: Output,
    attention: Ref,
    effects: Ref | None,
    *,
    request: SweepRequest,
    view: FieldView,
    source: Unkeyed[Source],
    pool: Unkeyed[WorkerPool],
) -> None:
    """Capture the second pass, which ``attention`` requests."""
    SweepRecorder(out, effects, view, pool).take(source, request)


@dataclass(frozen=True)
class SweepRecorder:
    """Writes lines to spools and cubes, and resumes a stopped capture."""

    out: Output
    effects: Ref | None  # of a simulated source
    view: FieldView
    pool: WorkerPool

    def take(self, source: Source, request: SweepRequest) -> None:
        """Capture the sweeps one after the other, and store the record of the source beside their cubes."""
        lines = sum(one.lines for one in request.sweeps)
        found = SignalStatistics(len(self.view.wavelength_nm), lines * self.view.camera.samples)
        before = 0
        self.out.report(0.0)  # before the first line, which takes a rig some time
        kept = self.out.spool / KEPT
        make_folder(kept, self.out.spool.parents[1])
        if self.effects is not None:
            source = cast(SimulatedLight, source).with_effects(chosen_effects(self.effects), request.starts_s)
        with source.opened(kept) as opened:
            for sweep in request.sweeps:

                def taken(count: int, before: int = before) -> None:
                    self.out.report((before + count) / (lines or 1))

                self._sweep(opened, sweep, found, taken)
                before += sweep.lines
        if self.effects is not None and isinstance(source, SimulatedSource):
            with suppress(PipelineError):  # only the effects that were left out cannot be rendered
                exact = chosen_effects(self.effects, exact=True)
                self.out.facts[SAVED_S] = source.saved_seconds(exact, request.sweeps)
        np.savez(self.out.path / STATISTICS, allow_pickle=False, **found.arrays())
        with suppress(FileNotFoundError):
            write_new(self.out.path / RECORD, read_own(kept / RECORD))

    def _sweep(self, source: Source, sweep: Sweep, found: SignalStatistics, taken: Callable[[int], None]) -> None:
        """Write the lines of a sweep into spool and cube, one by one.

        Lines that cannot be are not valid in the cube. Raises SceneError: they are more than a tenth.
        """
        references = source.references(sweep)
        manifest = None if self.effects is None else load_manifest(self.effects)
        bands = self.view.wavelength_nm, self.view.fwhm_nm
        header = SweepHeader(sweep, references, *bands, source.name, simulation=manifest)
        of_spool = {"sweep": asdict(sweep), "camera": asdict(self.view.camera), **self.view.light}
        statistics = LineStatistics(found, sweep, references, self.view.camera)
        judge = LineJudge(references, exposing(self.view.camera, sweep).exposure_ms)
        with (
            Spool.open(self.out.spool, *references.dark.shape, header=of_spool, name=sweep.name) as spool,
            RawCubeWriter(self.out.path / f"{sweep.name}.zarr", header, statistics.add) as cube,
        ):

            def take(line: Line) -> None:
                spool.append(line)
                cube.write([judge.judged(line)])
                taken(spool.count)

            for block in spool.blocks():
                cube.write([judge.judged(line) for line in block])
            taken(spool.count)
            take_lines(source, sweep, take, self.pool, first=spool.count)
        for note in judge.notes(f"sweep {sweep.name}", sweep.lines):
            self.out.note(note)


Take = Callable[[Line], None]


def take_lines(
    source: Source, sweep: Sweep, take: Take, pool: WorkerPool, *, first: int = 0, at_once: int = BLOCK_LINES
) -> None:
    """Call ``take`` with the lines of a sweep, in order, from line ``first`` on.

    Worker threads render a simulated sweep in blocks of ``at_once`` lines, one block more than there are workers;
    ``take`` runs in this thread. Errors of ``take`` discard the lines rendered ahead. An error of a block is raised
    after the lines before it. The number of workers and the size of blocks do not change the lines.
    """
    workers = WorkerPool("threads", pool.workers).count  # the scene is in the memory of this process
    if workers == 1 or not isinstance(source, SimulatedSource):
        for line in source.lines(sweep, first):
            take(line)
        return
    starts = iter(range(first, sweep.lines, at_once))
    with ThreadPoolExecutor(workers) as team:

        def begun(count: int) -> Iterator[Future[list[Line]]]:
            for start in islice(starts, count):
                yield team.submit(source.lines_of, sweep, range(start, min(start + at_once, sweep.lines)))

        try:
            waiting = deque(begun(workers + 1))
            while waiting:
                for line in waiting.popleft().result():
                    take(line)
                waiting.extend(begun(1))
        finally:
            team.shutdown(cancel_futures=True)
