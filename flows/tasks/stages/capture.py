"""The stages that take sweeps: lines into the spool as they come, and from there into one cube a sweep."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.tasks.capture_plan import CapturePlan
from flows.tasks.scene import FieldSource
from flows.tasks.stage import Product, Report, Wanted, stage
from flows.tasks.stages.attention import load_plan
from flows.tasks.stages.effects import chosen_effects, load_manifest
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import CostModel, Sweep
from pipeline.signal.subspace import SignalStatistics
from pipeline.signal.sweep_signal import LineStatistics
from pipeline.simulator.simulated import BLOCK_LINES, SimulatedSource, sweep_starts
from pipeline.source import Line, Source
from storage.archive.archive import Archive
from storage.archive.keys import StageRef, stage_key
from storage.archive.manifests import write_table
from storage.arrays.cubes import RawCubeWriter, SweepHeader, write_statistics
from storage.arrays.spool import Spool
from storage.parallel.pool import WorkerPool

RAW = Product("capture", version=12)
RIG_RECORD = "rig.json"  # beside the cubes: what a rig's captures were like


@stage("capture_coarse", "coarse sweep", RAW, inputs=1, retries=2, named="raw_coarse")
def capture_coarse(effects: StageRef, *, plan: CapturePlan, recorder: SweepRecorder, report: Report) -> Wanted:
    """Sweep the whole field once, fast."""
    return recorder.wanted(plan.coarse, [effects], report)


@stage("capture_fine", "fine sweeps", RAW, inputs=2, retries=2, named="raw_fine")
def capture_fine(
    attention: StageRef, effects: StageRef, *, plan: CapturePlan, recorder: SweepRecorder, report: Report
) -> Wanted:
    """Go back for the places that the plan chose."""
    return recorder.wanted(load_plan(attention).sweeps, [attention, effects], report, begins_s=plan.coarse_s)


@dataclass(frozen=True)
class SweepRecorder:
    """Takes sweeps of a field into an archive: who takes the lines, and what is known of them before."""

    archive: Archive
    source: FieldSource
    source_key: Mapping[str, Any]  # what the captured light depends on, beside the sweeps and the effects
    wavelength_nm: NDArray[np.float64]
    fwhm_nm: NDArray[np.float64] | None
    camera: LineCamera
    cost: CostModel
    pool: WorkerPool

    def wanted(
        self, sweeps: Sequence[Sweep], inputs: Sequence[StageRef], report: Report, *, begins_s: float = 0.0
    ) -> Wanted:
        """Want some sweeps, one after the other from ``begins_s`` on, with the effects of the last of the inputs."""
        clock = sweep_starts(sweeps, self.camera, self.cost, after_s=begins_s)
        params = {**self.source_key, "sweeps": [asdict(sweep) for sweep in sweeps], "starts_s": list(clock.values())}
        key = stage_key(RAW.name, RAW.version, params, [ref.key for ref in inputs])
        total = sum(sweep.lines for sweep in sweeps) or 1

        def build(path: Path) -> None:
            """Take the sweeps one after the other, and write what the source recorded beside their cubes."""
            found = SignalStatistics(len(self.wavelength_nm), sum(one.lines for one in sweeps) * self.camera.samples)
            before, manifest = 0, load_manifest(inputs[-1]) if self.source.simulates else None
            report(0.0)  # a rig is at work long before its first line is here
            folder, lit = self.archive.spool_folder(key), self.source.lit(chosen_effects(inputs[-1]), clock)
            with lit.opened(folder) as source:
                for sweep in sweeps:

                    def taken(count: int, before: int = before) -> None:
                        report((before + count) / total)

                    self._capture(source, sweep, path, folder, manifest, found, taken)
                    before += sweep.lines
                write_statistics(path, found)
                if source.record is not None:
                    write_table(path / RIG_RECORD, source.record)

        return Wanted(build, params, inputs, then=partial(self.archive.drop_spool, key))

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
        """Take lines into the spool and then the cube, one by one, from where an interrupted capture stopped."""
        references = source.references(sweep)
        header = SweepHeader(sweep, references, self.wavelength_nm, self.fwhm_nm, source.name, simulation=effects)
        samples, bands = references.dark.shape
        about = {"sweep": asdict(sweep), **self.source_key}
        with (
            Spool.open(folder, samples, bands, header=about, name=sweep.name) as spool,
            RawCubeWriter(path / f"{sweep.name}.zarr", header) as cube,
        ):
            statistics = LineStatistics(found, sweep, references, self.camera)

            def take(line: Line) -> None:
                spool.append(line)
                cube.write([line])
                statistics.add(line)
                taken(spool.count)

            for block in spool.blocks():
                cube.write(block)
                for line in block:
                    statistics.add(line)
            taken(spool.count)
            take_lines(source, sweep, take, self.pool, first=spool.count)
            statistics.flush()


Take = Callable[[Line], None]


def take_lines(
    source: Source, sweep: Sweep, take: Take, pool: WorkerPool, *, first: int = 0, at_once: int = BLOCK_LINES
) -> None:
    """Give ``take`` the sweep's lines one by one, in order, from line ``first`` on.

    ``take`` is called in this thread while others render. Beside one block of ``at_once`` lines for each worker there
    is one more, so that nobody waits while lines are taken. Where ``take`` raises, what was rendered ahead is lost;
    what the first block that cannot be rendered raises comes once the lines before it are taken. A source that is no
    simulation gives its lines when it has them. Neither the number of workers nor the size of blocks changes a line.
    """
    workers = WorkerPool(
        "threads", pool.workers
    ).count  # whoever else makes blocks: the scene lies in this process's memory
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
