"""Lines and cubes as lazy xarray arrays: only the requested values are read and restored, chunk by chunk."""

from __future__ import annotations

import time
import tracemalloc
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.signal.components import Components
from spectralzoom.pipeline.signal.condense import RESIDUAL_STEP, UNUSABLE
from spectralzoom.pipeline.source import References
from spectralzoom.spectra import open_lazy_lines, open_lazy_mosaic
from spectralzoom.storage.arrays import layout
from spectralzoom.storage.arrays.cubes import SweepHeader
from spectralzoom.storage.arrays.mosaics import MosaicWriter
from spectralzoom.storage.arrays.signal_cubes import LineRows, SignalCubeWriter

LINES, SAMPLES, BANDS = 70, 90, 12
COUNT = 4  # of components
STEP = 0.5
Restored = tuple[Path, NDArray[np.float64]]  # a store, and its values
WAVELENGTHS = np.linspace(400, 900, BANDS)
RARE = np.array([[3, 5], [66, 80]])


def law() -> Components:
    """Return four components of twelve bands."""
    rng = np.random.default_rng(5)
    axes = np.linalg.qr(rng.normal(size=(BANDS, COUNT)))[0].T
    return Components(rng.uniform(1, 2, BANDS), axes, rng.uniform(0.01, 0.02, BANDS))


