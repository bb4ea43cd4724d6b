"""Raw cubes, mosaics and attention maps are read as written, also by plain xarray; a damaged block raises an error."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import IncompleteStoreError
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.source import Line, References
from spectralzoom.storage.arrays.cubes import RawCubeWriter, SweepHeader, open_raw_cube
from spectralzoom.storage.arrays.georeference import AngularGrid, grid_of
from spectralzoom.storage.arrays.mosaics import Attention, open_mosaic, write_attention
from tests.storage.plain_mosaic import write_values

GRID = AngularGrid(1.057e-4, (100, 70))


def _header(lines: int, samples: int, bands: int, started: str | None = None) -> SweepHeader:
    frame = np.arange(samples * bands, dtype=np.float32).reshape(samples, bands)
    references = References(frame, frame + 1000, np.full(bands, 0.9, np.float32))
    sweep = Sweep("fine-0", "fine", "y", 12.5, -40.0, lines)
    fwhm = np.full(bands, 5.0)
    return SweepHeader(sweep, references, np.linspace(400, 1000, bands), fwhm, source="sim", started=started)


def _lines(header: SweepHeader, seed: int = 0) -> list[Line]:
    lines, *frame = header.shape
    data = np.random.default_rng(seed).integers(0, 4096, (lines, *frame), dtype=np.uint16)
    return [Line(n, data[n], 0.001 * n, -0.5, 0.1 * n, 100.0, n % 7 != 3) for n in range(lines)]


@pytest.mark.parametrize("bands", [1, 15, 270])
def test_raw_cube_round_trip(tmp_path: Path, bands: int) -> None:
    """Numbers, line facts, references, wavelengths and the sweep come back bit by bit for any band count."""
    header = _header(70, 9, bands)
    lines = _lines(header)
    with RawCubeWriter(tmp_path / "raw.zarr", header) as cube:
        for first in range(0, 70, 33):
            cube.write(lines[first : first + 33])
    found = open_raw_cube(tmp_path / "raw.zarr")
    np.testing.assert_array_equal(found.read(), np.stack([line.data for line in lines]))
    np.testing.assert_array_equal(found.read(60, 66), [line.data for line in lines[60:66]])
    assert (found.sweep, found.shape, found.source) == (header.sweep, header.shape, "sim")
    assert found.position.tolist() == [[line.mirror_x, line.mirror_y] for line in lines]
    assert found.valid_line.tolist() == [line.valid for line in lines]
    np.testing.assert_array_equal(found.references.white, header.references.white)
    np.testing.assert_array_equal(found.wavelength_nm, header.wavelength_nm)


def test_raw_cube_opens_with_plain_xarray(tmp_path: Path) -> None:
    """Dimensions, coordinates and CF attributes are where any reader looks for them."""
    header = _header(66, 40, 5, started="2026-05-01T10:00:00")
    with RawCubeWriter(tmp_path / "raw.zarr", header) as cube:
        cube.write(_lines(header))
    with xr.open_zarr(tmp_path / "raw.zarr", consolidated=False) as data:
        assert data["dn"].dims == ("line", "sample", "band")
        assert data["dn"].dtype == np.uint16
        assert {"wavelength", "fwhm", "time", "mirror_x", "mirror_y", "exposure_ms", "valid_line"} <= set(data.coords)
        assert data["wavelength"].attrs["standard_name"] == "radiation_wavelength"
        assert data["time"].values[10] == np.datetime64("2026-05-01T10:00:01")
        assert data.attrs["Conventions"] == "CF-1.12"
        near = data.swap_dims(band="wavelength").sel(wavelength=690, method="nearest")
        assert float(near["wavelength"]) == 700.0


def test_raw_cube_refuses_to_end_early(tmp_path: Path) -> None:
    """The error counts the written lines: 2 of 3."""
    header = _header(3, 4, 2)
    cube = RawCubeWriter(tmp_path / "raw.zarr", header)
    cube.write(_lines(header)[:2])
    with pytest.raises(IncompleteStoreError, match="2 of 3 lines"):
        cube.close()


def _calibrated(tmp_path: Path) -> tuple[Path, SweepHeader, list[Line]]:
    """Return a stored sweep of 130 lines whose references have all optional parts."""
    header = _header(130, 9, 4)
    bad = np.zeros((9, 4), np.bool_)
    bad[3, 1] = True
    header = replace(header, references=replace(header.references, bad=bad, by_mirror=True))
    lines = _lines(header)
    with RawCubeWriter(tmp_path / "raw.zarr", header) as cube:
        cube.write(lines)
    return tmp_path / "raw.zarr", header, lines


def test_optional_references_are_read_as_written(tmp_path: Path) -> None:
    """Dead pixels and mirror flag are stored where there are any; other cubes have no such arrays."""
    path, header, _ = _calibrated(tmp_path)
    found = open_raw_cube(path).references
    np.testing.assert_array_equal(found.bad, header.references.bad)
    assert found.by_mirror
    plain = _header(2, 9, 4)
    with RawCubeWriter(tmp_path / "plain.zarr", plain) as cube:
        cube.write(_lines(plain))
    assert not (tmp_path / "plain.zarr" / "bad").exists()
    found = open_raw_cube(tmp_path / "plain.zarr").references
    assert (found.bad, found.by_mirror) == (None, False)


def test_a_damaged_block_fails_only_when_it_is_read(tmp_path: Path) -> None:
    """Opening reads no line; the error names the damaged array."""
    path, _, lines = _calibrated(tmp_path)
    shard = path / "dn" / "c" / "1" / "0" / "0"
    shard.write_bytes(shard.read_bytes()[:-40])
    cube = open_raw_cube(path)
    np.testing.assert_array_equal(cube.read(11, 12)[0], lines[11].data)
    with pytest.raises(IncompleteStoreError, match="dn cannot be read"):
        cube.read(100, 101)


def test_raw_lines_are_stored_in_chunks_of_64(tmp_path: Path) -> None:
    """A chunk is 64 lines of up to 640 samples with all bands, with blosc and crc32c: it is read as a whole."""
    header = _header(130, 100, 6)
    with RawCubeWriter(tmp_path / "raw.zarr", header) as cube:
        cube.write(_lines(header))
    meta = json.loads((tmp_path / "raw.zarr" / "dn" / "zarr.json").read_text())
    (sharding,) = meta["codecs"]
    assert meta["chunk_grid"]["configuration"]["chunk_shape"] == [64, 128, 6]
    assert sharding["configuration"]["chunk_shape"] == [64, 128, 6]
    assert [codec["name"] for codec in sharding["configuration"]["codecs"]] == ["bytes", "blosc", "crc32c"]
    assert len([path for path in (tmp_path / "raw.zarr" / "dn" / "c").rglob("*") if path.is_file()]) == 3


NM = np.linspace(400, 900, 270)


def _values(bands: int) -> NDArray[np.float32]:
    values = np.random.default_rng(bands).random((100, 70, bands)).astype(np.float32)
    values[:5, 3:8] = np.nan
    return values


@pytest.mark.parametrize("bands", [1, 40])
def test_mosaic_round_trip(tmp_path: Path, bands: int) -> None:
    """Values are read as rounded, missing ones as NaN; plain xarray masks and scales the same scores."""
    stored = write_values(tmp_path / "m.zarr", _values(bands), NM[:bands], GRID)
    found = open_mosaic(tmp_path / "m.zarr")
    np.testing.assert_array_equal(found.values(), stored)
    assert grid_of(dict(found.group.attrs)) == GRID
    assert found.shape == (100, 70)
    with xr.open_zarr(tmp_path / "m.zarr", consolidated=False) as data:
        assert data["scores"].dims == ("component", "y", "x")
        np.testing.assert_allclose(data["scores"].values.transpose(1, 2, 0), found.scores())


def test_mosaic_has_the_spatial_transform_of_its_grid(tmp_path: Path) -> None:
    """The transform maps the centre pixel's corner to the undeflected direction, for coarse grids too."""
    for grid, shape in ((GRID, (100, 70)), (AngularGrid(1.057e-4, (100, 70), factor=4), (25, 18))):
        a, _, c, _, e, f = grid.box(shape).affine[:6]
        assert a * 35 / grid.factor + c == pytest.approx(0, abs=1e-12)
        assert e * 50 / grid.factor + f == pytest.approx(0, abs=1e-12)
    write_values(tmp_path / "m.zarr", _values(2), NM[:2], GRID)
    with xr.open_zarr(tmp_path / "m.zarr", consolidated=False) as data:
        assert data.attrs["spatial:dimensions"] == ["y", "x"]
        assert data.attrs["zarr_conventions"][0]["uuid"].startswith("689b58e2")


def test_attention_round_trip(tmp_path: Path) -> None:
    """Scores keep NaN and infinity; ranks keep -1 for patches that were not chosen."""
    score = np.array([[1.0, np.nan], [np.inf, -np.inf]])
    attention = Attention(score, np.array([[1, -1], [0, -1]], np.int32), "entropy")
    write_attention(tmp_path / "a.zarr", attention)
    with xr.open_zarr(tmp_path / "a.zarr", consolidated=False) as data:
        np.testing.assert_array_equal(data["score"].values, score)
        np.testing.assert_array_equal(data["rank"].values, attention.rank)
        assert data.attrs["policy"] == "entropy"


def test_open_refuses_missing_and_other_stores(tmp_path: Path) -> None:
    """A missing folder and a store without the expected arrays are incomplete."""
    with pytest.raises(IncompleteStoreError, match="cannot be read"):
        open_mosaic(tmp_path / "none.zarr")
    write_attention(tmp_path / "a.zarr", Attention(np.zeros((1, 1)), np.zeros((1, 1), np.int32), "x"))
    with pytest.raises(IncompleteStoreError, match="wavelength cannot be read"):
        open_raw_cube(tmp_path / "a.zarr")
