"""The stage that condenses lines: to the components of the field's spectra that rise above the noise."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np

from flows.settings.survey_settings import SignalChoice
from flows.tasks.stage import FieldFrame, Product, Report, Wanted, stage
from flows.tasks.stages.capture import RIG_RECORD
from flows.tasks.stages.placement import MOSAIC_STEP
from flows.terminal.figures import format_bytes
from pipeline.errors import BudgetError, IncompleteStoreError
from pipeline.geometry.camera import LineCamera
from pipeline.signal.calibrate import number_values
from pipeline.signal.components import Components
from pipeline.signal.condense import RESIDUAL_STEP, ResidualLaw, score_lines, whole_steps
from pipeline.signal.lines import BLOCK_LINES
from pipeline.signal.subspace import FEW_BANDS, SignalStatistics, bands_alone, components_of_field, with_shared
from pipeline.signal.sweep_signal import CondensedSweep, Condenser, calibrated_blocks, differing_lines
from storage.archive.keys import StageRef
from storage.archive.manifests import check_files, read_table, write_table
from storage.arrays.cubes import RawCube, SweepHeader, open_raw_cubes, read_statistics
from storage.arrays.layout import numbers_in_memory
from storage.arrays.signal_cubes import LineRows, SignalCubeWriter, open_signal_cubes
from storage.arrays.spool import line_values

SIGNAL = Product("condense", version=1)
SIGNAL_FINE = Product("condense_fine", version=2)
RECORD = "signal.json"
SHARED_FRACTION = 2e-3  # of all spectra: of more rare ones, a component is cheaper than their residuals
COARSER = (1.5, 2.0, 3.0, 4.0, 6.0)  # steps that a limit of bytes may ask for [noise's deviations]
SAMPLED_BLOCKS = 8  # of lines, by which bytes are foretold
MOST_RARE = 0.05  # of spectra: more are no exceptions, and raw lines stay


@stage("condense_coarse", "signal of the sweeps", SIGNAL, named="signal_coarse")
def condense_coarse(
    raw: StageRef,
    *,
    camera: LineCamera,
    signal: SignalChoice,
    kept_bytes: int | None,
    frame: FieldFrame,
    report: Report,
) -> Wanted:
    """Condense the sweeps of the first pass, or of a uniform scan, with its mosaic in at most ``kept_bytes``."""
    limit = None if kept_bytes is None else KeptBytes(kept_bytes, frame.grid.height * frame.grid.width)
    return _condensed([raw], camera, signal, report, limit)


@stage("condense_fine", "signal of all passes", SIGNAL_FINE, named="signal_fine")
def condense_fine(
    raw: StageRef,
    raw_first: StageRef,
    *,
    camera: LineCamera,
    signal: SignalChoice,
    kept_bytes: int | None,
    frame: FieldFrame,
    report: Report,
) -> Wanted:
    """Condense the sweeps of the later passes and those of the first by common components, so that lines merge."""
    limit = None if kept_bytes is None else KeptBytes(kept_bytes, frame.grid.height * frame.grid.width)
    return _condensed([raw, raw_first], camera, signal, report, limit)


@dataclass(frozen=True)
class KeptBytes:
    """Limit of bytes for the scores of lines and of the mosaic made of them."""

    most: int
    mosaic_px: int

    def step(self, cubes: Sequence[RawCube], components: Components, camera: LineCamera, finest: float) -> float:
        """Return the finest step in which they fit, by lines here and there from all sweeps.

        Raises BudgetError: not even the coarsest does; names the least that is enough.
        """
        blocks = [(cube, block) for cube in cubes for block in range(-(-cube.shape[0] // BLOCK_LINES))]
        some = blocks[:: max(1, len(blocks) // SAMPLED_BLOCKS)]
        scores = [
            score_lines(values, valid, components).scores
            for cube, block in some
            for _, values, valid in calibrated_blocks(cube, camera, [block])
        ]
        spectra = sum(cube.shape[0] * cube.shape[1] for cube in cubes)

        def take(step: float, count: int) -> float:
            whole = (whole_steps(one, step).transpose(2, 0, 1) for one in scores)
            packed = sum(numbers_in_memory(np.ascontiguousarray(one, np.int32))[0] for one in whole)
            return count * packed / max(sum(one[..., 0].size for one in scores), 1)

        least = 0.0
        for step in (finest, *(step for step in COARSER if step > finest)):
            least = take(step, spectra) + take(MOSAIC_STEP * step, self.mosaic_px)
            if least <= self.most:
                return step
        raise BudgetError(
            f"--kept-bytes {self.most} does not hold the scores of lines and mosaic: in the coarsest steps they take "
            f"{format_bytes(least)}; raw lines stay until a larger one is given"
        )


def _condensed(
    passes: Sequence[StageRef], camera: LineCamera, choice: SignalChoice, report: Report, limit: KeptBytes | None
) -> Wanted:
    """Want the condensed sweeps of some captures."""

    def build(path: Path) -> None:
        """Find the components of all lines, and write every sweep's scores; once more where rare spectra share some."""
        captured = [(open_raw_cubes(raw.path), read_statistics(raw.path)) for raw in passes]
        cubes = [cube for of_pass, _ in captured for cube in of_pass]
        found = reduce(SignalStatistics.merged, (statistics for _, statistics in captured))
        components = components_of(found, cubes, choice)
        step = choice.step if limit is None else limit.step(cubes, components, camera, choice.step)
        law = ResidualLaw.learned(found.spectra, components)
        condenser = Condenser(components, law, camera, choice.rare_spectra, step)

        def written(condenser: Condenser) -> list[CondensedSweep]:
            """Write every sweep, by the noise of its own pass: exposures differ."""
            of_passes = []
            for of_pass, statistics in captured:
                law = condenser.law if len(passes) == 1 else ResidualLaw.learned(statistics.spectra, components)
                of_passes += [(cube, replace(condenser, law=law)) for cube in of_pass]
            return _write_sweeps(path, of_passes, found, report)

        done = written(condenser)
        better = with_shared_directions(condenser, done, found, choice.false_alarm)
        if better is not None:
            condenser, components, done = better, better.components, written(better)
        write_table(path / RECORD, _record(condenser, done))
        for raw in passes[:1]:
            if (raw.path / RIG_RECORD).is_file():  # raw lines may go
                shutil.copyfile(raw.path / RIG_RECORD, path / RIG_RECORD)

    key = {"camera": {"bits": camera.bits}, **asdict(choice)}  # of a camera scores depend on where it saturates
    return Wanted(build, key if limit is None else {**key, "kept": asdict(limit)}, list(passes))


