"""Compress lines, or a raster, into components of spectra that exceed the noise."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from functools import reduce
from pathlib import Path

import numpy as np

from spectralzoom.flows.stage import Output, Report, stage
from spectralzoom.pipeline.errors import IncompleteStoreError, SceneError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.signal.calibrate import number_values
from spectralzoom.pipeline.signal.components import Components, SignalChoice
from spectralzoom.pipeline.signal.condense import RESIDUAL_STEP, CondensedSweep, Condenser, ResidualLaw, differing_lines
from spectralzoom.pipeline.signal.subspace import (
    FEW_BANDS,
    SignalStatistics,
    bands_alone,
    components_of_field,
    with_shared,
)
from spectralzoom.pipeline.source import RECORD
from spectralzoom.storage.arrays.cubes import RawCube, SweepHeader, open_raw_cubes, read_statistics
from spectralzoom.storage.arrays.signal_cubes import LineRows, SignalCubeWriter, open_signal_cubes
from spectralzoom.storage.arrays.spool import line_values
from spectralzoom.storage.store import Ref, check_store, read_table, write_table

MADE_BY = ("pipeline/signal", "storage/arrays/signal_cubes.py", "storage/arrays/mosaics.py")
SIGNAL_RECORD = "signal.json"  # of compressed sweeps; a copy lies beside their mosaic
SHARED_FRACTION = 2e-3  # of rare spectra, from which on a component takes less space than residuals
MOST_COMPARED = 65_536  # rare spectra, in which shared directions are searched for
MOST_RARE = 0.05  # fraction of spectra, above which raw lines are kept


@stage("signal", version=7, product="condense", made_by=MADE_BY)
def condense_coarse(out: Output, raw: Ref, *, camera: LineCamera, signal: SignalChoice) -> None:
    """Compress the sweeps of the first pass, or of the uniform scan."""
    condense(out, [raw], camera, signal)


@stage("signal of all passes", version=8, made_by=MADE_BY)
def condense_fine(out: Output, raw: Ref, first: Ref, *, camera: LineCamera, signal: SignalChoice) -> None:
    """Compress the sweeps of both passes, ``raw`` of the second one, with common components."""
    condense(out, [raw, first], camera, signal)


def condense(out: Output, passes: Sequence[Ref], camera: LineCamera, signal: SignalChoice) -> None:
    """Compute the components, and write the scores of every sweep; again if rare spectra share components.

    Raises SceneError: no spectrum is valid.
    """
    captured = [(open_raw_cubes(raw.path), read_statistics(raw.path)) for raw in passes]
    cubes = [cube for of_pass, _ in captured for cube in of_pass]
    found = reduce(SignalStatistics.merged, (statistics for _, statistics in captured))
    if cubes and not found.count:
        raise SceneError(
            "no spectrum of the sweeps is valid: their samples are saturated or dead, or their lines were lost; "
            "capture with a shorter exposure, or look at the dark and white frames. The raw lines stay"
        )
    components = components_of(found, cubes, signal)
    law = ResidualLaw.learned(found.spectra, components)
    condenser = Condenser(components, law, camera, signal.rare_spectra, signal.step)

    def written(condenser: Condenser) -> list[CondensedSweep]:
        """Write every sweep with the noise model of its own pass, since exposures differ."""
        of_passes = []
        for of_pass, statistics in captured:
            spectra = statistics.spectra
            law = condenser.law if len(passes) == 1 else ResidualLaw.learned(spectra, condenser.components)
            of_passes += [(cube, replace(condenser, law=law)) for cube in of_pass]
        return _write_sweeps(out.path, of_passes, found, out.report)

    done = written(condenser)
    better = with_shared_directions(condenser, done, found, signal.false_alarm)
    if better is not None:
        condenser = better
        done = written(condenser)
    every = sum(int(cube.valid_line.sum()) * cube.shape[1] for cube in cubes)
    record = {
        "components": len(condenser.components),
        "bands": condenser.components.bands,
        "step": condenser.step,
        "spectra": sum(one.known for one in done),
        "rare": sum(len(one.rare) for one in done),
        "saturated": sum(one.saturated for one in done) / max(every, 1),
    }
    write_table(out.path / SIGNAL_RECORD, record)
    rig_record = passes[0].path / RECORD
    if rig_record.is_file():  # the raw lines may be deleted
        shutil.copyfile(rig_record, out.path / RECORD)


def with_shared_directions(
    condenser: Condenser, done: Sequence[CondensedSweep], found: SignalStatistics, false_alarm: float
) -> Condenser | None:
    """Return a condenser with additional components that many rare spectra share; None where there are none."""
    rare, spectra = sum(len(one.rare) for one in done), sum(one.known for one in done)
    if rare <= max(2 * condenser.components.bands, SHARED_FRACTION * spectra):
        return None
    some = [one.residuals[:: -(-rare // MOST_COMPARED)] for one in done]
    shared = with_shared(condenser.components, np.concatenate(some) * np.float32(RESIDUAL_STEP), false_alarm)
    if len(shared) == len(condenser.components):
        return None
    return replace(condenser, components=shared, law=ResidualLaw.learned(found.spectra, shared))


def components_of(found: SignalStatistics, cubes: Sequence[RawCube], choice: SignalChoice) -> Components:
    """Return the components of a pass; few bands are kept as they are, in steps of one DN of the longest exposure."""
    if np.count_nonzero(found.lit) > FEW_BANDS or not found.count:
        bands = cubes[0].wavelength_nm if cubes else np.zeros(found.bands)  # a pass without sweeps
        return components_of_field(found, bands, false_alarm=choice.false_alarm, least=choice.least)
    return bands_alone(found, reduce(np.fmin, (number_values(cube.references, cube.exposure_ms) for cube in cubes)))


def _write_sweeps(
    path: Path, sweeps: Sequence[tuple[RawCube, Condenser]], found: SignalStatistics, report: Report
) -> list[CondensedSweep]:
    """Write scores and residuals of every sweep."""
    origin = np.zeros(found.bands) if found.origin is None else found.origin
    done = []
    for number, (cube, condenser) in enumerate(sweeps):
        first = sweeps[0][0]
        out = path / f"{cube.sweep.name}.zarr"
        shutil.rmtree(out, ignore_errors=True)
        bands = cube.wavelength_nm, cube.fwhm_nm
        writer = SignalCubeWriter(
            out,
            SweepHeader(cube.sweep, cube.references, *bands, cube.source, cube.started, cube.simulation),
            condenser.components,
            step=condenser.step,
            largest=condenser.components.largest(
                found.largest + np.abs(origin - np.nan_to_num(condenser.components.mean))
            ),
            frames_of=first.sweep.name if number and cube.references.same_as(first.references) else None,
        )

        def part(fraction: float, number: int = number) -> None:
            report((number + fraction) / len(sweeps))

        done.append(condenser.sweep(cube, writer.write, part))
        x, y = cube.position.T
        writer.close(LineRows(cube.time_s, x, y, cube.exposure_ms, cube.valid_line), done[-1].rare, done[-1].residuals)
    return done


def raw_differs(passes: Sequence[Ref], signal: Ref, camera: LineCamera) -> str | None:
    """Return why raw lines must be kept, or None if they can be deleted: every line is compared with its scores.

    ``passes`` are the captures in the order of their compression. Before, every byte of the store is verified.
    """
    try:
        check_store(signal.path, every_byte=True)
        return _lines_differ(passes, signal, camera)
    except IncompleteStoreError as error:
        return f"{error}"


def _lines_differ(passes: Sequence[Ref], signal: Ref, camera: LineCamera) -> str | None:
    record = read_table(signal.path / SIGNAL_RECORD)
    if record["rare"] > MOST_RARE * max(record["spectra"], 1):
        fraction = 100 * record["rare"] / record["spectra"]
        return f"{record['components']} components leave {fraction:.1f} % of the spectra with residuals above the noise"
    cubes = [cube for raw in passes for cube in open_raw_cubes(raw.path)]
    of_sweep = {stored.sweep: stored for stored in open_signal_cubes(signal.path)}
    if any(cube.sweep not in of_sweep for cube in cubes):
        return "the sweeps of the signal are not those of the raw lines"
    found = reduce(SignalStatistics.merged, (read_statistics(raw.path) for raw in passes))
    whole = len(cubes) == len(of_sweep)
    few = components_of(found, cubes, SignalChoice()) if np.count_nonzero(found.lit) <= FEW_BANDS and whole else None
    for cube in cubes:
        stored = of_sweep[cube.sweep]
        if wrong := differing_lines(cube, stored, camera, few):
            return f"sweep {cube.sweep.name}: {line_values(wrong)} of the signal are not those of the raw lines"
    return None
