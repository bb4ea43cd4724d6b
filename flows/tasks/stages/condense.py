"""The stage that condenses lines: to the components of the field's spectra that rise above the noise."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from flows.settings.survey_settings import SignalChoice
from flows.tasks.stage import Product, Report, Wanted, stage
from flows.tasks.stages.capture import RIG_RECORD
from pipeline.errors import IncompleteStoreError
from pipeline.geometry.camera import LineCamera
from pipeline.signal.calibrate import number_values
from pipeline.signal.components import Components
from pipeline.signal.condense import RESIDUAL_STEP, ResidualLaw
from pipeline.signal.subspace import (
    FEW_BANDS,
    SignalStatistics,
    bands_alone,
    find_components,
    least_of_field,
    with_shared,
)
from pipeline.signal.sweep_signal import CondensedSweep, Condenser, differing_lines
from storage.archive.keys import StageRef
from storage.archive.manifests import check_files, read_table, write_table
from storage.arrays.cubes import RawCube, SweepHeader, open_raw_cubes
from storage.arrays.signal_cubes import LineRows, SignalCubeWriter, open_signal_cubes
from storage.arrays.spool import line_values
from storage.arrays.statistics import read_statistics

SIGNAL = Product("condense", version=1)
SIGNAL_FINE = Product("condense_fine", version=1)
RECORD = "signal.json"
SHARED_FRACTION = 2e-3  # of all spectra: of more rare ones, a component is cheaper than their residuals
MOST_RARE = 0.05  # of spectra: more are no exceptions, and raw lines stay


@stage("condense_coarse", "signal of the sweeps", SIGNAL, named="signal_coarse")
def condense_coarse(raw: StageRef, *, camera: LineCamera, signal: SignalChoice, report: Report) -> Wanted:
    """Condense the sweeps of the first pass, or of a uniform scan."""
    return _condensed(raw, camera, signal, report)


@stage("condense_fine", "signal of the fine sweeps", SIGNAL_FINE, named="signal_fine")
def condense_fine(raw: StageRef, *, camera: LineCamera, signal: SignalChoice, report: Report) -> Wanted:
    """Condense the sweeps of the second pass."""
    return _condensed(raw, camera, signal, report)


def _condensed(raw: StageRef, camera: LineCamera, choice: SignalChoice, report: Report) -> Wanted:
    """Want the condensed sweeps of a capture."""

    def build(path: Path) -> None:
        """Find the components of the pass, and write every sweep's scores; once more where rare spectra share some."""
        cubes = open_raw_cubes(raw.path)
        found = read_statistics(raw.path)
        components = components_of(found, cubes, choice)
        condenser = Condenser(
            components, ResidualLaw.learned(found.spectra, components), camera, choice.rare_spectra, choice.step
        )
        done = _write_sweeps(path, cubes, condenser, found, report)
        better = with_shared_directions(condenser, done, found, choice.false_alarm)
        if better is not None:
            condenser, done = better, _write_sweeps(path, cubes, better, found, report)
        write_table(path / RECORD, _record(condenser, done))
        if (raw.path / RIG_RECORD).is_file():  # raw lines may go
            shutil.copyfile(raw.path / RIG_RECORD, path / RIG_RECORD)

    key = {"camera": {"bits": camera.bits}, **asdict(choice)}  # of a camera scores depend on where it saturates
    return Wanted(build, key, [raw])


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
        least = max(choice.least, least_of_field(found.expected))
        return find_components(found, false_alarm=choice.false_alarm, least=least)
    return bands_alone(found, number_values(cubes[0].references))


def _write_sweeps(
    path: Path, cubes: Sequence[RawCube], condenser: Condenser, found: SignalStatistics, report: Report
) -> list[CondensedSweep]:
    """Store the scores of every sweep, and what components do not hold."""
    origin = np.zeros(found.bands) if found.origin is None else found.origin
    largest = condenser.components.largest(found.largest + np.abs(origin - np.nan_to_num(condenser.components.mean)))
    done = []
    for number, cube in enumerate(cubes):
        out = path / f"{cube.sweep.name}.zarr"
        shutil.rmtree(out, ignore_errors=True)
        shared = cubes[0].sweep.name if number and cube.references.same_as(cubes[0].references) else None
        writer = SignalCubeWriter(
            out, header_of(cube), condenser.components, step=condenser.step, largest=largest, frames_of=shared
        )

        def part(fraction: float, number: int = number) -> None:
            report((number + fraction) / len(cubes))

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


def raw_differs(raw: StageRef, signal: StageRef, camera: LineCamera) -> str | None:
    """Compare every raw line with what was condensed from it; say why raw lines are to stay, None where they may go.

    Every byte of the condensed store is read again before, so that rare spectra and components are as published.
    """
    try:
        check_files(signal.path, hashes=True)
        return _lines_differ(raw, signal, camera)
    except IncompleteStoreError as error:
        return f"{error}"


def _lines_differ(raw: StageRef, signal: StageRef, camera: LineCamera) -> str | None:
    record = read_table(signal.path / RECORD)
    if record["rare"] > MOST_RARE * max(record["spectra"], 1):
        fraction = 100 * record["rare"] / record["spectra"]
        return f"{fraction:.1f} % of the spectra have more than noise beside {record['components']} components"
    cubes, condensed = open_raw_cubes(raw.path), open_signal_cubes(signal.path)
    if [cube.sweep for cube in cubes] != [stored.sweep for stored in condensed]:
        return "the sweeps of the signal are not those of the raw lines"
    found = read_statistics(raw.path)
    few = components_of(found, cubes, SignalChoice()) if found.bands <= FEW_BANDS else None
    for cube, stored in zip(cubes, condensed, strict=True):
        wrong = differing_lines(cube, stored, camera, few)
        if wrong:
            return f"sweep {cube.sweep.name}: {line_values(wrong)} of the signal are not those of the raw lines"
    return None
