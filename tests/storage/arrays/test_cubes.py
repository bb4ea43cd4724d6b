"""What is stored comes back, opens with plain xarray, and a flipped bit is never a number."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import zarr

from pipeline.errors import IncompleteStoreError, ShapeError
from pipeline.geometry.scan import Sweep
from pipeline.source import Line, References
from storage.archive.archive import Archive
from storage.archive.manifests import check_files
from storage.arrays.cubes import RawCubeWriter, SweepHeader, open_raw_cube
from storage.arrays.layout import AngularGrid, round_bits
from storage.arrays.mosaics import (
    Attention,
    Mosaic,
    MosaicWriter,
    PatchWriter,
    load_attention,
    load_mosaic,
    open_patches,
    write_attention,
)

GRID = AngularGrid(1.057e-4, (100, 70))


def _header(lines: int, samples: int, bands: int, started: str | None = None) -> SweepHeader:
    frame = np.arange(samples * bands, dtype=np.float32).reshape(samples, bands)
    references = References(frame, frame + 1000, np.full(bands, 0.9, np.float32))
    sweep = Sweep("fine-0", "fine", "y", 12.5, -40.0, lines)
    fwhm = np.full(bands, 5.0)
    return SweepHeader(sweep, references, np.linspace(400, 1000, bands), fwhm, source="sim", started=started)


def _lines(header: SweepHeader, seed: int = 0) -> list[Line]:
    rng = np.random.default_rng(seed)
    lines, *frame = header.shape
    data = rng.integers(0, 4096, (lines, *frame), dtype=np.uint16)
    return [Line(n, data[n], 0.001 * n, -0.5, 0.1 * n, 100.0, n % 7 != 3) for n in range(lines)]


@pytest.mark.parametrize("bands", [1, 2, 4, 15, 200, 270, 939])
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


def test_raw_cube_refuses_what_does_not_fit(tmp_path: Path) -> None:
    """Lines out of order, of another size, too many or too few are named."""
    header = _header(3, 4, 2)
    lines = _lines(header)
    cube = RawCubeWriter(tmp_path / "raw.zarr", header)
    with pytest.raises(ShapeError, match="got line 1, expected line 0 of 3"):
        cube.write(lines[1:])
    with pytest.raises(ShapeError, match=r"line 0: shape \(3, 2\)"):
        cube.write([Line(0, lines[0].data[:3], 0, 0, 0, 1)])
    cube.write(lines[:2])
    with pytest.raises(IncompleteStoreError, match="2 of 3 lines"):
        cube.close()
    with pytest.raises(ShapeError, match="calibrate with the sweep's own binning"):
        SweepHeader(header.sweep, header.references, np.arange(3.0))


def _calibrated(tmp_path: Path) -> tuple[Path, SweepHeader, list[Line]]:
    """A stored sweep of 130 lines whose references have all that references can have."""
    header = _header(130, 9, 4)
    rng = np.random.default_rng(4)
    flat = rng.uniform(0.9, 1.1, (9, 4)).astype(np.float32)
    bad = np.zeros((9, 4), np.bool_)
    bad[3, 1] = True
    header = replace(header, references=replace(header.references, bad=bad, flat=flat, by_mirror=True))
    lines = _lines(header)
    with RawCubeWriter(tmp_path / "raw.zarr", header) as cube:
        cube.write(lines)
    return tmp_path / "raw.zarr", header, lines


def test_bad_flat_and_mirror_come_back(tmp_path: Path) -> None:
    """They are stored where there are any; without them nothing is, as in cubes of before."""
    path, header, _ = _calibrated(tmp_path)
    found = open_raw_cube(path).references
    np.testing.assert_array_equal(found.bad, header.references.bad)
    np.testing.assert_array_equal(found.flat, header.references.flat)
    assert found.by_mirror
    plain = _header(2, 9, 4)
    with RawCubeWriter(tmp_path / "plain.zarr", plain) as cube:
        cube.write(_lines(plain))
    assert not {"bad", "flat"} & {path.name for path in (tmp_path / "plain.zarr").iterdir()}
    found = open_raw_cube(tmp_path / "plain.zarr").references
    assert (found.bad, found.flat, found.by_mirror) == (None, None, False)
    with pytest.raises(ShapeError, match=r"bad has shape \(9, 3\), the dark frame \(9, 4\)"):
        replace(plain, references=replace(plain.references, bad=np.zeros((9, 3), np.bool_)))


def test_lines_are_read_as_they_are_asked_for(tmp_path: Path) -> None:
    """Opening reads no line: a damaged block is an error only where it is asked for, and is named."""
    path, _, lines = _calibrated(tmp_path)
    shard = path / "dn" / "c" / "1" / "0" / "0"
    shard.write_bytes(shard.read_bytes()[:-40])
    cube = open_raw_cube(path)
    np.testing.assert_array_equal(cube.read(11, 12)[0], lines[11].data)
    with pytest.raises(IncompleteStoreError, match="dn cannot be read"):
        cube.read(100, 101)


def test_layout_is_one_range_read_a_patch(tmp_path: Path) -> None:
    """Shards of 64 lines, chunks of 32 x 32 x all bands, each with blosc and crc32c inside the shard."""
    header = _header(130, 100, 6)
    with RawCubeWriter(tmp_path / "raw.zarr", header) as cube:
        cube.write(_lines(header))
    meta = json.loads((tmp_path / "raw.zarr" / "dn" / "zarr.json").read_text())
    (sharding,) = meta["codecs"]
    assert meta["chunk_grid"]["configuration"]["chunk_shape"] == [64, 128, 6]
    assert sharding["configuration"]["chunk_shape"] == [32, 32, 6]
    assert [codec["name"] for codec in sharding["configuration"]["codecs"]] == ["bytes", "blosc", "crc32c"]
    assert len([path for path in (tmp_path / "raw.zarr" / "dn" / "c").rglob("*") if path.is_file()]) == 3


def test_an_image_without_bands_has_a_chunk_a_file(tmp_path: Path) -> None:
    """Calls for chunks of a few kilobytes would cost more than unpacking them."""
    coverage = MosaicWriter(tmp_path / "m.zarr", (130, 700), np.array([500.0, 700.0])).group["coverage"]
    assert isinstance(coverage, zarr.Array)
    assert coverage.chunks == coverage.shards == (64, 640)


def _mosaic(bands: int, shape: tuple[int, int] = (100, 70)) -> Mosaic:
    rng = np.random.default_rng(bands)
    values = rng.lognormal(size=(*shape, bands)).astype(np.float32)
    values[:5, 3:8] = np.nan
    coverage = np.where(np.isnan(values[..., 0]), 0, 1.5).astype(np.float32)
    return Mosaic(values, coverage, np.linspace(400, 900, bands), None, GRID, np.full((25, 17, 3), 9, np.uint8))


def write_mosaic(path: Path, mosaic: Mosaic) -> None:
    """Store a mosaic in one block of rows, with its quicklook."""
    writer = MosaicWriter(path, mosaic.values.shape[:2], mosaic.wavelength_nm, grid=mosaic.grid)
    writer.write_tile(0, 0, mosaic.values, mosaic.coverage)
    assert mosaic.quicklook is not None
    writer.write_quicklook(mosaic.quicklook)


@pytest.mark.parametrize("bands", [1, 4, 270])
def test_mosaic_round_trip(tmp_path: Path, bands: int) -> None:
    """Values come back rounded to 11 bits, missing ones as NaN, all else exactly; xarray sees the same."""
    mosaic = _mosaic(bands)
    write_mosaic(tmp_path / "m.zarr", mosaic)
    found = load_mosaic(tmp_path / "m.zarr")
    np.testing.assert_array_equal(found.values, round_bits(mosaic.values))
    np.testing.assert_allclose(found.values, mosaic.values, rtol=2.5e-4)
    np.testing.assert_array_equal(found.coverage, mosaic.coverage)
    assert found.grid == GRID
    with xr.open_zarr(tmp_path / "m.zarr", consolidated=False) as data:
        np.testing.assert_array_equal(data["values"].values, found.values)
        assert data["values"].dims == ("y", "x", "band")
        assert data["quicklook"].shape == (25, 17, 3)


def test_mosaic_says_where_its_pixels_lie(tmp_path: Path) -> None:
    """The spatial transform maps the centre pixel's corner to the undeflected direction, for coarse grids alike."""
    coarse = AngularGrid(1.057e-4, (100, 70), factor=4)
    for grid, shape in ((GRID, (100, 70)), (coarse, (25, 18))):
        a, _, c, _, e, f = grid.attributes(shape)["spatial:transform"]
        assert a * 35 / grid.factor + c == pytest.approx(0, abs=1e-12)
        assert e * 50 / grid.factor + f == pytest.approx(0, abs=1e-12)
    write_mosaic(tmp_path / "m.zarr", _mosaic(2))
    with xr.open_zarr(tmp_path / "m.zarr", consolidated=False) as data:
        assert data.attrs["spatial:dimensions"] == ["y", "x"]
        assert data.attrs["zarr_conventions"][0]["uuid"].startswith("689b58e2")


