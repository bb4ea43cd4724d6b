"""The stages that take sweeps: lines into the spool as they come, and from there into one cube a sweep."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from threading import Semaphore
from typing import Any

from flows.tasks.run import CaptureRun, SurveyRun
from flows.tasks.stage import Product, Wanted, stage
from flows.tasks.stages.attention import load_plan
from flows.tasks.stages.effects import chosen_effects, load_manifest
from pipeline.geometry.scan import Sweep
from pipeline.simulator.simulated import BLOCK_LINES, SimulatedSource, sweep_starts
from pipeline.source import Line, Source
from storage.archive.keys import StageRef, stage_key
from storage.archive.manifests import write_table
from storage.arrays.cubes import RawCube, RawCubeWriter, SweepHeader, open_raw_cube
from storage.arrays.spool import Spool
from storage.parallel.pool import WorkerPool, run_blocks

RAW = Product("capture", version=10)
RIG_RECORD = "rig.json"  # beside the cubes: what a rig's captures were like


@stage("capture_coarse", "coarse sweep", RAW, inputs=1, retries=2, named="raw_coarse")
def capture_coarse(run: SurveyRun, effects: StageRef) -> Wanted:
    """Sweep the whole field once, fast."""
    return sweeps_wanted(run, run.plan.coarse, [effects])


@stage("capture_fine", "fine sweeps", RAW, inputs=2, retries=2, named="raw_fine")
def capture_fine(run: SurveyRun, attention: StageRef, effects: StageRef) -> Wanted:
    """Go back for the places that the plan chose."""
    return sweeps_wanted(run, load_plan(attention).sweeps, [attention, effects], begins_s=run.plan.coarse_s)


def sweeps_wanted(
    run: CaptureRun, sweeps: Sequence[Sweep], inputs: Sequence[StageRef], *, begins_s: float = 0.0
) -> Wanted:
    """Some sweeps, one after the other from ``begins_s`` on, with the effects of the last of the inputs."""
    clock = sweep_starts(sweeps, run.camera, run.settings.cost, after_s=begins_s)
    params = {**run.source_key(), "sweeps": [asdict(sweep) for sweep in sweeps], "starts_s": list(clock.values())}
    key = stage_key(RAW.name, RAW.version, params, [ref.key for ref in inputs])
    total = sum(sweep.lines for sweep in sweeps) or 1

    def build(path: Path) -> None:
        """Take the sweeps one after the other, and write what the source recorded beside their cubes."""
        before, manifest = 0, load_manifest(inputs[-1]) if run.source.simulates else None
        run.report(0.0)  # a rig is at work long before its first line is here
        lit = run.source.lit(chosen_effects(inputs[-1]), clock)
        with lit.opened(run.archive.spool_folder(key)) as source:
            for sweep in sweeps:
                _capture_sweep(run, source, sweep, path, key=key, before=before, total=total, effects=manifest)
                before += sweep.lines
            if source.record is not None:
                write_table(path / RIG_RECORD, source.record)

    return Wanted(build, params, inputs, then=partial(run.archive.drop_spool, key))


def _capture_sweep(
    run: CaptureRun,
    source: Source,
    sweep: Sweep,
    path: Path,
    *,
    key: str,
    before: int,
    total: int,
    effects: Mapping[str, Any] | None,
) -> None:
    """Lines into the spool and then the cube, one by one, from where a broken capture stopped.

    Lines that were lost since are asked for again; a rig captures nothing for them, and what it cannot give is invalid.
    """
    references = source.references(sweep)
    header = SweepHeader(sweep, references, run.scene.wavelength_nm, run.scene.fwhm_nm, source.name, simulation=effects)
    samples, bands = references.dark.shape
    about = {"sweep": asdict(sweep), **run.source_key()}
    folder = run.archive.spool_folder(key)
    with (
        Spool.open(folder, samples, bands, header=about, name=sweep.name) as spool,
        RawCubeWriter(path / f"{sweep.name}.zarr", header) as cube,
    ):

        def take(line: Line) -> None:
            spool.append(line)
            cube.write([line])
            run.report((before + spool.count) / total)

        spool.mend(source.lines_again(sweep, spool.lost))
        for block in spool.blocks():
            cube.write(block)
        run.report((before + spool.count) / total)
        take_lines(source, sweep, take, run.settings.pool, first=spool.count)


def captured(ref: StageRef) -> list[RawCube]:
    """Open the sweeps of a capture, in the order of their names."""
    return [open_raw_cube(path) for path in sorted(ref.path.glob("*.zarr"))]


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
    )  # whoever else makes blocks, for the scene lies in this process's memory
    if workers.count == 1 or not isinstance(source, SimulatedSource):
        for line in source.lines(sweep, first):
            take(line)
        return
    blocks = [range(start, min(start + at_once, sweep.lines)) for start in range(first, sweep.lines, at_once)]
    make = partial(_rendered, source, sweep, Semaphore(workers.count))
    run_blocks(make, blocks, replace(workers, workers=workers.count + 1), keep=False, each=_InOrder(take, first))


def _rendered(source: SimulatedSource, sweep: Sweep, free: Semaphore, numbers: range) -> list[Line] | Exception:
    """Lines of one block once a worker is free, or why there are none: to be raised in their turn, not before."""
    with free:
        try:
            return source.lines_of(sweep, numbers)
        except Exception as error:
            return error


class _InOrder:
    """Takes blocks as they end, and holds back those that wait for an earlier one."""

    def __init__(self, take: Take, first: int) -> None:
        self._take, self._next = take, first
        self._waiting: dict[int, list[Line] | Exception] = {}

    def __call__(self, numbers: range, made: list[Line] | Exception) -> None:
        self._waiting[numbers.start] = made
        while self._next in self._waiting:
            lines = self._waiting.pop(self._next)
            if isinstance(lines, Exception):
                raise lines
            for line in lines:
                self._take(line)
            self._next += len(lines)