def with_shared_directions(
    condenser: Condenser, done: Sequence[CondensedSweep], found: SignalStatistics, false_alarm: float
) -> Condenser | None:
    """Return a condenser with the directions too that many rare spectra share; None where there are none."""
    rare, spectra = sum(len(one.rare) for one in done), sum(one.known for one in done)
    components = condenser.components
    if rare <= max(2 * components.bands, SHARED_FRACTION * spectra):
        return None
    residuals = np.concatenate([one.residuals for one in done]) * np.float32(RESIDUAL_STEP)
    shared = with_shared(components, residuals, false_alarm)
    if len(shared) == len(components):
        return None
    return replace(condenser, components=shared, law=ResidualLaw.learned(found.spectra, shared))


def camera_of(params: Mapping[str, Any]) -> LineCamera:
    """Return a camera with those values of which the scores of a condensed pass depend, by the pass's parameters."""
    return LineCamera(**params["camera"])


def components_of(found: SignalStatistics, cubes: Sequence[RawCube], choice: SignalChoice) -> Components:
    """Find the components of a pass; few bands are kept as they are, in steps of one number of the camera."""
    if found.bands > FEW_BANDS or not found.count:
        bands = cubes[0].wavelength_nm if cubes else np.zeros(found.bands)  # a pass may have no sweep
        return components_of_field(found, bands, false_alarm=choice.false_alarm, least=choice.least)
    return bands_alone(found, number_values(cubes[0].references))


