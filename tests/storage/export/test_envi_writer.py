"""ENVI files: bit for bit through this project's reader and through rasterio, in blocks, never a pair that is none."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from pipeline.errors import PoseError, SceneError, ShapeError
from storage.export.envi_writer import EnviFile, header_text, write_envi
from storage.readers.envi_cubes import INTERLEAVES, open_envi_cube

pytestmark = pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")  # odc-geo on affine 3
SHAPE = (70, 13, 5)
WAVE = np.array([444.6096654275093, 550.0, 650.4000000000001, 800.1, 1000 / 3])
WIDTH = np.array([6.0, 5.5, 1 / 3, 7.0, 8.25])
BOX = (500000, 5770000, 500006.5, 5770035)


def numbers(dtype: str) -> NDArray[Any]:
    """Numbers over the whole range of the type, NaN and infinity among those that float."""
    rng, kind = np.random.default_rng(5), np.dtype(dtype)
    found = np.frombuffer(rng.bytes(int(np.prod(SHAPE)) * kind.itemsize), kind).reshape(SHAPE).copy()
    if kind.kind == "f":
        found[0, 0], found[1, 1] = np.nan, np.inf
    return found


def lines_of(values: NDArray[Any], count: int = 32) -> Iterator[tuple[int, NDArray[Any]]]:
    """The cube in blocks of lines."""
    for first in range(0, len(values), count):
        yield first, values[first : first + count]


@pytest.mark.parametrize("interleave", INTERLEAVES)
@pytest.mark.parametrize("dtype", ["<u2", ">u2", "<f4", ">f4", "<f8", "<i2", "|u1"])
def test_numbers_come_back_bit_for_bit(tmp_path: Path, interleave: str, dtype: str) -> None:
    """The project's reader gives the bytes, bands and type that were written, and has nothing to note."""
    values = numbers(dtype)
    data = write_envi(tmp_path / "a.hdr", EnviFile(SHAPE, dtype, interleave, WAVE, WIDTH, "raw {x}"), lines_of(values))
    assert data == tmp_path / "a.img"
    for address in (data, tmp_path / "a.hdr"):
        found = open_envi_cube(address)
        assert np.ascontiguousarray(found.values).tobytes() == values.tobytes()
        assert found.header.dtype == np.dtype(dtype)
        assert (found.header.interleave, found.lost_lines, found.notes) == (interleave, 0, ())
        np.testing.assert_array_equal(found.header.wavelength_nm, WAVE)
        np.testing.assert_array_equal(found.header.fwhm_nm, WIDTH)
        assert found.header.fields["description"] == "raw (x)"


@pytest.mark.parametrize("interleave", ["bil", "bsq"])
@pytest.mark.parametrize(("dtype", "nodata"), [("<u2", None), (">u2", 0.0), ("<f4", float("nan")), ("<f4", -9999.5)])
def test_rasterio_reads_the_same(tmp_path: Path, interleave: str, dtype: str, nodata: float | None) -> None:
    """GDAL's reader agrees on values, bands, nodata and wavelengths."""
    rasterio = pytest.importorskip("rasterio")
    values, box = numbers(dtype), GeoBox.from_bbox(BOX, crs="EPSG:32632", resolution=0.5)
    file = EnviFile(SHAPE, dtype, interleave, WAVE, WIDTH, nodata=nodata, geobox=box)
    with rasterio.open(write_envi(tmp_path / "a.hdr", file, lines_of(values))) as found:
        np.testing.assert_array_equal(np.moveaxis(found.read(), 0, -1), values)
        assert found.count == 5
        assert found.nodata == pytest.approx(nodata, nan_ok=True)
        assert float(found.tags(3)["wavelength"]) == WAVE[2]


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:25832", "EPSG:3035", "EPSG:32733", "EPSG:2056"])
def test_map_info_puts_the_image_where_it_lies(tmp_path: Path, crs: str) -> None:
    """UTM of either half of the earth and other projections: rasterio finds CRS and transform again."""
    rasterio = pytest.importorskip("rasterio")
    box = GeoBox.from_bbox(BOX, crs=crs, resolution=0.5)
    file = EnviFile(SHAPE, "<f4", geobox=box)
    with rasterio.open(write_envi(tmp_path / "a.hdr", file, lines_of(np.zeros(SHAPE, np.float32)))) as found:
        assert found.crs.to_epsg() == int(crs.removeprefix("EPSG:"))
        assert found.transform == box.affine