@pytest.mark.parametrize(("count", "at_once"), [(0, 64), (1, 64), (5, 2), (70, 64), (70, 70), (150, 40), (128, 1)])
def test_patches_round_trip(tmp_path: Path, count: int, at_once: int) -> None:
    """Any number of patches, none included, however many are written at once."""
    rng = np.random.default_rng(count)
    patch_index, origin = np.arange(count, dtype=np.int64)[::-1].copy(), rng.integers(0, 900, (count, 2))
    values, valid = rng.random((count, 8, 8, 15)).astype(np.float32), rng.random((count, 8, 8)) > 0.3
    writer = PatchWriter(
        tmp_path / "p.zarr", patch_index, origin, 8, np.linspace(400, 900, 15), fwhm_nm=np.full(15, 4.0)
    )
    for first in range(0, max(count, 1), at_once):
        writer.write(values[first : first + at_once], valid[first : first + at_once])
    found = open_patches(tmp_path / "p.zarr")
    np.testing.assert_array_equal(found.patch_index, patch_index)
    np.testing.assert_array_equal(found.read(0, count), round_bits(values))
    np.testing.assert_array_equal(found.read(1, 3), round_bits(values)[1:3])
    with xr.open_zarr(tmp_path / "p.zarr", consolidated=False) as data:
        assert data["values"].dims == ("patch", "y", "x", "band")
        assert {"patch_index", "patch_y", "patch_x", "wavelength", "fwhm"} <= set(data.coords)
        np.testing.assert_array_equal(data["valid"].values, valid)
        np.testing.assert_array_equal(np.stack([data["patch_y"], data["patch_x"]], axis=-1), origin)


