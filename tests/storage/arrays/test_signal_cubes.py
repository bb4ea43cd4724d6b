"""Condensed sweeps are read as stored, zarr and xarray restore their spectra, and flipped bits raise errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import IncompleteStoreError
from spectralzoom.pipeline.geometry.mirror import mirror_throughput
from spectralzoom.pipeline.signal.calibrate import calibrate
from spectralzoom.pipeline.signal.components import Components
from spectralzoom.pipeline.signal.condense import RESIDUAL_STEP, CondensedSweep, Condenser, ResidualLaw
from spectralzoom.pipeline.signal.subspace import SignalStatistics, find_components
from spectralzoom.storage.arrays import signal_cubes
from spectralzoom.storage.arrays.cubes import SweepHeader
from spectralzoom.storage.arrays.layout import LARGEST_SHORT, read_array
from spectralzoom.storage.readers.recordings import RESTORED, open_recording
from tests.pipeline.signal.made_spectra import CAMERA, DARK, GAIN, MadeLines, field_of, raw_of
from tests.storage.small_archive import flip

SHAPE = (130, 70)
BANDS = 24
RARE = [(2, 3), (64, 69), (129, 0)]


def lines_of(bands: int = BANDS, signal: float = 30.0) -> MadeLines:
    """Return lines of three materials with three rare spectra."""
    raw = raw_of(field_of(4, SHAPE, bands, materials=min(3, bands), signal=signal).values)
    rng = np.random.default_rng(3)
    for line, sample in RARE:  # each of its own kind
        raw[line, sample] += rng.choice([0, 60], bands).astype(np.uint16)
    return MadeLines.of(raw)


def store(path: Path, lines: MadeLines, *, step: float = 1.0) -> tuple[signal_cubes.SignalCube, CondensedSweep]:
    """Condense lines and store them."""
    values, valid = calibrate(lines.raw, lines.references, saturated_dn=4095, position=lines.position)
    found = SignalStatistics(values.shape[2], values[..., 0].size)
    found.add(values, valid)
    components = find_components(found)
    bands = np.linspace(400, 1000, values.shape[2])
    header = SweepHeader(lines.sweep, lines.references, bands, np.full(len(bands), 5.0), "sim", "2026-05-01T10:00:00")
    origin = np.zeros(len(bands)) if found.origin is None else found.origin
    largest = components.largest(found.largest + np.abs(origin - np.nan_to_num(components.mean)))
    writer = signal_cubes.SignalCubeWriter(path, header, components, step=step, largest=largest)
    law = ResidualLaw.learned(found.spectra, components)
    done = Condenser(components, law, CAMERA, 1e-3, step).sweep(lines, writer.write)
    x, y = lines.position.T
    facts = signal_cubes.LineRows(lines.time_s, x, y, np.full(len(x), 100.0), lines.valid_line)
    writer.close(facts, done.rare, done.residuals)
    return signal_cubes.open_signal_cube(path), done


def common(cube: signal_cubes.SignalCube) -> NDArray[np.bool_]:
    """Return a mask of the spectra that are not rare, (line, sample)."""
    found = np.ones(SHAPE, np.bool_)
    found[cube.rare] = False
    return found


def test_condensed_sweep_round_trip(tmp_path: Path) -> None:
    """Sweep, line positions and times, references, step and places of rare spectra are as written."""
    lines = lines_of()
    cube, done = store(tmp_path / "fine-0.zarr", lines, step=0.5)
    assert (cube.sweep, cube.source, cube.started, cube.step) == (lines.sweep, "sim", "2026-05-01T10:00:00", 0.5)
    assert cube.usable.all()
    np.testing.assert_array_equal(cube.position, lines.position)
    np.testing.assert_array_equal(cube.time_s, lines.time_s)
    np.testing.assert_array_equal(cube.references.white, lines.references.white)
    assert list(zip(*(part.tolist() for part in cube.rare), strict=True)) == RARE == [tuple(p) for p in done.rare]
    assert cube.simulation is None
    np.testing.assert_allclose(cube.components.axes @ cube.components.axes.T, np.eye(len(cube.components)), atol=1e-9)
    assert [one.sweep.name for one in signal_cubes.open_signal_cubes(tmp_path)] == ["fine-0"]


def test_xarray_restores_the_spectra(tmp_path: Path) -> None:
    """Scores are in standard deviations of the noise; one more line of code adds the rare residuals."""
    cube, _ = store(tmp_path / "fine-0.zarr", lines_of(), step=0.5)
    with xr.open_zarr(tmp_path / "fine-0.zarr", consolidated=False) as data:
        assert data["scores"].dims == ("component", "line", "sample")
        assert {"wavelength", "band", "time"} <= set(data.variables)
        spectra = (data["scores"].astype("f8") * data["axes"]).sum("component") + data["mean"]
        spectra = spectra.transpose("line", "sample", "band").values
        place = data["rare_line"].values.astype(int), data["rare_sample"].values.astype(int)
        spectra[place] += data["rare_residual"].values * data["noise"].values
    np.testing.assert_allclose(spectra, cube.spectra(0, 130), atol=1e-5)


def test_rare_spectra_are_restored(tmp_path: Path) -> None:
    """From any block of lines, they lie within a quarter of the noise of the raw spectra."""
    lines = lines_of()
    cube, _ = store(tmp_path / "fine-0.zarr", lines)
    values, _ = calibrate(lines.raw, lines.references, saturated_dn=4095)
    for line, sample in RARE:
        for first, last in ((0, 130), (line, line + 1), (line // 64 * 64, 130)):
            off = cube.spectra(first, last)[line - first, sample] - values[line, sample]
            assert np.abs(off / cube.components.noise).max() <= RESIDUAL_STEP / 2 + 1e-3


def test_a_window_equals_that_part_of_the_whole(tmp_path: Path) -> None:
    """Scores of some lines and samples equal that part of all scores."""
    cube, _ = store(tmp_path / "fine-0.zarr", lines_of())
    whole = cube.read()
    assert whole.dtype == np.int16
    np.testing.assert_array_equal(cube.read(60, 70, slice(5, 66)), whole[60:70, 5:66])
    np.testing.assert_array_equal(cube.read(127), whole[127:])


READS: dict[str, Callable[[signal_cubes.SignalCube], object]] = {
    "scores": lambda cube: cube.read(),
    "rare_residual": lambda cube: cube.spectra(0, 130),
}


@pytest.mark.parametrize("name", READS)
def test_a_flipped_bit_raises_an_error(tmp_path: Path, name: str) -> None:
    """The error names the damaged array; no wrong number is returned."""
    lines = lines_of()
    lines.raw[9, 9] = 4095
    store(tmp_path / "fine-0.zarr", lines)
    chunk = next(path for path in (tmp_path / "fine-0.zarr" / name / "c").rglob("*") if path.is_file())
    flip(chunk, chunk.stat().st_size // 2)
    with pytest.raises(IncompleteStoreError, match=rf"/{name} cannot be read"):
        READS[name](signal_cubes.open_signal_cube(tmp_path / "fine-0.zarr"))


def test_a_store_that_was_not_closed_is_incomplete(tmp_path: Path) -> None:
    """Before it is closed a store lacks the line facts, without which a sweep cannot be opened."""
    lines = lines_of()
    header = SweepHeader(lines.sweep, lines.references, np.linspace(400, 1000, BANDS))
    signal_cubes.SignalCubeWriter(tmp_path / "a.zarr", header, Components.empty(BANDS), step=1.0, largest=1.0)
    with pytest.raises(IncompleteStoreError, match="mirror_x"):
        signal_cubes.open_signal_cube(tmp_path / "a.zarr")


@pytest.mark.parametrize("by_mirror", [False, True])
def test_restored_lines_are_close_to_raw_lines(tmp_path: Path, by_mirror: bool) -> None:
    """Errors stay below 6 standard deviations, and 3.5 DN in rare spectra; the noise falls by half or more."""
    made = field_of(4, SHAPE, BANDS)
    lines = MadeLines.of(lines_of().raw, by_mirror=by_mirror)
    light = mirror_throughput(lines.position)[:, None, None] if by_mirror else 1.0
    raw = np.rint((lines.raw.astype(float) - DARK) * light + DARK).astype(np.uint16)
    lines = replace(lines, raw=raw)
    cube, _ = store(tmp_path / "fine-0.zarr", lines)
    restored = signal_cubes.open_lines(tmp_path / "fine-0.zarr")
    assert isinstance(restored, signal_cubes.RestoredCube)
    assert open_recording(tmp_path / "fine-0.zarr", replace(CAMERA, samples=SHAPE[1])).notes == (RESTORED,)
    numbers = restored.read()
    assert (numbers.dtype, numbers.shape, restored.shape) == (np.uint16, raw.shape, raw.shape)
    off = numbers.astype(float) - raw
    assert np.abs(off[~common(cube)]).max() <= 0.25 * 10 + 1
    assert np.abs(off).max() < 6 * 10
    clean = (made.clean / GAIN) * light + DARK
    truth = (numbers - clean)[common(cube)]
    assert np.sqrt(np.mean(truth**2)) < 0.5 * np.sqrt(np.mean((raw - clean)[common(cube)] ** 2))
    np.testing.assert_array_equal(restored.read(60, 70, slice(4, 9)), numbers[60:70, 4:9])
    np.testing.assert_array_equal(restored.read_lines(np.array([1, 65, 128])), numbers[[1, 65, 128]])


def test_restored_lines_count_unusable_spectra_as_saturated(tmp_path: Path) -> None:
    """A spectrum saturated in all bands is restored as 65535 in each, and calibrates as unusable again."""
    lines = lines_of()
    lines.raw[7, 9] = 4095
    store(tmp_path / "fine-0.zarr", lines)
    numbers = signal_cubes.open_lines(tmp_path / "fine-0.zarr").read(0, 10)
    assert np.argwhere((numbers == 65_535).all(axis=2)).tolist() == [[7, 9]]
    _, valid = calibrate(numbers, lines.references, saturated_dn=4095)
    assert np.argwhere(~valid).tolist() == [[7, 9]]


def test_lines_without_light_are_stored(tmp_path: Path) -> None:
    """There is no component and no usable spectrum: spectra are NaN, and restored lines are saturated."""
    lines = lines_of()
    lines = replace(lines, references=replace(lines.references, white=lines.references.dark))
    cube, _ = store(tmp_path / "fine-0.zarr", lines)
    assert not cube.usable.any()
    assert np.isnan(cube.spectra(0, 130)).all()
    assert cube.read(0, 5).shape == (5, 70, 0)
    assert (signal_cubes.open_lines(tmp_path / "fine-0.zarr").read() == 65_535).all()


@pytest.mark.parametrize(("largest", "kind"), [(LARGEST_SHORT, "int16"), (LARGEST_SHORT + 1, "int32")])
def test_scores_beyond_16_bits_are_stored_in_32(tmp_path: Path, largest: float, kind: str) -> None:
    """The largest possible score selects the type; both types store the rounded scores exactly."""
    lines = lines_of()
    header = SweepHeader(lines.sweep, lines.references, np.linspace(400, 1000, BANDS))
    components = Components(np.zeros(BANDS), np.eye(2, BANDS), np.ones(BANDS), spread=np.array([9.0, 4.0]))
    writer = signal_cubes.SignalCubeWriter(tmp_path / "a.zarr", header, components, step=1.0, largest=largest)
    scores = np.random.default_rng(0).uniform(-largest, largest, (*SHAPE, 2)).astype(np.float32)
    writer.write(0, scores, np.zeros(SHAPE, np.uint8))
    steps = np.array([[70_000, -3], [0, 9]]).repeat(BANDS // 2, axis=1).astype(np.int32)
    x, y = lines.position.T
    facts = signal_cubes.LineRows(lines.time_s, x, y, np.full(len(x), 100.0), lines.valid_line)
    writer.close(facts, np.array([[0, 1], [5, 6]]), steps)
    cube = signal_cubes.open_signal_cube(tmp_path / "a.zarr")
    assert cube.read().dtype == kind
    np.testing.assert_array_equal(cube.components.spread, [9.0, 4.0])
    np.testing.assert_array_equal(cube.read(), np.rint(scores))
    off = cube.spectra(0, 1)[0, 1] - components.restore(cube.read(0, 1)[0, 1])
    np.testing.assert_array_equal(off[2:], steps[0, 2:] * RESIDUAL_STEP)


def test_a_score_beyond_its_type_is_clipped(tmp_path: Path) -> None:
    """A score above the expected bound keeps its sign; it does not wrap around."""
    lines = lines_of()
    header = SweepHeader(lines.sweep, lines.references, np.linspace(400, 1000, BANDS))
    components = Components(np.zeros(BANDS), np.eye(1, BANDS), np.ones(BANDS))
    writer = signal_cubes.SignalCubeWriter(tmp_path / "a.zarr", header, components, step=1.0, largest=100.0)
    scores = np.zeros((1, 70, 1), np.float32)
    scores[0, :2, 0] = 40_000, -1e9
    writer.write(0, scores, np.zeros((1, 70), np.uint8))
    kept = read_array(writer.group, "scores")[0, 0]
    assert kept[0] > LARGEST_SHORT
    assert kept[1] < -LARGEST_SHORT