def restored(scores: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return spectra by the formula of the documentation: scores * step @ axes + mean."""
    components = law()
    return np.rint(scores / STEP) * STEP @ (components.axes * components.noise) + components.mean


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Restored:
    """Write a compressed sweep with two rare spectra and an unusable one; return its path and the expected values."""
    path = tmp_path_factory.mktemp("sweep") / "coarse-0.zarr"
    rng = np.random.default_rng(1)
    frames = References(np.zeros((SAMPLES, BANDS)), np.ones((SAMPLES, BANDS)), np.ones(BANDS))
    header = SweepHeader(Sweep("coarse-0", "coarse", "x", 0.0, 0.0, LINES), frames, WAVELENGTHS, None, "test")
    scores = rng.normal(0, 20, (LINES, SAMPLES, COUNT)).astype(np.float32)
    quality = np.zeros((LINES, SAMPLES), np.uint8)
    quality[10, 20] = UNUSABLE
    writer = SignalCubeWriter(path, header, law(), step=STEP, largest=200)
    for first in (0, 64):
        writer.write(first, scores[first : first + 64], quality[first : first + 64])
    left = rng.integers(-50, 50, (2, BANDS)).astype(np.int16)
    column = np.arange(LINES, dtype=float)
    writer.close(LineRows(column * 0.02, column / 100, column * 0, column * 0 + 20, column >= 0), RARE, left)
    values = restored(scores)
    values[RARE[:, 0], RARE[:, 1]] += left * RESIDUAL_STEP * law().noise
    values[10, 20] = np.nan
    return path, values


@pytest.fixture(scope="module")
def mosaic(tmp_path_factory: pytest.TempPathFactory) -> Restored:
    """Write a mosaic of two shards in x, with an uncovered corner; return its path and the expected values."""
    path = tmp_path_factory.mktemp("mosaic") / "mosaic.zarr"
    scores = np.random.default_rng(2).normal(0, 20, (70, 700, COUNT)).astype(np.float32)
    seen = np.ones((70, 700), np.bool_)
    seen[:5, :9] = False
    MosaicWriter(path, seen.shape, law(), WAVELENGTHS, step=STEP, largest=200).write_rows(0, scores, seen)
    return path, np.where(seen[..., None], restored(scores), np.nan)


def test_lines_are_restored_with_rare_spectra(sweep: Restored) -> None:
    """Every line and band is restored, NaN where unusable; coordinates give time, mirror and exposure of each line."""
    path, values = sweep
    lines = open_lazy_lines(path)
    assert (lines.dims, lines.dtype) == (("line", "sample", "band"), np.float32)
    np.testing.assert_allclose(lines.values, values, rtol=1e-5)
    assert {"time", "mirror_x", "mirror_y", "exposure_ms", "valid_line", "wavelength"} <= set(lines.coords)
    assert (lines.time.attrs["units"], lines.wavelength.attrs["units"], lines.attrs["units"]) == ("s", "nm", "1")
    red = lines.sel(wavelength=660, method="nearest")
    np.testing.assert_allclose(red.values, values[..., np.abs(WAVELENGTHS - 660).argmin()], rtol=1e-5)


def test_a_mosaic_is_restored_in_blocks_of_whole_shards(mosaic: Restored) -> None:
    """Pixels without coverage are NaN, and every axis has a coordinate."""
    path, values = mosaic
    cube = open_lazy_mosaic(path)
    assert (cube.dims, cube.chunks) == (("y", "x", "band"), ((64, 6), (640, 60), (BANDS,)))
    np.testing.assert_allclose(cube.values, values, rtol=1e-5)
    assert set(cube.dims) <= set(cube.indexes)


PLACES = st.one_of(
    st.integers(-60, 59),
    st.builds(
        slice, st.none() | st.integers(-80, 80), st.none() | st.integers(-80, 80), st.sampled_from([None, 1, 3, -2])
    ),
    st.lists(st.integers(-60, 59), max_size=4),
)


@given(st.sampled_from(["sweep", "mosaic"]), PLACES, PLACES, st.integers(0, BANDS - 1) | st.just(slice(None, None, -1)))
def test_any_selection_equals_the_same_selection_of_all_values(
    sweep: Restored, mosaic: Restored, which: str, row: Any, column: Any, band: Any
) -> None:
    """Rows and columns take integers, slices of any step and lists; bands an integer or the reversed axis."""
    path, values = sweep if which == "sweep" else mosaic
    opened = (open_lazy_lines if which == "sweep" else open_lazy_mosaic)(path)
    wanted = dict(zip(opened.dims, (row, column, band), strict=True))
    expected = opened.copy(data=values).isel(wanted)
    np.testing.assert_allclose(opened.isel(wanted).values, expected.values, rtol=1e-5)


def test_opening_reads_only_coordinates(sweep: Restored, mosaic: Restored, monkeypatch: pytest.MonkeyPatch) -> None:
    """Opening takes less than 0.2 s, and one requested value reads the scores once."""
    heard = Mock(wraps=layout.read_array)
    monkeypatch.setattr(layout, "read_array", heard)
    begun = time.process_time()
    lines, cube = open_lazy_lines(sweep[0]), open_lazy_mosaic(mosaic[0])
    assert time.process_time() - begun < 0.2
    assert not {"scores", "quality", "coverage", "rare_residual"} & {call.args[1] for call in heard.call_args_list}
    assert lines[0, 0, 0].values.size == cube[0, 0, 0].values.size == 1
    assert [call.args[1] for call in heard.call_args_list].count("scores") == 2


def test_a_selection_needs_only_its_own_memory(tmp_path: Path) -> None:
    """One band of a cube of 48 MB, one spectrum or a small window is restored without the rest."""
    side, bands = 640, 30
    components = Components(np.ones(bands), np.eye(bands)[:2], np.ones(bands))
    writer = MosaicWriter(tmp_path / "mosaic.zarr", (side, side), components, np.linspace(400, 900, bands), largest=9)
    writer.write_rows(0, np.ones((side, side, 2), np.float32), np.ones((side, side), np.bool_))
    cube = open_lazy_mosaic(tmp_path / "mosaic.zarr")
    assert cube[0, 0].values.shape == (bands,)
    for chosen, most in ((cube[..., 3], 3), (cube[5, 7], 0.3), (cube[100:110, 50:60], 0.3)):
        tracemalloc.start()
        values = chosen.values
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < values.nbytes + most * 1e6
    assert cube.nbytes == side * side * bands * 4
