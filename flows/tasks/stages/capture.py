"""Define the stages that capture sweeps: lines go to a spool, and to one raw cube per sweep."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.tasks.capture_plan import CapturePlan
from spectralzoom.flows.tasks.scene import FieldSource
from spectralzoom.flows.tasks.stage import Product, Report, Wanted, stage
from spectralzoom.flows.tasks.stages.attention import load_plan
from spectralzoom.flows.tasks.stages.effects import chosen_effects, load_manifest
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import CostModel, Sweep
from spectralzoom.pipeline.signal.condense import LineStatistics
from spectralzoom.pipeline.signal.subspace import SignalStatistics
from spectralzoom.pipeline.simulator.simulated import BLOCK_LINES, SimulatedSource, sweep_starts
from spectralzoom.pipeline.source import Line, Source
from spectralzoom.storage.arrays.cubes import STATISTICS, RawCubeWriter, SweepHeader
from spectralzoom.storage.arrays.spool import Spool
from spectralzoom.storage.parallel.pool import WorkerPool
from spectralzoom.storage.store import Archive, Ref, stage_key, write_table

RAW = Product("capture", version=13)
RIG_RECORD = "rig.json"  # record of a rig's captures, beside the cubes


@stage("capture_coarse", "capture", RAW, inputs=1, retries=2, named="raw_coarse")
def capture_coarse(effects: Ref, *, plan: CapturePlan, recorder: SweepRecorder, report: Report) -> Wanted:
    """Capture the first pass, or the uniform scan."""
    return recorder.wanted(plan.coarse, [effects], report)


@stage("capture_fine", "capture of requested lines", RAW, inputs=2, retries=2, named="raw_fine")
def capture_fine(attention: Ref, effects: Ref, *, plan: CapturePlan, recorder: SweepRecorder, report: Report) -> Wanted:
    """Capture the second pass."""
    return recorder.wanted(load_plan(attention).sweeps, [attention, effects], report, begins_s=plan.coarse_s)


@dataclass(frozen=True)
class SweepRecorder:
    """Recorder of sweeps of a field: archive, source and parameters of the lines."""

    archive: Archive
    source: FieldSource
    source_key: Mapping[str, Any]  # parameters of the captured light, without sweeps and effects
    wavelength_nm: NDArray[np.float64]
    fwhm_nm: NDArray[np.float64] | None
    camera: LineCamera
    cost: CostModel
    pool: WorkerPool

    def wanted(
        self, sweeps: Sequence[Sweep], inputs: Sequence[Ref], report: Report, *, begins_s: float = 0.0
    ) -> Wanted:
        """Request sweeps, one after the other from ``begins_s`` on, with the effects of the last input."""
        clock = sweep_starts(sweeps, self.camera, self.cost, after_s=begins_s)
        params = {**self.source_key, "sweeps": [asdict(sweep) for sweep in sweeps], "starts_s": list(clock.values())}
        key = stage_key(RAW.name, RAW.version, params, inputs)
        total = sum(sweep.lines for sweep in sweeps) or 1

        def build(path: Path) -> None:
            """Capture the sweeps one after the other, and write the record of the source beside their cubes."""
            found = SignalStatistics(len(self.wavelength_nm), sum(one.lines for one in sweeps) * self.camera.samples)
            manifest = load_manifest(inputs[-1]) if self.source.simulates else None
            before = 0
            report(0.0)  # before the first line, which takes a rig some time
            folder = self.archive.spool_folder(key)
            with self.source.lit(chosen_effects(inputs[-1]), clock).opened(folder) as source:
                for sweep in sweeps:

                    def taken(count: int, before: int = before) -> None:
                        report((before + count) / total)

                    self._capture(source, sweep, path, folder, manifest, found, taken)
                    before += sweep.lines
                np.savez(path / STATISTICS, allow_pickle=False, **found.arrays())
                if source.record is not None:
                    write_table(path / RIG_RECORD, source.record)

        return Wanted(build, params, inputs)

    def _capture(
        self,
        source: Source,
        sweep: Sweep,
        path: Path,
        folder: Path,
        effects: Mapping[str, Any] | None,
        found: SignalStatistics,
        taken: Callable[[int], None],
    ) -> None:
        """Write lines into spool and cube, one by one, and resume a stopped capture."""
        references = source.references(sweep)
        header = SweepHeader(sweep, references, self.wavelength_nm, self.fwhm_nm, source.name, simulation=effects)
        samples, bands = references.dark.shape
        statistics = LineStatistics(found, sweep, references, self.camera)
        with (
            Spool.open(
                folder, samples, bands, header={"sweep": asdict(sweep), **self.source_key}, name=sweep.name
            ) as spool,
            RawCubeWriter(path / f"{sweep.name}.zarr", header, statistics.add) as cube,
        ):

            def take(line: Line) -> None:
                spool.append(line)
                cube.write([line])
                taken(spool.count)

            for block in spool.blocks():
                cube.write(block)
            taken(spool.count)
            take_lines(source, sweep, take, self.pool, first=spool.count)


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