@pytest.mark.parametrize(("count", "bands", "chunk"), [(70, 1, 64), (70, 270, 8), (6, 900, 3), (7, 900, 1)])
def test_chunks_of_patches_have_up_to_4_mb(tmp_path: Path, count: int, bands: int, chunk: int) -> None:
    """As many patches of 16 x 16 px make a chunk as fit 4 MB and part the file evenly, and one at the least."""
    origin = np.zeros((count, 2), np.int64)
    PatchWriter(tmp_path / "p.zarr", np.arange(count), origin, 16, np.linspace(400, 900, bands))
    chunks = zarr.open_group(tmp_path / "p.zarr", mode="r")["values"].chunks  # type: ignore[union-attr]
    assert chunks == (chunk, 16, 16, bands)


def test_patches_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    """More than there are patches, of another size, or with the validity of others: nothing of them is kept."""
    writer = PatchWriter(tmp_path / "p.zarr", np.arange(70), np.zeros((70, 2), np.int64), 2, np.array([500.0]))
    values, valid = np.zeros((70, 2, 2, 1), np.float32), np.ones((70, 2, 2), bool)
    writer.write(values[:10], valid[:10])
    with pytest.raises(ShapeError, match="patches 10:80"):
        writer.write(values, valid)
    with pytest.raises(ShapeError, match="patches 10:11"):
        writer.write(values[:1, :1], valid[:1, :1])
    with pytest.raises(ShapeError, match="patches 10:12"):
        writer.write(values[:2], valid[:1])
    writer.write(values[10:], valid[10:])
    assert open_patches(tmp_path / "p.zarr").read(0, 70).max() == 0


def test_attention_round_trip(tmp_path: Path) -> None:
    """Scores keep NaN and infinity; ranks keep -1 for what was not chosen."""
    score = np.array([[1.0, np.nan], [np.inf, -np.inf]])
    attention = Attention(score, np.array([[1, -1], [0, -1]], np.int32), "entropy")
    write_attention(tmp_path / "a.zarr", attention)
    found = load_attention(tmp_path / "a.zarr")
    np.testing.assert_array_equal(found.score, score)
    np.testing.assert_array_equal(found.rank, attention.rank)
    assert found.policy == "entropy"
    with xr.open_zarr(tmp_path / "a.zarr", consolidated=False) as data:
        np.testing.assert_array_equal(data["score"].values, score)


def test_a_flipped_bit_is_an_error_and_is_named(archive: Archive) -> None:
    """crc32c stops the reader, here and in plain xarray; verify names the shard."""
    with archive.publish("mosaic", "k") as staged:
        write_mosaic(staged.path / "m.zarr", _mosaic(15))
    ref = archive.refs()[0]
    shard = ref.path / "m.zarr" / "values" / "c" / "0" / "0" / "0"
    content = bytearray(shard.read_bytes())
    content[len(content) // 3] ^= 1
    shard.write_bytes(content)
    with pytest.raises(IncompleteStoreError, match=r"values cannot be read.*run verify"):
        load_mosaic(ref.path / "m.zarr")
    with xr.open_zarr(ref.path / "m.zarr", consolidated=False) as data, pytest.raises(ValueError, match="checksum"):
        data["values"].load()
    with pytest.raises(IncompleteStoreError, match=r"values/c/0/0/0 has changed"):
        check_files(ref.path, hashes=True)


def test_what_is_no_store(tmp_path: Path) -> None:
    """A missing folder and one without the arrays are incomplete stores."""
    with pytest.raises(IncompleteStoreError, match="no readable Zarr store"):
        load_mosaic(tmp_path / "none.zarr")
    write_attention(tmp_path / "a.zarr", Attention(np.zeros((1, 1)), np.zeros((1, 1), np.int32), "x"))
    with pytest.raises(IncompleteStoreError, match="wavelength cannot be read"):
        open_raw_cube(tmp_path / "a.zarr")
