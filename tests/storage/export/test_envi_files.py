"""ENVI files are equal bit by bit in this project, Spectral Python (SPy) and rasterio; broken pairs are refused."""

from __future__ import annotations

import random
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.rig.camera.camera_texts import DATA_TYPES, INTERLEAVES
from storage.export.image_files import EnviFile, write_envi
from storage.readers.envi_files import EnviCube, open_envi_cube

pytest.importorskip("spectral", reason="SPy is the oracle: pip install spectral")
envi = pytest.importorskip("spectral.io.envi", reason="SPy is the oracle: pip install spectral")

# SPy warns of ENVI's own keys
pytestmark = pytest.mark.filterwarnings("ignore:Parameters with non-lowercase names")
ORDERS = {"little": "<", "big": ">"}
CODES = sorted(DATA_TYPES)
SHAPE = (6, 7, 5)
NM = [401.25, 402.5, 550.0, 800.125, 999.875]
WIDTHS = [5.5, 5.25, 6.0, 7.125, 8.0]
NAMES = ["blue 1", "blue 2", "green", "edge", "last"]


def numbers(code: int, seed: int = 0) -> NDArray[Any]:
    """Return random numbers over an ENVI type's whole range, (line, sample, band); floats include NaN and infinity."""
    kind = np.dtype(DATA_TYPES[code])
    rng = np.random.default_rng(100 * code + seed)
    if kind.kind in "ui":
        return np.frombuffer(rng.bytes(int(np.prod(SHAPE)) * kind.itemsize), kind).reshape(SHAPE).copy()
    values = rng.normal(0, 1e6, SHAPE) + (1j * rng.normal(0, 1, SHAPE) if kind.kind == "c" else 0)
    values[0, 0], values[1, 1] = np.nan, np.inf
    return values.astype(kind)


def written_by_spy(folder: Path, code: int, interleave: str, order: str, **about: Any) -> tuple[Path, NDArray[Any]]:
    """Return a header that SPy wrote beside a random cube, and the cube."""
    values = numbers(code)
    header = folder / "a.hdr"
    envi.save_image(str(header), values, interleave=interleave, byteorder=order, ext=".img", metadata=about, force=True)
    return header, values


def assert_same(found: EnviCube, values: NDArray[Any], code: int, order: str) -> None:
    """Check that values are equal bit by bit, of the type and byte order asked for, and without lost lines."""
    assert found.header.dtype == np.dtype(ORDERS[order] + DATA_TYPES[code])
    assert np.ascontiguousarray(found.values, values.dtype).tobytes() == values.tobytes()
    assert found.lost_lines == 0


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("interleave", INTERLEAVES)
@pytest.mark.parametrize("code", CODES)
def test_envi_files_of_spy_are_read(tmp_path: Path, code: int, interleave: str, order: str) -> None:
    """Every type, interleave and byte order is read exactly, with and without a header offset."""
    header, values = written_by_spy(tmp_path, code, interleave, order)
    assert_same(open_envi_cube(header), values, code, order)
    shifted(header, 37)
    assert_same(open_envi_cube(header), values, code, order)
    np.testing.assert_array_equal(envi.open(str(header)).open_memmap(interleave="bip"), values)


def shifted(header: Path, offset: int) -> None:
    """Put bytes before the numbers, and state the offset in the header."""
    data = header.with_suffix(".img")
    data.write_bytes(random.Random(1).randbytes(offset) + data.read_bytes())
    header.write_text(header.read_text().replace("header offset = 0", f"header offset = {offset}"))
    assert f"header offset = {offset}" in header.read_text()


@pytest.mark.parametrize("code", CODES)
def test_spy_reads_written_envi_files(tmp_path: Path, code: int) -> None:
    """For every type, SPy and this project read the same numbers, bands and description."""
    values = numbers(code)
    file = EnviFile(SHAPE, DATA_TYPES[code], np.array(NM), np.array(WIDTHS), "two {x}")
    data = write_envi(tmp_path / "a.hdr", file, in_blocks(values))
    assert data == tmp_path / "a.img"
    found = envi.open(str(tmp_path / "a.hdr"))
    np.testing.assert_array_equal(found.open_memmap(interleave="bip"), values)
    assert (found.bands.centers, found.bands.bandwidths) == (NM, WIDTHS)
    assert found.metadata["description"] == "two (x)"
    ours = open_envi_cube(data)
    assert_same(ours, values, code, "little")
    assert (ours.notes, ours.header.fields["description"]) == ((), "two (x)")


def in_blocks(values: NDArray[Any]) -> Iterator[tuple[int, NDArray[Any]]]:
    """Yield four lines, then the rest."""
    yield 0, values[:4]
    yield 4, values[4:]


def test_spy_and_this_project_agree_on_band_metadata(tmp_path: Path) -> None:
    """Both read the same wavelengths, widths and no-data value from a header of SPy."""
    about = {"wavelength": NM, "fwhm": WIDTHS, "wavelength units": "nm", "band names": NAMES, "data ignore value": -7.5}
    header, _ = written_by_spy(tmp_path, 4, "bil", "little", **about)
    ours, theirs = open_envi_cube(header).header, envi.open(str(header))
    assert ours.wavelength_nm.tolist() == theirs.bands.centers == NM
    assert ours.fwhm_nm.tolist() == theirs.bands.bandwidths == WIDTHS
    assert ours.nodata == float(theirs.metadata["data ignore value"]) == -7.5


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
@pytest.mark.parametrize("dtype", ["u2", "f4"])
def test_rasterio_reads_written_envi_files(tmp_path: Path, dtype: str) -> None:
    """GDAL's reader agrees on values, number of bands and wavelengths."""
    code = next(code for code, name in DATA_TYPES.items() if name == dtype)
    values = numbers(code)
    file = EnviFile(SHAPE, dtype, np.array(NM), np.array(WIDTHS))
    with rasterio.open(write_envi(tmp_path / "a.hdr", file, in_blocks(values))) as found:
        np.testing.assert_array_equal(np.moveaxis(found.read(), 0, -1), values)
        assert found.count == 5
        assert float(found.tags(3)["wavelength"]) == NM[2]


def test_a_large_cube_is_written_in_little_memory(tmp_path: Path) -> None:
    """Memory follows the block, not the file: 500 lines of 160 kB need less than three blocks of 64."""
    shape = (500, 400, 200)
    block = np.ones((64, *shape[1:]), np.uint16)
    blocks = ((first, block[: min(64, shape[0] - first)]) for first in range(0, shape[0], 64))
    tracemalloc.start()
    data = write_envi(tmp_path / "a.hdr", EnviFile(shape, "u2"), blocks)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert data.stat().st_size == 2 * int(np.prod(shape))
    assert peak < 3 * block.nbytes


def test_an_interrupted_write_leaves_no_old_header(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process killed between the two renames leaves data without a header, which is refused, never misread."""
    write_envi(tmp_path / "a.hdr", EnviFile(SHAPE, "u2"), in_blocks(numbers(12)))
    real = Path.replace

    def killed(self: Path, target: Path) -> Path:
        if self.suffix == ".hdr":
            raise KeyboardInterrupt
        return real(self, target)

    monkeypatch.setattr(Path, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        write_envi(tmp_path / "a.hdr", EnviFile(SHAPE, "u2"), in_blocks(numbers(12)))
    with pytest.raises(SceneError, match="no header beside"):
        open_envi_cube(tmp_path / "a.img")