def test_a_large_cube_is_written_in_little_memory(tmp_path: Path) -> None:
    """Memory follows the block, not the file: 500 lines of 160 kB stay within three blocks of 64."""
    shape = (500, 400, 200)
    block = np.ones((64, *shape[1:]), np.uint16)
    blocks = ((first, block[: min(64, shape[0] - first)]) for first in range(0, shape[0], 64))
    tracemalloc.start()
    data = write_envi(tmp_path / "a.hdr", EnviFile(shape, "<u2"), blocks)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert data.stat().st_size == 2 * int(np.prod(shape))
    assert peak < 3 * block.nbytes


def test_another_order_of_bands_replaces_the_first(tmp_path: Path) -> None:
    """Exported again, a pair has the new order, and no file of the old one stays to be taken for it."""
    values = numbers("<u2")
    for interleave in ("bsq", "bil"):
        write_envi(tmp_path / "a.hdr", EnviFile(SHAPE, "<u2", interleave), lines_of(values))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.hdr", "a.img"]
    np.testing.assert_array_equal(open_envi_cube(tmp_path / "a.hdr").values, values)


def test_a_header_never_stands_beside_other_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed between the two renames, the pair has no header and says so; it does not read wrongly."""
    write_envi(tmp_path / "a.hdr", EnviFile(SHAPE, "<u2", "bsq"), lines_of(numbers("<u2")))
    real = Path.replace

    def killed(self: Path, target: Path) -> Path:
        if self.suffix == ".hdr":
            raise KeyboardInterrupt
        return real(self, target)

    monkeypatch.setattr(Path, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        write_envi(tmp_path / "a.hdr", EnviFile(SHAPE, "<u2", "bil"), lines_of(numbers("<u2")))
    with pytest.raises(SceneError, match="no header beside"):
        open_envi_cube(tmp_path / "a.img")


@pytest.mark.parametrize(
    ("blocks", "words"),
    [
        ([(0, np.zeros((69, 13, 5)))], "69 of 70 lines were given"),
        ([(0, np.zeros((71, 13, 5)))], "do not follow 0"),
        ([(1, np.zeros((69, 13, 5)))], "do not follow 0"),
        ([(0, np.zeros((70, 5, 13)))], "do not follow 0"),
    ],
)
def test_blocks_that_do_not_fill_the_file_leave_nothing(tmp_path: Path, blocks: Any, words: str) -> None:
    """Missing, shifted or turned blocks are refused, and no file is left."""
    with pytest.raises(ShapeError, match=words):
        write_envi(tmp_path / "a.hdr", EnviFile(SHAPE, "<f4"), iter(blocks))
    assert list(tmp_path.iterdir()) == []


def test_what_envi_cannot_say_is_refused() -> None:
    """Types and orders that it has no word for, wavelengths of other bands, and grids without north up or a CRS."""
    with pytest.raises(ShapeError, match="ENVI has no float16"):
        header_text(EnviFile(SHAPE, "<f2"))
    with pytest.raises(ShapeError, match="in order 'bli'"):
        header_text(EnviFile(SHAPE, "<f4", "bli"))
    with pytest.raises(ShapeError, match="wavelength has shape"):
        header_text(EnviFile(SHAPE, "<f4", wavelength_nm=WAVE[:2]))
    box = GeoBox.from_bbox(BOX, crs="EPSG:32632", resolution=0.5)
    for wrong in (box.rotate(10), box.flipy(), GeoBox(box.shape, box.affine, None)):
        with pytest.raises(PoseError, match="north up and a CRS"):
            header_text(EnviFile(SHAPE, "<f4", geobox=wrong))