def _write_sweeps(
    path: Path, sweeps: Sequence[tuple[RawCube, Condenser]], found: SignalStatistics, report: Report
) -> list[CondensedSweep]:
    """Store the scores of every sweep, and what components do not hold."""
    origin = np.zeros(found.bands) if found.origin is None else found.origin
    done = []
    for number, (cube, condenser) in enumerate(sweeps):
        mean = np.nan_to_num(condenser.components.mean)
        largest = condenser.components.largest(found.largest + np.abs(origin - mean))
        out, first = path / f"{cube.sweep.name}.zarr", sweeps[0][0]
        shutil.rmtree(out, ignore_errors=True)
        shared = first.sweep.name if number and cube.references.same_as(first.references) else None
        writer = SignalCubeWriter(
            out, header_of(cube), condenser.components, step=condenser.step, largest=largest, frames_of=shared
        )

        def part(fraction: float, number: int = number) -> None:
            report((number + fraction) / len(sweeps))

        done.append(condenser.sweep(cube, writer.write, part))
        x, y = cube.position.T
        facts = LineRows(cube.time_s, x, y, cube.exposure_ms, cube.valid_line)
        writer.close(facts, done[-1].rare, done[-1].residuals, cube.quicklook())
    return done


def header_of(cube: RawCube) -> SweepHeader:
    """Return what was known of a stored sweep before its first line."""
    bands = cube.wavelength_nm, cube.fwhm_nm
    return SweepHeader(cube.sweep, cube.references, *bands, cube.source, cube.started, cube.simulation)


def _record(condenser: Condenser, done: Sequence[CondensedSweep]) -> dict[str, Any]:
    """Return what receipts and checks want to know of a condensed pass."""
    return {
        "components": len(condenser.components),
        "bands": condenser.components.bands,
        "step": condenser.step,
        "spectra": sum(one.known for one in done),
        "rare": sum(len(one.rare) for one in done),
    }


def raw_differs(passes: Sequence[StageRef], signal: StageRef, camera: LineCamera) -> str | None:
    """Compare every raw line with what was condensed from it; say why raw lines are to stay, None where they may go.

    ``passes`` are the captures in the order in which they were condensed.

    Every byte of the condensed store is read again before, so that rare spectra and components are as published.
    """
    try:
        check_files(signal.path, hashes=True)
        return _lines_differ(passes, signal, camera)
    except IncompleteStoreError as error:
        return f"{error}"


def _lines_differ(passes: Sequence[StageRef], signal: StageRef, camera: LineCamera) -> str | None:
    record = read_table(signal.path / RECORD)
    if record["rare"] > MOST_RARE * max(record["spectra"], 1):
        fraction = 100 * record["rare"] / record["spectra"]
        return f"{fraction:.1f} % of the spectra have more than noise beside {record['components']} components"
    cubes = [cube for raw in passes for cube in open_raw_cubes(raw.path)]
    of_sweep = {stored.sweep: stored for stored in open_signal_cubes(signal.path)}
    if any(cube.sweep not in of_sweep for cube in cubes):
        return "the sweeps of the signal are not those of the raw lines"
    found = reduce(SignalStatistics.merged, (read_statistics(raw.path) for raw in passes))
    whole = len(cubes) == len(of_sweep)  # else the stored components are all that is known
    few = components_of(found, cubes, SignalChoice()) if found.bands <= FEW_BANDS and whole else None
    for cube in cubes:
        stored = of_sweep[cube.sweep]
        wrong = differing_lines(cube, stored, camera, few)
        if wrong:
            return f"sweep {cube.sweep.name}: {line_values(wrong)} of the signal are not those of the raw lines"
    return None
